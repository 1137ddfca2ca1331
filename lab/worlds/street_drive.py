# SPDX-License-Identifier: MIT
"""The paths of KITTI's odometry benchmark, driven through rendered streets whose surface is known.

The path is the benchmark's own ground truth, to the last digit; the street along it is made up. Where the
path comes back, it finds the street as it was.
"""

import hashlib
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from lab.worlds.road_ground import RoadGround
from lab.worlds.roadside import roadside
from tsfusion.core.errors import DatasetError
from tsfusion.datasets.cameras import RecordedCamera
from tsfusion.datasets.dataset import STREET, Frames
from tsfusion.datasets.trajectory_files import read_kitti
from tsfusion.datasets.worlds.worlds import World
from tsfusion.geometry import se3
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.keyframe import Intrinsics

CAMERA_HEIGHT = 1.65  # metres above the road
FRAME_NS = 100_000_000  # KITTI's ten frames a second, without its jitter
SIZE = (370, 1226)  # of sequences 04 to 12
CAMERA = Intrinsics(707.0912, 707.0912, 601.8873, 183.1104)
BASELINE_FX = 379.8145  # metre · pixels: 0.5372 m
BLUR = 0.55  # pixels, of the lens
READ_NOISE, SHOT_NOISE = 1.1, 0.016  # grey levels, and their square a level

Floats = NDArray[np.float64]


class DriveName(NamedTuple):
    """A drive by its name.

    Attributes:
        sequence: of KITTI's odometry benchmark.
        keyframe_distance: metres between keyframes (10° of turn) that gives as many of the true poses as
            the paper fused: 428 on 06, 242 on 07.
    """

    sequence: str
    keyframe_distance: float


@dataclass(frozen=True, eq=False)
class StreetWorld(World):
    """Solids on a ground that is no solid of the table."""

    ground: RoadGround | None = None
    # (3, 3) rotation of the world's points into the axes of the solids (z up) and the ground; None = none
    upright: Floats | None = None

    def distance(self, points: NDArray[np.floating]) -> Floats:
        """Signed distance as `World.distance`, the ground's too."""
        points = self.turned(np.asarray(points, dtype=np.float64).reshape(-1, 3))
        to_solids = super().distance(points)
        return to_solids if self.ground is None else np.minimum(to_solids, self.ground.distance(points))

    def turned(self, points: Floats) -> Floats:
        """The world's points (n, 3) in the axes of its solids."""
        return points if self.upright is None else points @ self.upright.T


DRIVES = {"kitti06": DriveName("06", 2.505), "kitti07": DriveName("07", 2.68)}


