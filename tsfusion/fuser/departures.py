# SPDX-License-Identifier: MIT
"""Find the keyframes that must leave a map: those that a command selects, and those outside its window.

Both searches run a slice at a time, so that keyframes are fused in between.
"""

import errno
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
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
from tsfusion.journal import Position, state_folder
from tsfusion.journal.ledger import Ledger
from tsfusion.wire.records import codec

_SLICE_S = 0.05  # seconds at a time
_REST_S = 0.15  # between two slices while keyframes come
_INSIDE = 0.9  # share of a keyframe's points in the box: noise or a view out of a window is tolerated


class KeyframeSearch:
    """Search for the keyframes of a `Find` that lie in its box, and for those that are forgotten.

    Call `go_on` after `wait` seconds until it answers.
    """

    def __init__(self, find: Find, folder: Path, ledger: Ledger, done: dict[bytes, SessionProgress]) -> None:
        self._find, self._ledger, self._done = find, ledger, done
        self._folder = folder / state_folder.JOURNAL_FOLDER
        self._selected: list[FoundKeyframes] = []
        self._steps = self._search()
        self._next = 0.0  # time.monotonic()

    def wait(self, idle: bool) -> float:
        """Return the seconds until the next `go_on`."""
        return 0.0 if idle else max(self._next - time.monotonic(), 0.0)

    def go_on(self) -> Found | None:
        """Look at some keyframes. Return the result after the last one, before it None."""
        until = time.monotonic() + _SLICE_S
        try:
            for _ in self._steps:
                if time.monotonic() >= until:
                    self._next = time.monotonic() + _REST_S
                    return None
            return self._found()
        except (JournalError, InvalidConfig) as error:
            return Found(self._find.number, error=str(error))

    def _search(self) -> Iterator[None]:
        for one in self._find.sessions:
            columns = one.columns
            if self._find.selection.box is not None:
                inside = np.zeros(columns.shape[1], np.bool_)
                for at, place in enumerate(one.positions):
                    inside[at] = self._lies_in_box(one.session, int(columns[0, at]), place)
                    yield
                columns = columns[:, inside]
            columns[3] = self._ledger.forgotten_of(one.session).mask(columns[0])
            if columns.size:
                self._selected.append(FoundKeyframes(one.session, one.client, columns.T.tobytes()))
            yield

    def _lies_in_box(self, session: bytes, seq: int, place: Position) -> bool:
        """Return True if the sensor is in the box, and so are nearly all its measured points."""
        low, high = np.sort(np.array(self._find.selection.box).reshape(2, 3), axis=0)

        def inside(points: NDArray[np.floating]) -> NDArray[np.bool_]:
            return np.asarray(((points >= low) & (points <= high)).all(axis=-1))

        pose = self._ledger.pose_of(session, seq)
        if pose is not None and not inside(pose[:3, 3]):
            return False  # without a look into the journal
        try:
            keyframe = codec.decode_keyframe(journal.read(self._folder, place).frames)
            placed = self._ledger.placed(session, keyframe)
            placed = placed if pose is None else replace(placed, T_world_camera=pose)
        except (DecodeError, InvalidKeyframe):  # the map has no such keyframe
            return False
        except JournalError as error:
            if error.temporary and (error.errno != errno.ENOENT or journal.is_away(self._folder, None)):
                raise
            return False
        if not inside(placed.T_world_camera[:3, 3]):
            return False
        points = points_world(placed)
        points = points[np.isfinite(points).all(axis=1)]
        return not len(points) or bool(inside(points).mean() >= _INSIDE)

    def _found(self) -> Found:
        if self._find.selection.numbers is not None and len(self._selected) > 1:
            names = ", ".join(one.session.hex()[:8] for one in self._selected)
            raise InvalidConfig(
                f"several sessions have keyframes of these numbers: {names}; name one of them"
            )
        if self._find.selection.session and len(self._selected) > 1:
            names = ", ".join(one.session.hex() for one in self._selected)
            raise InvalidConfig(f"several sessions begin with {self._find.selection.session}: {names}")
        return Found(self._find.number, tuple(self._selected), tuple(self._unavailable()))

    def _unavailable(self) -> Iterator[str]:
        """Yield sessions whose selected keyframes may be in the map but no longer in the journal."""
        if not self._find.reaches_back:
            return
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


