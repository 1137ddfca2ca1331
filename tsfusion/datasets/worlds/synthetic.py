# SPDX-License-Identifier: MIT
"""Render recordings of synthetic worlds. Their surfaces are known exactly."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import DatasetError
from tsfusion.datasets.dataset import STREET, Frames
from tsfusion.datasets.worlds import worlds
from tsfusion.datasets.worlds.worlds import GROUND, ROOM, Solids
from tsfusion.geometry.frame import Frame

USUAL_COUNT = 40  # keyframes
FRAME_NS = 100_000_000  # nominal: ten keyframes a second
DEPTH_SCALE = 1e-4  # metres per unit
DISPARITY_SCALE = 1 / 16  # pixels per unit
KINECT_RANGE = 6.0  # metres; the uint16 depth ends at 6.5
TOF_RANGE = (0.5, 4.5)  # metres
COLOR_NOISE = 3.0  # levels, for the colour camera of the time-of-flight sensor
SENSORS = {
    "kinect": KINECT_RANGE + 1,
    "tof": KINECT_RANGE + 1,
    "stereo": 200.0,
    "lidar": None,
}  # metres of reach

# LiDAR axes (x forward, y left, z up) in camera axes.
_T_CAMERA_LIDAR = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
TILE = 16  # rays along a side of a tile
# Metres by which a solid's bounding ball is enlarged: solids so near to a hit point dim its light
# (`daylight`). Rounding errors are far smaller.
WIDER = 0.6

Indices = NDArray[np.int32]


@dataclass(frozen=True)
class SyntheticLidar:
    """Spinning LiDAR: elevations in degrees, range and its noise `sigma` in metres, shares of lost rays."""

    rows: int = 64
    columns: int = 900
    lowest: float = -24.8
    highest: float = 2.0
    max_range: float = 80.0
    sigma: float = 0.02
    dropout: float = 0.02
    grazing: float = 0.03  # |cosine of incidence|; below it, nothing returns


LIDARS = {"room": SyntheticLidar(lowest=-45.0, highest=45.0, max_range=30.0), "street": SyntheticLidar()}
WORLDS: dict[str, Callable[[int], worlds.World]] = {  # number of keyframes → world
    "room": lambda _: worlds.room(),
    "street": lambda count: worlds.street(max(80.0, count + 40.0)),
    "corridor": lambda _: worlds.ring(),
    "rooms": lambda _: worlds.rooms(),
    **{
        name: lambda _, name=name: worlds.room(name)  # type: ignore[misc]
        for name in ("room-untextured", "room-plain", "room-bare")
    },
}


class Synthetic(Frames):
    """Posed keyframes of a world (`room`, `street`, …), seen by one kind of sensor.

    Equal arguments give equal bytes, for any number of threads and order of access. Noise:

    - kinect: Gaussian, σ = 0.0012 + 0.0019 (z - 0.4)² m; uint16 depth in 0.1 mm; no depth beyond 6 m.
    - tof: as of a Kinect v2, σ = (0.0012 + 0.0004 z²) / √cos of the angle to the surface. Pixels at outlines
      lie between front and back or are lost. No depth at grazing angles, below 0.5 m or beyond 4.5 m. Colour
      has white noise of 3 levels.
    - stereo: disparity error 0.35 px correlated over 2.5 px and 0.15 px white, 1 % outliers of 4 px; ×16.
    - lidar: 64 × 900 rays, range error 2 cm, 2 % lost, grazing rays lost. Points have colour.

    Args:
        world: a name in `WORLDS` (`room`, `street`, …), or your own `World`, seen with the room's LiDAR.
        sensor: `kinect`, `tof`, `stereo` or `lidar`; default the world's, `kinect`.
        count: keyframes, spread over the whole path. Default: the first 40 of `World.steps`, which are close
            enough for a scanner. The room's path is a closed circle; the street's has one metre for each
            keyframe.
        seed: of the noise; the world does not change.
        width: of the image, pixels; default 320 in the room, 620 in the street. The noise in pixels is the
            same.
        color: True renders colour too.
        path: of the sensor. In a room `circle` (looking inwards, default), `tour` (the whole room) or
            `handheld` (10 Hz at walking speed, for any count); in the street `drive`.

    Raises:
        DatasetError: the world, sensor or path is unknown, or count or width is too small.
    """

    def __init__(
        self,
        world: str | worlds.World = "room",
        sensor: str | None = None,
        *,
        count: int | None = None,
        seed: int = 0,
        noise: bool = True,
        width: int | None = None,
        color: bool = True,
        path: str | None = None,
    ) -> None:
        if isinstance(world, str) and world not in WORLDS:
            raise DatasetError(
                f"world must be one of {', '.join(WORLDS)}, got {world!r}; in a clone, `pip install -e lab` "
                "adds kitti06, kitti07 and desk"
            )
        if sensor and sensor not in SENSORS:
            raise DatasetError(
                f"sensor of a synthetic world must be kinect, tof, stereo or lidar, got {sensor!r}"
            )
        given, count = count, USUAL_COUNT if count is None else count
        if count < 1 or seed < 0 or (width is not None and width < 16):
            raise DatasetError(
                "expected count >= 1, seed >= 0 and width >= 16, "
                f"got count {count}, seed {seed}, width {width}"
            )
        self.world = WORLDS[world](count) if isinstance(world, str) else world
        self.name, self.sensor, self.skipped = f"synthetic {self.world.name}", sensor or self.world.sensor, {}
        self.usual = STREET if self.world.name == "street" else {}
        self.timestamps_ns = np.arange(count, dtype=np.int64) * FRAME_NS
        path = path or next(iter(self.world.paths))
        if path not in self.world.paths:
            raise DatasetError(f"path must be one of {', '.join(self.world.paths)}, got {path!r}")
        self._path = self.world.paths[path]
        self.camera = _resized(self.world.camera, width)
        self.lidar = LIDARS.get(self.world.name, LIDARS["room"])
        self._count, self._seed, self._noise, self._with_color = count, seed, noise, color
        self._steps = self.world.steps if given is None else count
        lidar = self.sensor == "lidar"
        self._directions = _lidar_rays(self.lidar) if lidar else _camera_rays(self.camera)
        shape = (self.lidar.rows, self.lidar.columns) if lidar else self.camera.size
        self._tiles = RayTiles(self._directions, shape)

    def __len__(self) -> int:
        return self._count

    def distance(self, points: NDArray[np.floating]) -> NDArray[np.float64]:
        """Return the signed distance to the true surface: (n, 3) metres → (n,) float64."""
        return self.world.distance(points)

    def pose(self, index: int) -> NDArray[np.float64]:
        """Return (4, 4) T_world_camera of a keyframe; for LiDAR, T_world_sensor."""
        T = self._path(index, self._steps)
        return T @ _T_CAMERA_LIDAR if self.sensor == "lidar" else T

    def _frame(self, index: int) -> Frame:
        T = self.pose(index)
        distance, incidence, color = self._render(T)
        rng = np.random.default_rng([self._seed, index])
        common: dict[str, Any] = {
            "T_world_camera": T,
            "sensor": self.sensor,
            "timestamp_ns": self._stamp(index),
        }
        if self.sensor == "lidar":
            return Frame(**self._scan(distance, incidence, color, rng), **common)
        height, width = self.camera.size
        z = distance.reshape(height, width)
        common["intrinsics"] = self.camera.intrinsics
        common["color"] = color.reshape(height, width, 3) if len(color) else None
        if self.sensor == "kinect":
            depth = kinect(z, rng if self._noise else None)
            return Frame(depth=depth, depth_scale=DEPTH_SCALE, **common)
        if self.sensor == "tof":
            depth = time_of_flight(z, incidence.reshape(height, width), rng if self._noise else None)
            if self._noise and common["color"] is not None:
                noisy = common["color"] + COLOR_NOISE * rng.standard_normal((height, width, 3))
                common["color"] = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
            return Frame(depth=depth, depth_scale=DEPTH_SCALE, **common)
        baseline_fx = self.camera.baseline * self.camera.intrinsics.fx
        disparity = stereo(z, baseline_fx, rng if self._noise else None)
        return Frame(disparity=disparity, disparity_scale=DISPARITY_SCALE, baseline_fx=baseline_fx, **common)

    def _render(
        self, T: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.uint8]]:
        """Return (distance, |cosine of incidence|, BGR) of every ray from the pose `T`, without noise."""
        from tsfusion.kernels.base import runtime

        runtime.start()
        from tsfusion.kernels.worlds import synthetic_raycast as kernels

        rays = len(self._directions)
        distance, incidence = np.empty(rays), np.empty(rays)
        color = np.empty((rays if self._with_color else 0, 3), dtype=np.uint8)
        reach = SENSORS[self.sensor] or self.lidar.max_range
        solids = self.world.near(T[:3, 3], reach)
        starts, listed = self._tiles.lists(T, solids)
        kernels.cast(
            T, self._directions, solids, self._tiles.tile_of, starts, listed, distance, incidence, color
        )
        return distance, incidence, color

    def _scan(
        self,
        distance: NDArray[np.float64],
        incidence: NDArray[np.float64],
        color: NDArray[np.uint8],
        rng: "np.random.Generator",
    ) -> dict[str, Any]:
        keep = (distance > 0) & (distance < self.lidar.max_range)
        if self._noise:
            keep &= (rng.random(len(distance)) >= self.lidar.dropout) & (incidence > self.lidar.grazing)
            distance = distance + rng.normal(0, self.lidar.sigma, len(distance))
        points = (self._directions[keep] * distance[keep, None]).astype(np.float32)
        return {"points": points, "color": color[keep] if len(color) else None}


def kinect(z: NDArray[np.float64], rng: "np.random.Generator | None") -> NDArray[np.uint16]:
    """Convert (H, W) metres to uint16 of 0.1 mm with noise (Nguyen, Izadi and Lovell 2012); 0 = no return."""
    valid = (z > 0) & (z < KINECT_RANGE)
    if rng is not None:
        z = z + (0.0012 + 0.0019 * (z - 0.4) ** 2) * rng.standard_normal(z.shape)
    return _counted(z, DEPTH_SCALE, valid)


def time_of_flight(
    z: NDArray[np.float64], incidence: NDArray[np.float64], rng: "np.random.Generator | None"
) -> NDArray[np.uint16]:
    """Convert (H, W) metres and |cosines| to uint16 of 0.1 mm, with a Kinect v2's errors; 0 = no return.

    Noise by distance and angle is after Fankhauser et al. 2015. At outlines, pixels mix the light of two
    surfaces.
    """
    valid = (z > TOF_RANGE[0]) & (z < TOF_RANGE[1])
    if rng is not None:
        near, far = (morph(z, np.ones((3, 3), np.uint8)) for morph in (cv2.erode, cv2.dilate))
        outline = far - near > 0.03 + 0.03 * z
        share = rng.random(z.shape)
        mixed = near + rng.random(z.shape) * (far - near)
        z = np.where(outline & (share < 0.3), mixed, z)
        valid &= ~(outline & (share > 0.7)) & (incidence > 0.12)
        sigma = (0.0012 + 0.0004 * z**2) / np.sqrt(np.maximum(incidence, 0.1))
        z = z + sigma * rng.standard_normal(z.shape)
    return _counted(z, DEPTH_SCALE, valid)


def stereo(
    z: NDArray[np.float64], baseline_fx: float, rng: "np.random.Generator | None"
) -> NDArray[np.uint16]:
    """Convert (H, W) metres to uint16 disparity × 16 with a matcher's errors; 0 = no match."""
    valid = z > 0
    disparity = np.divide(baseline_fx, z, out=np.zeros_like(z), where=valid)
    if rng is not None:
        smooth = cv2.GaussianBlur(rng.standard_normal(z.shape), (0, 0), 2.5)
        # A normalised Gaussian of σ pixels leaves 1 / (2 σ √π) of white noise's deviation.
        disparity += 0.35 * (2 * 2.5 * np.sqrt(np.pi)) * smooth + 0.15 * rng.standard_normal(z.shape)
        outlier = rng.random(z.shape) < 0.01
        disparity += np.where(outlier, 4 * rng.standard_normal(z.shape), 0)
    return _counted(disparity, DISPARITY_SCALE, valid)


