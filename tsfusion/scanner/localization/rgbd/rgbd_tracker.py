# SPDX-License-Identifier: MIT
"""Track RGB-D frames: align each frame to the last tracking keyframe, by corners and planes together."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry import se3
from tsfusion.geometry.frame import Attitude, Frame
from tsfusion.geometry.inertial_sensors import GyroscopeTrust
from tsfusion.scanner.localization import features
from tsfusion.scanner.localization.localizer import Localizer, Lost, TrackedPose
from tsfusion.scanner.localization.rgbd import point_to_plane, pose_solver
from tsfusion.scanner.localization.rgbd.rgbd_frame import RGBDFrame, TrackingKeyframe

MAX_KEYFRAMES = 40  # tracking keyframes kept, about 0.3 MB each at 640×480
KEYFRAME_DISTANCE, KEYFRAME_ANGLE = 0.1, np.radians(10)  # metres and radians to the next keyframe
KEYFRAME_PARALLAX = 0.075  # share of the median depth; near surfaces change their looks in a shorter distance
KEYFRAME_OVERLAP = 0.6  # share of the last keyframe's view; with less, the next keyframe starts
MIN_PLANES = 0.03  # share of the depth image that must show planes
MIN_INLIERS, MIN_RECALLED = 12, 8  # corners
PIXEL_TOLERANCE = 2.0  # pixels at 640 columns
MIN_COLUMNS = 320  # a corner of a smaller image is no more exact than of one with so many columns
NEWEST_COMPARED, COMPARED = 4, 10  # newest keyframes, and all keyframes, that a lost frame is compared with
MAX_RECALLED = 4  # most similar keyframes, from which the pose is searched
MAX_EXTRAPOLATION = 3.0  # the motion is continued over at most 3 times the last frame interval

MAX_OLDER = 2  # older keyframes that are used together with the last one
MAX_OLDER_ANGLE = np.radians(60)
MIN_OLDER_OVERLAP, MIN_OLDER_AGREEING = 0.5, 0.75  # shares
COARSE_AGREEMENT = 0.03  # metres, plus three deviations: agreement before the pose is exact
# Corners that raise the misfit by more than this factor and offset may lie on a moving object: if the image
# is more alike without them, they are left out.
MISFIT_FACTOR, MISFIT_OFFSET = 1.2, 0.3  # the offset in deviations
FEWEST_DELAYS, MOST_DELAYS = 15, 300  # frames from which the delay of colour is estimated
LEAST_DELAY_S, SURE_DELAY = 0.005, 5.0  # smallest delay that counts, in seconds and in standard errors
LONGEST_DELAY_S = 0.2  # no camera's colour is later; over a longer time, motion does not stay the same
LEAST_SHOWN = 0.03  # share of the corners' motion against planes that poses show; noise: 0.001, delay: 0.05
MAX_ELAPSED_S = 1.0  # seconds since the last frame; after more, the velocity is not known

Corners = tuple[NDArray[np.float64], features.Pixels]  # (n, 3) points of a keyframe, (n, 2) pixels in a frame
_NO_CORNERS: Corners = (np.empty((0, 3)), np.empty((0, 2), np.float32))


@dataclass(frozen=True, eq=False)
class _Attempt:
    keyframe: TrackingKeyframe
    T_keyframe_camera: se3.Transform
    by_corners: se3.Transform | None  # T_keyframe_camera as corners alone tell it
    evidence: pose_solver.PoseEvidence
    delay: tuple[float, float] | None  # information about the delay of colour, and the pull towards one


class ColorDelay:
    """Time by which colour is later than depth, by least squares over the first frames; 0 until it is sure.

    Corners follow colour, planes follow depth: a delay moves them apart in proportion to the motion. In a
    steady motion it does not: errors of the corners alone then look like a delay, which is not told.
    """

    seconds = 0.0

    def __init__(self) -> None:
        self._frames = list[tuple[float, float]]()
        self._shown = np.zeros(2)  # sums of products of twists: by corners and by poses, by corners alone

    @property
    def told(self) -> float:
        """Delay in seconds, 0 where the poses do not show the motion that it was found by."""
        return self.seconds if self._shown[0] > LEAST_SHOWN * self._shown[1] else 0.0

    def compare(self, by_corners: se3.Twist | None, by_poses: se3.Twist | None) -> None:
        """Add a frame's motion between corners and planes, as corners and as poses tell it."""
        if by_corners is not None and by_poses is not None and len(self._frames) < MOST_DELAYS:
            self._shown += by_corners @ by_poses, by_corners @ by_corners

    def add(self, information: float, pull: float) -> None:
        """Add what a frame tells about the delay, both for each second, at the present estimate."""
        if len(self._frames) == MOST_DELAYS or information <= 0:
            return
        self._frames.append((information, pull + information * self.seconds))
        known, towards = np.array(self._frames).T
        mean = float(towards.sum() / known.sum())
        error = float(np.linalg.norm(towards - known * mean) / known.sum())
        least = max(LEAST_DELAY_S, SURE_DELAY * error)
        sure = len(known) >= FEWEST_DELAYS and least < abs(mean) < LONGEST_DELAY_S
        self.seconds = mean if sure else 0.0


