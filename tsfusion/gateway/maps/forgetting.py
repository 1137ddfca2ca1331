# SPDX-License-Identifier: MIT
"""Handle requests to forget keyframes of a map: find them, journal their removal and, if wanted, erase them.

The index of records has the keyframes of a selection; the fuser knows which lie in its box. A record that
removes them is journaled like any other, so every later fuser leaves them out. Before they are erased, the
map and its checkpoints must have let them go: to subtract a keyframe from the map, the fuser needs its record
in the journal.
"""

import logging
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tsfusion.core import logs
from tsfusion.core.errors import JournalError
from tsfusion.core.number_ranges import NumberRanges
from tsfusion.core.readable_numbers import count_of
from tsfusion.fuser import fuser_messages
from tsfusion.fuser.fuser_messages import EXPIRED, Found, FoundKeyframes, Saved
from tsfusion.gateway.maps import moved_maps
from tsfusion.gateway.maps.map_records import MapRecords
from tsfusion.journal import Position
from tsfusion.wire.messages.forget_messages import Forgotten, ForgottenSession, Selection
from tsfusion.wire.records.corrections import MAX_KEYFRAMES

log = logging.getLogger(__name__)

MOST_REQUESTS = 8  # requests that can wait
_STEP_S = 0.1  # seconds of erasing in a step
_LEFT_FILES = ("*.damaged*", "journal/*.replaced", "journal/*.damaged*")

Send = Callable[[fuser_messages.ToFuser], bool]
Append = Callable[[bytes, NDArray[np.int64]], None]
OnAnswer = Callable[[Forgotten | str], None]
_Stage = Literal["ask", "find", "leave", "save", "erase"]


class ForgetRequest:
    """Request to forget keyframes of a map, and its progress."""

    def __init__(
        self, selection: Selection, on_answer: OnAnswer, *, erase: bool = False, dry_run: bool = False
    ) -> None:
        self.selection, self.on_answer = selection, on_answer
        self.erase, self.dry_run = erase, dry_run
        self.stage: _Stage = "ask"
        self.found = Found(0)
        self.unavailable = 0  # keyframes that corrections could not move before the request
        self.erasing: Iterator[int] | None = None
        self.erased = self.quarantined = 0

    @property
    def positions(self) -> Iterator[Position]:
        """Positions of the records found for this."""
        return (place for one in self.found.sessions for place in one.positions)

    def is_answered(self, in_map: Callable[[bytes], int]) -> bool:
        """True if the fuser has applied every record found for this. `in_map`: see `Forgetting.step`."""
        return all(in_map(one.session) >= one.columns[0].max(initial=0) for one in self.found.sessions)


