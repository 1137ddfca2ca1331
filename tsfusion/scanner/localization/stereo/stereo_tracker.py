# SPDX-License-Identifier: MIT
"""Track stereo pairs from frame to frame: find corners, their disparity, and the motion that fits them."""

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import InvalidKeyframe
from tsfusion.geometry import se3
from tsfusion.geometry.frame import Attitude, Frame
from tsfusion.geometry.inertial_sensors import GyroscopeTrust
from tsfusion.scanner.localization import features
from tsfusion.scanner.localization.localizer import Localizer, Lost, TrackedPose, TrackingKeyframes
from tsfusion.scanner.localization.stereo.rectification_check import RectificationCheck, RectificationMonitor
from tsfusion.scanner.localization.stereo.reprojection import StereoCamera, refine

MAX_CORNERS = 1000
MIN_POINTS = 25  # points that must agree
MIN_SHARE, MIN_SHARE_SUDDEN = 0.25, 0.4  # of the followed points must agree; in a sudden motion
MIN_POINTS_EXPECTED = 15  # points that must agree with the expected motion, after a gap
PIXEL_TOLERANCE = 1.0  # drift on KITTI 06: 0.82 %; with a tolerance of 1.5: 0.90 %
MAX_OFFSET_ERROR = 3.0  # pixels: points with larger errors are not used to estimate offsets
MIN_RANGE = 2.0  # pixels, of eight tenths of the disparities; in less, errors of matching look like an offset
EDGE_REACH, EDGE_STEP = 5, 1.0  # pixels around a corner; and of disparity, by which an edge differs
SHRINK = 4  # times smaller images of blurred views, which are followed again; 3 loses 3 of 30 frames, 2 all
MIN_MOTION = 1.0  # pixels: with less median motion, the old frame stays the reference
MIN_DISPARITY = 1.0  # pixels
SUDDEN_DISTANCE = 0.1  # of the points' median depth; a motion that differs more from the last is sudden
SUDDEN_ANGLE = np.radians(10)
MIN_SHARE_LEAP, SAME_TURN = 0.6, np.radians(2)  # of a sudden motion that turns as a gyroscope does
BELIEVED_S = 1.5  # seconds for which the last velocity is used when frames are missing
KEYFRAME_DISTANCE = 0.15  # of the points' median depth to the next tracking keyframe
HINT = " (is the view blank, the pair rectified, and left the left camera's?)"
DEPTH_CAMERA_BASELINE_FX = 43.0  # px·m, for depth cameras with unknown baseline (Kinect: 0.075 m × 575 px)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Reference:
    """Frame that the next frames are compared with: its corners with disparity."""

    gray: NDArray[np.uint8]
    pixels: features.Pixels  # (n, 2) corners with depth
    disparity: NDArray[np.float32]  # (n,), with the offset added
    offset: float  # pixels
    dense: NDArray[np.float32]  # (H, W) disparity of the whole image; 0 = none
    rig: StereoCamera
    timestamp_ns: int
    attitude: Attitude | None
    T_world_camera: se3.Transform

    @cached_property
    def points(self) -> NDArray[np.float64]:
        """3D points of the corners, (n, 3) metres in the camera's axes."""
        return self.rig.lift(self.pixels, self.disparity)

    @cached_property
    def on_surface(self) -> NDArray[np.bool_]:
        """(n,) True for corners on one surface. At an edge the disparity may be of what is behind."""
        (height, width), (x, y) = self.gray.shape, np.rint(self.pixels.T).astype(np.intp)
        around = [
            self.dense[np.clip(y + down, 0, height - 1), np.clip(x + across, 0, width - 1)]
            for across, down in EDGE_REACH * np.array([(1, 0), (-1, 0), (0, 1), (0, -1)])
        ]
        apart = np.abs(np.stack(around) + self.offset - self.disparity).max(axis=0)
        return np.asarray(apart < EDGE_STEP)

    @cached_property
    def coarse(self) -> "_Reference":
        """Corners of the shrunk image. They tell nothing of the offset: none counts as on a surface."""
        gray = _shrunk(self.gray)
        pixels = features.corners(gray, MAX_CORNERS)
        measured = features.bilinear(self.dense, SHRINK * (pixels + 0.5) - 0.5)
        corrected, rig = measured + np.float32(self.offset), self.rig
        deep = (measured > 0) & (corrected > MIN_DISPARITY)
        return replace(
            self, gray=gray, pixels=pixels[deep], disparity=corrected[deep] / np.float32(SHRINK),
            dense=np.full(gray.shape, -np.inf, np.float32),
            rig=StereoCamera(rig.intrinsics.scaled(1 / SHRINK), rig.baseline_fx / SHRINK),
        )  # fmt: skip

    @property
    def median_depth(self) -> float:
        return float(np.median(self.points[:, 2]))


