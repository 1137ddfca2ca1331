# SPDX-License-Identifier: MIT
"""Find the keyframes that must leave a map: those that a command selects, and those outside its window.

Both searches run a slice at a time, so that keyframes are fused in between.
"""

import time
from array import array
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion import journal
from tsfusion.core.config import SERVER_SESSION
from tsfusion.core.errors import DecodeError, InvalidConfig, InvalidKeyframe, JournalError
from tsfusion.fuser import fuser_messages
from tsfusion.fuser.fuser_messages import EXPIRED, Begin, Expire, Find, Found, FoundKeyframes, SessionProgress
from tsfusion.geometry.keyframe import points_world
from tsfusion.geometry.keyframe_rows import KeyframeRows
from tsfusion.journal import Position, Record, state_folder
from tsfusion.journal.ledger import Ledger
from tsfusion.wire.messages.forget_messages import Selection
from tsfusion.wire.records import codec

_SLICE_S = 0.05  # seconds at a time
_REST_S = 0.15  # between two slices while keyframes come
_INSIDE = 0.9  # share of a keyframe's points in the box: noise or a view out of a window is tolerated


class KeyframeSearch:
    """Search for selected keyframes in the journal. Call `go_on` after `wait` seconds until it answers."""

    def __init__(self, find: Find, folder: Path, ledger: Ledger, done: dict[bytes, SessionProgress]) -> None:
        self._find, self._ledger, self._done = find, ledger, done
        self._place = state_folder.JournalPlace(folder / state_folder.JOURNAL_FOLDER)
        self._selected: dict[bytes, tuple[str, array[int]]] = {}  # client and `FoundKeyframes.rows`
        self._steps = self._search(find.selection)
        self._next = 0.0  # time.monotonic()
        self._since_ns: int | None = None
        self._first_ns: int | None = None  # of the first record in the journal

    def wait(self, idle: bool) -> float:
        """Return the seconds until the next `go_on`."""
        return 0.0 if idle else max(self._next - time.monotonic(), 0.0)

    def go_on(self) -> Found | None:
        """Search a part of the journal. Return the result once the whole journal is searched, before None."""
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
                _, rows = self._selected.setdefault(step.session, (step.client, array("q")))
                is_forgotten = self._ledger.is_forgotten(step.session, step.seq)
                rows.extend((step.seq, step.position.segment, step.position.offset, is_forgotten))
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
        """Return True if the sensor is in the box, and so are nearly all its measured points."""
        low, high = corners.min(axis=0), corners.max(axis=0)
        try:
            keyframe = codec.decode_keyframe(record.frames)
            pose = self._ledger.pose_of(record.session, record.seq)
            placed = self._ledger.placed(record.session, keyframe)
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
        found = [FoundKeyframes(key, name, rows.tobytes()) for key, (name, rows) in self._selected.items()]
        return Found(self._find.number, tuple(found), tuple(self._unavailable()))

    def _unavailable(self) -> Iterator[str]:
        """Yield sessions whose selected keyframes may be in the map but no longer in the journal."""
        if self._first_ns is not None and self._since_ns is not None and self._since_ns >= self._first_ns:
            return  # those keyframes came before `since`
        for key, seq in self._ledger.unknown():
            if key == SERVER_SESSION:
                continue
            client = self._done[key].client if key in self._done else ""
            own = self._find.selection
            first = min((one for one, _ in own.numbers), default=1) if own.numbers is not None else 1
            if key.hex().startswith(own.session) and own.client in (None, client) and first <= seq:
                yield f"{key.hex()[:8]} up to number {seq}"


_INTERVAL_S = 0.5  # between two looks while keyframes come: each may write a record to the journal
_PATIENCE_S = 5.0  # for that record to come back