class Forgetting:
    """Queue of one map's requests to forget, handled one after another. Call `step` again and again.

    Args:
        append: journals the record that removes keyframes of a session.
        send: passes a message to the fuser; returns False if the fuser's queue is full.
    """

    def __init__(self, name: str, records: MapRecords, *, append: Append, send: Send) -> None:
        self._name, self._records = name, records
        self._append, self._send = append, send
        self._requests: deque[ForgetRequest] = deque()
        self._number = 0

    @property
    def is_idle(self) -> bool:
        return not self._requests

    def add(self, request: ForgetRequest) -> None:
        """Add a request to the queue. If too many wait, refuse it at once."""
        if len(self._requests) >= MOST_REQUESTS:
            request.on_answer("too many requests to forget wait: ask again")
        else:
            self._requests.append(request)

    def give_up(self, why: str) -> None:
        """Answer every request in the queue with the reason `why` it fails."""
        while self._requests:
            self._answer(why)

    def on_ready(self) -> None:
        """Repeat the question of the first request to a new fuser, which does not know the old one's."""
        if self._requests:
            request = self._requests[0]
            request.stage = {"find": "ask", "save": "leave"}.get(request.stage, request.stage)  # type: ignore[assignment]

    def step(self, *, is_server_answered: bool, in_map: Callable[[bytes], int], unavailable: int) -> None:
        """Do the next step of the first request: ask the fuser, order a checkpoint, or erase a while.

        Args:
            is_server_answered: True if the map has applied all of the server's own records.
            in_map: returns the highest number of a session that the fuser has answered. Records after it are
                not erased: after a crash they would be missing, and count as lost.
            unavailable: number of keyframes that should leave or move, but stay where they were fused.
        """
        if not self._requests:
            return
        request = self._requests[0]
        if request.stage == "ask":
            self._number += 1
            request.unavailable = unavailable
            records = self._records
            if self._send(records.index.select(self._number, request.selection, records.sessions)):
                request.stage = "find"
        elif request.stage == "leave" and is_server_answered and request.is_answered(in_map):
            if unavailable > request.unavailable:
                count = count_of(unavailable - request.unavailable, "keyframe")
                stay = f"{count} cannot be taken out of the map: the log says why"
                self._answer(f"{stay}; all that were selected are forgotten, and nothing was erased")
            elif self._send(fuser_messages.Save(alone=True)):
                request.stage = "save"
        elif request.stage == "erase":
            self._go_on_erasing(request)

    # --- answers of the fuser ---

    def on_found(self, found: Found) -> None:
        """Journal the removal of the keyframes that the fuser found, for a request or the map's window."""
        if found.number == EXPIRED:
            with suppress(JournalError):  # the fuser finds them again once the disk takes records
                self._remove(found)
            return
        if not self._requests or found.number != self._number or self._requests[0].stage != "find":
            return  # asked before the fuser died
        request = self._requests[0]
        request.found = found
        if found.error or request.dry_run:
            self._answer(found.error or self._result(request))
            return
        try:
            self._remove(found)
        except JournalError as error:
            self._answer(f"nothing was forgotten: {error}")
            return
        self._log(request)
        if request.erase:
            request.stage = "leave"
        else:
            self._answer(self._result(request))

    def on_saved(self, saved: Saved) -> None:
        """Handle the result of the checkpoint without the keyframes. Start to erase after a success."""
        if not saved.alone or not self._requests or self._requests[0].stage != "save":
            return
        request = self._requests[0]
        if saved.problem:
            self._answer(f"nothing was erased: {saved.problem}")
            return
        # Before the records: after a crash, the same request finds records that are left, and goes on.
        request.quarantined = sum(
            self._records.quarantine.drop(session.session, _numbers(session))
            for session in request.found.sessions
        )
        request.erasing = self._records.journal.erase(request.positions)
        request.stage = "erase"

    def _remove(self, found: Found) -> None:
        for session in found.sessions:
            for start in range(0, len(session.new), MAX_KEYFRAMES):
                self._append(session.session, session.new[start : start + MAX_KEYFRAMES])

    # --- erasing ---

    def _go_on_erasing(self, request: ForgetRequest) -> None:
        assert request.erasing is not None
        until = time.monotonic() + _STEP_S
        try:
            for erased in request.erasing:
                request.erased = erased
                if time.monotonic() >= until:
                    return
        except JournalError as error:
            self._answer(f"only {request.erased} records were erased: {error}")
            return
        self._records.index.set_erased(request.positions)
        self._answer(self._result(request))

    def _result(self, request: ForgetRequest) -> Forgotten:
        return Forgotten(
            sessions=tuple(_described(one) for one in request.found.sessions),
            erased=request.erased,
            quarantined=request.quarantined,
            remains=tuple(self._left_files()) if request.erase else (),
            unavailable=request.found.unavailable,
        )

    def _left_files(self) -> Iterator[str]:
        """Yield files that may hold bytes of any keyframe of the map, and that this server never deletes."""
        for pattern in _LEFT_FILES:
            yield from (str(path) for path in sorted(self._records.folder.glob(pattern)))
        yield from map(str, moved_maps.left_behind(self._records.folder))

    def _log(self, request: ForgetRequest) -> None:
        for one in map(_described, request.found.sessions):
            log.info(
                "%s are forgotten%s: %s",
                count_of(one.keyframes, "keyframe"),
                " and will be erased" if request.erase else "",
                one.numbers,
                extra=logs.about(map=self._name, session=bytes.fromhex(one.session), client=one.client),
            )

    def _answer(self, answer: Forgotten | str) -> None:
        self._requests.popleft().on_answer(answer)


def _numbers(session: FoundKeyframes) -> NumberRanges:
    numbers = NumberRanges()
    numbers.add(session.columns[0])
    return numbers


def _described(session: FoundKeyframes) -> ForgottenSession:
    return ForgottenSession(
        session=session.session.hex(),
        client=session.client,
        keyframes=len(session.new),
        selected=tuple(_numbers(session)),
    )
