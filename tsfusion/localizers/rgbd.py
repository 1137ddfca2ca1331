# SPDX-License-Identifier: MIT
"""RGB-D odometry: every frame against the last tracking keyframe, by corners and planes together."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tsfusion import se3
from tsfusion.frame import Frame
from tsfusion.localizers import features, icp, joint, judge
from tsfusion.localizers.base import Corrections, Lost, Pose
from tsfusion.localizers.views import Seen, View

Matrix = NDArray[np.float64]

_KEPT = 40  # tracking keyframes
_DISTANCE, _ANGLE = 0.1, np.radians(10)  # to the next one
_OVERLAP = 0.6  # with the last one; below: the next one
_ENOUGH = 500  # blocks with a plane

EVIDENCE = []
X = dict(n=1, a=np.radians(60), o=.5, g=.7)


@dataclass(frozen=True, eq=False)
class _Found:
    view: View
    T_view_camera: Matrix
    evidence: judge.Evidence

    @property
    def T_world_camera(self) -> Matrix:
        return self.view.T_world_camera @ self.T_view_camera


class RGBD:
    """Follows a depth camera, with colour where there is some. A `Localizer`.

    A frame's corners are followed from the tracking keyframe (Lucas and Kanade); the pose they give begins a
    Gauss-Newton over their reprojection and the distances of the frame's points to the keyframe's planes.
    """

    def __init__(self) -> None:
        self._next = 0
        self._kept: deque[View] = deque(maxlen=_KEPT)
        self.reset()

    def reset(self) -> None:
        """Forget the world: the next frame's camera is the new one's origin."""
        self._kept.clear()
        self._last: Matrix = np.eye(4)
        self._step: Matrix | None = np.eye(4)  # since the frame before; None = lost

    def corrections(self) -> Corrections | None:
        """None: this localizer never looks back."""
        return None

    def track(self, frame: Frame) -> Pose | Lost:
        """Where the camera was.

        Raises:
            InvalidKeyframe: when the frame has no depth image.
        """
        seen = Seen.of(frame)
        planes = int(np.count_nonzero(seen.surface.planes[3]))
        if planes < _ENOUGH:
            return self._lost(frame, f"{planes} of {len(seen.surface.planes[3])} blocks of the depth image show a surface")
        if not self._kept:
            return self._start(frame, seen, np.eye(4), 1.0)
        reason = ""
        for view, guess, strict in self._guesses(seen):
            found, why = self._attempt(seen, view, guess, strict)
            if found is not None:
                return self._go_on(frame, seen, found)
            reason = reason or why
        return self._lost(frame, reason)

    def _guesses(self, seen: Seen) -> Iterator[tuple[View, Matrix, bool]]:
        """What to try: (view, T_view_camera, whether it takes strong evidence)."""
        view = self._kept[-1]
        T_view_last = se3.inverse(view.T_world_camera) @ self._last
        if self._step is not None:
            yield view, T_view_last @ self._step, False
        yield view, T_view_last, self._step is None
        for view in reversed(self._kept):
            points, pixels = view.recall(seen)
            resected = features.resection(points, pixels, seen.intrinsics, tolerance=3 * seen.columns / 640)
            if resected is not None and resected[1].sum() >= 12:
                yield view, resected[0], True

    def _attempt(self, seen: Seen, view: View, guess: Matrix, strict: bool) -> tuple[_Found | None, str]:
        points, pixels = view.follow(seen, guess)
        tolerance = 2 * seen.columns / 640
        resected = features.resection(points, pixels, seen.intrinsics, guess=guess, tolerance=tolerance)
        if resected is not None and resected[1].sum() >= 12:
            guess, inliers = resected
            points, pixels = points[inliers], pixels[inliers]
        else:
            points, pixels = points[:0], pixels[:0]
        links = [joint.Link(np.eye(4), view.seen.surface, points, pixels.astype(np.float64))]
        for other in self._others(view, seen, guess):
            T_other_view = se3.inverse(other.T_world_camera) @ view.T_world_camera
            links.append(joint.Link(T_other_view, other.seen.surface, points[:0], pixels[:0]))
        estimate = joint.solve(links, seen.surface, seen.intrinsics, seen.columns, guess)
        evidence = judge.weigh(seen, view, estimate, len(points))
        EVIDENCE.append((evidence, len(view.points), estimate.scale, strict))
        doubt = evidence.doubt(strict=strict)
        return (None, doubt) if doubt else (_Found(view, estimate.T_anchor_camera, evidence), "")

    def _others(self, view: View, seen: Seen, guess: Matrix) -> list[View]:
        T = view.T_world_camera @ guess
        some = seen.surface.every(8)
        near = []
        for other in self._kept:
            if len(near) == X['n'] or other is view: break
            D = se3.inverse(other.T_world_camera) @ T
            if se3.angle(D) > X['a']: continue
            m = icp.match(other.seen.surface, seen.surface, D, some)
            if len(m.distance) > X['o'] * len(some) and (np.abs(m.distance) < .03 + 3 * m.sigma).mean() > X['g']:
                near.append(other)
        return near

    def _go_on(self, frame: Frame, seen: Seen, found: _Found) -> Pose:
        T = found.T_world_camera
        self._step = None if self._step is None else se3.inverse(self._last) @ T
        if self._step is None:
            self._step = np.eye(4)
        self._last = T
        quality = found.evidence.agreeing
        away = found.T_view_camera
        if se3.distance(away) > _DISTANCE or se3.angle(away) > _ANGLE or found.evidence.overlap < _OVERLAP:
            return self._start(frame, seen, T, quality)
        return Pose(
            T_world_camera=T,
            timestamp_ns=frame.timestamp_ns,
            anchor=found.view.number,
            T_anchor_camera=away,
            quality=quality,
        )

    def _start(self, frame: Frame, seen: Seen, T: Matrix, quality: float) -> Pose:
        view = View.of(seen, self._next, T)
        self._next += 1
        self._last = T
        self._kept.append(view)
        return Pose(
            T_world_camera=T,
            timestamp_ns=frame.timestamp_ns,
            anchor=view.number,
            T_anchor_camera=np.eye(4),
            starts_anchor=True,
            quality=quality,
        )

    def _lost(self, frame: Frame, reason: str) -> Lost:
        self._step = None
        return Lost(reason=reason, timestamp_ns=frame.timestamp_ns)