class RGBDLocalizer(Localizer):
    """`Localizer` of depth cameras, with colour if there is any.

    Corners are followed from the last tracking keyframe (Lucas and Kanade) and give a first pose.
    Gauss-Newton then refines it by the corners' reprojection errors and by the distances of the frame's
    points to planes. The planes are those of this keyframe and of the two oldest keyframes that see the same
    surface. Frames without an image use depth alone. A pose is accepted only if depth, image and geometry
    support it. A lost camera is searched near the last pose, then by ORB corners of the last keyframes.
    """

    absolute = False

    def __init__(self) -> None:
        self._next = self._turn = 0
        self.color_delay = ColorDelay()
        self._kept: deque[TrackingKeyframe] = deque(maxlen=MAX_KEYFRAMES)
        self._gyroscope = GyroscopeTrust()
        self.reset()

    def reset(self) -> None:
        """Forget the world. The next frame's camera is the origin of the new one."""
        self._kept.clear()
        self._last: se3.Transform = np.eye(4)
        self._last_ns = self._interval_ns = 0
        self._attitude: Attitude | None = None  # of the last frame with a pose
        self._motion: se3.Transform | None = None  # motion between the last two frames; None = not known
        self._by_corners: se3.Transform | None = None  # of the last frame in the last keyframe
        self._is_lost = False

    def track(self, frame: Frame) -> TrackedPose | Lost:
        """Find the camera's pose.

        Raises:
            InvalidKeyframe: the frame has no depth image.
        """
        current = RGBDFrame.of(frame)
        if current.surface.covered < MIN_PLANES:
            return self._lost(frame, f"{current.surface.covered:.1%} of the depth image shows a surface")
        if not self._kept:
            return self._start(frame, current, np.eye(4))
        self._elapsed_s = (frame.timestamp_ns - self._last_ns) / 1e9
        reason: str | None = None
        held: tuple[_Attempt, bool] | None = None  # with whether the camera counted as lost
        for seen, keyframe, guess, matched in self._guesses(frame, current):
            if held is not None and seen is not current:
                continue  # depth alone has less support
            found = self._attempt(seen, keyframe, guess, matched)
            doubt = found.evidence.doubt(strict=self._is_lost)
            if doubt is None and (held is None or found.evidence.beats(held[0].evidence)):
                if found.evidence.is_strong:
                    return self._accept(frame, current, found)
                held = found, self._is_lost
            reason = reason or doubt
        if held is not None:
            found, self._is_lost = held
            return self._accept(frame, current, found)
        return self._lost(frame, reason or "nothing known is in view")

    def _guesses(
        self, frame: Frame, current: RGBDFrame
    ) -> Iterator[tuple[RGBDFrame, TrackingKeyframe, se3.Transform, Corners]]:
        """Yield what of the frame to use, keyframes, first guesses of T_keyframe_camera, and matched corners.

        The likeliest come first. Where the image fails, depth alone is tried. The camera counts as lost when
        the last pose itself has failed.
        """
        last = self._kept[-1]
        T_keyframe_last = se3.inverse(last.T_world_camera) @ self._last
        near = [T_keyframe_last]
        motion = np.eye(4) if self._motion is None else self._continued(self._motion, frame)
        if self._motion is not None:
            near.insert(0, T_keyframe_last @ motion)
        turn = self._gyroscope.turn(frame, self._attitude)
        if turn is not None:
            near.insert(0, T_keyframe_last @ se3.transform(turn, motion[:3, 3]))
        for seen in (current, replace(current, image=None))[: 1 if current.image is None else 2]:
            yield from ((seen, last, guess, _NO_CORNERS) for guess in near)
        self._is_lost = True
        if current.gray is None:
            return
        for keyframe, points, pixels in self._recalled(current):
            tolerance = 1.5 * _tolerance(current)
            resected = features.resection(points, pixels, current.intrinsics, tolerance=tolerance)
            if resected is not None and resected[1].sum() >= MIN_RECALLED:
                yield current, keyframe, resected[0], (points[resected[1]], pixels[resected[1]])

    def _recalled(
        self, current: RGBDFrame
    ) -> list[tuple[TrackingKeyframe, NDArray[np.float64], features.Pixels]]:
        """Return the most similar of the newest and some older keyframes, with matched corners."""
        newest, others = list(self._kept)[-NEWEST_COMPARED:][::-1], list(self._kept)[:-NEWEST_COMPARED]
        self._turn += COMPARED - NEWEST_COMPARED
        turned = others[self._turn % len(others) :] + others if others else []
        keyframes = newest + turned[: min(len(others), COMPARED - NEWEST_COMPARED)]
        recalled = [(keyframe, *keyframe.recall(current)) for keyframe in keyframes]
        return sorted(recalled, key=lambda entry: -len(entry[1]))[:MAX_RECALLED]

    def _continued(self, motion: se3.Transform, frame: Frame) -> se3.Transform:
        """Return a motion continued over the time since the last frame."""
        now_ns = frame.timestamp_ns - self._last_ns
        if now_ns <= 0 or self._interval_ns <= 0:
            return motion
        longer = now_ns / self._interval_ns
        return se3.exp(se3.log(motion) * longer) if longer <= MAX_EXTRAPOLATION else np.eye(4)

    def _attempt(
        self, current: RGBDFrame, keyframe: TrackingKeyframe, guess: se3.Transform, matched: Corners
    ) -> _Attempt:
        """Find the best T_keyframe_camera near `guess`, and the evidence for it.

        Matched corners are used where fewer are followed.
        """
        points, pixels = keyframe.follow(current, guess)
        tolerance = _tolerance(current)
        resected = features.resection(points, pixels, current.intrinsics, guess=guess, tolerance=tolerance)
        if resected is None or resected[1].sum() < max(MIN_INLIERS, len(matched[0])):
            return self._aligned(current, keyframe, guess, matched)
        by_corners, inliers = resected
        drift = self._drift(keyframe, by_corners)
        start = by_corners if drift is None else se3.exp(-self.color_delay.seconds * drift) @ by_corners
        found = self._aligned(current, keyframe, start, (points[inliers], pixels[inliers]), drift)
        before, after = (_misfit(current, keyframe, T) for T in (guess, start))
        if after > MISFIT_FACTOR * before + MISFIT_OFFSET:
            without = self._aligned(current, keyframe, guess, matched)
            found = max(found, without, key=lambda each: each.evidence.likeness or 0.0)
        return replace(found, by_corners=by_corners)

    def _aligned(
        self,
        current: RGBDFrame,
        keyframe: TrackingKeyframe,
        guess: se3.Transform,
        corners: Corners,
        drift: se3.Twist | None = None,
    ) -> _Attempt:
        """Align the frame by these corners, and by the planes of the keyframe and of older ones."""
        T_late = np.eye(4) if drift is None else se3.exp(self.color_delay.seconds * drift)
        targets = [pose_solver.AlignmentTarget(np.eye(4), keyframe.frame.surface, *corners, T_late)]
        for older in self._older(current, keyframe.T_world_camera @ guess, keyframe):
            T_older_keyframe = se3.inverse(older.T_world_camera) @ keyframe.T_world_camera
            targets.append(pose_solver.AlignmentTarget(T_older_keyframe, older.frame.surface, *_NO_CORNERS))
        estimate = pose_solver.solve(targets, current.surface, current.intrinsics, current.columns, guess)
        evidence = pose_solver.pose_evidence(current, keyframe, estimate, len(corners[0]))
        delay = estimate.along(drift) if drift is not None and len(corners[0]) else None
        return _Attempt(keyframe, estimate.T_anchor_camera, None, evidence, delay)

    def _drift(
        self, keyframe: TrackingKeyframe, T_keyframe_camera: se3.Transform, *, by_poses: bool = False
    ) -> se3.Twist | None:
        """Return the motion between corners and planes for each second of delay; None if it is not known.

        The pose before is that by corners, too, if known: against the last pose, the delay counts as motion.
        """
        if keyframe.velocity is None or not 0 < self._elapsed_s < MAX_ELAPSED_S:
            return None
        before = self._by_corners if keyframe is self._kept[-1] and not by_poses else None
        if before is None:
            before = se3.inverse(keyframe.T_world_camera) @ self._last
        moved = se3.log(T_keyframe_camera @ se3.inverse(before))
        return np.asarray(moved / self._elapsed_s - keyframe.velocity)

    def _older(
        self, current: RGBDFrame, T_world_camera: se3.Transform, keyframe: TrackingKeyframe
    ) -> list[TrackingKeyframe]:
        """Return the oldest keyframes that see the frame's surface and agree about the frame's pose."""
        some, chosen = current.surface.every(8), list[TrackingKeyframe]()
        for older in self._kept:
            if len(chosen) == MAX_OLDER or older is keyframe:
                break
            T_older_camera = se3.inverse(older.T_world_camera) @ T_world_camera
            if se3.angle(T_older_camera) < MAX_OLDER_ANGLE:
                found = point_to_plane.match(older.frame.surface, current.surface, T_older_camera, some)
                agree = np.abs(found.distance) < COARSE_AGREEMENT + 3 * found.sigma
                enough = max(1.0, MIN_OLDER_OVERLAP * len(some))
                if len(agree) >= enough and agree.mean() >= MIN_OLDER_AGREEING:
                    chosen.append(older)
        return chosen

    def _accept(self, frame: Frame, current: RGBDFrame, found: _Attempt) -> TrackedPose:
        away, evidence, known = found.T_keyframe_camera, found.evidence, not self._is_lost
        if known and found.delay is not None:
            self.color_delay.add(*found.delay)
            if found.by_corners is not None:
                by_poses = self._drift(found.keyframe, away, by_poses=True)
                self.color_delay.compare(self._drift(found.keyframe, found.by_corners), by_poses)
        T = se3.nearest(found.keyframe.T_world_camera @ away)
        self._motion = se3.inverse(self._last) @ T if known else None
        if self._motion is not None:
            self._gyroscope.judge(self._gyroscope.turn(frame, self._attitude), self._motion)
        self._interval_ns = frame.timestamp_ns - self._last_ns if known else 0
        far = (
            se3.distance(away) > min(KEYFRAME_DISTANCE, KEYFRAME_PARALLAX * current.surface.median_depth)
            or se3.angle(away) > KEYFRAME_ANGLE
            or evidence.overlap < KEYFRAME_OVERLAP
        )
        if far or found.keyframe is not self._kept[-1]:
            return self._start(frame, current, T, evidence)
        self._remember_pose(T, frame)
        self._by_corners = found.by_corners
        return TrackedPose(
            T_world_camera=T,
            timestamp_ns=frame.timestamp_ns,
            anchor=found.keyframe.number,
            T_anchor_camera=away,
            quality=evidence.agreeing,
            covariance=evidence.covariance,
            color_delay_s=self.color_delay.told,
            T_then_now=self._motion_to_color(),
        )

    def _start(
        self,
        frame: Frame,
        current: RGBDFrame,
        T: se3.Transform,
        evidence: pose_solver.PoseEvidence | None = None,
    ) -> TrackedPose:
        """Make the frame the newest tracking keyframe."""
        keyframe = TrackingKeyframe.of(current, self._next, T)
        if self._motion is not None and self._interval_ns > 0:
            keyframe = replace(keyframe, velocity=1e9 / self._interval_ns * se3.log(self._motion))
        self._next += 1
        if self._kept:
            self._kept[-1] = self._kept[-1].packed()
        self._kept.append(keyframe)
        self._remember_pose(T, frame)
        self._by_corners = np.eye(4)
        return TrackedPose(
            T_world_camera=T,
            timestamp_ns=frame.timestamp_ns,
            anchor=keyframe.number,
            T_anchor_camera=np.eye(4),
            starts_anchor=True,
            quality=1.0 if evidence is None else evidence.agreeing,
            covariance=None if evidence is None else evidence.covariance,
            color_delay_s=self.color_delay.told,
            T_then_now=self._motion_to_color(),
        )

    def _motion_to_color(self) -> se3.Transform | None:
        """Return the motion of the camera from depth to colour, T_then_now; None = none, or not known."""
        delay_ns = 1e9 * self.color_delay.told
        longest_ns = MAX_EXTRAPOLATION * self._interval_ns  # stamps may hardly grow
        if self._motion is None or not 0 < abs(delay_ns) <= longest_ns:
            return None
        return se3.exp(-delay_ns / self._interval_ns * se3.log(self._motion))

    def _remember_pose(self, T: se3.Transform, frame: Frame) -> None:
        self._last, self._last_ns, self._attitude, self._is_lost = (
            T,
            frame.timestamp_ns,
            frame.attitude,
            False,
        )

    def _lost(self, frame: Frame, reason: str) -> Lost:
        self._motion, self._is_lost = None, True
        return Lost(reason=reason, timestamp_ns=frame.timestamp_ns)


def _tolerance(current: RGBDFrame) -> float:
    """Return the largest error of a followed corner, pixels."""
    return PIXEL_TOLERANCE * max(current.columns, MIN_COLUMNS) / 640


def _misfit(current: RGBDFrame, keyframe: TrackingKeyframe, T_keyframe_camera: se3.Transform) -> float:
    """Return the median distance of the frame's points from the keyframe's planes, in sensor deviations."""
    found = point_to_plane.match(
        keyframe.frame.surface, current.surface, T_keyframe_camera, current.surface.every(4)
    )
    return float(np.median(np.abs(found.distance) / found.sigma)) if len(found.distance) else np.inf
