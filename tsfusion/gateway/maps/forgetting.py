# SPDX-License-Identifier: MIT
"""Requests to forget keyframes of one map: found, written to the journal, and if wanted erased.

The fuser finds the keyframes of a selection. A record that removes them is journaled like any other, so that
every fuser, at any time, leaves them out. To erase them, the map must have let them go first, and so must
its checkpoints: a keyframe is subtracted from the map by what the journal holds of it.
"""

import logging
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tsfusion.core import logs
from tsfusion.core.errors import JournalError
from tsfusion.core.number_ranges import NumberRanges
from tsfusion.core.readable_numbers import count_of
from tsfusion.fuser import fuser_messages
from tsfusion.fuser.fuser_messages import EXPIRED, Find, Found, FoundKeyframes, Saved
from tsfusion.gateway.maps import moved_maps
from tsfusion.journal import Journal, Position
from tsfusion.journal.quarantine import Quarantine
from tsfusion.wire.messages.forget_messages import Forgotten, ForgottenSession, Selection
from tsfusion.wire.records.corrections import MAX_KEYFRAMES

log = logging.getLogger(__name__)

MOST_REQUESTS = 8  # that wait
_STEP_S = 0.1  # seconds of erasing in a step
_LEFT_FILES = ("*.damaged*", "journal/*.replaced", "journal/*.damaged*")

Send = Callable[[fuser_messages.ToFuser], bool]
Append = Callable[[bytes, NDArray[np.int64]], None]
OnAnswer = Callable[[Forgotten | str], None]
_Stage = Literal["ask", "find", "leave", "save", "erase"]


class ForgetRequest:
    """One request, and how far it is."""

    def __init__(
        self, selection: Selection, on_answer: OnAnswer, *, erase: bool = False, dry_run: bool = False
    ) -> None:
        self.selection, self.on_answer = selection, on_answer
        self.erase, self.dry_run = erase, dry_run
        self.stage: _Stage = "ask"
        self.found = Found(0)
        self.unavailable = 0  # keyframes that corrections could not move, before
        self.erasing: Iterator[int] | None = None
        self.erased = self.quarantined = 0

    def is_answered(self, in_map: Callable[[bytes], int]) -> bool:
        """True if the fuser has answered every record that was found; `in_map` as of `Forgetting.step`."""
        return all(
            in_map(one.session) >= max(np.frombuffer(one.seqs, np.int64), default=0)
            for one in self.found.sessions
        )


class Forgetting:
    """The requests of one map, one after another. Call `step` again and again.

    Args:
        append: journals the record that removes keyframes of a session.
        send: passes a message to the fuser; False when it cannot take one now.
    """

    def __init__(
        self, name: str, folder: Path, journal: Journal, quarantine: Quarantine, *, append: Append, send: Send
    ) -> None:
        self._name, self._folder = name, folder
        self._journal, self._quarantine = journal, quarantine
        self._append, self._send = append, send
        self._requests: deque[ForgetRequest] = deque()
        self._number = 0

    @property
    def is_idle(self) -> bool:
        return not self._requests

    def add(self, request: ForgetRequest) -> None:
        """Take a request; it is answered at once when too many wait."""
        if len(self._requests) >= MOST_REQUESTS:
            request.on_answer("too many requests to forget wait: ask again")
        else:
            self._requests.append(request)

    def give_up(self, why: str) -> None:
        """Answer every request with a reason."""
        while self._requests:
            self._answer(why)

    def on_ready(self) -> None:
        """Begin again with a new fuser: it knows nothing of what the one before was asked."""
        if self._requests:
            request = self._requests[0]
            request.stage = {"find": "ask", "save": "leave"}.get(request.stage, request.stage)  # type: ignore[assignment]

    def step(self, *, is_server_answered: bool, in_map: Callable[[bytes], int], unavailable: int) -> None:
        """Do the next piece of work of the first request.

        Args:
            is_server_answered: whether the map has done all that the server's own records ask.
            in_map: the highest number of a session that the fuser has answered. What it has not cannot be
                erased: after a crash nobody would hand it out, and it would count as lost.
            unavailable: keyframes that stay where they were fused though they should not.
        """
        if not self._requests:
            return
        request = self._requests[0]
        if request.stage == "ask":
            self._number += 1
            request.unavailable = unavailable
            if self._send(Find(self._number, request.selection)):
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
        """Take the keyframes that the fuser found, or those that are too old or too far away."""
        if found.number == EXPIRED:
            with suppress(JournalError):  # they are found again, when the disk takes records
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
        """Note that a checkpoint without the keyframes was written, or why not."""
        if not saved.alone or not self._requests or self._requests[0].stage != "save":
            return
        request = self._requests[0]
        if saved.problem:
            self._answer(f"nothing was erased: {saved.problem}")
            return
        # Before the records: while one of them is left, the same request finds it after a crash, and goes on.
        request.quarantined = sum(
            self._quarantine.drop(session.session, NumberRanges(_ranges(session)))
            for session in request.found.sessions
        )
        positions = [one for session in request.found.sessions for one in _positions(session)]
        request.erasing = self._journal.erase(positions)
        request.stage = "erase"

    def _remove(self, found: Found) -> None:
        for session in found.sessions:
            seqs = np.frombuffer(session.seqs, np.int64)
            new = np.unique(seqs[~np.frombuffer(session.forgotten, np.bool_)])
            for start in range(0, len(new), MAX_KEYFRAMES):
                self._append(session.session, new[start : start + MAX_KEYFRAMES])

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
        """Files of the map that may hold something of any keyframe, and that nothing deletes."""
        for pattern in _LEFT_FILES:
            yield from (str(path) for path in sorted(self._folder.glob(pattern)))
        yield from map(str, moved_maps.left_behind(self._folder))

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


def _positions(session: FoundKeyframes) -> Iterator[Position]:
    segments, offsets = np.frombuffer(session.segments, np.int64), np.frombuffer(session.offsets, np.int64)
    return (Position(*place) for place in zip(segments.tolist(), offsets.tolist(), strict=True))


def _ranges(session: FoundKeyframes) -> tuple[tuple[int, int], ...]:
    ranges = NumberRanges()
    ranges.add(np.frombuffer(session.seqs, np.int64))
    return tuple(ranges)


def _described(session: FoundKeyframes) -> ForgottenSession:
    seqs = np.frombuffer(session.seqs, np.int64)
    new = seqs[~np.frombuffer(session.forgotten, np.bool_)]
    return ForgottenSession(
        session=session.session.hex(),
        client=session.client,
        keyframes=len(np.unique(new)),
        selected=_ranges(session),
    )
