# SPDX-License-Identifier: MIT
"""Draw scanners in the 3-D scene: their poses, last pictures, and the paths of their keyframes."""

import math
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry.trajectory import quaternion
from tsfusion.viewer.map.scanner_tracks import ScannerTrack, ScannerTracks
from tsfusion.viewer.map.vertex_colors import item_color
from tsfusion.wire.records import array_encoding
from tsfusion.wire.records.record_header import Refused

if TYPE_CHECKING:
    import viser

_WIDTHS = {"paths": 4.0, "first paths": 1.5}  # pixels
_PICTURE_WIDTH = 320  # pixels
_MOST_PIXELS = 1 << 26


class ScannerMarks(ScannerTracks):
    """Frustums, axes and paths of a map's scanners in the scene."""

    def __init__(self, scene: "viser.SceneApi") -> None:
        super().__init__()
        self._scene = scene
        self.shows = {"scanners": True, "paths": True, "first paths": True}

    def show(self, what: str, wanted: bool) -> None:
        """Show or hide `scanners`, `paths` or `first paths`."""
        self.shows[what] = wanted
        for scanner in self._scanners.values():
            for kind, node in scanner.nodes.items():
                if kind == what or (what == "scanners" and kind == "name"):
                    node.visible = wanted

    def _remove(self, scanner: ScannerTrack) -> None:
        for node in scanner.nodes.values():
            node.remove()

    def _place(self, scanner: ScannerTrack) -> None:
        node = scanner.nodes.get("scanners")
        if node is not None and (scanner.pose is None or _is_frustum(node) is (_view(scanner) is None)):
            scanner.nodes.pop("scanners").remove()
            node = None
        if scanner.pose is None:
            return
        wxyz, position = np.roll(quaternion(scanner.pose[:3, :3]), 1), scanner.pose[:3, 3]
        if node is None:
            node = self._add(scanner)
        node.wxyz, node.position = wxyz, position

    def _show_picture(self, scanner: ScannerTrack, jpeg: bytes) -> bool:
        node = scanner.nodes.get("scanners")
        if node is None or not _is_frustum(node):
            return False
        node.image = small_picture(jpeg)
        return True

    def _add(self, scanner: ScannerTrack) -> Any:
        name, color = f"/scanners/{scanner.session.hex()}", item_color(scanner.number)
        size, view = 10 * self.voxel_size, _view(scanner)
        shown = self.shows["scanners"]
        if view is None:
            node: Any = self._scene.add_frame(
                name,
                axes_length=2 * size,
                axes_radius=0.12 * size,
                origin_radius=0.25 * size,
                origin_color=color,
            )
        else:
            node = self._scene.add_camera_frustum(
                name,
                fov=view[0],
                aspect=view[1],
                scale=size,
                thickness=3.0,
                thickness_units="screen",
                color=color,
                format="jpeg",
            )
        node.visible = shown
        scanner.nodes["scanners"] = node
        return node

    def _line(
        self, scanner: ScannerTrack, kind: str, ends: NDArray[np.float32], color: NDArray[np.uint8]
    ) -> None:
        node = scanner.nodes.get(kind)
        if node is not None:
            node.points = ends
        elif len(ends):
            scanner.nodes[kind] = self._scene.add_line_segments(
                f"/{kind.replace(' ', '-')}/{scanner.session.hex()}",
                ends,
                color,
                thickness=_WIDTHS[kind],
                thickness_units="screen",
                visible=self.shows[kind],
            )


def _is_frustum(node: Any) -> bool:
    return hasattr(node, "image")


def _view(scanner: ScannerTrack) -> tuple[float, float] | None:
    """Return a camera's vertical angle and aspect; None for a LiDAR, and before the first keyframe."""
    newest = scanner.newest
    if newest is None or newest.intrinsics is None or newest.shape is None:
        return None
    height, width = newest.shape
    return 2 * math.atan2(height / 2, abs(newest.intrinsics.fy)), width / height


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