def _counted(image: NDArray[np.float64], unit: float, valid: NDArray[np.bool_]) -> NDArray[np.uint16]:
    return np.where(valid, np.clip(np.rint(image / unit), 0, 65535), 0).astype(np.uint16)


def _resized(camera: worlds.SyntheticCamera, width: int | None) -> worlds.SyntheticCamera:
    if width is None:
        return camera
    factor = width / camera.size[1]
    size = (round(camera.size[0] * factor), width)
    return worlds.SyntheticCamera(size, camera.intrinsics.scaled(factor), camera.baseline)


def _camera_rays(camera: worlds.SyntheticCamera) -> NDArray[np.float64]:
    """Return the (H·W, 3) float64 directions of a camera's pixels, with z = 1."""
    K, (height, width) = camera.intrinsics, camera.size
    v, u = np.mgrid[:height, :width]
    rays = np.stack([(u - K.cx) / K.fx, (v - K.cy) / K.fy, np.ones(u.shape)], axis=-1)
    return rays.reshape(-1, 3)


def _lidar_rays(lidar: SyntheticLidar) -> NDArray[np.float64]:
    """Return the (rows·columns, 3) float64 unit directions of a LiDAR's rays, x forward, z up."""
    elevation = np.radians(np.linspace(lidar.highest, lidar.lowest, lidar.rows))[:, None]
    azimuth = np.linspace(np.pi, -np.pi, lidar.columns, endpoint=False)[None, :]
    x, y = np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth)
    return np.stack([x, y, np.broadcast_to(np.sin(elevation), x.shape)], axis=-1).reshape(-1, 3)


