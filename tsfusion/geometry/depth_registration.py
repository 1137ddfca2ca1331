# SPDX-License-Identifier: MIT
"""Register a colour camera to a depth camera: find the colour of depth pixels."""

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import InvalidConfig
from tsfusion.geometry.calibration import Size
from tsfusion.geometry.keyframe import Intrinsics, check_pose

_FAR = np.float32(65.535)  # metres: assumed depth of pixels without depth
_STRIP = 32  # rows at once


class Registration:
    """Registration of a depth and a colour camera that are fixed to each other, both without distortion.

    Args:
        depth, color: the cameras' intrinsics.
        size, color_size: (height, width) of their images; `color_size` None = the same.
        T_color_depth: (4, 4), `p_color = T_color_depth @ p_depth`, metres.

    Raises InvalidKeyframe if `T_color_depth` is not rigid.
    """

    def __init__(
        self,
        depth: Intrinsics,
        color: Intrinsics,
        T_color_depth: NDArray[np.float64],
        size: Size,
        *,
        color_size: Size | None = None,
    ) -> None:
        T = check_pose(T_color_depth)
        self.size, self.color_size = size, color_size or size
        v, u = (np.arange(side, dtype=np.float64) for side in size)
        turned = color.matrix @ T[:3, :3] @ np.linalg.inv(depth.matrix)
        # A pixel at depth z lies at z · at_infinity + moved in the colour camera (homogeneous).
        self._at_infinity = np.empty((3, *size), np.float32)
        for into, (by_u, by_v, always) in zip(self._at_infinity, turned, strict=True):
            into[:] = by_u * u + by_v * v[:, None] + always
        self._moved = (color.matrix @ T[:3, 3]).astype(np.float32)

    def color_of_depth(self, color: NDArray[np.uint8], depth_m: NDArray[np.float32]) -> NDArray[np.uint8]:
        """Return the colour of every depth pixel: (H, W, 3) uint8 of the depth's size.

        A pixel without depth (0) gets the colour of a distant point. A pixel outside the colour image gets
        its border's colour. A pixel hidden from the colour camera gets the colour of the hiding surface.
        """
        expected = (*self.color_size, 3)
        if color.shape != expected or color.dtype != np.uint8:
            raise InvalidConfig(f"color must be {expected} uint8, got {color.shape} {color.dtype}")
        seen = np.empty((*self.size, 3), np.uint8)
        for rows, z in self._strips(depth_m):
            u, v = self._pixels(np.where(z > 0, z, _FAR), rows)
            seen[rows] = cv2.remap(color, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return seen

    def _strips(self, depth_m: NDArray[np.float32]) -> Iterator[tuple[slice, NDArray[np.float32]]]:
        """Yield the depth image a few rows at a time, so that intermediate arrays fit into the CPU cache."""
        if depth_m.shape != self.size:
            raise InvalidConfig(f"depth must be of size {self.size}, got {depth_m.shape}")
        for top in range(0, len(depth_m), _STRIP):
            rows = slice(top, top + _STRIP)
            yield rows, depth_m[rows]

    def _pixels(self, z: NDArray[np.float32], rows: slice) -> tuple[NDArray[np.float32], ...]:
        """Return columns and rows in the colour image of the depth pixels `z`, (k, W) metres, of `rows`."""
        x, y, there = (
            z * each[rows] + moved for each, moved in zip(self._at_infinity, self._moved, strict=True)
        )
        there[there <= 0] = 1  # behind it
        return x / there, y / there
