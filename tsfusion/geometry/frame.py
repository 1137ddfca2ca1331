# SPDX-License-Identifier: MIT
"""Hold frames: measurements of a sensor at one moment, before its pose is known."""

import dataclasses
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import InvalidKeyframe
from tsfusion.geometry.keyframe import MAX_BASELINE_M, Intrinsics, Keyframe
from tsfusion.geometry.stereo_matching import UNITS, Matcher, quick_disparity
from tsfusion.geometry.sweeps import Motion

FrameKind = Literal["depth", "disparity", "points", "pair"]


class Attitude(NamedTuple):
    """Rotation by a gyroscope, which drifts; without meaning beside one before another count of gaps."""

    R: NDArray[np.float64]  # (3, 3), from the axes of the camera or LiDAR to those of the gyroscope's start
    gaps: int = 0  # in the values before


_SHARED = [each.name for each in dataclasses.fields(Keyframe) if each.init]  # fields of frames and keyframes


@dataclass(frozen=True, eq=False, kw_only=True)
class Frame:
    """One measurement without a known pose. Give one of `depth`, `disparity`, `points`, or `left` and
    `right`.

    Fields have the same meaning and checks as those of the same name in a `Keyframe`.

    Attributes:
        sensor: sensor model (`kinect`, `tof`, `realsense`, `stereo`, `lidar`, `scanner`); empty = unknown.
        timestamp_ns: the sensor's clock; 0 = unknown.
        captured_ns: `time.monotonic_ns()` at capture; 0 = unknown.
        T_world_camera: (4, 4) float64, the source's own pose (ground truth, another SLAM), used only by the
            localizer `given`; None = no pose.
        left, right: (H, W) uint8 grey, rectified, with `intrinsics` of both and `baseline_fx`.
        color: (H, W, 3) uint8 BGR of the depth or of the left image, or (N, 3) of the points.
        motion: motion of the sensor while it measures, by the source's own poses; None = unknown.
        untimed: why the times of the points are useless; empty = there are none, or they are used.
        specific_force: (3,) m/s², the accelerometer's value in the axes of the camera or LiDAR (at rest it
            points away from the ground); None = no value.
        attitude: rotation by a gyroscope, of which only changes between near frames are of use; None = no
            value.

    Raises:
        InvalidKeyframe: names the field, its value and the expected value.
    """

    sensor: str
    timestamp_ns: int = 0
    captured_ns: int = 0
    T_world_camera: NDArray[np.float64] | None = None
    depth: NDArray[Any] | None = None
    depth_scale: float = 0.001
    disparity: NDArray[np.uint16] | None = None
    disparity_scale: float = 1 / UNITS
    baseline_fx: float | None = None
    left: NDArray[np.uint8] | None = None
    right: NDArray[np.uint8] | None = None
    points: NDArray[np.float32] | None = None
    point_times_s: NDArray[np.float32] | None = None
    origins: NDArray[np.float32] | None = None
    motion: Motion | None = None
    untimed: str = ""
    color: NDArray[np.uint8] | None = None
    confidence: NDArray[np.uint8] | None = None
    intrinsics: Intrinsics | None = None
    specific_force: NDArray[np.float64] | None = None
    attitude: Attitude | None = None
    kind: FrameKind = field(init=False)

    def __post_init__(self) -> None:
        put = object.__setattr__  # the dataclass is frozen for everyone else
        pair = self.left is not None or self.right is not None
        if pair:
            self._check_pair()
        checked = self._at(np.eye(4) if self.T_world_camera is None else self.T_world_camera)
        put(self, "kind", "pair" if pair else checked.kind)
        for name in ("depth", "disparity", "points", "point_times_s", "origins", "color", "confidence"):
            if not (pair and name == "disparity"):
                put(self, name, getattr(checked, name))
        put(self, "intrinsics", checked.intrinsics)
        if self.T_world_camera is not None:
            put(self, "T_world_camera", checked.T_world_camera)
        if self.specific_force is not None:
            force = np.asarray(self.specific_force, dtype=np.float64)
            if force.shape != (3,) or not np.isfinite(force).all():
                raise InvalidKeyframe(f"specific_force must be 3 finite numbers, got {force}")
            put(self, "specific_force", force)
        turned = None if self.attitude is None else self.attitude.R
        if turned is not None and (np.shape(turned) != (3, 3) or not np.isfinite(turned).all()):
            raise InvalidKeyframe(f"attitude must be a 3×3 rotation, got {np.asarray(turned).tolist()}")

    def turn_since(self, attitude: Attitude | None) -> NDArray[np.float64] | None:
        """Return R_before_now, (3, 3), since a frame with this attitude; None = not known."""
        if attitude is None or self.attitude is None or attitude.gaps != self.attitude.gaps:
            return None
        return np.asarray(attitude.R.T @ self.attitude.R)

    @classmethod
    def of(cls, keyframe: Keyframe, sensor: str) -> "Frame":
        """Make a frame of a keyframe; the keyframe's pose becomes the source's own pose."""
        fields = {name: getattr(keyframe, name) for name in _SHARED}
        return cls(**{**fields, "sensor": keyframe.sensor or sensor})

    def along_axis(self) -> "Frame":
        """Convert depth along each pixel's ray to depth along the axis. InvalidKeyframe without depth."""
        if self.depth is None or self.intrinsics is None:
            raise InvalidKeyframe(f"depth_along_ray is for depth images, and this is one of {self.kind}")
        z = self.depth / self.intrinsics.ray_lengths(self.depth.shape)
        z = np.rint(z).astype(np.uint16) if self.depth.dtype == np.uint16 else z
        return dataclasses.replace(self, depth=z)

    def keyframe(self, T_world_camera: NDArray[np.float64], motion: Motion | None = None) -> Keyframe:
        """Make a keyframe of the frame; a stereo pair is matched first.

        `motion`: motion of the sensor, which corrects points with times; None = unknown.
        """
        if self.kind != "pair":
            return self._at(T_world_camera, motion=motion)
        return self._at(T_world_camera, disparity=self.matched)

    @cached_property
    def matched(self) -> NDArray[np.uint16]:
        """Disparity of a stereo pair at full resolution: (H, W) uint16 in 1/16 px, 0 = uncertain."""
        assert self.left is not None
        assert self.right is not None
        return Matcher()(self.left, self.right)

    @cached_property
    def quick_disparity(self) -> NDArray[np.float32] | None:
        """Disparity of a stereo pair at half the resolution, (H, W) float32 pixels, 0 = none, or None."""
        return None if self.left is None or self.right is None else quick_disparity(self.left, self.right)

    @property
    def tracking_disparity(self) -> NDArray[np.float32] | None:
        """Disparity of a stereo pair, (H, W) float32 pixels, 0 = none; None without a pair.

        If the pair was matched before, this is `matched`, else `quick_disparity`.
        Both track equally well: rendered KITTI 06 drifts by 0.11 % with both, KITTI 06 itself by 0.8 %.
        """
        if "matched" in vars(self):
            whole: NDArray[np.float32] = self.matched * np.float32(1 / UNITS)
            return whole
        return self.quick_disparity

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the measurement: (H, W) of images, (N,) of points."""
        for array in (self.depth, self.disparity, self.left):
            if array is not None:
                return tuple(array.shape)
        assert self.points is not None
        return (len(self.points),)

    @cached_property
    def gray(self) -> NDArray[np.uint8] | None:
        """Grey image, (H, W) uint8: the left one, or the colour's luminance; None without an image."""
        if self.left is not None:
            return self.left
        if self.color is None or self.points is not None:
            return None
        gray: NDArray[np.uint8] = cv2.cvtColor(self.color, cv2.COLOR_BGR2GRAY)
        return gray

    @cached_property
    def depth_m(self) -> NDArray[np.float32] | None:
        """Depth along the optical axis, (H, W) float32 metres, 0 = none; None for points and stereo pairs."""
        if self.depth is not None:
            if self.depth.dtype == np.uint16:
                metres: NDArray[np.float32] = self.depth * np.float32(self.depth_scale)
                return metres
            with np.errstate(invalid="ignore"):
                valid = np.isfinite(self.depth) & (self.depth > 0)
            return np.where(valid, self.depth, np.float32(0)).astype(np.float32)
        if self.disparity is None or self.baseline_fx is None:
            return None
        scale = np.float32(self.baseline_fx / self.disparity_scale)
        depth = np.zeros(self.disparity.shape, np.float32)
        np.divide(scale, self.disparity, out=depth, where=self.disparity > 0)
        return depth

    def _check_pair(self) -> None:
        others = [name for name in ("depth", "disparity", "points") if getattr(self, name) is not None]
        if others or self.left is None or self.right is None:
            given = [name for name in ("left", "right") if getattr(self, name) is not None] + others
            raise InvalidKeyframe(
                f"exactly one of depth, disparity, points and left with right must be given, got {given}"
            )
        for name in ("left", "right"):
            image = getattr(self, name)
            if image.dtype != np.uint8 or image.ndim != 2 or image.shape != self.left.shape:
                raise InvalidKeyframe(
                    f"{name} must be a grey (H, W) uint8 image of the other's size, got {image.shape} of "
                    f"{image.dtype} beside {self.left.shape}"
                )
        if self.intrinsics and (self.baseline_fx or 0) > MAX_BASELINE_M * self.intrinsics.fx:
            metres = (self.baseline_fx or 0) / self.intrinsics.fx
            raise InvalidKeyframe(f"baseline_fx says {metres:.4g} m of baseline: are these millimetres?")

    def _at(self, T: NDArray[np.float64], disparity: Any = None, motion: Motion | None = None) -> Keyframe:
        if self.left is not None and disparity is None:  # placeholder until `matched` is needed
            disparity = np.broadcast_to(np.uint16(0), self.left.shape)
        given = {name: getattr(self, name) for name in _SHARED}
        given |= {"T_world_camera": T, "motion": motion, "sensor": self.sensor or None}
        return Keyframe(**given if disparity is None else given | {"disparity": disparity})
