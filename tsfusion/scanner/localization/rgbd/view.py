# SPDX-License-Identifier: MIT
"""What the RGB-D tracker keeps of a frame, and of the frames it compares others with."""

from dataclasses import dataclass
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
_CORNERS = 400
_DESCRIBED = 600
_RATIO = 0.8  # of the best match's distance to the second best's
_ALIKE = 64  # bits that may differ
_AROUND = 9  # blocks over which grey is normalised
_FLAT = 8.0  # grey levels of contrast that count as half


@dataclass(frozen=True, eq=False)
class Seen:
    """One frame as the tracker looks at it.

    Attributes:
        gray: (H, W) uint8; None = depth alone.
        columns: W.
    """

    intrinsics: Intrinsics
    shape: tuple[int, ...]
    gray: Gray | None
    surface: point_to_plane.Surface

    @classmethod
    def of(cls, frame: Frame) -> "Seen":
        """
        Raises:
            InvalidKeyframe: when the frame has no depth image.
        """
        depth = frame.depth_m
        if depth is None or frame.intrinsics is None:
            raise InvalidKeyframe(
                f"the rgbd localizer needs a depth or disparity image in every frame, got {frame.kind}; "
                "take the localizer `stereo` for pairs and `lidar` for points"
            )
        return cls(frame.intrinsics, depth.shape, frame.gray, point_to_plane.surface(depth, frame.intrinsics))

    @property
    def columns(self) -> int:
        """Of the image."""
        return self.shape[1]

    @cached_property
    def pattern(self) -> NDArray[np.float32] | None:
        """(rows·columns,) grey of blocks less the mean around, over the contrast there; None = no image."""
        if self.gray is None:
            return None
        rows, columns = self.surface.shape
        block = self.columns // columns
        whole = self.gray[: rows * block, : columns * block]
        small = cv2.resize(whole, (columns, rows), interpolation=cv2.INTER_AREA).astype(np.float32)
        around = (_AROUND, _AROUND)
        away = small - cv2.blur(small, around)
        contrast = np.sqrt(cv2.blur(away * away, around) + _FLAT**2)
        pattern: NDArray[np.float32] = (away / contrast).ravel()
        return pattern

    @cached_property
    def described(self) -> tuple[features.Pixels, NDArray[np.uint8]]:
        """(n, 2) pixels and (n, 32) descriptions of ORB corners (Rublee et al. 2011)."""
        if self.gray is not None:
            points, found = cv2.ORB.create(_DESCRIBED).detectAndCompute(self.gray, None)
            if found is not None and len(points):
                return np.array([point.pt for point in points], np.float32), found.astype(np.uint8)
        return np.empty((0, 2), np.float32), np.empty((0, 32), np.uint8)

    def lifted(self, pixels: features.Pixels) -> tuple[NDArray[np.float64], NDArray[np.bool_]]:
        """(n, 3) points where the pixels' rays meet the planes of their blocks, and which have one."""
        K, (rows, columns) = self.intrinsics, self.surface.shape
        column, row = ((pixels + 0.5) / (self.columns // columns)).astype(np.intp).T
        inside = (column >= 0) & (row >= 0) & (column < columns) & (row < rows)
        plane = self.surface.planes[:, np.where(inside, row * columns + column, 0)].astype(np.float64)
        rays = features.lifted(pixels, np.ones(len(pixels)), K)
        toward = np.einsum("in,ni->n", plane[:3], rays)
        ok = inside & (plane[3] > 0) & (toward > 1e-3)
        z = plane[3] / np.where(ok, toward, 1)
        return rays * z[:, None], ok


@dataclass(frozen=True, eq=False)
class FrameView:
    """A tracking keyframe.

    Attributes:
        number: of the anchor.
        T_world_camera: (4, 4).
        corners: (n, 2) pixels.
        points: (n, 3) of the corners, in the camera's axes.
    """

    number: int
    T_world_camera: se3.Transform
    seen: Seen
    corners: features.Pixels
    points: NDArray[np.float64]

    @classmethod
    def of(cls, seen: Seen, number: int, T_world_camera: se3.Transform) -> "FrameView":
        """Of a frame whose pose is known."""
        if seen.gray is None:
            return cls(number, T_world_camera, seen, np.empty((0, 2), np.float32), np.empty((0, 3)))
        corners = features.corners(seen.gray, _CORNERS)
        corners = corners[features.above_noise(seen.gray, corners)]
        points, ok = seen.lifted(corners)
        return cls(number, T_world_camera, seen, corners[ok], points[ok])

    def follow(self, seen: Seen, T_view_camera: se3.Transform) -> tuple[NDArray[np.float64], features.Pixels]:
        """(n, 3) corners of this view found again near where the pose given says, and (n, 2) there."""
        old, new = self.seen.gray, seen.gray
        if old is None or new is None or old.shape != new.shape or not len(self.points):
            return np.empty((0, 3)), np.empty((0, 2), np.float32)
        K = seen.intrinsics
        q = se3.apply(se3.inverse(T_view_camera), self.points)
        ahead = q[:, 2] > 0.05
        z = np.where(ahead, q[:, 2], 1)
        expected = np.stack([K.fx * q[:, 0] / z + K.cx, K.fy * q[:, 1] / z + K.cy], axis=1)
        margin = seen.columns // 16
        ok = ahead & (expected > -margin).all(axis=1)
        ok &= (expected[:, 0] < seen.shape[1] + margin) & (expected[:, 1] < seen.shape[0] + margin)
        moved, found = features.follow(old, new, self.corners[ok], guess=expected[ok].astype(np.float32))
        return self.points[ok][found], moved[found]

    def recall(self, seen: Seen) -> tuple[NDArray[np.float64], features.Pixels]:
        """(n, 3) corners of this view that look like some of the frame's, wherever, and (n, 2) those."""
        pixels, here = seen.described
        mine, there = self.seen.described
        if len(here) < 2 or len(there) < 2:
            return np.empty((0, 3)), np.empty((0, 2), np.float32)
        pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(there, here, k=2)
        good = [a for a, b in pairs if a.distance < min(_RATIO * b.distance, _ALIKE)]
        query = np.array([match.queryIdx for match in good], dtype=np.intp)
        train = np.array([match.trainIdx for match in good], dtype=np.intp)
        points, ok = self.seen.lifted(mine[query].reshape(-1, 2))
        return points[ok], pixels[train][ok].reshape(-1, 2)
