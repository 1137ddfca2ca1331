# SPDX-License-Identifier: MIT
"""Ask a server for its health, once or repeatedly, and judge if it is well."""

import time
from typing import Any

import msgspec
from msgspec import Struct

from tsfusion.core.errors import ServerUnreachable, TransportError
from tsfusion.core.limits import Rates
from tsfusion.core.readable_numbers import count_of
from tsfusion.wire.asking.queries import CommandRefused, fetch_health, fetch_status
from tsfusion.wire.messages.health import Health, MapHealth, Status

READY, NOT_READY = 0, 3  # exit statuses; 1 is for errors, also if no server answers
_RECHECK_INTERVAL = 0.5  # seconds between two checks for a stall
_MIN_TIMEOUT = 0.2  # minimum seconds to wait for a fuser's answer
_OF_KEYFRAMES = frozenset({"durable", "fused", "waiting", "skipped", "refused", "rejected", "quarantined"})


class ServerSnapshot(Struct, frozen=True, kw_only=True):
    """State of a server at one moment."""

    address: str  # address of the server, for the user
    health: Health | None = None  # the gateway's answer; None if it did not answer
    error: str = ""  # why it did not answer
    maps: dict[str, Status] = {}  # map → status of its fuser, if the fuser answered
    unavailable: dict[str, str] = {}  # map → why its fuser's status is not known
    still: dict[str, float] = {}  # map → seconds in which keyframes waited and none was fused
    stalled: dict[str, float] = {}  # the same, only of maps in which this is too long
    rate: float = 0.0  # keyframes a second fused lately; 0 if unknown
    older: dict[str, Status] = {}  # map → last known status of a fuser that is too busy to be asked
    missing: str = ""  # map that was asked for and is not open, if any
    only: str = ""  # map that was asked for; empty for all

    @property
    def problems(self) -> list[str]:
        """Faults of the server, one sentence each; empty if all is well."""
        if self.health is None:
            return [self.error]
        found = [*self.health.problems]
        if self.missing:
            found.append(f"no map {self.missing} is open here, but {', '.join(self.health.maps) or 'none'}")
        for name, seconds in self.stalled.items():
            waiting = count_of(self.health.maps[name].waiting, "keyframe waits", "keyframes wait")
            found.append(f"map {name}: {waiting}, and none was fused for {seconds:.0f} s")
        if not self.health.ready and not found:
            found.append("not ready")
        return found

    @property
    def exit_status(self) -> int:
        """0 if ready; 3 if not ready, or a map is blocked or stalled. Counts the map asked for, or all."""
        assert self.health is not None
        if self.only and not self.missing:
            one = self.health.maps[self.only]
            well = not one.problem and one.state in ("idle", "busy")
        else:
            blocked = any(one.problem for one in self.health.maps.values())
            well = self.health.ready and not blocked and not self.missing
        return READY if well and not self.stalled else NOT_READY

    def as_json(self) -> dict[str, Any]:
        """Return the snapshot as plain values for JSON."""
        fields = {"health": self.health, "maps": self.maps, "unavailable": self.unavailable,
                  "stalled": list(self.stalled), "exit_status": self.exit_status}  # fmt: skip
        plain: dict[str, Any] = msgspec.to_builtins(fields)
        if self.health is not None:
            health = plain["health"]
            health["messages_refused"] = health.pop("refused")
            health["maps"] = {name: _with_units(one) for name, one in health["maps"].items()}
            health["clients"] = [_with_units(one) for one in health["clients"]]
        return plain


def _with_units(counts: dict[str, Any]) -> dict[str, Any]:
    """Return the fields of a map or client, with `keyframes_` before the names of counts of keyframes."""
    return {f"keyframes_{name}" if name in _OF_KEYFRAMES else name: one for name, one in counts.items()}