@dataclass(frozen=True, eq=False)
class _StereoView:
    """Grey image and camera of one frame. Its corners and disparity are computed on first use."""

    frame: Frame
    gray: NDArray[np.uint8]
    rig: StereoCamera

    @classmethod
    def of(cls, frame: Frame) -> "_StereoView":
        """Make the view of a frame. Raise InvalidKeyframe for a frame without an image or depth."""
        gray = frame.gray
        if gray is None or (frame.depth_m is None and frame.right is None):
            raise InvalidKeyframe(
                f"the localizer stereo follows stereo pairs, or depth with a colour image; got {frame.kind}"
                + ("" if frame.kind == "points" else " without colour")
            )
        assert frame.intrinsics is not None
        return cls(frame, gray, StereoCamera(frame.intrinsics, frame.baseline_fx or DEPTH_CAMERA_BASELINE_FX))

    @cached_property
    def disparity(self) -> NDArray[np.float32]:
        """(H, W) pixels of disparity; 0 = no disparity."""
        quick, depth = self.frame.tracking_disparity, self.frame.depth_m
        if quick is not None:
            return quick
        assert depth is not None
        return np.divide(self.rig.baseline_fx, depth, out=np.zeros_like(depth), where=depth > 0)

    @cached_property
    def corners(self) -> tuple[features.Pixels, NDArray[np.float32]]:
        """Corners of the left image, (n, 2) pixels, and their (n,) disparities."""
        pixels = features.corners(self.gray, MAX_CORNERS)
        return pixels, features.bilinear(self.disparity, pixels)

    def reference(self, T_world_camera: se3.Transform, offset: float) -> _Reference:
        """Return the corners with disparity, to which the offset is added, with the frame's pose."""
        pixels, disparity = self.corners
        corrected = disparity + np.float32(offset)
        deep = (disparity > 0) & (corrected > MIN_DISPARITY)
        return _Reference(
            gray=self.gray, pixels=pixels[deep], disparity=corrected[deep], offset=offset,
            dense=self.disparity, rig=self.rig, timestamp_ns=self.frame.timestamp_ns,
            attitude=self.frame.attitude, T_world_camera=T_world_camera,
        )  # fmt: skip


