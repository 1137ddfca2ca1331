# SPDX-License-Identifier: MIT
"""Whether a pose that was found can be believed."""

from dataclasses import dataclass

import numpy as np

from tsfusion.geometry import se3
from tsfusion.scanner.localization.rgbd import point_to_plane
from tsfusion.scanner.localization.rgbd.pose_solver import Estimate
from tsfusion.scanner.localization.rgbd.view import FrameView, Seen

_NEAR = 0.01  # metres, and three deviations: a point on its plane
_PATTERN = 0.1  # of what all could be: below, there is nothing to compare
_SAFETY = 3.0  # times the information that noise alone would give

_OVERLAP, _OVERLAP_STRICT = 0.25, 0.4
_AGREEING, _AGREEING_STRICT, _AGREEING_DEPTH_ALONE = 0.7, 0.8, 0.92
_LIKENESS, _LIKENESS_STRICT = 0.2, 0.3
_UNCERTAINTY = 0.01


@dataclass(frozen=True)
class Evidence:
    """How a view agrees with another from the pose found.

    Attributes:
        overlap: share of the view's points that fall onto planes of the other.
        agreeing: share of these that lie on them.
        likeness: -1 to 1, of the grey patterns there; None = no image, or nothing on it.
        corners: number that agree.
        uncertainty: metres; deviation of the pose in its worst direction, rotations taken at the surface.
    """

    overlap: float
    agreeing: float
    likeness: float | None
    corners: int
    uncertainty: float

    def doubt(self, *, strict: bool) -> str | None:
        """Why the pose cannot be believed; None = it can.

        In a recorded kitchen poses from frame to frame agreed by 0.92 or more in depth and by 0.35 or more in
        the image, wrong ones by 0.26 and 0.05 or less, but depth alone by 0.9 when centimetres off.

        Args:
            strict: the pose came out of the blue.
        """
        agreeing = _AGREEING_STRICT if strict else _AGREEING
        likeness = _LIKENESS_STRICT if strict else _LIKENESS
        if self.likeness is None:
            agreeing = _AGREEING_DEPTH_ALONE
        overlap = _OVERLAP_STRICT if strict else _OVERLAP
        if self.overlap < overlap:
            return f"{self.overlap:.0%} of the view is of what is known, at least {overlap:.0%} must be"
        if self.agreeing < agreeing:
            return f"{self.agreeing:.0%} of the depth agrees, at least {agreeing:.0%} must"
        if self.likeness is not None and self.likeness < likeness:
            return f"the image agrees by {self.likeness:.2f}, it must by {likeness:.2f} of 1"
        if self.uncertainty > _UNCERTAINTY:
            return (
                f"the view leaves the pose open by {min(self.uncertainty, 9.99):.3f} m (a plain wall?), "
                f"at most {_UNCERTAINTY:.3f} m is allowed"
            )
        return None


def weigh(seen: Seen, view: FrameView, estimate: Estimate, corners: int) -> Evidence:
    """The evidence for an estimate of `seen`'s pose in `view`'s axes."""
    found = point_to_plane.match(view.seen.surface, seen.surface, estimate.T_anchor_camera, None)
    agree = np.abs(found.distance) < _NEAR + 3 * found.sigma
    total = max(1, seen.surface.points.shape[1])
    return Evidence(
        overlap=len(agree) / total,
        agreeing=float(agree.mean()) if len(agree) else 0.0,
        likeness=_likeness(seen, view, found),
        corners=corners,
        uncertainty=_uncertainty(estimate, found),
    )


def _likeness(seen: Seen, view: FrameView, found: point_to_plane.Match) -> float | None:
    if seen.pattern is None or view.seen.pattern is None or not len(found.block):
        return None
    here, there = seen.pattern[seen.surface.index[found.chosen]], view.seen.pattern[found.block]
    energy = float(here @ here + there @ there) / 2
    return float(here @ there) / energy if energy > _PATTERN * len(here) else None


def _uncertainty(estimate: Estimate, found: point_to_plane.Match) -> float:
    if not len(found.block):
        return float("inf")
    center = found.moved.mean(axis=1).astype(np.float64)
    around = np.eye(4)
    around[:3, 3] = center
    A = se3.adjoint(around)
    lever = max(0.1, float(np.sqrt(found.moved.astype(np.float64).var(axis=1).sum())))
    to_metres = A @ np.diag([1, 1, 1, *[1 / lever] * 3])
    planes, noise, corners = (
        to_metres.T @ H @ to_metres for H in (estimate.planes, _SAFETY * estimate.spurious, estimate.corners)
    )
    values, axes = np.linalg.eigh(planes - noise)
    least = float(np.linalg.eigvalsh(axes @ np.diag(np.maximum(values, 0)) @ axes.T + corners)[0])
    return 1 / np.sqrt(least) if least > 1e-9 else float("inf")
