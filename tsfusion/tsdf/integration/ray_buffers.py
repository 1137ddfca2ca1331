# SPDX-License-Identifier: MIT
"""Hold the rays of one keyframe and the blocks they touch, in memory that the next keyframe reuses."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.config import SensorModel, VolumeConfig
from tsfusion.geometry.keyframe import Intrinsics, Keyframe
from tsfusion.kernels.base import sensor_noise
from tsfusion.kernels.base.voxel_traversal import COST, RAY_FIELDS, SAMPLES, STRIP_FIELDS, UNIT
from tsfusion.kernels.integration import ray_smoothing, rays_from_images, rays_from_points
from tsfusion.kernels.integration.integrate import (
    CUBE,
    TOUCHED_COUNT,
    TOUCHED_HEADER,
    TOUCHED_MISSING,
    TOUCHED_OVERFLOW,
    UNIT_SCRATCH,
)
from tsfusion.tsdf.integration.carved_blocks import CarvedBlocks, PointRays
from tsfusion.tsdf.store.growing_array import GrowingArray

_FEW_MISSING = 1 << 15  # size of the set of missing blocks for a usual keyframe
STRIPS = 64  # units of parallel work; fixed, so that no result depends on the thread count
FULL_WEIGHT_SIGMA = 0.25  # voxels; smaller noise does not show in the map
_NOTHING = {len(shape): np.zeros(shape, np.uint8) for shape in ((1,), (1, 3))}


class RayBuffers:
    """Memory for one keyframe's rays (`rays`, in `strips`), the slots they touch (`touched`), keys of missing
    blocks (`missing`, a hash set), and carved space (`carved`)."""

    def __init__(self, *, color: bool, regularised: bool) -> None:
        self._modelled: tuple[Any, ...] = ()  # inputs of `_parameters`
        self._parameters = np.empty(0)
        self.color = color
        self.colored = False  # the current keyframe brings colour, and the map keeps it
        self.rays = np.zeros((0, RAY_FIELDS), np.int32)
        self.again = np.zeros((2, 0), np.int32)
        self.scratch = np.zeros(0, np.int64)
        self.strips = np.zeros((STRIPS, STRIP_FIELDS), np.int32)
        self.missing = np.zeros(_FEW_MISSING, np.int64)
        self.carved = CarvedBlocks()
        self._touched = GrowingArray((), np.int32, 1024)
        self._owners = GrowingArray((), np.int64, 1024)
        units = STRIPS * ray_smoothing.SIGNAL if regularised else 1
        self.signal = np.zeros(units * ray_smoothing.SIGNAL_FIELDS, np.float32)
        self.crossed = np.zeros(units * ray_smoothing.CROSSED_FIELDS, np.int32)
        self._votes = GrowingArray((CUBE,), np.int64, 1024 if regularised else 1)
        self._voted = GrowingArray((CUBE,), np.int32, 1024 if regularised else 1)

    @property
    def touched(self) -> NDArray[np.int32]:
        """Report on touched blocks: counts and flags, then the slots (kernels/integration/integrate.py)."""
        return self._touched.array

    @property
    def votes(self) -> NDArray[np.int64]:
        """Votes of the smoothing along rays for each voxel of touched blocks; zero between keyframes."""
        return self._votes.array

    @property
    def voted(self) -> NDArray[np.int32]:
        """Number of voxels that have votes, and their indices in `votes` (`ray_smoothing`)."""
        return self._voted.array

    @property
    def touched_slots(self) -> NDArray[np.int32]:
        return self.touched[TOUCHED_HEADER : TOUCHED_HEADER + self.touched[TOUCHED_COUNT]]

    @property
    def owners(self) -> NDArray[np.int64]:
        """Number of the thread (unit) that adds to each block, by slot (kernels/integration/integrate.py)."""
        return self._owners.array

    def reserve_touched(self, blocks: int) -> None:
        """Allocate memory for a list of all `blocks` of the map, which a keyframe may touch."""
        self._touched.reserve(TOUCHED_HEADER + blocks)
        self._owners.reserve(blocks)

    def share_out(self, units: int) -> None:
        """Assign neighbouring strips of about equal total cost to each of `units` threads."""
        if self.again.shape[1] < len(self.rays):
            self.again = np.zeros((2, len(self.rays)), np.int32)
        if len(self.scratch) < units * UNIT_SCRATCH:
            self.scratch = np.zeros(units * UNIT_SCRATCH, np.int64)
        cost = self.strips[:, COST].astype(np.int64) + 1
        before = np.cumsum(cost) - cost // 2
        self.strips[:, UNIT] = np.minimum(before * units // int(cost.sum()), units - 1)

    def make_rays(self, keyframe: Keyframe, config: VolumeConfig) -> None:
        """Convert a keyframe to rays (`rays`) and, if the map carves, carved blocks (`carved`)."""
        voxel_size, bundle = config.voxel_size, int(config.bundle)
        parameters = self._model(config, keyframe.sensor, keyframe.baseline_fx)
        self.colored = self.color and keyframe.color is not None
        T = keyframe.T_world_camera
        self.carved.forget()
        if keyframe.kind == "points":
            pose = np.ascontiguousarray(T[:3]) / voxel_size
            origins = keyframe.origins
            if origins is None or not len(origins):
                origins = np.zeros(3, np.float32)
            starts, confidence = origins.reshape(-1, 3), _optional(keyframe.confidence, 1)
            self._rays_of_points(
                keyframe.points, starts, *_optional(keyframe.color if self.colored else None, 2), *confidence,
                pose, parameters, bundle,
            )  # fmt: skip
            if not config.space_carving:
                most = config.max_blocks_per_keyframe
                points = PointRays(keyframe.measurement, starts, *confidence)
                self.carved.find_clear_of_points(points, T, parameters, most)
        else:
            height = keyframe.shape[0]
            color = keyframe.color if self.colored else None
            image, confidence = self.as_read(keyframe.measurement), _optional(keyframe.confidence, 2)
            read_as = int(keyframe.kind == "disparity"), _depth_scale(keyframe)
            self._rays_of_image(
                image, *read_as, *_optional(None if color is None else color.reshape(height, -1), 2),
                *confidence, _camera(keyframe, voxel_size), parameters, bundle,
            )  # fmt: skip
            find = self.carved.find if config.space_carving else self.carved.find_clear
            find(keyframe, (image, *read_as, *confidence), parameters, config.max_blocks_per_keyframe)

    def _model(
        self, config: VolumeConfig, sensor: str | None, baseline_fx: float | None
    ) -> NDArray[np.float64]:
        """Return the sensor model's numbers for kernels, reused if they are those of the last keyframe."""
        modelled = config, sensor, baseline_fx
        if modelled != self._modelled:
            self._parameters = model_parameters(
                config.model(sensor), config.voxel_size, baseline_fx,
                outlier_filter=config.outlier_filter, space_carving=config.space_carving,
            )  # fmt: skip
            self._modelled = modelled
        return self._parameters

    @property
    def samples(self) -> int:
        return int(self.strips[:, SAMPLES].sum())

    @staticmethod
    def as_read(image: NDArray[Any]) -> NDArray[Any]:
        """Return the image as float32: kernels for a second dtype cost a second of compilation per start."""
        return image.astype(np.float32, copy=False)

    def _rays_of_points(self, points: Any, *rest: Any) -> None:
        self._reserve_rays(len(points))
        rays_from_points.rays_from_points(points, *rest, self.rays, self.strips)

    def _rays_of_image(self, image: NDArray[Any], *rest: Any) -> None:
        self._reserve_rays(rays_from_images.most_rays(*image.shape))
        rays_from_images.rays_from_image(image, *rest, self.rays, self.strips)

    @property
    def most_missing(self) -> int:
        """Largest number of keys in the hash set `missing`: half of its entries."""
        return len(self.missing) // 2

    def take_missing(self) -> NDArray[np.int64]:
        """Return the keys of the missing blocks, in an order set only by the keys and the set's size.

        Empties `missing`, and shrinks it if it was much too large.
        """
        keys: NDArray[np.int64] = self.missing[self.missing != 0]
        if len(self.missing) > max(_FEW_MISSING, 16 * len(keys)):
            self.missing = np.zeros(_FEW_MISSING, np.int64)
        self.forget_missing()
        return keys

    def forget_missing(self) -> None:
        """Empty `missing` without allocating memory."""
        self.missing[:] = 0
        self.touched[[TOUCHED_OVERFLOW, TOUCHED_MISSING]] = 0

    def grow_missing(self, keys: int) -> None:
        """Empty the set `missing`, and make it large enough for `keys` keys."""
        self.missing = np.zeros(1 << max(2 * keys - 1, 1).bit_length(), np.int64)
        self.touched[[TOUCHED_OVERFLOW, TOUCHED_MISSING]] = 0

    def reserve_votes(self) -> None:
        """Allocate memory for the smoothing's votes in all touched blocks."""
        self._votes.reserve(int(self.touched[TOUCHED_COUNT]))
        # One chunk holds the length; each unit may leave a part of its last chunk empty
        self._voted.reserve(int(self.touched[TOUCHED_COUNT]) + 1 + STRIPS * ray_smoothing.CHUNK // CUBE)

    @property
    def nbytes(self) -> int:
        arrays = [value for value in vars(self).values() if isinstance(value, np.ndarray)]
        growing = self._touched, self._owners, self._votes, self._voted
        return self.carved.nbytes + sum(a.nbytes for a in arrays) + sum(g.array.nbytes for g in growing)

    def _reserve_rays(self, count: int) -> None:
        if len(self.rays) < count:
            self.rays = np.zeros((count, RAY_FIELDS), np.int32)


def model_parameters(
    model: SensorModel,
    voxel_size: float,
    baseline_fx: float | None,
    *,
    outlier_filter: bool = True,
    space_carving: bool = False,
) -> NDArray[np.float64]:
    """Return the sensor model for kernels: (12,) float64, indices in kernels/base/sensor_noise.py."""
    slope, z0 = model.sigma_slope, model.sigma_z0
    if baseline_fx is not None and model.disparity_sigma > 0:
        slope, z0 = model.disparity_sigma / baseline_fx, 0.0
    parameters = np.empty(sensor_noise.MODEL_FIELDS)
    parameters[sensor_noise.SIGMA_FLOOR] = model.sigma_floor
    parameters[sensor_noise.SIGMA_SLOPE] = slope
    parameters[sensor_noise.SIGMA_Z0] = z0
    parameters[sensor_noise.LEAST_SUPPORT] = model.min_support
    parameters[sensor_noise.MOST_SUPPORT] = model.max_support
    parameters[sensor_noise.VOXEL_SIZE] = voxel_size
    parameters[sensor_noise.FULL_WEIGHT_SIGMA] = FULL_WEIGHT_SIGMA * voxel_size
    parameters[sensor_noise.MIN_RANGE] = model.min_range
    parameters[sensor_noise.MAX_RANGE] = model.max_range
    parameters[sensor_noise.DROPS_LONE_SAMPLES] = outlier_filter
    parameters[sensor_noise.SUPPORT_PER_SIGMA] = 3 * 256 / voxel_size
    parameters[sensor_noise.CARVES_SPACE] = space_carving
    parameters[sensor_noise.LEAST_BEHIND] = model.min_behind
    return parameters


def _depth_scale(keyframe: Keyframe) -> float:
    """Return metres per unit of depth, or metres times units for disparity."""
    if keyframe.kind == "disparity":
        assert keyframe.baseline_fx is not None  # checked by Keyframe
        return keyframe.baseline_fx / keyframe.disparity_scale
    return keyframe.depth_scale if keyframe.measurement.dtype == np.uint16 else 1.0


def _camera(keyframe: Keyframe, voxel_size: float) -> NDArray[np.float64]:
    """Return the camera in voxels, (4, 3) float64: steps per column and row, pixel (0, 0), and centre."""
    K, T = keyframe.intrinsics, keyframe.T_world_camera
    assert K is not None  # checked by Keyframe
    rows = np.ascontiguousarray(T[:3].T) / voxel_size
    rows[0] /= K.fx
    rows[1] /= K.fy
    rows[2] = rows[2] - K.cx * rows[0] - K.cy * rows[1]
    return rows


def _optional(array: NDArray[np.uint8] | None, dims: int) -> tuple[NDArray[Any], int]:
    """Return an array (empty for None) that a kernel accepts, and a flag: 1 if it has content."""
    return (_NOTHING[dims], 0) if array is None else (array, 1)


def keyframes_of_every_kind(model: SensorModel, voxel_size: float) -> list[Keyframe]:
    """Return keyframes of 16×16 samples in range, one for each kind of rays, to compile all kernels with."""
    near = max(model.min_range * 1.5, 4 * voxel_size)
    pose, camera = np.eye(4), Intrinsics(20.0, 20.0, 8.0, 8.0)
    color = np.zeros((16, 16, 3), np.uint8)
    metres = np.full((16, 16), near, np.float32)
    units = np.full((16, 16), 1000, np.uint16)
    rays = np.dstack(
        [*np.meshgrid(np.linspace(-0.4, 0.4, 16), np.linspace(-0.4, 0.4, 16)), np.ones((16, 16))]
    )
    points = (rays * near).reshape(-1, 3).astype(np.float32)
    return [
        Keyframe(depth=metres, intrinsics=camera, T_world_camera=pose, color=color),
        Keyframe(depth=units, depth_scale=near / 1000, intrinsics=camera, T_world_camera=pose),
        Keyframe(disparity=units, disparity_scale=1 / 16, baseline_fx=near * 1000 / 16,
                 intrinsics=camera, T_world_camera=pose),
        Keyframe(points=points, T_world_camera=pose, color=color.reshape(-1, 3)),
    ]  # fmt: skip
