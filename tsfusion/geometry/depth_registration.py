# SPDX-License-Identifier: MIT
"""Registration of a depth and a colour camera: the colour of depth pixels, the depth of colour pixels."""

from collections.abc import Iterator

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import InvalidConfig
from tsfusion.geometry.keyframe import Intrinsics, check_pose

Size = tuple[int, int]  # height, width
_FAR = np.float32(65.535)  # metres: assumed depth of pixels without depth
_OVERLAP = 1.2  # width at which a depth pixel is drawn, in pixels: no gaps on slanted surfaces
_STRIP = 32  # rows at once


class Registration:
    """Registration of a depth and a colour camera that are fixed to each other, both without distortion.

    Args:
        depth, color: the cameras' intrinsics.
        size, color_size: (height, width) of their images; `color_size` None = the same.
        T_color_depth: (4, 4), `p_color = T_color_depth @ p_depth`, metres.

    Raises:
        InvalidKeyframe: `T_color_depth` is not rigid.
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
        self._reach = _OVERLAP / 2 * np.array([color.fx / depth.fx, abs(color.fy / depth.fy)])

    def color_of_depth(self, color: NDArray[np.uint8], depth_m: NDArray[np.float32]) -> NDArray[np.uint8]:
        """Colour of every depth pixel: (H, W, 3) uint8 of the depth's size.

        A pixel without depth (0) gets the colour far away there; one outside of the colour image, the colour
        of its border; one hidden from the colour camera, the colour of what hides it.
        """
        expected = (*self.color_size, 3)
        if color.shape != expected or color.dtype != np.uint8:
            raise InvalidConfig(f"color must be {expected} uint8, got {color.shape} {color.dtype}")
        seen = np.empty((*self.size, 3), np.uint8)
        for rows, z in self._strips(depth_m):
            u, v, _ = self._pixels(np.where(z > 0, z, _FAR), rows)
            seen[rows] = cv2.remap(color, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return seen

    def depth_of_color(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Depth of every colour pixel: (H, W) float32 metres of the colour's size, 0 = none.

        Each depth pixel is drawn a fifth larger than it appears there, the nearest in front.
        """
        height, width = self.color_size
        nearest = np.full(height * width, np.inf, np.float32)
        reach_u, reach_v = (np.float32(reach) for reach in self._reach)
        for rows, depth in self._strips(depth_m):
            u, v, z = self._pixels(np.where(depth > 0, depth, np.float32(0)), rows)
            valid = (depth > 0) & (z > 0)
            u, v, z = u[valid], v[valid], z[valid]
            first_u, last_u = np.ceil(u - reach_u), np.floor(u + reach_u)
            first_v, last_v = np.ceil(v - reach_v), np.floor(v + reach_v)
            for down in range(int(2 * reach_v) + 1):
                for right in range(int(2 * reach_u) + 1):
                    column, row = first_u + right, first_v + down
                    drawn = (column <= last_u) & (row <= last_v)
                    drawn &= (column >= 0) & (column < width) & (row >= 0) & (row < height)
                    at = (row[drawn] * width + column[drawn]).astype(np.intp)
                    np.minimum.at(nearest, at, z[drawn])
        nearest[np.isinf(nearest)] = 0
        return nearest.reshape(height, width)

    def _strips(self, depth_m: NDArray[np.float32]) -> Iterator[tuple[slice, NDArray[np.float32]]]:
        """A depth image a few rows at a time, so that what is made of them stays in the cache."""
        if depth_m.shape != self.size:
            raise InvalidConfig(f"depth must be of size {self.size}, got {depth_m.shape}")
        for top in range(0, len(depth_m), _STRIP):
            rows = slice(top, top + _STRIP)
            yield rows, depth_m[rows]

    def _pixels(self, z: NDArray[np.float32], rows: slice) -> tuple[NDArray[np.float32], ...]:
        """Columns, rows and depths of some rows' depth pixels in the colour camera."""
        x, y, there = (
            z * each[rows] + moved for each, moved in zip(self._at_infinity, self._moved, strict=True)
        )
        behind = there <= 0
        there[behind] = 1
        return x / there, y / there, np.where(behind, np.float32(0), there)
