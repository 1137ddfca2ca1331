# SPDX-License-Identifier: MIT
"""Find the keyframes of a selection in a map's journal, a part at a time: others are fused between."""

import time
from array import array
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tsfusion import journal
from tsfusion.core.config import SERVER_SESSION
from tsfusion.core.errors import DecodeError, InvalidConfig, InvalidKeyframe, JournalError
from tsfusion.fuser.messages import Find, Found, FoundKeyframes, SessionProgress
from tsfusion.geometry.keyframe import points_world
from tsfusion.journal import Record, state_folder
from tsfusion.journal.keyframe_poses import KeyframePoses
from tsfusion.wire import codec
from tsfusion.wire.forgetting import Selection

_SLICE_S = 0.05  # seconds at a time
_REST_S = 0.15  # between two slices while keyframes come
_INSIDE = 0.9  # share of a keyframe's points: noise, or a look out of a window, is not to keep it


class KeyframeSearch:
    """One search. Call `go_on` when `wait` is over, until it gives the answer.

    Args:
        folder: the map's.
        done: how far the map is with each session.
    """

    def __init__(
        self, find: Find, folder: Path, poses: KeyframePoses, done: dict[bytes, SessionProgress]
    ) -> None:
        self._find, self._poses, self._done = find, poses, done
        self._place = state_folder.JournalPlace(folder / state_folder.JOURNAL_FOLDER)
        self._selected: dict[bytes, _Columns] = {}
        self._steps = self._search(find.selection)
        self._next = 0.0  # time.monotonic()
        self._since_ns: int | None = None
        self._first_ns: int | None = None  # of the first record in the journal

    def wait(self, idle: bool) -> float:
        """Seconds until it is time to go on."""
        return 0.0 if idle else max(self._next - time.monotonic(), 0.0)

    def go_on(self) -> Found | None:
        """Search for a while; the answer when all was looked at."""
        until = time.monotonic() + _SLICE_S
        try:
            for _ in self._steps:
                if time.monotonic() >= until:
                    self._next = time.monotonic() + _REST_S
                    return None
            return self._found()
        except (JournalError, InvalidConfig) as error:
            return Found(self._find.number, error=str(error))

    def _search(self, selection: Selection) -> Iterator[None]:
        if selection.counts_from_end:
            selection = selection.at_end(self._last_logged_ns())
        for _, step in self._place.steps():
            if isinstance(step, Record) and self._first_ns is None:
                self._first_ns = step.logged_ns
                self._since_ns = selection.since_ns
            if isinstance(step, Record) and not step.is_correction and self._is_selected(selection, step):
                self._selected.setdefault(step.session, _Columns(step.client)).add(
                    step, self._poses.is_forgotten(step.session, step.seq)
                )
            yield

    def _last_logged_ns(self) -> int:
        for path in reversed(self._place.files()):
            found = [record for record in journal.records(path) if record.session != SERVER_SESSION]
            if found:
                return max(record.logged_ns for record in found)
        return 0

    def _is_selected(self, selection: Selection, record: Record) -> bool:
        return selection.has(
            session=record.session, client=record.client, seq=record.seq, logged_ns=record.logged_ns
        ) and (selection.box is None or self._lies_in(np.array(selection.box).reshape(2, 3), record))

    def _lies_in(self, corners: NDArray[np.float64], record: Record) -> bool:
        """True if the sensor was in the box, and so is nearly all that it measured."""
        low, high = corners.min(axis=0), corners.max(axis=0)
        try:
            keyframe = codec.decode_keyframe(record.frames)
            pose = self._poses.pose_of(record.session, record.seq)
            placed = self._poses.placed(record.session, keyframe)
            placed = placed if pose is None else replace(placed, T_world_camera=pose)
        except (DecodeError, InvalidKeyframe):  # the map has no such keyframe
            return False
        eye = placed.T_world_camera[:3, 3]
        if not ((eye >= low) & (eye <= high)).all():
            return False
        points = points_world(placed)
        points = points[np.isfinite(points).all(axis=1)]
        inside = ((points >= low) & (points <= high)).all(axis=1)
        return not len(inside) or bool(inside.mean() >= _INSIDE)

    def _found(self) -> Found:
        if self._find.selection.numbers is not None and len(self._selected) > 1:
            names = ", ".join(key.hex()[:8] for key in self._selected)
            raise InvalidConfig(
                f"several sessions have keyframes of these numbers: {names}; name one of them"
            )
        if self._find.selection.session and len(self._selected) > 1:
            names = ", ".join(key.hex() for key in self._selected)
            raise InvalidConfig(f"several sessions begin with {self._find.selection.session}: {names}")
        sessions = tuple(columns.found(key) for key, columns in self._selected.items())
        return Found(self._find.number, sessions, tuple(self._unavailable()))

    def _unavailable(self) -> Iterator[str]:
        """The sessions that may have selected keyframes in the map which the journal has no more."""
        if self._first_ns is not None and self._since_ns is not None and self._since_ns >= self._first_ns:
            return  # those came before
        for key, seq in self._poses.unknown():
            if key == SERVER_SESSION:
                continue
            client = self._done[key].client if key in self._done else ""
            own = self._find.selection
            first = min((one for one, _ in own.numbers), default=1) if own.numbers is not None else 1
            if key.hex().startswith(own.session) and own.client in (None, client) and first <= seq:
                yield f"{key.hex()[:8]} up to number {seq}"


class _Columns:
    """The selected keyframes of one session."""

    def __init__(self, client: str) -> None:
        self._client = client
        self._seqs, self._segments, self._offsets = array("q"), array("q"), array("q")
        self._forgotten = array("b")

    def add(self, record: Record, is_forgotten: bool) -> None:
        self._seqs.append(record.seq)
        self._segments.append(record.position.segment)
        self._offsets.append(record.position.offset)
        self._forgotten.append(is_forgotten)

    def found(self, session: bytes) -> FoundKeyframes:
        columns = (self._seqs, self._segments, self._offsets, self._forgotten)
        return FoundKeyframes(session, self._client, *(column.tobytes() for column in columns))