class StereoLocalizer(Localizer):
    """`Localizer` of rectified stereo pairs, and of disparity or depth images with a grey or colour image.

    A frame is compared with the last frame that had a pose and had moved. So a few bad or missing frames are
    bridged, and a camera that stands still does not drift. (Keyframes several metres apart were worse in
    turns.)
    """

    absolute = False

    def __init__(self) -> None:
        self._anchors = TrackingKeyframes()
        self._rectification = RectificationMonitor()
        self._gyroscope = GyroscopeTrust()
        self._reference: _Reference | None = None
        self._velocity: NDArray[np.float64] | None = None  # twist per second; per frame without timestamps
        # The last frame until `prepare`; with its pose if it may become the reference.
        self._newest: tuple[_StereoView, se3.Transform | None] | None = None

    @property
    def rectification(self) -> RectificationCheck | None:
        """Check of the rectification by the pairs so far; None before eight pairs."""
        self.prepare()
        return self._rectification.check

    def track(self, frame: Frame) -> TrackedPose | Lost:
        """Find the left camera's pose in the axes of the first frame's left camera."""
        self.prepare()
        view = _StereoView.of(frame)
        if self._reference is None:
            return self._start(view)
        turn = self._gyroscope.turn(frame, self._reference.attitude)
        found = self._compare(self._reference, view.gray, frame.timestamp_ns, turn)
        if isinstance(found, str) and turn is not None:
            found = self._compare(self._reference, view.gray, frame.timestamp_ns, turn, guessed=False)
        if isinstance(found, str):
            self._newest = view, None
            return Lost(reason=found, timestamp_ns=frame.timestamp_ns)
        T_reference_camera, quality, moved = found
        self._gyroscope.judge(turn, T_reference_camera)
        T = se3.nearest(self._reference.T_world_camera @ T_reference_camera)
        self._newest = view, T if moved > MIN_MOTION else None
        return self._anchors.pose(T, frame.timestamp_ns, quality=quality)

    def prepare(self) -> None:
        """Find the corners of the last frame and their disparity. The next frame is compared with them."""
        newest, self._newest = self._newest, None
        if newest is None:
            return
        view, T = newest
        if view.frame.right is not None and self._rectification.wants_pair:
            self._check_rows(view, view.frame.right)
        if T is None:
            return
        reference = view.reference(T, self._rectification.offset)
        if len(reference.pixels) >= MIN_POINTS:
            self._reference = reference
            self._anchors.distance = KEYFRAME_DISTANCE * reference.median_depth

    def reset(self) -> None:
        self._reference = self._velocity = self._newest = None
        self._anchors.reset()

    def _start(self, view: _StereoView) -> TrackedPose | Lost:
        """Make a frame the first of a world if it has enough corners with depth; otherwise return Lost."""
        self._newest = view, np.eye(4)
        self.prepare()
        if self._reference is None:
            count = np.count_nonzero(view.corners[1] > MIN_DISPARITY)
            reason = f"only {count} corners with depth" + HINT * (view.frame.kind == "pair")
            return Lost(reason=reason, timestamp_ns=view.frame.timestamp_ns)
        return self._anchors.pose(np.eye(4), view.frame.timestamp_ns)

    def _compare(
        self,
        reference: _Reference,
        gray: NDArray[np.uint8],
        timestamp_ns: int,
        turn: NDArray[np.float64] | None,
        *,
        guessed: bool = True,  # by the turn, which else is only compared with what is found
    ) -> tuple[se3.Transform, float, float] | str:
        """Return T_reference_camera, share of agreeing points, their median motion in pixels; or why not."""
        if gray.shape != reference.gray.shape:
            return f"the image is {gray.shape[1]}×{gray.shape[0]}, unlike those before"
        gray = features.in_light_of(reference.gray, gray)
        elapsed = _elapsed(reference.timestamp_ns, timestamp_ns)
        if elapsed > BELIEVED_S:
            self._velocity = None
        expected = None if self._velocity is None else se3.exp(self._velocity * elapsed)
        if turn is not None and guessed:
            expected = se3.transform(turn, np.zeros(3) if expected is None else expected[:3, 3])
        matches = _follow(reference, gray, expected, thorough=self._rectification.wants_motion)
        found = self._motion(reference, *matches, expected, turn)
        if isinstance(found, str) and expected is not None:  # after missing frames, all looks larger
            matches = _follow_warped(reference, gray, expected)
            again = self._motion(reference, *matches, expected, turn, only_expected=True)
            found = found if isinstance(again, str) else again
        if isinstance(found, str):  # shrunk, views are alike that a fast turn has blurred
            matches = _follow(reference.coarse, _shrunk(gray), expected, thorough=True)
            again = self._motion(reference.coarse, *matches, expected, turn)
            found = found if isinstance(again, str) else (*again[:2], SHRINK * again[2])
        if isinstance(found, str):
            return found
        self._velocity = se3.log(found[0]) / elapsed
        return found

    def _motion(
        self,
        reference: _Reference,
        pixels: features.Pixels,
        followed: NDArray[np.bool_],
        expected: se3.Transform | None,
        turn: NDArray[np.float64] | None,
        *,
        only_expected: bool = False,
    ) -> tuple[se3.Transform, float, float] | str:
        """Find the motion from the corners' (n, 2) `pixels` where `followed` is True. Return as `_compare`.

        With `only_expected` fewer points are enough, but no motion other than the expected one is accepted.
        """
        least = MIN_POINTS_EXPECTED if only_expected else MIN_POINTS
        old, disparity, new = reference.pixels[followed], reference.disparity[followed], pixels[followed]
        if len(new) < least:
            return f"{len(new)} of {len(followed)} corners were found again"
        found = features.resection(
            reference.points[followed],
            new,
            reference.rig.intrinsics,
            guess=expected,
            tolerance=PIXEL_TOLERANCE,
        )
        agree = np.zeros(len(new), bool) if found is None else found[1]
        share = float(agree.mean())
        if found is None or agree.sum() < least or share < MIN_SHARE:
            return f"{agree.sum()} of {len(new)} points agree"
        is_sudden = _is_sudden(expected, found[0], reference.median_depth)
        if is_sudden and (only_expected or share < _least_share(found[0], turn)):
            return f"{agree.sum()} of {len(new)} points agree on a sudden motion"
        motion = refine(found[0], old[agree], disparity[agree], new[agree], reference.rig)
        if motion is None:
            return f"{agree.sum()} points do not fix the motion"
        self._check_disparity(motion.T_old_new, reference, followed, new)
        return motion.T_old_new, share, float(np.median(np.abs(new - old)[agree].max(axis=1)))

    def _check_rows(self, view: _StereoView, right: NDArray[np.uint8]) -> None:
        """Add a pair to the check, also corners without disparity: bad rectification may be the cause."""
        pixels, disparity = view.corners
        matched = disparity > 0
        guess = pixels.copy()
        guess[:, 0] -= np.where(matched, disparity, np.median(disparity[matched]) if matched.any() else 0)
        other, found = features.follow(view.gray, right, pixels, guess=guess)
        self._rectification.add_pair(pixels[found], other[found], right.shape)

    def _check_disparity(
        self, T: se3.Transform, reference: _Reference, followed: NDArray[np.bool_], new: features.Pixels
    ) -> None:
        points = se3.apply(se3.inverse(T), reference.points[followed])
        near = np.linalg.norm(reference.rig.project(points) - new, axis=1) < MAX_OFFSET_ERROR
        near &= reference.on_surface[followed]
        old, disparity = reference.pixels[followed][near], reference.disparity[followed][near]
        if not len(disparity) or np.ptp(np.percentile(disparity, [10, 90])) < MIN_RANGE:
            return
        motion = refine(T, old, disparity, new[near], reference.rig, with_offset=True)
        if motion is not None:
            self._rectification.add_motion(reference.offset + motion.offset, motion.offset_sigma)


