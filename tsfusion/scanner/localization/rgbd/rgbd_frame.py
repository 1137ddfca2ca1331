# SPDX-License-Identifier: MIT
"""Prepare an RGB-D frame for tracking, and make tracking keyframes from frames."""

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import InvalidKeyframe
from tsfusion.geometry import se3
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.scanner.localization import features
from tsfusion.scanner.localization.rgbd import point_to_plane

Gray = NDArray[np.uint8]
MAX_CORNERS = 400  # corners followed from a tracking keyframe
MAX_ORB_CORNERS = 600
MAX_RATIO = 0.8  # best match's distance divided by the second best's
MAX_DIFFERENT_BITS = 64  # of 256, in a match
PATTERN_WINDOW = 9  # grey is normalised over 9×9 blocks
HALF_CONTRAST = 8.0  # grey levels
JPEG_QUALITY = 95  # for kept images: a fifth of the memory, and a change below a camera's noise


@dataclass(frozen=True, eq=False)
class RGBDFrame:
    """Grey image and planes of one frame."""

    intrinsics: Intrinsics
    shape: tuple[int, ...]  # (H, W) of the image
    image: Gray | bytes | None  # grey, (H, W) uint8 or a JPEG; None without an image
    surface: point_to_plane.PlaneImage  # planes of the depth image

    @classmethod
    def of(cls, frame: Frame) -> "RGBDFrame":
        """Prepare a frame.

        Raises:
            InvalidKeyframe: the frame has no depth image.
        """
        depth = frame.depth_m
        if depth is None or frame.intrinsics is None:
            raise InvalidKeyframe(
                f"the rgbd localizer needs a depth or disparity image in every frame, got {frame.kind}; "
                "take the localizer `stereo` for pairs and `lidar` for points"
            )
        return cls(
            frame.intrinsics, depth.shape, frame.gray, point_to_plane.fit_planes(depth, frame.intrinsics)
        )

    @property
    def gray(self) -> Gray | None:
        """Grey image, (H, W) uint8; None without an image."""
        if not isinstance(self.image, bytes):
            return self.image
        return np.asarray(cv2.imdecode(np.frombuffer(self.image, np.uint8), cv2.IMREAD_GRAYSCALE), np.uint8)

    def packed(self) -> "RGBDFrame":
        """Return the frame with its image as a JPEG, without cached results."""
        if self.image is None or isinstance(self.image, bytes):
            return self
        done, jpeg = cv2.imencode(".jpg", self.image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
        return replace(self, image=jpeg.tobytes()) if done else self  # a JPEG cannot be so wide

    @property
    def columns(self) -> int:
        """Width of the image, pixels."""
        return self.shape[1]

    @cached_property
    def pattern(self) -> NDArray[np.float32] | None:
        """Normalised grey of the blocks, (rows·columns,): (grey - mean) / contrast. None without an image."""
        gray = self.gray
        if gray is None:
            return None
        rows, columns = self.surface.shape
        block = self.columns // columns
        whole = gray[: rows * block, : columns * block]
        small = cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA).astype(np.float32)
        around = (PATTERN_WINDOW, PATTERN_WINDOW)
        away = small - cv2.blur(small, around)
        contrast = np.sqrt(cv2.blur(away * away, around) + HALF_CONTRAST**2)
        pattern: NDArray[np.float32] = (away / contrast).ravel()
        return pattern

    @cached_property
    def orb_corners(self) -> tuple[features.Pixels, NDArray[np.uint8]]:
        """ORB corners (Rublee et al. 2011): (n, 2) pixels and (n, 32) uint8 descriptors."""
        gray = self.gray
        if gray is not None:
            points, found = cv2.ORB.create(MAX_ORB_CORNERS).detectAndCompute(gray, None)
            if found is not None and len(points):
                return np.array([point.pt for point in points], np.float32), found.astype(np.uint8)
        return np.empty((0, 2), np.float32), np.empty((0, 32), np.uint8)

    def back_project(self, pixels: features.Pixels) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """Intersect the rays of (n, 2) pixels with blocks' planes. Return (n, 3) points, (n,) found."""
        K, (rows, columns) = self.intrinsics, self.surface.shape
        column, row = ((pixels + 0.5) / (self.columns // columns)).astype(np.intp).T
        inside = (column >= 0) & (row >= 0) & (column < columns) & (row < rows)
        normals, offsets = self.surface.planes(np.where(inside, row * columns + column, 0))
        rays = features.back_project(pixels, np.ones(len(pixels)), K)
        toward = np.einsum("in,ni->n", normals.astype(np.float64), rays)
        ok = inside & (offsets > 0) & (toward > 1e-3)
        z = offsets.astype(np.float64) / np.where(ok, toward, 1)
        return rays * z[:, None], ok


@dataclass(frozen=True, eq=False)
class TrackingKeyframe:
    """Frame with a pose, which later frames are aligned to."""

    number: int  # anchor number
    T_world_camera: se3.Transform  # (4, 4)
    frame: RGBDFrame
    corners: features.Pixels  # (n, 2) pixels
    points: NDArray[np.float64]  # (n, 3) metres, the corners in the camera's axes
    velocity: se3.Twist | None = None  # of the camera in its axes, each second; None = not known

    @classmethod
    def of(cls, frame: RGBDFrame, number: int, T_world_camera: se3.Transform) -> "TrackingKeyframe":
        """Make a tracking keyframe of a frame: find its corners."""
        kept = replace(frame, surface=frame.surface.without_points())
        if frame.gray is None:
            return cls(number, T_world_camera, kept, np.empty((0, 2), np.float32), np.empty((0, 3)))
        corners = features.corners(frame.gray, MAX_CORNERS)
        corners = corners[features.stronger_than_noise(frame.gray, corners)]
        points, ok = frame.back_project(corners)
        return cls(number, T_world_camera, kept, corners[ok], points[ok])

    def packed(self) -> "TrackingKeyframe":
        """Return the keyframe in little memory, for use after a newer keyframe exists."""
        return replace(self, frame=self.frame.packed())

    def follow(
        self, frame: RGBDFrame, T_keyframe_camera: se3.Transform
    ) -> tuple[NDArray[np.float64], features.Pixels]:
        """Follow corners into a frame near `T_keyframe_camera`. Return (n, 3) points, (n, 2) pixels."""
        old, new = self.frame.gray, frame.gray
        if old is None or new is None or old.shape != new.shape or not len(self.points):
            return np.empty((0, 3)), np.empty((0, 2), np.float32)
        K = frame.intrinsics
        q = se3.apply(se3.inverse(T_keyframe_camera), self.points)
        ahead = q[:, 2] > 0.05
        z = np.where(ahead, q[:, 2], 1)
        expected = np.stack([K.fx * q[:, 0] / z + K.cx, K.fy * q[:, 1] / z + K.cy], axis=1)
        margin = frame.columns // 16
        ok = ahead & (expected > -margin).all(axis=1)
        ok &= (expected[:, 0] < frame.shape[1] + margin) & (expected[:, 1] < frame.shape[0] + margin)
        guess = expected[ok].astype(np.float32)
        moved, found = features.follow(old, new, self.corners[ok], guess=guess, thorough=False)
        return self.points[ok][found], moved[found]

    def recall(self, frame: RGBDFrame) -> tuple[NDArray[np.float64], features.Pixels]:
        """Match ORB corners with a frame at any pose. Return (n, 3) points, (n, 2) pixels in the frame."""
        pixels, here = frame.orb_corners
        mine, there = self.frame.orb_corners
        if len(here) < 2 or len(there) < 2:
            return np.empty((0, 3)), np.empty((0, 2), np.float32)
        pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(there, here, k=2)
        good = [a for a, b in pairs if a.distance < min(MAX_RATIO * b.distance, MAX_DIFFERENT_BITS)]
        query = np.array([match.queryIdx for match in good], dtype=np.intp)
        train = np.array([match.trainIdx for match in good], dtype=np.intp)
        points, ok = self.frame.back_project(mine[query].reshape(-1, 2))
        return points[ok], pixels[train][ok].reshape(-1, 2)
