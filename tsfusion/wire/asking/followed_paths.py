# SPDX-License-Identifier: MIT
"""Poses of a map's keyframes for a viewer: those that come, and all of them, again after some moved."""

from typing import Any

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from tsfusion.core.errors import DecodeError
from tsfusion.geometry.keyframe_rows import POSE, KeyframeRows
from tsfusion.geometry.up_direction import SensorPosture
from tsfusion.wire.asking.map_events import MapEvent, PathsFound, ScannerSeen
from tsfusion.wire.messages.health import MapHealth
from tsfusion.wire.messages.questions import (
    ANSWER_BYTES,
    LONGEST_WAIT_S,
    Keyframes,
    Scanned,
    Scans,
    ScansFound,
)

_PAUSE_S = 2.0  # wait between two rounds of questions: so long for each answer of the last round


class FollowedPaths:
    """The paths of a map's scanners, and the next questions about them."""

    def __init__(self) -> None:
        self._is_due = True
        self._next = 0.0  # time.monotonic()
        self._asked: Keyframes | None = None
        self._answers = 0  # of this round, or the last one
        self._pages: list[KeyframeRows] = []
        self._epoch = ""
        self._moved: dict[bytes, NDArray[np.float64]] = {}  # T_map_odometry by session
        self._counts: tuple[int, ...] | None = None
        self._scans = ScansFound("", 0)  # the last answer about keyframes that came
        self._fused = self._fused_then = 0  # keyframes in the map: now, and when the last round began
        self._scanned = 0  # keyframes that scanners have sent since the last round began

    def question(self, now: float, most_bytes: int = ANSWER_BYTES) -> Keyframes | None:
        """Return the next question, for an answer of so many bytes, or None without one."""
        if self._asked is None and self._is_due and now >= self._next:
            self._is_due, self._next = False, now + _PAUSE_S * max(self._answers, 1)
            self._asked, self._answers = Keyframes(), 0
            self._fused_then, self._scanned = self._fused, 0
            self._pages.clear()
        return self._asked and replace(self._asked, most_bytes=most_bytes)

    def on_keyframes(self, epoch: str, arrays: dict[str, NDArray[Any]]) -> list[MapEvent]:
        """Take the answer to the last question. Return the paths after the last answer of a round, else [].

        Raises:
            DecodeError: for a malformed answer; ask again.
        """
        asked = self._asked
        if asked is None:
            return []
        if asked.session and epoch != self._epoch:  # another process: earlier answers do not belong to it
            self._asked, self._is_due = None, True
            return []
        self._epoch = epoch
        self._answers += 1
        try:
            page = self._page(arrays)
            last = arrays["last_session"].tobytes(), int(arrays["last"])
            held = SensorPosture(arrays["held"].tolist())
        except (KeyError, IndexError, TypeError, ValueError) as error:
            raise DecodeError(f"an answer about keyframes is malformed: {error!r}") from error
        self._pages.append(page)
        if last[0]:
            if last == (asked.session, asked.after):
                raise DecodeError("an answer about keyframes has no end")
            self._asked = Keyframes(session=last[0], after=last[1])
            return []
        self._asked = None
        rows = KeyframeRows.joined(self._pages)
        return [PathsFound({key: (each.seqs, each.matrices) for key, each in rows.by_session()}, held)]

    def _page(self, arrays: dict[str, NDArray[Any]]) -> KeyframeRows:
        sessions = tuple(one.tobytes() for one in arrays["sessions"])
        self._moved.update(zip(sessions, arrays["T_map_odometry"], strict=True))
        seqs, poses = arrays["seqs"].ravel(), arrays["poses"].reshape(-1, POSE)
        if not len(arrays["session"]) == len(seqs) == len(poses):
            raise ValueError("columns of different lengths")
        nowhere = np.zeros_like(seqs)
        return KeyframeRows.joined([KeyframeRows(sessions, arrays["session"], seqs, nowhere, nowhere, poses)])

    def scans_question(self, most_bytes: int) -> Scans:
        """Return the next question about keyframes that come."""
        return Scans(self._scans.until, self._scans.epoch, LONGEST_WAIT_S, most_bytes)

    def on_scans(self, found: ScansFound) -> list[MapEvent]:
        """Take the answer to the last question about keyframes that come."""
        self._is_due |= found.missed
        self._scans = found
        return [self._seen(one) for one in found.scans]

    def _seen(self, scanned: Scanned) -> ScannerSeen:
        self._scanned += not scanned.late
        T = np.array([*scanned.pose, 0.0, 0.0, 0.0, 1.0]).reshape(4, 4)
        moved = self._moved.get(scanned.session)
        return ScannerSeen(
            session=scanned.session,
            seq=scanned.seq,
            T_world_camera=T if moved is None else moved @ T,
            intrinsics=scanned.intrinsics,
            shape=scanned.shape,
            picture=scanned.picture or None,
            client=scanned.client,
        )

    def on_health(self, health: MapHealth) -> None:
        """Take the map's health: it shows if keyframes moved, left, or came from the journal alone."""
        counts = (
            health.corrections,
            health.keyframes_moved,
            health.keyframes_forgotten,
            health.corrections_waiting,
            health.fuser_restarts,
        )
        before, self._counts = self._counts, counts
        self._fused = health.keyframes_fused
        came_alone = not health.waiting and self._fused - self._fused_then > self._scanned
        self._is_due |= came_alone or before not in (None, counts)