class ServerWatcher:
    """Takes snapshots of a server, and remembers when each map last fused or rejected a keyframe.

    Args:
        address: the server's data address.
        timeout: seconds to wait for an answer.
        stall_after: a map stalls if keyframes wait and none is fused or rejected for so many seconds.
        only: name of the only map to ask about; empty for all.
        connection: arguments `control` and `keys` of `fetch_health`.
    """

    def __init__(
        self, address: str, *, timeout: float, stall_after: float, only: str = "", **connection: Any
    ) -> None:
        self._address, self._connection = address, connection
        self._timeout, self._stall_after, self._only = timeout, stall_after, only
        self._moved: dict[str, tuple[object, float]] = {}  # map → its last progress, and since when
        self._statuses: dict[str, tuple[object, Status]] = {}  # map → its progress, and its status then
        self._asked = self._well = time.monotonic()
        self._rates = Rates()

    def check_once(self) -> ServerSnapshot:
        """Return a snapshot. If keyframes wait, first wait until one is fused or `stall_after` is over.

        Raises:
            TransportError: when the server does not answer.
        """
        began = {name: self._progress(one) for name, one in self._selected(self._health()).items()}
        while True:
            health = self._health()
            snapshot = self._judge(health)
            waiting = [
                name for name, one in self._selected(health).items()
                if one.waiting and self._progress(one) == began.get(name)
            ]  # fmt: skip
            if not waiting or snapshot.exit_status != READY:
                return self._with_maps(snapshot, health, always=True)
            time.sleep(_RECHECK_INTERVAL)

    def check_again(self) -> ServerSnapshot:
        """Return the next snapshot of many. A busy fuser is not asked.

        Raises:
            TransportError: when the server does not answer.
        """
        health = self._health()
        snapshot = self._with_maps(self._judge(health), health, always=False)
        self._asked = time.monotonic()
        if snapshot.exit_status == READY:
            self._well = self._asked
        return snapshot

    @property
    def unwell(self) -> bool:
        """True if no snapshot in the last `stall_after` seconds was ready, not even the newest."""
        return self._asked - self._well >= self._stall_after

    def _health(self) -> Health:
        wanted = self._only or None  # a map that moved is followed
        return fetch_health(self._address, map_name=wanted, timeout=self._timeout, **self._connection)

    def _selected(self, health: Health) -> dict[str, MapHealth]:
        return {name: one for name, one in health.maps.items() if self._only in ("", name)}

    def _progress(self, one: MapHealth) -> object:
        return one.keyframes_fused, one.rejected

    def _judge(self, health: Health) -> ServerSnapshot:
        now = time.monotonic()
        still = {}
        selected = self._selected(health)
        for name, one in selected.items():
            progress = (health.epoch, self._progress(one))
            before, since = self._moved.get(name, (None, now))
            if before != progress or not one.waiting:
                since = now
            self._moved[name] = (progress, since)
            if one.waiting:
                still[name] = max(now - since, one.fusing_s)  # it may have stalled before the first snapshot
        rate, _ = self._rates(sum(one.keyframes_fused for one in selected.values()), 0)
        missing = self._only if self._only and not selected else ""
        return ServerSnapshot(
            address=self._address, health=health, missing=missing, only=self._only,
            rate=max(rate or 0.0, 0.0),
            still=still, stalled={name: one for name, one in still.items() if one >= self._stall_after},
        )  # fmt: skip

    def _with_maps(self, snapshot: ServerSnapshot, health: Health, *, always: bool) -> ServerSnapshot:
        deadline = time.monotonic() + self._timeout
        maps, unavailable = {}, {}
        older: dict[str, Status] = {}
        for name, one in self._selected(health).items():
            version = (health.epoch, one.keyframes_durable, one.keyframes_fused)
            known, status = self._statuses.get(name, (None, None))
            if known != version or status is None:
                if one.waiting and not always:
                    older |= {name: status} if status is not None else {}
                    continue
                timeout = max(deadline - time.monotonic(), _MIN_TIMEOUT)
                try:
                    status = fetch_status(self._address, map_name=name, timeout=timeout, **self._connection)
                except ServerUnreachable:
                    unavailable[name] = f"its fuser did not answer within {timeout:.1f} s"
                    continue
                except TransportError as error:
                    unavailable[name] = error.reason if isinstance(error, CommandRefused) else str(error)
                    continue
            self._statuses[name] = (version, status)
            maps[name] = status
        return msgspec.structs.replace(snapshot, maps=maps, unavailable=unavailable, older=older)
