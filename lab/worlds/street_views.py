# SPDX-License-Identifier: MIT
"""Rendered views of a long street: which solids each tile of the image may show, the rays, the colours."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lab.worlds.road_ground import RoadGround
from tsfusion.datasets.worlds.worlds import Solids
from tsfusion.geometry.keyframe import Intrinsics

TILE = 16  # pixels
REACH = 260.0  # metres
_NEAR = 0.2  # metres: no solid is nearer to the camera
_EDGES = np.array([(a, a | 1 << k) for a in range(8) for k in range(3) if not a >> k & 1])
_CORNERS = np.array([[(c >> k & 1) * 2 - 1 for k in range(3)] for c in range(8)], dtype=float)
_SUBPIXELS = np.array([(-0.375, -0.125), (0.125, -0.375), (0.375, 0.125), (-0.125, 0.375)])

Floats = NDArray[np.float64]


class StreetRenderer:
    """Renders a street of solids on its ground.

    Args:
        solids: (m, 12), z up.
        size: (height, width) in pixels.
    """

    def __init__(self, solids: Solids, ground: RoadGround, size: tuple[int, int], K: Intrinsics) -> None:
        from tsfusion.kernels.base import runtime

        runtime.start()
        self._solids, self._ground, self._size, self._K = solids, ground, size, K
        turn = np.stack([solids[:, 7], -solids[:, 8], solids[:, 8], solids[:, 7]], axis=1).reshape(-1, 2, 2)
        corners = _CORNERS * solids[:, None, 4:7]
        corners[:, :, :2] = corners[:, :, :2] @ turn.transpose(0, 2, 1)
        self._corners = corners + solids[:, None, 1:4]
        v, u = np.mgrid[: size[0], : size[1]].reshape(2, -1)
        self._pixels = np.stack([u, v], axis=1).astype(np.float64)
        self._whole = self._rays(self._pixels)

    def depth(self, T_up_camera: Floats) -> Floats:
        """(H, W) metres along the optical axis at pixels' middles; 0 = the sky."""
        distance, _ = self._cast(T_up_camera, self._tiles(T_up_camera), self._pixels)
        return distance.reshape(self._size)

    def view(self, T_up_camera: Floats) -> tuple[Floats, NDArray[np.float32]]:
        """((H, W) depth as `depth`, (H, W, 3) float32 BGR light); outlines are smooth over their pixels."""
        lists = self._tiles(T_up_camera)
        distance, hit = self._cast(T_up_camera, lists, self._pixels)
        color = self._shade(T_up_camera, self._pixels, distance, hit)
        outline = np.flatnonzero(_outline(hit.reshape(self._size), distance.reshape(self._size)))
        parts = [color[outline]]
        for shift in _SUBPIXELS:
            pixels = self._pixels[outline] + shift
            parts.append(self._shade(T_up_camera, pixels, *self._cast(T_up_camera, lists, pixels)))
        color[outline] = np.mean(parts[1:], axis=0)
        return distance.reshape(self._size), color.reshape(*self._size, 3)

    def _cast(
        self, T: Floats, lists: tuple[NDArray[np.int32], NDArray[np.int32], Floats], pixels: Floats
    ) -> tuple[Floats, NDArray[np.int32]]:
        from lab.worlds.kernels.street_raycast import cast_view

        columns = -(-self._size[1] // TILE)
        u, v = np.rint(pixels).astype(np.int32).T
        tile = v.clip(0, self._size[0] - 1) // TILE * columns + u.clip(0, self._size[1] - 1) // TILE
        distance, hit = np.empty(len(pixels)), np.empty(len(pixels), dtype=np.int32)
        ground = self._ground
        cast_view(
            T, self._rays(pixels), tile, *lists, self._solids, ground.heights, ground.apart, ground.layout,
            REACH, distance, hit,
        )  # fmt: skip
        return distance, hit

    def _shade(
        self, T: Floats, pixels: Floats, distance: Floats, hit: NDArray[np.int32]
    ) -> NDArray[np.float32]:
        from lab.worlds.kernels.street_shading import shade_view

        color, ground = np.empty((len(pixels), 3), dtype=np.float32), self._ground
        shade_view(
            T, self._rays(pixels), distance, hit, 1 / self._K.fx, self._solids, ground.heights, ground.apart,
            ground.nearest, ground.course, ground.shade, ground.layout, color,
        )  # fmt: skip
        return color

    def _rays(self, pixels: Floats) -> Floats:
        K = self._K
        if pixels is self._pixels and hasattr(self, "_whole"):
            return self._whole
        rays: Floats = np.column_stack(
            [(pixels[:, 0] - K.cx) / K.fx, (pixels[:, 1] - K.cy) / K.fy, np.ones(len(pixels))]
        )
        return rays

    def _tiles(self, T: Floats) -> tuple[NDArray[np.int32], NDArray[np.int32], Floats]:
        """(starts, listed, nearest) of `cast_view`: the solids whose outline may reach into each tile."""
        camera = (self._corners - T[:3, 3]) @ T[:3, :3]
        nearest = np.maximum(camera[..., 2].min(axis=1), 0.0)
        rows, columns = (-(-side // TILE) for side in self._size)
        chosen = np.flatnonzero((camera[..., 2].max(axis=1) > _NEAR) & (nearest < REACH))
        chosen = chosen[np.argsort(nearest[chosen], kind="stable")]
        low, high = self._bounds(camera[chosen])
        first = np.floor(np.maximum(low, 0) / TILE).astype(int)
        last = np.floor(np.minimum(high, np.array(self._size)[::-1] - 1) / TILE).astype(int)
        width, height = np.maximum(last - first + 1, 0).T
        count = width * height
        owner = np.repeat(np.arange(len(chosen)), count)
        within = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        tile = (first[owner, 1] + within // np.maximum(width, 1)[owner]) * columns
        tile += first[owner, 0] + within % np.maximum(width, 1)[owner]
        order = np.argsort(tile, kind="stable")
        starts = np.searchsorted(tile[order], np.arange(rows * columns + 1)).astype(np.int32)
        listed = chosen[owner[order]].astype(np.int32)
        return starts, listed if len(listed) else np.zeros(1, np.int32), nearest

    def _bounds(self, camera: Floats) -> tuple[Floats, Floats]:
        """Smallest and largest pixel (n, 2) of boxes, the part in front of the camera: (n, 8, 3) corners."""
        a, b = camera[:, _EDGES[:, 0]], camera[:, _EDGES[:, 1]]
        share = (_NEAR - a[..., 2:]) / np.where(a[..., 2:] == b[..., 2:], 1e-9, b[..., 2:] - a[..., 2:])
        crossing = a + np.clip(share, 0, 1) * (b - a)
        points = np.concatenate([camera, crossing], axis=1)
        front = points[..., 2] > _NEAR * 0.999
        z = np.where(front, points[..., 2], 1.0)
        K = self._K
        u, v = K.fx * points[..., 0] / z + K.cx, K.fy * points[..., 1] / z + K.cy
        low = [np.where(front, x, np.inf).min(axis=1) - 1 for x in (u, v)]
        high = [np.where(front, x, -np.inf).max(axis=1) + 1 for x in (u, v)]
        limits: dict[str, Any] = {"a_min": -1e6, "a_max": 1e6}
        return np.clip(np.stack(low, axis=1), **limits), np.clip(np.stack(high, axis=1), **limits)


def _outline(hit: NDArray[np.int32], distance: Floats) -> NDArray[np.bool_]:
    """(H·W,) pixels next to another solid, or to a jump of the same one."""
    result = np.zeros(hit.shape, dtype=bool)
    for here, there in (((slice(1, None),), (slice(None, -1),)),
                        ((slice(None), slice(1, None)), (slice(None), slice(None, -1)))):  # fmt: skip
        change = hit[here] != hit[there]
        result[here] |= change
        result[there] |= change
    return result.ravel()