class RayTiles:
    """Cones around the tiles of an image's rays, to leave out solids that no ray of a tile can meet.

    Args:
        directions: (H·W, 3) float64 directions of the rays, row by row, in the sensor's axes.
        shape: (H, W).
    """

    def __init__(self, directions: NDArray[np.float64], shape: tuple[int, int]) -> None:
        rows, columns = np.mgrid[: shape[0], : shape[1]] // TILE
        self.tile_of: Indices = (rows * (columns.max() + 1) + columns).ravel().astype(np.int32)
        rays = directions / np.linalg.norm(directions, axis=1, keepdims=True)
        count = int(self.tile_of.max()) + 1
        axes = np.stack([np.bincount(self.tile_of, rays[:, k], count) for k in range(3)], axis=1)
        self._axes = axes / np.linalg.norm(axes, axis=1, keepdims=True)
        cosines = np.ones(count)
        np.minimum.at(cosines, self.tile_of, (rays * self._axes[self.tile_of]).sum(axis=1))
        self._angles: NDArray[np.float64] = np.arccos(
            np.clip(cosines, -1, 1)
        )  # half of the cones' opening angle, radians

    def lists(self, T_world_sensor: NDArray[np.float64], solids: Solids) -> tuple[Indices, Indices]:
        """Return (starts, listed) for `cast`: tile t may meet the solids listed[starts[t] : starts[t + 1]].

        Args:
            solids: (m, 12), as in a `World`.
        """
        away = solids[:, 1:4] - T_world_sensor[:3, 3]
        distance = np.linalg.norm(away, axis=1)
        radius = np.linalg.norm(solids[:, 4:7], axis=1) + WIDER
        beyond = np.maximum(distance, radius)
        ball = np.arcsin(radius / beyond)  # half of the angle under which the solid is seen
        cosines = (self._axes @ T_world_sensor[:3, :3].T) @ (away / beyond[:, None]).T
        meets = np.arccos(np.clip(cosines, -1, 1)) <= self._angles[:, None] + ball
        meets |= (distance <= radius) | np.isin(solids[:, 0], (ROOM, GROUND))
        starts = np.concatenate([[0], np.cumsum(meets.sum(axis=1))]).astype(np.int32)
        listed = np.nonzero(meets)[1].astype(np.int32)
        return starts, listed if len(listed) else np.zeros(1, np.int32)
