# SPDX-License-Identifier: MIT
"""Follow a map's scanners: their newest poses and pictures, and the paths of their keyframes."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.viewer.map.vertex_colors import item_color
from tsfusion.wire.asking.followed_map import PathsFound, ScannerSeen

_PICTURE_PAUSE = 1.0  # least seconds between two pictures of a scanner
_PATH_PAUSE = 1.0  # seconds between two versions of a path
_MOST_POINTS = 3000  # of a drawn path
_FADED = 0.6  # share of grey in the colour of first paths
_LOST = 60  # voxels: keyframes farther apart are not connected in a path


@dataclass
class ScannerTrack:
    """A scanner as it was last seen, and the positions of its keyframes."""

    session: bytes
    number: int
    newest: ScannerSeen | None = None
    pose: NDArray[np.float64] | None = None
    now: dict[int, NDArray[np.float64]] = field(default_factory=dict)  # position by keyframe
    first: dict[int, NDArray[np.float64]] = field(default_factory=dict)  # first position by keyframe
    is_found: bool = False  # was in a `PathsFound` event
    is_placed: bool = False  # the frustum shows the newest pose
    is_drawn: bool = False  # the path shows the newest positions
    path_at: float = -math.inf
    picture_at: float = -math.inf
    picture: bytes | None = None
    nodes: dict[str, Any] = field(default_factory=dict)

    @property
    def frame(self) -> str:
        """Name of its frame for other programs."""
        return f"scanner_{self.number + 1}"


class ScannerTracks(ABC):
    """Tracks of a map's scanners; a subclass draws them."""

    def __init__(self) -> None:
        self._scanners: dict[bytes, ScannerTrack] = {}
        self.voxel_size = 0.02

    def clear(self) -> None:
        for scanner in self._scanners.values():
            self._remove(scanner)
        self._scanners.clear()

    @property
    def sessions(self) -> list[bytes]:
        """Sessions of all scanners, in order of appearance."""
        return list(self._scanners)

    def name(self, session: bytes) -> str:
        """Return a scanner's name for a person: its key's name, or the first digits of its session."""
        scanner = self._scanners.get(session)
        client = scanner.newest.client if scanner and scanner.newest else ""
        return client or session.hex()[:8]

    def pose(self, session: bytes) -> NDArray[np.float64] | None:
        """Return the pose of a scanner's newest keyframe, (4, 4) T_world_camera; None if unknown."""
        scanner = self._scanners.get(session)
        return None if scanner is None else scanner.pose

    def note_seen(self, event: ScannerSeen) -> None:
        """Move a scanner to the pose of a new keyframe, and extend its path."""
        scanner = self._scanner(event.session)
        scanner.newest, scanner.pose = event, event.T_world_camera  # an earlier keyframe after a rewind
        scanner.picture = event.picture or scanner.picture
        position = event.T_world_camera[:3, 3]
        scanner.first.setdefault(event.seq, position)
        scanner.now[event.seq] = position
        scanner.is_placed = scanner.is_drawn = False

    def note_paths(self, event: PathsFound) -> None:
        """Replace the paths by the positions of all keyframes; keyframes that came later stay."""
        for session, scanner in self._scanners.items():
            if session not in event.paths and scanner.is_found:
                scanner.now, scanner.newest, scanner.pose = {}, None, None
                scanner.is_placed = scanner.is_drawn = False
        for session, (seqs, poses) in event.paths.items():
            scanner = self._scanner(session)
            numbers = seqs.tolist()
            last = max(numbers, default=-1)
            newest = last if scanner.newest is None else scanner.newest.seq
            later = {seq: place for seq, place in scanner.now.items() if last < seq <= newest}
            scanner.now = dict(zip(numbers, poses[:, :3, 3], strict=True)) | later
            for seq, place in scanner.now.items():
                scanner.first.setdefault(seq, place)
            if newest in numbers:
                scanner.pose = poses[numbers.index(newest)]
            scanner.is_found, scanner.is_placed, scanner.is_drawn = True, False, False

    def is_due(self, now: float) -> bool:
        return any(
            not one.is_placed
            or (not one.is_drawn and now >= one.path_at + _PATH_PAUSE)
            or (one.picture is not None and now >= one.picture_at + _PICTURE_PAUSE)
            for one in self._scanners.values()
        )

    def draw(self, now: float) -> None:
        """Draw what has changed since the last call."""
        for scanner in self._scanners.values():
            if not scanner.is_placed:
                scanner.is_placed = True
                self._place(scanner)
            self._offer_picture(scanner, now)
            if scanner.is_drawn:
                continue
            if now >= scanner.path_at + _PATH_PAUSE:
                scanner.path_at, scanner.is_drawn = now, True
                self._draw_paths(scanner)

    @abstractmethod
    def _place(self, scanner: ScannerTrack) -> None:
        """Draw a scanner at its newest pose, or nowhere if that is unknown."""

    @abstractmethod
    def _show_picture(self, scanner: ScannerTrack, jpeg: bytes) -> bool:
        """Show a scanner's picture; return False if it cannot be shown yet."""

    @abstractmethod
    def _line(
        self, scanner: ScannerTrack, kind: str, ends: NDArray[np.float32], color: NDArray[np.uint8]
    ) -> None:
        """Draw the line `paths` or `first paths` of a scanner; `ends`: (n, 2, 3) metres."""

    @abstractmethod
    def _remove(self, scanner: ScannerTrack) -> None:
        """Remove all that is drawn of a scanner."""

    def _scanner(self, session: bytes) -> ScannerTrack:
        return self._scanners.setdefault(session, ScannerTrack(session, len(self._scanners)))

    def _offer_picture(self, scanner: ScannerTrack, now: float) -> None:
        is_due = scanner.picture is not None and now >= scanner.picture_at + _PICTURE_PAUSE
        if is_due and scanner.picture is not None and self._show_picture(scanner, scanner.picture):
            scanner.picture_at, scanner.picture = now, None

    def _draw_paths(self, scanner: ScannerTrack) -> None:
        color = np.array(item_color(scanner.number), np.float64)
        seqs = sorted(scanner.now)
        now = np.array([scanner.now[seq] for seq in seqs]).reshape(-1, 3)
        first = np.array([scanner.first[seq] for seq in seqs]).reshape(-1, 3)
        moved = len(now) > 0 and bool((np.linalg.norm(now - first, axis=1) > self.voxel_size).any())
        faded = color + _FADED * (150 - color)
        shown = {"paths": (now, color), "first paths": (first if moved else first[:0], faded)}
        for kind, (points, shade) in shown.items():
            segments = _segments(points, _LOST * self.voxel_size)
            self._line(scanner, kind, segments, np.rint(shade).astype(np.uint8))


def _segments(points: NDArray[np.float64], most: float) -> NDArray[np.float32]:
    """Return (n, 2, 3) segments from point to point, without jumps of more than `most` metres."""
    points = points[:: max(1, math.ceil(len(points) / _MOST_POINTS))]
    pairs = np.stack((points[:-1], points[1:]), axis=1)
    steps = np.linalg.norm(pairs[:, 1] - pairs[:, 0], axis=1)
    # Thinned paths and fast scanners have long steps everywhere
    usual = 10 * float(np.median(steps)) if len(steps) else 0.0
    found: NDArray[np.float32] = pairs[steps <= max(most, usual)].astype(np.float32)
    return found
