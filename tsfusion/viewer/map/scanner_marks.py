# SPDX-License-Identifier: MIT
"""Draw scanners in the 3-D scene: their poses, last pictures, and the paths of their keyframes."""

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry.trajectory import quaternion
from tsfusion.viewer.map.vertex_colors import item_color
from tsfusion.wire.asking.map_events import PathsFound, ScannerSeen
from tsfusion.wire.records import array_encoding
from tsfusion.wire.records.record_header import Refused

if TYPE_CHECKING:
    import viser

_PICTURE_PAUSE = 1.0  # least seconds between two pictures of a scanner
_PATH_PAUSE = 1.0  # seconds between two versions of a path
_MOST_POINTS = 3000  # of a drawn path
_WIDTHS = {"paths": 4.0, "first paths": 1.5}  # pixels
_FADED = 0.6  # share of grey in the colour of first paths
_LOST = 60  # voxels: keyframes farther apart are not connected in a path
_PICTURE_WIDTH = 320  # pixels
_MOST_PIXELS = 1 << 26


@dataclass
class _ScannerMark:
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


class ScannerMarks:
    """Frustums, axes and paths of a map's scanners in the scene."""

    def __init__(self, scene: "viser.SceneApi") -> None:
        self._scene = scene
        self._scanners: dict[bytes, _ScannerMark] = {}
        self.voxel_size = 0.02
        self.shows = {"scanners": True, "paths": True, "first paths": True}

    def clear(self) -> None:
        for scanner in self._scanners.values():
            for node in scanner.nodes.values():
                node.remove()
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

    def positions(self) -> NDArray[np.float64]:
        """Return the (n, 3) positions of the keyframes of all scanners."""
        found = [list(scanner.now.values()) for scanner in self._scanners.values() if scanner.now]
        return np.concatenate(found) if found else np.zeros((0, 3))

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
        """Send what has changed since the last call to the scene."""
        for session, scanner in self._scanners.items():
            if not scanner.is_placed:
                scanner.is_placed = True
                self._place(session, scanner)
            self._hang_picture(scanner, now)
            if scanner.is_drawn:
                continue
            if now >= scanner.path_at + _PATH_PAUSE:
                scanner.path_at, scanner.is_drawn = now, True
                self._draw_paths(session, scanner)

    def show(self, what: str, wanted: bool) -> None:
        """Show or hide `scanners`, `paths` or `first paths`."""
        self.shows[what] = wanted
        for scanner in self._scanners.values():
            for kind, node in scanner.nodes.items():
                if kind == what or (what == "scanners" and kind == "name"):
                    node.visible = wanted

    def _scanner(self, session: bytes) -> _ScannerMark:
        return self._scanners.setdefault(session, _ScannerMark(len(self._scanners)))

    def _place(self, session: bytes, scanner: _ScannerMark) -> None:
        if scanner.pose is None:
            if (gone := scanner.nodes.pop("scanners", None)) is not None:
                gone.remove()
            return
        wxyz, position = np.roll(quaternion(scanner.pose[:3, :3]), 1), scanner.pose[:3, 3]
        node = scanner.nodes.get("scanners")
        if node is None:
            node = self._add(session, scanner)
        node.wxyz, node.position = wxyz, position

    def _hang_picture(self, scanner: _ScannerMark, now: float) -> None:
        """Show a scanner's last picture in its frustum, if it is new."""
        node = scanner.nodes.get("scanners")
        is_due = scanner.picture is not None and now >= scanner.picture_at + _PICTURE_PAUSE
        if is_due and scanner.picture is not None and node is not None and _is_frustum(node):
            scanner.picture_at = now
            node.image, scanner.picture = small_picture(scanner.picture), None

    def _add(self, session: bytes, scanner: _ScannerMark) -> Any:
        name, color = f"/scanners/{session.hex()}", item_color(scanner.number)
        size, newest = 10 * self.voxel_size, scanner.newest
        shown = self.shows["scanners"]
        if newest is None or newest.intrinsics is None or newest.shape is None:
            node: Any = self._scene.add_frame(
                name,
                axes_length=2 * size,
                axes_radius=0.12 * size,
                origin_radius=0.25 * size,
                origin_color=color,
            )
        else:
            height, width = newest.shape
            fov = 2 * math.atan2(height / 2, abs(newest.intrinsics.fy))
            node = self._scene.add_camera_frustum(
                name,
                fov=fov,
                aspect=width / height,
                scale=size,
                thickness=3.0,
                thickness_units="screen",
                color=color,
                format="jpeg",
            )
        node.visible = shown
        scanner.nodes["scanners"] = node
        return node

    def _draw_paths(self, session: bytes, scanner: _ScannerMark) -> None:
        color = np.array(item_color(scanner.number), np.float64)
        seqs = sorted(scanner.now)
        now = np.array([scanner.now[seq] for seq in seqs]).reshape(-1, 3)
        first = np.array([scanner.first[seq] for seq in seqs]).reshape(-1, 3)
        name = session.hex()
        self._line(scanner, f"/paths/{name}", now, color)
        moved = len(now) > 0 and bool((np.linalg.norm(now - first, axis=1) > self.voxel_size).any())
        faded = color + _FADED * (150 - color)
        self._line(scanner, f"/first-paths/{name}", first if moved else first[:0], faded)

    def _line(
        self, scanner: _ScannerMark, name: str, points: NDArray[np.float64], color: NDArray[np.float64]
    ) -> None:
        kind = name.split("/")[1].replace("-", " ")
        segments = _segments(points, _LOST * self.voxel_size)
        node = scanner.nodes.get(kind)
        if node is not None:
            node.points = segments
        elif len(segments):
            scanner.nodes[kind] = self._scene.add_line_segments(
                name,
                segments,
                np.rint(color).astype(np.uint8),
                thickness=_WIDTHS[kind],
                thickness_units="screen",
                visible=self.shows[kind],
            )


def _segments(points: NDArray[np.float64], most: float) -> NDArray[np.float32]:
    """Return (n, 2, 3) segments from point to point, without jumps of more than `most` metres."""
    points = points[:: max(1, math.ceil(len(points) / _MOST_POINTS))]
    pairs = np.stack((points[:-1], points[1:]), axis=1)
    steps = np.linalg.norm(pairs[:, 1] - pairs[:, 0], axis=1)
    # Thinned paths and fast scanners have long steps everywhere
    usual = 10 * float(np.median(steps)) if len(steps) else 0.0
    found: NDArray[np.float32] = pairs[steps <= max(most, usual)].astype(np.float32)
    return found


def _is_frustum(node: Any) -> bool:
    return hasattr(node, "image")


def small_picture(jpeg: bytes) -> NDArray[np.uint8] | None:
    """Return a JPEG as (h, w, 3) RGB, at most 320 pixels wide; None if it cannot be read."""
    try:
        height, width = array_encoding.image_size(jpeg)
    except Refused:
        return None
    if height * width > _MOST_PIXELS:
        return None
    flag = cv2.IMREAD_REDUCED_COLOR_4 if width >= 8 * _PICTURE_WIDTH else cv2.IMREAD_COLOR
    flag = cv2.IMREAD_REDUCED_COLOR_2 if 4 * _PICTURE_WIDTH <= width < 8 * _PICTURE_WIDTH else flag
    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), flag | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        return None
    if image.shape[1] > _PICTURE_WIDTH:
        size = (_PICTURE_WIDTH, max(1, round(image.shape[0] * _PICTURE_WIDTH / image.shape[1])))
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(image[..., ::-1])
