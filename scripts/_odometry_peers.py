# SPDX-License-Identifier: MIT
"""Common odometry of RGB-D cameras to compare with: Open3D's and OpenCV's, frame to frame."""

from abc import ABC, abstractmethod
from importlib import import_module
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry.frame import Frame
from tsfusion.scanner.localization.localizer import Lost, Pose, PoseCorrections

MAX_DEPTH = 5.0  # metres


class FrameToFrame(ABC):
    """The motion from each frame to the next, multiplied up; a failure keeps the last pose and is Lost."""

    absolute = False

    def __init__(self) -> None:
        self._number = 0
        self._last: Any = None
        self._T = np.eye(4)

    def track(self, frame: Frame) -> Pose | Lost:
        prepared = self.prepare(frame)
        step = np.eye(4) if self._last is None else self.motion(self._last, prepared, frame)
        self._last = prepared
        if step is None:
            return Lost(reason="no motion was found", timestamp_ns=frame.timestamp_ns)
        self._T = self._T @ step
        self._number += 1
        return Pose(
            T_world_camera=self._T, timestamp_ns=frame.timestamp_ns, anchor=self._number,
            T_anchor_camera=np.eye(4), starts_anchor=True,
        )  # fmt: skip

    @abstractmethod
    def prepare(self, frame: Frame) -> Any:
        """Convert a frame for the library."""

    @abstractmethod
    def motion(self, last: Any, now: Any, frame: Frame) -> NDArray[np.float64] | None:
        """T_last_now, None = failed."""

    def corrections(self) -> PoseCorrections | None:
        return None

    def reset(self) -> None:
        self._last, self._T = None, np.eye(4)


class Open3D(FrameToFrame):
    """`compute_rgbd_odometry` with the hybrid term and default options."""

    def prepare(self, frame: Frame) -> Any:
        o3d: Any = import_module("open3d")
        assert frame.depth_m is not None
        color = np.zeros((*frame.shape, 3), np.uint8) if frame.color is None else frame.color
        return o3d.geometry.RGBDImage.create_from_color_and_depth(
            o3d.geometry.Image(np.ascontiguousarray(color[:, :, ::-1])), o3d.geometry.Image(frame.depth_m),
            depth_scale=1.0, depth_trunc=MAX_DEPTH,
        )  # fmt: skip

    def motion(self, last: Any, now: Any, frame: Frame) -> NDArray[np.float64] | None:
        o3d: Any = import_module("open3d")
        odometry = o3d.pipelines.odometry
        K, (height, width) = frame.intrinsics, frame.shape
        assert K is not None
        found, T_last_now, _ = odometry.compute_rgbd_odometry(
            now, last, o3d.camera.PinholeCameraIntrinsic(width, height, K.fx, K.fy, K.cx, K.cy), np.eye(4),
            odometry.RGBDOdometryJacobianFromHybridTerm(), odometry.OdometryOption(depth_max=MAX_DEPTH),
        )  # fmt: skip
        return np.asarray(T_last_now) if found else None


class OpenCV(FrameToFrame):
    """`cv2.Odometry` of RGB and depth, default settings."""

    def prepare(self, frame: Frame) -> Any:
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