class StreetDrive(Frames):
    """Stereo pairs along a KITTI path through a rendered street: 1226×370, at ten a second.

    Exposure changes on the way, differs a little between the cameras, and the grey values carry noise. Equal
    arguments give equal bytes, whatever the thread count and the order of access.

    Args:
        world: a name in `DRIVES`.
        kitti: the benchmark's folder, which holds `poses/06.txt`, or that file; default the folder
            `kitti_odometry` in $TSFUSION_DATA. It may not be passed on, so it does not come with the package.
        count: the first so many frames.
        seed: of the noise; the street does not change.
        width: of the image, pixels.
        color: render colour too, else the grey image stands for it.

    Raises:
        DatasetError: no such drive, no poses, or a count or width that is too small.
    """

    sensor = "stereo"
    usual = STREET

    def __init__(
        self,
        world: str = "kitti06",
        sensor: str = "stereo",
        *,
        kitti: str | Path | None = None,
        count: int | None = None,
        seed: int = 0,
        noise: bool = True,
        width: int | None = None,
        color: bool = True,
    ) -> None:
        if world not in DRIVES:
            raise DatasetError(f"drive must be one of {', '.join(DRIVES)}, got {world!r}")
        if sensor != "stereo":
            raise DatasetError(f"sensor of {world} must be stereo, got {sensor!r}")
        if (count is not None and count < 1) or seed < 0 or (width is not None and width < 64):
            raise DatasetError(
                "expected count >= 1, seed >= 0 and width >= 64, "
                f"got count {count}, seed {seed}, width {width}"
            )
        self.drive = DRIVES[world]
        self.poses_file = find_poses(self.drive.sequence, kitti)
        poses = read_kitti(self.poses_file)
        self.name, self.skipped = f"synthetic {world}", {}
        self._upright = _upright(np.array(poses))
        self.world, self._ground = street_along(np.array(poses), self._upright, name=world)
        self._poses = poses[:count]
        self.timestamps_ns = np.arange(len(self._poses), dtype=np.int64) * FRAME_NS
        factor = 1.0 if width is None else width / SIZE[1]
        self.size = (round(SIZE[0] * factor), round(SIZE[1] * factor))
        self.intrinsics, self.baseline_fx = CAMERA.scaled(factor), BASELINE_FX * factor
        self.camera = RecordedCamera(self.intrinsics, self.size, "KITTI's")
        self._seed, self._noise, self._with_color = seed, noise, color
        self._renderer: Any = None

    def __len__(self) -> int:
        return len(self._poses)

    def distance(self, points: NDArray[np.floating]) -> Floats:
        """Signed distance to the true surface: (n, 3) metres → (n,) float64."""
        return self.world.distance(points)

    def depth(self, index: int) -> Floats:
        """(H, W) true metres along the left camera's axis; 0 = the sky."""
        depth: Floats = self._rendering().depth(self._eye(index, 0.0))
        return depth

    def fingerprint(self) -> str:
        """Hash of the poses and of small pictures of some of them: another street or look has another."""
        from lab.worlds.street_views import StreetRenderer

        settings = [self._seed, self._noise, *self.size, BLUR, READ_NOISE, SHOT_NOISE]
        digest = hashlib.sha256(np.array(self._poses).tobytes() + np.array(settings, dtype=float).tobytes())
        small = StreetRenderer(self.world.solids, self._ground, (29, 96), CAMERA.scaled(96 / SIZE[1]))
        for index in range(0, len(self), 50):
            light = small.view(self._eye(index, 0.0))[1] * _exposure(index)[0]
            digest.update(np.rint(255 * np.clip(light, 0, 1)).astype(np.uint8).tobytes())
        return digest.hexdigest()

    def _frame(self, index: int) -> Frame:
        lights = [self._light(index, shift) for shift in (0.0, self.baseline_fx / self.intrinsics.fx)]
        exposure = _exposure(index)
        left, right = (
            self._developed(_grey(light), gain, (index, camera))
            for camera, (light, gain) in enumerate(zip(lights, exposure, strict=True))
        )
        color = self._developed(lights[0], exposure[0], (index, 2)) if self._with_color else None
        if color is None:
            color = np.repeat(left[:, :, None], 3, axis=2)
        return self._posed_frame(
            index,
            left=left,
            right=right,
            baseline_fx=self.baseline_fx,
            intrinsics=self.intrinsics,
            color=color,
        )

    def _light(self, index: int, shift: float) -> NDArray[np.float32]:
        """(H, W, 3) float32 BGR light, `shift` metres to the right of the left camera."""
        light: NDArray[np.float32] = self._rendering().view(self._eye(index, shift))[1]
        sigma = BLUR * self.size[1] / SIZE[1]
        return cv2.GaussianBlur(light, (0, 0), sigma) if sigma > 0.3 else light

    def _eye(self, index: int, shift: float) -> Floats:
        """(4, 4) pose of a camera in the street's axes (z up)."""
        T = self._poses[index]
        assert T is not None
        position = T[:3, 3] + shift * T[:3, 0]
        return se3.transform(self._upright @ T[:3, :3], self._upright @ position)

    def _rendering(self) -> Any:
        if self._renderer is None:
            from lab.worlds.street_views import StreetRenderer

            self._renderer = StreetRenderer(self.world.solids, self._ground, self.size, self.intrinsics)
        return self._renderer

    def _developed(self, light: NDArray[np.float32], gain: float, what: tuple[int, int]) -> NDArray[np.uint8]:
        """Grey levels of a linear image: exposure, gamma, shot and read noise."""
        level = 255 * np.sqrt(np.clip(gain * light, 0, 1))  # gamma 2
        if self._noise:
            rng = np.random.default_rng([self._seed, *what])
            sigma = np.sqrt(READ_NOISE**2 + SHOT_NOISE * level)
            level += sigma * rng.standard_normal(level.shape, dtype=np.float32)
        image: NDArray[np.uint8] = np.clip(np.rint(level), 0, 255).astype(np.uint8)
        return image


def find_poses(sequence: str, kitti: str | Path | None) -> Path:
    """Poses file of a sequence of KITTI's odometry benchmark; raises DatasetError where there is none."""
    root = kitti
    if root is None and "TSFUSION_DATA" in os.environ:
        root = Path(os.environ["TSFUSION_DATA"]) / "kitti_odometry"
    if root is None:
        raise DatasetError(
            f"the path of KITTI {sequence} is needed: say --option kitti=FOLDER, which holds "
            f"poses/{sequence}.txt (data_odometry_poses.zip of KITTI's odometry benchmark)"
        )
    root = Path(root).expanduser()
    file = root if root.is_file() else root / "poses" / f"{sequence}.txt"
    if not file.is_file():
        raise DatasetError(
            f"{file} does not exist: expected the true poses of KITTI {sequence} "
            "(data_odometry_poses.zip of KITTI's odometry benchmark)"
        )
    return file


def street_along(poses: Floats, upright: Floats, *, name: str) -> tuple[StreetWorld, RoadGround]:
    """Street along the poses (n, 4, 4) of a camera 1.65 m above the road."""
    ground = RoadGround.along(poses[:, :3, 3] @ upright.T - (0, 0, CAMERA_HEIGHT))
    solids = roadside(ground, seed=len(poses) + sum(map(ord, name)))
    return StreetWorld(name, solids, {}, ground=ground, upright=upright), ground


def _upright(poses: Floats) -> Floats:
    """(3, 3) rotation into axes with z up, as cameras are held on average, and x as the first one looks."""
    up = -poses[:, :3, 1].mean(axis=0)
    up /= np.linalg.norm(up)
    forward = poses[0, :3, 2] - (poses[0, :3, 2] @ up) * up
    forward /= np.linalg.norm(forward)
    return np.stack([forward, np.cross(up, forward), up])


def _exposure(index: int) -> tuple[float, float]:
    """Gains of the left and the right camera: they follow the light slowly, and differ by two percent."""
    gain = 1.05 * 1.18 ** (np.sin(index / 23.0) + 0.6 * np.sin(index / 7.3 + 1))
    return float(gain), float(gain * (1 + 0.02 * np.sin(index / 41.0 + 2)))


def _grey(light: NDArray[np.float32]) -> NDArray[np.float32]:
    grey: NDArray[np.float32] = light @ np.array([0.114, 0.587, 0.299], dtype=np.float32)
    return grey
