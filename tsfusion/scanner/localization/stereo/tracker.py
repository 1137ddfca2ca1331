# SPDX-License-Identifier: MIT
"""Following a stereo camera from frame to frame: corners, their disparity, and the motion they agree on."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import InvalidKeyframe
from tsfusion.geometry import se3
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.stereo_matching import quick_disparity
from tsfusion.scanner.localization import features
from tsfusion.scanner.localization.localizer import Lost, Pose, PoseCorrections
from tsfusion.scanner.localization.stereo.rectification_check import RectificationCheck, RectificationMonitor
from tsfusion.scanner.localization.stereo.reprojection import StereoCamera, refine
from tsfusion.scanner.localization.tracking_keyframes import TrackingKeyframes

_CORNERS = 1000
_FEWEST = 25  # points that must agree
_LEAST_SHARE = 0.25  # of the followed points that must agree
_LEAST_SHARE_SURPRISED = 0.4  # … in a motion that was not to be expected
_TOLERANCE = 1.0  # pixels; KITTI 06 drifts by 0.82 % with it, by 0.90 % with 1.5
_STRAY = 3.0  # pixels: worse points are no use in the search for offsets
_STILL = 1.0  # pixels of median motion below which the old frame stays the reference
_LEAST_DISPARITY = 1.0  # pixels
_SURPRISE = 0.1  # of the points' median depth by which a motion may differ from the last one
_SURPRISE_ANGLE = np.radians(10)
_ANCHOR = 0.15  # of the points' median depth to the next tracking keyframe
_HINT = " (is the view blank, the pair rectified, and left the left camera's?)"
_PROJECTOR = 43.0  # px·m, a depth camera's baseline times focal length (Kinect: 0.075 m × 575 px)


@dataclass(frozen=True, eq=False, kw_only=True)
class _Reference:
    """A frame, reduced to what the next one is compared with."""

    gray: NDArray[np.uint8]
    pixels: features.Pixels  # (n, 2) corners with depth
    disparity: NDArray[np.float32]  # (n,)
    rig: StereoCamera
    timestamp_ns: int
    T_world_camera: se3.Transform

    @cached_property
    def points(self) -> NDArray[np.float64]:
        """(n, 3) metres, of the camera."""
        return self.rig.lift(self.pixels, self.disparity)

    @property
    def median_depth(self) -> float:
        return float(np.median(self.points[:, 2]))


@dataclass(frozen=True, eq=False)
class _DisparityImage:
    """A frame's left image, (H, W) pixels of disparity (0 = none), and the cameras."""

    gray: NDArray[np.uint8]
    disparity: NDArray[np.float32]
    rig: StereoCamera

    @cached_property
    def corners(self) -> tuple[features.Pixels, NDArray[np.float32]]:
        """(n, 2) pixels, and the (n,) disparities there."""
        pixels = features.corners(self.gray, _CORNERS)
        return pixels, features.bilinear(self.disparity, pixels)