class KeepWindow:
    """Bounds on the keyframes that a map keeps: age, number and distance, relative to the newest keyframe.

    Call `look` when `wait` is over: it sends the gateway the keyframes beyond a bound. The gateway writes a
    record that removes them, as for `tsfusion map forget`. The window's size bounds the cost.

    Args:
        seconds: largest age of a keyframe, by arrival at the server, relative to the newest; None = no bound.
        keyframes: largest number of keyframes, of all sessions together; None = no bound.
        radius: largest distance between sensor positions, metres; None = no bound.
    """

    def __init__(
        self,
        ledger: Ledger,
        folder: Path,
        *,
        seconds: float | None,
        keyframes: int | None,
        radius: float | None,
        send: Callable[[Found], None],
    ) -> None:
        self._ledger, self._folder, self._send = ledger, folder, send
        self._seconds, self._keyframes, self._radius = seconds, keyframes, radius
        self._before_segment = 0
        self._is_behind = self.is_set
        self._next = 0.0  # time.monotonic()
        self._asked: float | None = None  # time.monotonic() of the request; None once its record has come

    @property
    def is_set(self) -> bool:
        """True if the map has at least one bound."""
        return (self._seconds, self._keyframes, self._radius) != (None, None, None)

    @property
    def is_behind(self) -> bool:
        """True if keyframes entered the map since the last `look`, so that others may be out of bounds."""
        return self._is_behind

    def note_keyframe(self) -> None:
        """Record that a keyframe entered the map or moved, so that `look` is due."""
        self._is_behind = self.is_set

    def note_record(self) -> None:
        """Record that a record that removes keyframes came, as `look` had asked for."""
        self._asked = None

    def expire(self, before_segment: int) -> None:
        """Remove keyframes of segments below this number: the journal, at its limit, will delete them."""
        self._before_segment = max(before_segment, self._before_segment)
        self._is_behind = self.is_set

    def wait(self, idle: bool) -> float | None:
        """Return the seconds until the next `look`; None if no keyframe has arrived since the last one."""
        if not self._is_behind:
            return None
        from_s = [0.0 if idle else self._next, 0.0 if self._asked is None else self._asked + _PATIENCE_S]
        return max(max(from_s) - time.monotonic(), 0.0)

    def look(self) -> None:
        """Send the gateway the keyframes that are beyond a bound."""
        self._is_behind = False
        self._next = time.monotonic() + _INTERVAL_S
        kept = self._ledger.kept().in_order()
        beyond = kept[self._beyond(kept)]
        if not len(beyond):
            return
        self._asked = time.monotonic()
        found = [
            FoundKeyframes(
                session,
                "",
                np.pad(rows.seqs[:, None], ((0, 0), (0, 3))).tobytes(),
            )
            for session, rows in beyond.by_session()
        ]
        self._send(Found(EXPIRED, tuple(found)))

    def _beyond(self, kept: KeyframeRows) -> NDArray[np.bool_]:
        """Return an (n,) mask of keyframes beyond a bound; `kept` are the map's, in journal order."""
        beyond = kept.segments < self._before_segment
        if self._keyframes is not None:
            beyond[: -self._keyframes] = True
        if self._radius is not None:
            centers = kept.poses[:, 3::4]
            beyond |= ~(np.linalg.norm(centers - centers[-1:], axis=1) <= self._radius)
        if self._seconds is not None:
            beyond[: self._count_older(kept, self._seconds)] = True
        return beyond

    def _count_older(self, kept: KeyframeRows, seconds: float) -> int:
        """Return how many keyframes are `seconds` older than the newest, by binary search."""
        newest = self._logged_ns(kept, -1) if len(kept) else None
        if newest is None:
            return 0
        low, high = 0, len(kept) - 1
        while low < high:
            middle = (low + high) // 2
            logged = self._logged_ns(kept, middle)
            if logged is None or newest - logged > seconds * 1e9:
                low = middle + 1
            else:
                high = middle
        return low

    def _logged_ns(self, kept: KeyframeRows, at: int) -> int | None:
        """Return when keyframe `at` was journaled, wall clock; None if its record cannot be read."""
        try:
            return journal.logged_ns(self._folder, Position(int(kept.segments[at]), int(kept.offsets[at])))
        except JournalError:
            return None


class Departures:
    """Searches for keyframes that the gateway will remove from a map. Call `look` when `wait` is over."""

    def __init__(
        self,
        begin: Begin,
        ledger: Ledger,
        done: dict[bytes, SessionProgress],
        *,
        send: Callable[[Any], None],
    ) -> None:
        self._folder, self._ledger = Path(begin.folder), ledger
        self._done, self._send = done, send
        self._searches: deque[KeyframeSearch] = deque()
        self.window = KeepWindow(
            ledger,
            self._folder / state_folder.JOURNAL_FOLDER,
            seconds=begin.keep_seconds,
            keyframes=begin.keep_keyframes,
            radius=begin.keep_radius,
            send=send,
        )

    def ask(self, message: Find | Expire) -> None:
        """Take an order of the gateway: find keyframes, or let those of old segments expire."""
        if isinstance(message, fuser_messages.Find):
            self._searches.append(KeyframeSearch(message, self._folder, self._ledger, self._done))
        else:
            self.window.expire(message.before_segment)

    def wait(self, idle: bool) -> float | None:
        """Return the seconds until the next `look`; None = no search is needed."""
        return self._searches[0].wait(idle) if self._searches else self.window.wait(idle)

    def look(self) -> bool:
        """Search for a moment and send results; return True if the bounds (`KeepWindow`) were checked."""
        if not self._searches:
            self.window.look()
            return True
        if (found := self._searches[0].go_on()) is not None:
            self._searches.popleft()
            self._send(found)
        return False
