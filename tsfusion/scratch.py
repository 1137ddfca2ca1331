# SPDX-License-Identifier: MIT
"""Memory for one keyframe at a time: its rays, the blocks they touch and its sums. Reused, never per call."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.config import SensorModel
from tsfusion.errors import MapFull
from tsfusion.kernels import blocks, rays, smooth
from tsfusion.kernels.integrate import CUBE
from tsfusion.kernels.traversal import MAX_CROSSED, RAY_FIELDS
from tsfusion.keyframe import Keyframe
from tsfusion.storage import GrowingArray

BANDS = 64  # units of parallel work; fixed, so that nothing depends on the thread count
FULL_WEIGHT_SIGMA = 0.25  # voxels: noise below this no longer shows in the map


class Scratch:
    """Rays of the current keyframe (`rays`, by `band_start`/`band_count`) and what they touch.

    After `touch`, block `i < touched` has key `touched_keys[i]`, slot `touched_slots[i]` (-1 = new) and the
    sums `frame[i]`; `table`/`table_index` find `i` from a key.
    """

    def __init__(self, *, color: bool, regularised: bool, max_blocks: int) -> None:
        self.color = color
        self.colored = False  # the current keyframe brings colour, and the map keeps it
        self.regularised = regularised
        self.max_blocks = max_blocks
        self.rays = np.zeros((0, RAY_FIELDS), np.int32)
        self.band_start = np.zeros(BANDS, np.int32)
        self.band_count = np.zeros(BANDS, np.int32)
        self.band_samples = np.zeros(BANDS, np.int32)
        self._bundles = (
            np.zeros((BANDS, rays.TABLE_SIZE), np.int64),
            np.zeros((BANDS, rays.TABLE_SIZE, rays.SUM_FIELDS), np.int32),
            np.zeros((BANDS, rays.TABLE_SIZE, 3), np.int64),
            np.zeros((BANDS, rays.TILE_SAMPLES), np.int32),
        )
        self.signal = np.zeros((BANDS, MAX_CROSSED, smooth.SIGNAL_FIELDS), np.float32)
        self.crossed = np.zeros((BANDS, MAX_CROSSED, 2), np.int32)
        self._overflow = np.zeros(1, np.int32)
        self._set_table_size(1 << 14)
        self._frame = GrowingArray((CUBE,), np.int64, 1024)
        self._frame_color = GrowingArray((CUBE, 2), np.int64, 1024 if color else 1)
        self._votes = GrowingArray((CUBE,), np.int64, 1024 if regularised else 1)
        self.touched = 0

    @property
    def frame(self) -> NDArray[np.int64]:
        return self._frame.array

    @property
    def frame_color(self) -> NDArray[np.int64]:
        return self._frame_color.array

    @property
    def votes(self) -> NDArray[np.int64]:
        return self._votes.array

    def make_rays(self, keyframe: Keyframe, model: SensorModel, voxel_size: float, bundle: bool) -> int:
        """Fill `rays`; returns the number of valid samples."""
        parameters = model_parameters(model, voxel_size, keyframe.baseline_fx)
        self.colored = self.color and keyframe.color is not None
        T = keyframe.T_world_camera
        common = (
            int(bundle), *self._bundles, self._rays_for(keyframe.shape),
            self.band_start, self.band_count, self.band_samples,
        )  # fmt: skip
        if keyframe.kind == "points":
            pose = np.ascontiguousarray(T[:3]) / voxel_size
            origins = keyframe.origins if keyframe.origins is not None else np.zeros(3, np.float32)
            rays.rays_from_points(
                keyframe.points, origins.reshape(-1, 3),
                *_optional(keyframe.color, (1, 3)), *_optional(keyframe.confidence, (1,)),
                pose, parameters, *common,
            )  # fmt: skip
        else:
            assert keyframe.intrinsics is not None  # checked by Keyframe
            if keyframe.kind == "disparity":
                assert keyframe.baseline_fx is not None
                scale = keyframe.baseline_fx / keyframe.disparity_scale
            else:
                scale = keyframe.depth_scale if keyframe.measurement.dtype == np.uint16 else 1.0
            K = keyframe.intrinsics
            R = T[:3, :3] / voxel_size
            du, dv = R[:, 0] / K.fx, R[:, 1] / K.fy
            camera = np.stack([du, dv, R[:, 2] - K.cx * du - K.cy * dv, T[:3, 3] / voxel_size])
            rays.rays_from_image(
                keyframe.measurement, int(keyframe.kind == "disparity"), scale,
                *_optional(keyframe.color, (1, 1, 3)), *_optional(keyframe.confidence, (1, 1)),
                camera, parameters, *common,
            )  # fmt: skip
        return int(self.band_samples.sum())

    def touch(self, map_keys: NDArray[np.int64], map_slots: NDArray[np.int32]) -> None:
        """Find the blocks the rays cross and make room for their sums.

        Raises:
            MapFull: when they are more than `max_blocks` (a wrong scale or pose, usually).
        """
        while True:
            self.table[:] = 0
            self._overflow[0] = 0
            blocks.touch_blocks(self.rays, self.band_start, self.band_count, self.table, self._overflow)
            count = 0
            if not self._overflow[0]:
                count = blocks.index_blocks(
                    self.table, self.table_index, map_keys, map_slots, self.touched_keys, self.touched_slots
                )
                if count <= min(len(self.touched_keys), self.max_blocks):
                    break
            if count > self.max_blocks or len(self.table) > 8 * self.max_blocks:
                raise MapFull(
                    f"a keyframe may touch at most max_blocks_per_keyframe = {self.max_blocks} blocks, "
                    f"this one touches {count or 'far more'}; check its depth scale, or raise voxel_size"
                )
            self._set_table_size(2 * len(self.table))
        self.touched = count
        self._frame.reserve(count)
        if self.colored:
            self._frame_color.reserve(count)
        if self.regularised:
            self._votes.reserve(count)

    def clear(self) -> None:
        """Zero the sums of the current keyframe, whatever became of it."""
        self.frame[: self.touched] = 0
        if self.colored:
            self.frame_color[: self.touched] = 0
        if self.regularised:
            self.votes[: self.touched] = 0
        self.touched = 0

    @property
    def nbytes(self) -> int:
        arrays = [value for value in vars(self).values() if isinstance(value, np.ndarray)]
        arrays += self._bundles
        return sum(a.nbytes for a in arrays) + sum(
            g.array.nbytes for g in (self._frame, self._frame_color, self._votes)
        )

    def _set_table_size(self, size: int) -> None:
        self.table = np.zeros(size, np.int64)
        self.table_index = np.zeros(size, np.int32)
        self.touched_keys = np.zeros(size // 4, np.int64)  # a fuller table is grown first
        self.touched_slots = np.zeros(size // 4, np.int32)

    def _rays_for(self, shape: tuple[int, ...]) -> NDArray[np.int32]:
        if len(shape) == 2:
            tiles = -(-shape[0] // rays.TILE) * -(-shape[1] // rays.TILE)
        else:
            tiles = -(-shape[0] // rays.TILE_SAMPLES)
        if len(self.rays) < tiles * rays.TILE_SAMPLES:
            self.rays = np.zeros((tiles * rays.TILE_SAMPLES, RAY_FIELDS), np.int32)
        return self.rays


def model_parameters(model: SensorModel, voxel_size: float, baseline_fx: float | None) -> NDArray[np.float64]:
    """The kernel's `model` argument (9 float64, see kernels/rays.py)."""
    slope, z0 = model.sigma_slope, model.sigma_z0
    if baseline_fx is not None and model.disparity_sigma > 0:
        slope, z0 = model.disparity_sigma / baseline_fx, 0.0
    return np.array(
        [
            model.sigma_floor, slope, z0, model.min_support, model.max_support, voxel_size,
            FULL_WEIGHT_SIGMA * voxel_size, model.min_range, model.max_range,
        ]
    )  # fmt: skip


def _optional(array: NDArray[np.uint8] | None, shape: tuple[int, ...]) -> tuple[NDArray[Any], int]:
    return (np.zeros(shape, np.uint8), 0) if array is None else (array, 1)
