# SPDX-License-Identifier: MIT
"""RGB-D odometry: every frame against the last tracking keyframe, by corners and planes together."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry import se3
from tsfusion.geometry.frame import Frame
from tsfusion.scanner.localization import features
from tsfusion.scanner.localization.localizer import Lost, Pose, PoseCorrections
from tsfusion.scanner.localization.rgbd import point_to_plane, pose_acceptance, pose_solver
from tsfusion.scanner.localization.rgbd.view import FrameView, Seen

_KEPT = 40  # tracking keyframes, about 1 MB each at 640×480
_DISTANCE, _ANGLE = 0.1, np.radians(10)  # to the next one
_OVERLAP = 0.6  # with the last one; below: the next one
_SURFACE = 0.03  # share of the depth image that must show planes
_INLIERS = 12  # corners
_TOLERANCE = 2.0  # pixels at 640 columns
_NEWEST, _RECALLED = 4, 10  # keyframes compared by descriptions with a lost frame: always, and in all
_TRIED = 4  # of them, those that look most like it
_LONGEST = 3.0  # times the interval before, over which a motion is taken to go on

_OLDER = 2  # keyframes that take part beside the last one
_OLDER_ANGLE = np.radians(60)
_OLDER_OVERLAP, _OLDER_AGREEING = 0.5, 0.75  # shares
_NEAR = 0.03  # metres, and three deviations: depth that agrees before the pose is settled
_WORSE, _FITS = 1.2, 0.3  # times the misfit without corners, and deviations: beyond, they are on what moves


_NO_CORNERS = (np.empty((0, 3)), np.empty((0, 2), np.float32))


@dataclass(frozen=True, eq=False)
class _Found:
    view: FrameView
    T_view_camera: se3.Transform
    evidence: pose_acceptance.Evidence


class RGBDLocalizer:
    """Follows a depth camera, with colour where there is some. A `Localizer`.

    Corners are followed from the tracking keyframe (Lucas and Kanade); the pose they give begins a
    Gauss-Newton over their reprojection and the distances of the frame's points to the planes of that
    keyframe and of the two oldest that see the same. Frames without an image go by depth alone. A pose is
    given only where depth, image and geometry bear it out. What is lost is looked for near the last pose,
    then by descriptions (ORB) among the last keyframes.
    """

    absolute = False

    def __init__(self) -> None:
        self._next = self._turn = 0
        self._kept: deque[FrameView] = deque(maxlen=_KEPT)
        self.reset()

    def reset(self) -> None:
        """Forget the world: the next frame's camera is the new one's origin."""
        self._kept.clear()
        self._last: se3.Transform = np.eye(4)
        self._last_ns = self._interval_ns = 0
        self._motion: se3.Transform | None = None  # between the last two frames; None = not known
        self._is_lost = False

    def corrections(self) -> PoseCorrections | None:
        """None: this localizer never looks back."""
        return None

    def track(self, frame: Frame) -> Pose | Lost:
        """Where the camera was.

        Raises:
            InvalidKeyframe: when the frame has no depth image.
        """
        seen = Seen.of(frame)
        if seen.surface.covered < _SURFACE:
            return self._lost(frame, f"{seen.surface.covered:.1%} of the depth image shows a surface")
        if not self._kept:
            return self._start(frame, seen, np.eye(4), 1.0)
        reason: str | None = None
        for view, guess in self._guesses(frame, seen):
            found = self._attempt(seen, view, guess)
            doubt = found.evidence.doubt(strict=self._is_lost)
            if doubt is None:
                return self._go_on(frame, seen, found)
            reason = reason or doubt
        return self._lost(frame, reason or "nothing known is in view")

    def _guesses(self, frame: Frame, seen: Seen) -> Iterator[tuple[FrameView, se3.Transform]]:
        """(view, T_view_camera to begin with), the likeliest first; what follows the last pose is wild."""
        last = self._kept[-1]
        T_view_last = se3.inverse(last.T_world_camera) @ self._last
        if self._motion is not None:
            yield last, T_view_last @ self._expected_motion(frame)
        yield last, T_view_last
        self._is_lost = True
        if seen.gray is None:
            return
        for view, points, pixels in self._recalled(seen):
            tolerance = 1.5 * _TOLERANCE * seen.columns / 640
            resected = features.resection(points, pixels, seen.intrinsics, tolerance=tolerance)
            if resected is not None and resected[1].sum() >= _INLIERS:
                yield view, resected[0]

    def _recalled(self, seen: Seen) -> list[tuple[FrameView, NDArray[np.float64], features.Pixels]]:
        """Of the newest keyframes and some others, in turn, those most like the frame; the corners shared."""
        newest, others = list(self._kept)[-_NEWEST:][::-1], list(self._kept)[:-_NEWEST]
        self._turn += _RECALLED - _NEWEST
        turned = others[self._turn % len(others) :] + others if others else []
        views = newest + turned[: min(len(others), _RECALLED - _NEWEST)]
        recalled = [(view, *view.recall(seen)) for view in views]
        return sorted(recalled, key=lambda entry: -len(entry[1]))[:_TRIED]

    def _expected_motion(self, frame: Frame) -> se3.Transform:
        """The last motion, going on for as long as this frame is after the last one."""
        assert self._motion is not None
        now_ns = frame.timestamp_ns - self._last_ns
        if now_ns <= 0 or self._interval_ns <= 0:
            return self._motion
        longer = now_ns / self._interval_ns
        return se3.exp(se3.log(self._motion) * longer) if longer <= _LONGEST else np.eye(4)

    def _attempt(self, seen: Seen, view: FrameView, guess: se3.Transform) -> _Found:
        """The best pose near `guess`, T_view_camera, and what speaks for it."""
        points, pixels = view.follow(seen, guess)
        tolerance = _TOLERANCE * seen.columns / 640
        resected = features.resection(points, pixels, seen.intrinsics, guess=guess, tolerance=tolerance)
        agree = np.zeros(len(points), bool)
        if resected is not None and resected[1].sum() >= _INLIERS:
            before, after = (_misfit(seen, view, T) for T in (guess, resected[0]))
            if after < _WORSE * before + _FITS:
                guess, agree = resected
        points, pixels = points[agree], pixels[agree]
        links = [pose_solver.Link(np.eye(4), view.seen.surface, points, pixels)]
        for older in self._older(seen, view.T_world_camera @ guess, view):
            T_older_view = se3.inverse(older.T_world_camera) @ view.T_world_camera
            links.append(pose_solver.Link(T_older_view, older.seen.surface, *_NO_CORNERS))
        estimate = pose_solver.solve(links, seen.surface, seen.intrinsics, seen.columns, guess)
        return _Found(
            view, estimate.T_anchor_camera, pose_acceptance.weigh(seen, view, estimate, len(points))
        )

    def _older(self, seen: Seen, T_world_camera: se3.Transform, view: FrameView) -> list[FrameView]:
        """The oldest keyframes that see the same as the frame, and agree about where it is."""
        some, chosen = seen.surface.every(8), list[FrameView]()
        for older in self._kept:
            if len(chosen) == _OLDER or older is view:
                break
            T_older_camera = se3.inverse(older.T_world_camera) @ T_world_camera
            if se3.angle(T_older_camera) < _OLDER_ANGLE:
                found = point_to_plane.match(older.seen.surface, seen.surface, T_older_camera, some)
                agree = np.abs(found.distance) < _NEAR + 3 * found.sigma
                enough = max(1.0, _OLDER_OVERLAP * len(some))
                if len(agree) >= enough and agree.mean() >= _OLDER_AGREEING:
                    chosen.append(older)
        return chosen

    def _go_on(self, frame: Frame, seen: Seen, found: _Found) -> Pose:
        away, evidence, known = found.T_view_camera, found.evidence, not self._is_lost
        T = se3.nearest(found.view.T_world_camera @ away)
        self._motion = se3.inverse(self._last) @ T if known else None
        self._interval_ns = frame.timestamp_ns - self._last_ns if known else 0
        far = se3.distance(away) > _DISTANCE or se3.angle(away) > _ANGLE or evidence.overlap < _OVERLAP
        if far or found.view is not self._kept[-1]:
            return self._start(frame, seen, T, evidence.agreeing)
        self._stand(T, frame)
        return Pose(
            T_world_camera=T,
            timestamp_ns=frame.timestamp_ns,
            anchor=found.view.number,
            T_anchor_camera=away,
            quality=evidence.agreeing,
        )

    def _start(self, frame: Frame, seen: Seen, T: se3.Transform, quality: float) -> Pose:
        """The frame becomes the tracking keyframe."""
        view = FrameView.of(seen, self._next, T)
        self._next += 1
        self._kept.append(view)
        self._stand(T, frame)
        return Pose(
            T_world_camera=T,
            timestamp_ns=frame.timestamp_ns,
            anchor=view.number,
            T_anchor_camera=np.eye(4),
            starts_anchor=True,
            quality=quality,
        )

    def _stand(self, T: se3.Transform, frame: Frame) -> None:
        self._last, self._last_ns, self._is_lost = T, frame.timestamp_ns, False

    def _lost(self, frame: Frame, reason: str) -> Lost:
        self._motion, self._is_lost = None, True
        return Lost(reason=reason, timestamp_ns=frame.timestamp_ns)


def _misfit(seen: Seen, view: FrameView, T_view_camera: se3.Transform) -> float:
    """Median distance of the frame's points from the view's planes, in deviations of the sensor."""
    found = point_to_plane.match(view.seen.surface, seen.surface, T_view_camera, seen.surface.every(4))
    return float(np.median(np.abs(found.distance) / found.sigma)) if len(found.distance) else np.inf