class Departures:
    """Keyframes that must leave a map: those that `Find` selects, and those beyond its `Begin.keep_…`.

    Call `look` when `wait` is over: it sends the gateway these keyframes. The gateway writes a record that
    removes those beyond a bound, as for `tsfusion map forget`. The window's size bounds the cost.
    """

    def __init__(
        self,
        begin: Begin,
        ledger: Ledger,
        done: dict[bytes, SessionProgress],
        *,
        send: Callable[[Any], None],
    ) -> None:
        self._begin, self._folder, self._ledger = begin, Path(begin.folder), ledger
        self._done, self._send = done, send
        self._searches: deque[KeyframeSearch] = deque()
        self._before_segment = 0
        self.is_behind = begin.keeps_window  # keyframes came or moved since the last look at the bounds
        self._next = 0.0  # time.monotonic()
        self._asked: float | None = None  # time.monotonic() of the request; None once its record has come

    def ask(self, message: Find | Expire) -> None:
        """Take an order of the gateway: find keyframes, or let those of old segments expire."""
        if isinstance(message, fuser_messages.Find):
            self._searches.append(KeyframeSearch(message, self._folder, self._ledger, self._done))
        else:  # the journal, at its limit, will delete them
            self._before_segment = max(message.before_segment, self._before_segment)
            self.note_keyframe()

    def note_keyframe(self) -> None:
        """Record that a keyframe entered the map or moved, so that others may be out of bounds."""
        self.is_behind = self._begin.keeps_window

    def note_record(self) -> None:
        """Record that a record that removes keyframes came, as `look` had asked for."""
        self._asked = None

    def wait(self, idle: bool) -> float | None:
        """Return the seconds until the next `look`; None = no search is needed."""
        if self._searches:
            return self._searches[0].wait(idle)
        if not self.is_behind:
            return None
        from_s = [0.0 if idle else self._next, 0.0 if self._asked is None else self._asked + _PATIENCE_S]
        return max(max(from_s) - time.monotonic(), 0.0)

    def look(self) -> bool:
        """Search for a moment and send results; return True if the bounds were checked."""
        if not self._searches:
            self._look_at_bounds()
            return True
        if (found := self._searches[0].go_on()) is not None:
            self._searches.popleft()
            self._send(found)
        return False

    def _look_at_bounds(self) -> None:
        self.is_behind = False
        self._next = time.monotonic() + _INTERVAL_S
        kept = self._ledger.kept().in_order()
        beyond = kept[self._beyond(kept)]
        if len(beyond):
            self._asked = time.monotonic()
            found = [
                FoundKeyframes(session, "", np.pad(rows.seqs[:, None], ((0, 0), (0, 3))).tobytes())
                for session, rows in beyond.by_session()
            ]
            self._send(Found(EXPIRED, tuple(found)))

    def _beyond(self, kept: KeyframeRows) -> NDArray[np.bool_]:
        """Return an (n,) mask of keyframes beyond a bound; `kept` are the map's, in journal order."""
        beyond = kept.segments < self._before_segment
        if self._begin.keep_keyframes is not None:
            beyond[: -self._begin.keep_keyframes] = True
        if self._begin.keep_radius is not None:
            centers = kept.poses[:, 3::4]
            beyond |= ~(np.linalg.norm(centers - centers[-1:], axis=1) <= self._begin.keep_radius)
        if self._begin.keep_seconds is not None:
            beyond[: self._count_older(kept, self._begin.keep_seconds)] = True
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
        place = Position(int(kept.segments[at]), int(kept.offsets[at]))
        with suppress(JournalError):
            return journal.logged_ns(self._folder / state_folder.JOURNAL_FOLDER, place)
        return None
