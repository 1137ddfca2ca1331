# SPDX-License-Identifier: MIT
"""Asking a server how it is, once or again and again, and judging what it says."""

import time
from collections.abc import Callable
from typing import Any

import msgspec
from msgspec import Struct

from tsfusion.core.errors import ServerUnreachable, TransportError
from tsfusion.wire.health import Health, MapHealth, Status
from tsfusion.wire.messages import Command, Reply
from tsfusion.wire.queries import CommandRefused

READY, NOT_READY = 0, 3  # exit statuses; 1 is every error's, also that nobody answers
_AGAIN = 0.5  # seconds between the looks that tell a stall from a pause
_MIN_WAIT = 0.2  # seconds; of a fuser's answer

Ask = Callable[[Command, float], Reply]  # a command and seconds to wait for its answer


class Look(Struct, frozen=True, kw_only=True):
    """What was seen of a server at one moment.

    Attributes:
        health: None = it did not answer, and `error` says how.
        maps: what their fusers told; a map that is in `unavailable` instead could not say, and why.
        stalled: maps where keyframes wait and nothing is fused, and for how many seconds.
        missing: the map that was asked for and is not open; empty = it is, or none was asked for.
    """

    address: str
    health: Health | None = None
    error: str = ""
    maps: dict[str, Status] = {}
    unavailable: dict[str, str] = {}
    stalled: dict[str, float] = {}
    missing: str = ""
    only: str = ""

    @property
    def problems(self) -> list[str]:
        """What is wrong, a line each; empty = all is well."""
        if self.health is None:
            return [self.error]
        found = [*self.health.problems]
        if self.missing:
            found.append(f"no map {self.missing} is open here, but {', '.join(self.health.maps) or 'none'}")
        for name, seconds in self.stalled.items():
            waiting = self.health.maps[name].waiting
            found.append(f"map {name}: {waiting} keyframes wait, and none was fused for {seconds:.0f} s")
        if not self.health.ready and not found:
            found.append("not ready")
        return found

    @property
    def exit_status(self) -> int:
        """0 = ready; 3 = it answers, but is not, or a map is stalled. Of one map, if one was asked for."""
        assert self.health is not None
        if self.only and not self.missing:
            one = self.health.maps[self.only]
            well = not one.problem and one.state in ("idle", "busy")
        else:
            well = self.health.ready and not self.missing
        return READY if well and not self.stalled else NOT_READY

    def as_json(self) -> dict[str, Any]:
        """For a program."""
        shown = {"health": self.health, "maps": self.maps, "unavailable": self.unavailable,
                 "stalled": list(self.stalled), "exit_status": self.exit_status}  # fmt: skip
        return msgspec.to_builtins(shown)  # type: ignore[no-any-return]


class Watcher:
    """Remembers from look to look when each map last moved.

    Args:
        address: of the server, to be shown.
        ask: answers a command, or raises TransportError.
        only: one map's name; empty = all.
        stall_after: seconds without a keyframe fused, while some wait, that make a stall.
    """

    def __init__(self, address: str, ask: Ask, *, timeout: float, stall_after: float, only: str = "") -> None:
        self._address, self._ask, self._timeout = address, ask, timeout
        self._stall_after, self._only = stall_after, only
        self._moved: dict[str, tuple[object, float]] = {}  # map → how far it was, since when
        self._told: dict[str, tuple[object, Status]] = {}
        self._well = time.monotonic()

    def once(self) -> Look:
        """A look; where keyframes wait, it takes until one is fused or `stall_after` is over.

        Raises:
            TransportError: when the server does not answer.
        """
        began = {name: self._progress(one) for name, one in self._selected(self._health()).items()}
        while True:
            look = self._judged(self._health())
            assert look.health is not None
            waiting = [
                name for name, one in self._selected(look.health).items()
                if one.waiting and self._progress(one) == began.get(name)
            ]  # fmt: skip
            if not waiting or look.exit_status != READY:
                return self._with_maps(look, always=True)
            time.sleep(_AGAIN)

    def again(self) -> Look:
        """The next look of many: a fuser is asked only when it has nothing else to do.

        Raises:
            TransportError: when the server does not answer.
        """
        look = self._with_maps(self._judged(self._health()), always=False)
        if look.exit_status == READY:
            self._well = time.monotonic()
        return look

    @property
    def unwell(self) -> bool:
        """Whether `again` has seen nothing good for `stall_after` seconds, or a stall."""
        return time.monotonic() - self._well >= self._stall_after

    def _health(self) -> Health:
        reply = self._ask(Command(name="health"), self._timeout)
        if reply.health is None:
            raise TransportError(f"the server at {self._address} does not tell its health: is it older?")
        return reply.health

    def _selected(self, health: Health) -> dict[str, MapHealth]:
        return {name: one for name, one in health.maps.items() if self._only in ("", name)}

    def _progress(self, one: MapHealth) -> object:
        return one.keyframes_fused, one.rejected

    def _judged(self, health: Health) -> Look:
        now = time.monotonic()
        stalled = {}
        selected = self._selected(health)
        for name, one in selected.items():
            progress = (health.epoch, self._progress(one))
            before, since = self._moved.get(name, (None, now))
            if before != progress or not one.waiting:
                since = now
            self._moved[name] = (progress, since)
            if one.waiting and now - since >= self._stall_after:
                stalled[name] = now - since
        missing = self._only if self._only and not selected else ""
        return Look(
            address=self._address, health=health, stalled=stalled, missing=missing, only=self._only
        )  # fmt: skip

    def _with_maps(self, look: Look, *, always: bool) -> Look:
        assert look.health is not None
        deadline = time.monotonic() + self._timeout
        maps, unavailable = {}, {}
        for name, one in self._selected(look.health).items():
            version = (look.health.epoch, one.keyframes_durable, one.keyframes_fused)
            told, status = self._told.get(name, (None, None))
            if told != version or status is None:
                if one.waiting and not always:
                    continue
                wait = max(deadline - time.monotonic(), _MIN_WAIT)
                try:
                    status = self._ask(Command(name="status", map=name), wait).status
                except ServerUnreachable:
                    unavailable[name] = f"its fuser did not answer within {wait:.1f} s"
                    continue
                except TransportError as error:
                    unavailable[name] = error.reason if isinstance(error, CommandRefused) else str(error)
                    continue
            if status is not None:
                self._told[name] = (version, status)
                maps[name] = status
        return msgspec.structs.replace(look, maps=maps, unavailable=unavailable)