class StereoLocalizer:
    """`Localizer` of rectified stereo pairs; also of disparity or depth images with an image beside them.

    A frame is compared with the last one that had a pose: a few bad ones in between are bridged, and a camera
    that stands still does not drift. (Keyframes of several metres were worse in turns.)
    """

    absolute = False

    def __init__(self) -> None:
        self._anchors = TrackingKeyframes()
        self._rectification = RectificationMonitor()
        self._reference: _Reference | None = None
        self._velocity: NDArray[np.float64] | None = None  # twist a second; a frame where there are no stamps

    @property
    def rectification(self) -> RectificationCheck | None:
        """What the pairs so far say of their rectification; None until eight were looked at."""
        return self._rectification.check

    def track(self, frame: Frame) -> Pose | Lost:
        """Where the left camera was, seen from the first one."""
        image = _disparity_image(frame)
        if frame.right is not None and self._rectification.wants_pair:
            self._check_rows(image, frame.right)
        reference, T, quality, moved = self._reference, np.eye(4), 1.0, np.inf
        if reference is not None:
            found = self._compare(reference, image.gray, frame.timestamp_ns)
            if isinstance(found, str):
                self._velocity = None
                return Lost(reason=found, timestamp_ns=frame.timestamp_ns)
            T, quality, moved = se3.nearest(reference.T_world_camera @ found[0]), found[1], found[2]
        if moved > _STILL:
            pixels, disparity = image.corners
            deep = disparity > _LEAST_DISPARITY
            seen = _Reference(
                gray=image.gray,
                pixels=pixels[deep],
                disparity=disparity[deep],
                rig=image.rig,
                timestamp_ns=frame.timestamp_ns,
                T_world_camera=T,
            )
            if reference is None and len(seen.pixels) < _FEWEST:
                reason = f"only {len(seen.pixels)} corners with depth" + _HINT * (frame.kind == "pair")
                return Lost(reason=reason, timestamp_ns=frame.timestamp_ns)
            if len(seen.pixels) >= _FEWEST:
                self._reference = seen
                self._anchors.distance = _ANCHOR * seen.median_depth
        return self._anchors.pose(T, frame.timestamp_ns, quality=quality)

    def corrections(self) -> PoseCorrections | None:
        """None: odometry closes no loops."""
        return None

    def reset(self) -> None:
        """Begin a new world at the next frame."""
        self._reference = self._velocity = None
        self._anchors.reset()

    def _compare(
        self, reference: _Reference, gray: NDArray[np.uint8], timestamp_ns: int
    ) -> tuple[se3.Transform, float, float] | str:
        """T_reference_camera, the share of points that agree, their median motion in pixels; or a reason."""
        if gray.shape != reference.gray.shape:
            return f"the image is {gray.shape[1]}×{gray.shape[0]}, unlike those before"
        elapsed = _elapsed(reference.timestamp_ns, timestamp_ns)
        expected = None if self._velocity is None else se3.exp(self._velocity * elapsed)
        pixels, followed = _follow(reference, gray, expected)
        old, disparity, new = reference.pixels[followed], reference.disparity[followed], pixels[followed]
        if len(new) < _FEWEST:
            return f"{len(new)} of {len(followed)} corners were found again"
        found = features.resection(
            reference.points[followed], new, reference.rig.intrinsics, guess=expected, tolerance=_TOLERANCE
        )
        agree = np.zeros(len(new), bool) if found is None else found[1]
        share = float(agree.mean())
        if found is None or agree.sum() < _FEWEST or share < _LEAST_SHARE:
            return f"{agree.sum()} of {len(new)} points agree"
        if share < _LEAST_SHARE_SURPRISED and _surprising(expected, found[0], reference.median_depth):
            return f"{agree.sum()} of {len(new)} points agree on a sudden motion"
        motion = refine(found[0], old[agree], disparity[agree], new[agree], reference.rig)
        if motion is None:
            return f"{agree.sum()} points do not fix the motion"
        self._check_disparity(motion.T_old_new, reference, followed, new)
        self._velocity = se3.log(motion.T_old_new) / elapsed
        return motion.T_old_new, share, float(np.median(np.abs(new - old)[agree].max(axis=1)))

    def _check_rows(self, image: _DisparityImage, right: NDArray[np.uint8]) -> None:
        """Also where the matcher found nothing: that may be just what is wrong with the pair."""
        pixels, disparity = image.corners
        matched = disparity > 0
        guess = pixels.copy()
        guess[:, 0] -= np.where(matched, disparity, np.median(disparity[matched]) if matched.any() else 0)
        other, found = features.follow(image.gray, right, pixels, guess=guess)
        self._rectification.add_pair(pixels[found], other[found], right.shape)

    def _check_disparity(
        self,
        T: se3.Transform,
        reference: _Reference,
        followed: NDArray[np.bool_],
        new: features.Pixels,
    ) -> None:
        if not self._rectification.wants_motion:
            return
        points = se3.apply(se3.inverse(T), reference.points[followed])
        near = np.linalg.norm(reference.rig.project(points) - new, axis=1) < _STRAY
        old, disparity = reference.pixels[followed][near], reference.disparity[followed][near]
        motion = refine(T, old, disparity, new[near], reference.rig, with_offset=True)
        if motion is not None:
            self._rectification.add_motion(motion.offset, motion.offset_sigma)


def _disparity_image(frame: Frame) -> _DisparityImage:
    """Raises InvalidKeyframe for a frame without an image, or without depth."""
    gray, depth = frame.gray, frame.depth_m
    if gray is None or (depth is None and frame.right is None):
        raise InvalidKeyframe(
            f"the localizer stereo follows stereo pairs, or depth with a colour image; got {frame.kind}"
            + ("" if frame.kind == "points" else " without colour")
        )
    assert frame.intrinsics is not None
    rig = StereoCamera(frame.intrinsics, frame.baseline_fx or _PROJECTOR)
    if frame.right is not None:
        return _DisparityImage(gray, quick_disparity(gray, frame.right), rig)
    assert depth is not None
    return _DisparityImage(
        gray, np.divide(rig.baseline_fx, depth, out=np.zeros_like(depth), where=depth > 0), rig
    )


def _elapsed(before_ns: int, now_ns: int) -> float:
    """Seconds between two stamps; 1, for a frame, where one is unknown or they do not grow."""
    return (now_ns - before_ns) / 1e9 if 0 < before_ns < now_ns else 1.0


def _follow(
    reference: _Reference, gray: NDArray[np.uint8], expected: se3.Transform | None
) -> tuple[features.Pixels, NDArray[np.bool_]]:
    """The reference's corners in the new image, sought first where they are expected."""
    if expected is not None:
        guess = reference.rig.project(se3.apply(se3.inverse(expected), reference.points))
        pixels, found = features.follow(reference.gray, gray, reference.pixels, guess=guess)
        if found.mean() > 0.5:
            return pixels, found
    return features.follow(reference.gray, gray, reference.pixels)


def _surprising(expected: se3.Transform | None, found: se3.Transform, depth: float) -> bool:
    if expected is None:
        return True
    apart = se3.inverse(expected) @ found
    return bool(se3.distance(apart) > _SURPRISE * depth or se3.angle(apart) > _SURPRISE_ANGLE)
