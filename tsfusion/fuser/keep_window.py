# SPDX-License-Identifier: MIT
"""The keyframes that a map keeps where it is only to show what is now, and near."""

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tsfusion import journal
from tsfusion.core.errors import JournalError
from tsfusion.fuser.messages import EXPIRED, Found, FoundKeyframes
from tsfusion.journal import Position
from tsfusion.journal.keyframe_poses import KeptKeyframes, KeyframePoses

_INTERVAL_S = 0.5  # between two looks while keyframes come: each may write a record to the journal
_PATIENCE_S = 5.0  # for that record to come back


class KeepWindow:
    """The bounds of a map in time, number and space, all of them against its newest keyframe.

    Call `look` when `wait` is over: what is beyond a bound is told to the gateway, which writes a record that
    removes it, as for `tsfusion map forget`. The cost of a look is bounded by what the window holds.

    Args:
        seconds: between a keyframe's coming to the server and the newest one's; None = no bound.
        keyframes: how many, of all sessions together; None = no bound.
        radius: metres from sensor to sensor; None = no bound.
        send: takes the message.
    """

    def __init__(
        self,
        poses: KeyframePoses,
        folder: Path,
        *,
        seconds: float | None,
        keyframes: int | None,
        radius: float | None,
        send: Callable[[Found], None],
    ) -> None:
        self._poses, self._folder, self._send = poses, folder, send
        self._seconds, self._keyframes, self._radius = seconds, keyframes, radius
        self._before_segment = 0
        self._is_behind = self.is_set
        self._next = 0.0  # time.monotonic()
        self._asked: float | None = None  # time.monotonic(), until the record comes

    @property
    def is_set(self) -> bool:
        """True if a bound is set."""
        return (self._seconds, self._keyframes, self._radius) != (None, None, None)

    @property
    def is_behind(self) -> bool:
        """True if keyframes came since the last look."""
        return self._is_behind

    def note_keyframe(self) -> None:
        """Note that one more keyframe is in the map, or is elsewhere."""
        self._is_behind = self.is_set

    def note_record(self) -> None:
        """Note that a record came that removes keyframes."""
        self._asked = None

    def expire(self, before_segment: int) -> None:
        """Let keyframes go whose segments are to be deleted, for the journal is at its limit."""
        self._before_segment = max(before_segment, self._before_segment)
        self._is_behind = self.is_set

    def wait(self, idle: bool) -> float | None:
        """Seconds until it is time for a `look`; None = nothing has come since the last one."""
        if not self._is_behind:
            return None
        from_s = [0.0 if idle else self._next, 0.0 if self._asked is None else self._asked + _PATIENCE_S]
        return max(max(from_s) - time.monotonic(), 0.0)

    def look(self) -> None:
        """Tell which keyframes are beyond a bound."""
        self._is_behind = False
        self._next = time.monotonic() + _INTERVAL_S
        kept = self._poses.kept()
        beyond = self._beyond(kept) if len(kept.seqs) else np.zeros(0, np.bool_)
        if not beyond.any():
            return
        self._asked = time.monotonic()
        found = []
        for number, session in enumerate(kept.sessions):
            seqs = kept.seqs[beyond & (kept.session == number)]
            if len(seqs):
                none = np.zeros(len(seqs), np.bool_).tobytes()
                found.append(FoundKeyframes(session, "", seqs.tobytes(), b"", b"", none))
        self._send(Found(EXPIRED, tuple(found)))

    def _beyond(self, kept: KeptKeyframes) -> NDArray[np.bool_]:
        """(n,) whether each is beyond a bound."""
        order = np.lexsort((kept.offsets, kept.segments))  # as they came
        beyond = kept.segments < self._before_segment
        if self._keyframes is not None:
            beyond[order[: -self._keyframes]] = True
        if self._radius is not None:
            beyond |= ~(np.linalg.norm(kept.centers - kept.centers[order[-1]], axis=1) <= self._radius)
        if self._seconds is not None:
            beyond[order[: self._count_older(kept, order, self._seconds)]] = True
        return beyond

    def _count_older(self, kept: KeptKeyframes, order: NDArray[np.int64], seconds: float) -> int:
        """Number of keyframes older than so long before the last: by halving, so that few are looked at."""
        newest = self._logged_ns(kept, int(order[-1]))
        if newest is None:
            return 0
        low, high = 0, len(order) - 1
        while low < high:
            middle = (low + high) // 2
            logged = self._logged_ns(kept, int(order[middle]))
            if logged is None or newest - logged > seconds * 1e9:
                low = middle + 1
            else:
                high = middle
        return low

    def _logged_ns(self, kept: KeptKeyframes, at: int) -> int | None:
        """Wall clock at which a keyframe was journaled; None = its record cannot be read."""
        try:
            return journal.logged_ns(self._folder, Position(int(kept.segments[at]), int(kept.offsets[at])))
        except JournalError:
            return None
