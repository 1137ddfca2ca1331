# SPDX-License-Identifier: MIT
"""Common odometry of RGB-D cameras to compare with: OpenCV's, and Open3D's in its best modes."""

from abc import ABC, abstractmethod
from importlib import import_module
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry.frame import Frame
from tsfusion.scanner.localization.localizer import Lost, PoseCorrections, TrackedPose

MAX_DEPTH = 5.0  # metres
ITERATIONS = (20, 10, 5)  # coarse to fine; the default, twice to five times fewer, is too few at 7.5 Hz
KEYFRAME = 0.1, np.deg2rad(10)  # metres, radians: a new one when the camera has moved or turned so far


class FrameToFrame(ABC):
    """The motion from each frame to the next, multiplied up; a failure keeps the last pose and is Lost."""

    absolute = False

    def __init__(self) -> None:
        self._number = 0
        self._last: Any = None
        self._T = np.eye(4)

    def track(self, frame: Frame) -> TrackedPose | Lost:
        prepared = self.converted(frame)
        step = np.eye(4) if self._last is None else self.motion(self._last, prepared, frame)
        self._last = prepared
        if step is None:
            return Lost(reason="no motion was found", timestamp_ns=frame.timestamp_ns)
        self._T = self._T @ step
        self._number += 1
        return TrackedPose(
            T_world_camera=self._T, timestamp_ns=frame.timestamp_ns, anchor=self._number,
            T_anchor_camera=np.eye(4), starts_anchor=True,
        )  # fmt: skip

    @abstractmethod
    def converted(self, frame: Frame) -> Any:
        """Convert a frame for the library."""

    @abstractmethod
    def motion(self, last: Any, now: Any, frame: Frame) -> NDArray[np.float64] | None:
        """T_last_now, None = failed."""

    def prepare(self) -> None:
        return

    def settle(self) -> None:
        return

    def corrections(self) -> PoseCorrections | None:
        return None

    def reset(self) -> None:
        self._last, self._T = None, np.eye(4)


class Open3DKeyframes(FrameToFrame):
    """`t.pipelines.odometry.rgbd_odometry_multi_scale` against the last keyframe, from the last pose."""

    def __init__(self) -> None:
        super().__init__()
        self._T_key_last = np.eye(4)
        self._key: Any = None

    def converted(self, frame: Frame) -> Any:
        o3d: Any = import_module("open3d")
        assert frame.depth_m is not None
        color = np.zeros((*frame.shape, 3), np.uint8) if frame.color is None else frame.color[:, :, ::-1]
        images = color.astype(np.float32) / 255, frame.depth_m.astype(np.float32)
        return o3d.t.geometry.RGBDImage(
            *(o3d.t.geometry.Image(o3d.core.Tensor(np.ascontiguousarray(image))) for image in images)
        )

    def motion(self, last: Any, now: Any, frame: Frame) -> NDArray[np.float64] | None:
        o3d: Any = import_module("open3d")
        assert frame.intrinsics is not None
        odometry = o3d.t.pipelines.odometry
        self._key = last if self._key is None else self._key
        try:
            found = odometry.rgbd_odometry_multi_scale(
                now, self._key, o3d.core.Tensor(frame.intrinsics.matrix), o3d.core.Tensor(self._T_key_last),
                depth_scale=1.0, depth_max=MAX_DEPTH, criteria_list=_criteria(odometry),
                method=odometry.Method.PointToPlane,
            )  # fmt: skip
        except RuntimeError:  # a singular system: too few pixels agree
            return None
        T_key_now = found.transformation.numpy()
        step = np.asarray(np.linalg.inv(self._T_key_last) @ T_key_now)
        if _is_far(T_key_now):
            self._key, T_key_now = now, np.eye(4)
        self._T_key_last = T_key_now
        return step


def _is_far(T_key_now: NDArray[np.float64]) -> bool:
    """True if the camera is so far from the keyframe that its frame becomes the next one."""
    angle = np.arccos(np.clip((np.trace(T_key_now[:3, :3]) - 1) / 2, -1, 1))
    return bool(np.linalg.norm(T_key_now[:3, 3]) > KEYFRAME[0] or angle > KEYFRAME[1])


def _criteria(odometry: Any) -> list[Any]:
    return [odometry.OdometryConvergenceCriteria(steps, 1e-6, 1e-6) for steps in ITERATIONS]


class Open3DModel(FrameToFrame):
    """Frame to model: `t.pipelines.slam.Model`, the depth that its map predicts from the last pose."""

    voxel_size = 0.01  # metres

    def converted(self, frame: Frame) -> Any:
        o3d: Any = import_module("open3d")
        assert frame.depth_m is not None
        assert frame.intrinsics is not None
        device = o3d.core.Device("CPU:0")
        K = o3d.core.Tensor(frame.intrinsics.matrix)
        now, seen = (o3d.t.pipelines.slam.Frame(*frame.shape, K, device) for _ in range(2))
        color = np.zeros((*frame.shape, 3), np.uint8) if frame.color is None else frame.color[:, :, ::-1]
        for name, image in (("depth", frame.depth_m), ("color", color / 255)):
            pixels = o3d.core.Tensor(np.ascontiguousarray(image, np.float32))
            now.set_data_from_image(name, o3d.t.geometry.Image(pixels))
        if self._last is None:
            T = o3d.core.Tensor(np.eye(4))
            o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)
            self._model = o3d.t.pipelines.slam.Model(self.voxel_size, 16, 10_000, T, device)
            self._add(now, seen)
        return now, seen

    def motion(self, last: Any, now: Any, frame: Frame) -> NDArray[np.float64] | None:
        try:
            odometry = import_module("open3d").t.pipelines.odometry
            found = self._model.track_frame_to_model(
                now[0], last[1], 1.0, MAX_DEPTH, 0.07, odometry.Method.PointToPlane, _criteria(odometry)
            )
        except RuntimeError:  # a singular system: too few pixels agree
            return None
        step = np.asarray(found.transformation.numpy())
        self._T_world_now = self._T @ step
        self._add(*now)
        return step

    def _add(self, now: Any, seen: Any) -> None:
        o3d: Any = import_module("open3d")
        T = self._T_world_now if self._number else np.eye(4)
        self._model.update_frame_pose(self._number, o3d.core.Tensor(T))
        self._model.integrate(now, 1.0, MAX_DEPTH, 8.0)
        self._model.synthesize_model_frame(seen, 1.0, 0.1, MAX_DEPTH, 8.0, False)


class OpenCV(FrameToFrame):
    """`cv2.Odometry` of RGB and depth, default settings."""

    def converted(self, frame: Frame) -> Any:
        assert frame.depth_m is not None
        gray = np.zeros(frame.shape, np.uint8) if frame.gray is None else frame.gray
        return np.where(frame.depth_m < MAX_DEPTH, frame.depth_m, 0).astype(np.float32), gray

    def motion(self, last: Any, now: Any, frame: Frame) -> NDArray[np.float64] | None:
        assert frame.intrinsics is not None
        settings = cv2.OdometrySettings()
        settings.setCameraMatrix(frame.intrinsics.matrix.astype(np.float32))
        odometry = cv2.Odometry(cv2.ODOMETRY_TYPE_RGB_DEPTH, settings, cv2.ODOMETRY_ALGO_TYPE_COMMON)
        frames = [cv2.OdometryFrame(*images) for images in (now, last)]
        for each in frames:
            odometry.prepareFrame(each)
        found, T_last_now = odometry.compute(*frames)
        return np.asarray(T_last_now, np.float64) if found else None