def _shrunk(gray: NDArray[np.uint8]) -> NDArray[np.uint8]:
    height, width = (side // SHRINK for side in gray.shape)
    whole = gray[: SHRINK * height, : SHRINK * width]
    return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA), np.uint8)


def _elapsed(before_ns: int, now_ns: int) -> float:
    """Return the seconds between two timestamps, or 1 if one is unknown or they do not grow."""
    return (now_ns - before_ns) / 1e9 if 0 < before_ns < now_ns else 1.0


def _follow(
    reference: _Reference, gray: NDArray[np.uint8], expected: se3.Transform | None, *, thorough: bool
) -> tuple[features.Pixels, NDArray[np.bool_]]:
    """Follow the reference's corners into the new image, first from their expected positions."""
    if expected is not None:
        guess = reference.rig.project(se3.apply(se3.inverse(expected), reference.points))
        pixels, found = features.follow(
            reference.gray, gray, reference.pixels, guess=guess, thorough=thorough
        )
        if found.mean() > 0.5:
            return pixels, found
    return features.follow(reference.gray, gray, reference.pixels)


def _follow_warped(
    reference: _Reference, gray: NDArray[np.uint8], expected: se3.Transform
) -> tuple[features.Pixels, NDArray[np.bool_]]:
    """Follow the reference's corners into the new image, after warping it to the reference's camera.

    After a gap, near objects look larger. In the warped image they have their old size, except for the error
    of the expected motion.
    """
    rig, T = reference.rig, se3.inverse(expected)
    K, (height, width) = rig.intrinsics, gray.shape
    u, v = np.arange(width), np.arange(height)[:, None]
    x, y = ((u - K.cx) / K.fx).astype(np.float32), ((v - K.cy) / K.fy).astype(np.float32)
    inverse_depth = reference.dense * np.float32(1 / rig.baseline_fx)  # 0 = infinitely far
    R, t = T[:3, :3].astype(np.float32), T[:3, 3].astype(np.float32)
    X, Y, Z = (R[k, 0] * x + R[k, 1] * y + R[k, 2] + t[k] * inverse_depth for k in range(3))
    ahead = np.maximum(Z, 1e-3)
    at = np.dstack([K.fx * X / ahead + K.cx, K.fy * Y / ahead + K.cy]).astype(np.float32)
    warped = cv2.remap(gray, at, None, cv2.INTER_LINEAR)
    pixels, found = features.follow(reference.gray, warped, reference.pixels)
    return rig.project(se3.apply(T, rig.lift(pixels, reference.disparity))), found


def _least_share(found: se3.Transform, turn: NDArray[np.float64] | None) -> float:
    """Return the share of points that must agree on a sudden motion: more if only the place leaps."""
    turns = turn is None or se3.angle(se3.transform(turn.T @ found[:3, :3], np.zeros(3))) > SAME_TURN
    return MIN_SHARE_SUDDEN if turns else MIN_SHARE_LEAP


def _is_sudden(expected: se3.Transform | None, found: se3.Transform, depth: float) -> bool:
    if expected is None:
        return True
    apart = se3.inverse(expected) @ found
    return bool(se3.distance(apart) > SUDDEN_DISTANCE * depth or se3.angle(apart) > SUDDEN_ANGLE)
