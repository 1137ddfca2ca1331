# SPDX-License-Identifier: MIT
"""One pose from corners and planes together: Gauss-Newton over reprojection and point-to-plane distances.

Both errors are weighted by their deviations and made robust with the Geman-McClure kernel, whose reach
shrinks as the estimate settles.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry import se3
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.scanner.localization.rgbd import point_to_plane

PIXEL = 1.0  # deviation of a followed corner, at 640 columns
_REACH = 3.0  # deviations at which a residual counts a quarter
_TRUST = 0.1  # of a plane's residual against a corner's, until it is known how far neighbours err alike
_FLOOR, _CEILING = 0.25, 3.0  # deviation of the distances to planes, as a share of the sensor's
_PLANE_NOISE = 6.0  # sum of squares of a fit's offsets along one axis, in blocks: 3 × 3 of them
_WAVES = 0.03  # radians; what smooth errors of a sensor tilt its planes by
_DAMPING = 1e-6  # of the information's trace
_NEARLY_STILL, _STILL = 3e-4, 2e-5  # metres or radians; below, a round is over, the last one
_STEPS = ((4, 15, 0.3), (2, 6, 0.05), (1, 3, 0.03))  # blocks apart, iterations, gate in metres


@dataclass(frozen=True, eq=False)
class Link:
    """A view that the new one is compared with.

    Attributes:
        T_view_anchor: (4, 4), fixed.
        surface: of that view.
        points: (n, 3) of its corners, in its camera's axes.
        pixels: (n, 2) where the new image has them.
    """

    T_view_anchor: se3.Transform
    surface: point_to_plane.Surface
    points: NDArray[np.float64]
    pixels: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Estimate:
    """What came out.

    Attributes:
        T_anchor_camera: (4, 4).
        planes: (6, 6) information of a step from the left that the distances to planes give.
        spurious: (6, 6), what noise in the planes' normals alone would give.
        corners: (6, 6) information that the corners give.
    """

    T_anchor_camera: se3.Transform
    planes: se3.Matrix6
    spurious: se3.Matrix6
    corners: se3.Matrix6


def solve(
    links: Sequence[Link],
    here: point_to_plane.Surface,
    camera: Intrinsics,
    columns: int,
    T_anchor_camera: se3.Transform,
) -> Estimate:
    """The pose at which corners and planes agree best, from a pose nearby.

    Args:
        here: surface of the new view.
        camera, columns: intrinsics and width of its image.
    """
    T, trust = T_anchor_camera, _TRUST
    pixel = PIXEL * columns / 640
    planes = spurious = corners = np.zeros((6, 6))
    for apart, iterations, gate in _STEPS:
        some = here.every(apart) if apart > 1 else None
        reach = pixel * (4 if apart == _STEPS[0][0] else 1)
        for iteration in range(iterations):
            planes, spurious, corners, g = np.zeros((6, 6)), np.zeros((6, 6)), np.zeros((6, 6)), np.zeros(6)
            for link in links if apart == 1 else links[:1]:
                T_view_camera = link.T_view_anchor @ T
                found = point_to_plane.match(link.surface, here, T_view_camera, some)
                if apart == 1 and iteration == 0 and link is links[0]:
                    trust = 1 / point_to_plane.alike(found, link.surface.shape[1])
                H_planes, g_planes, weight = _planes(found, gate, apart**2 * trust)
                H_corners, g_corners = _corners(link, camera, T_view_camera, reach)
                A = se3.adjoint(link.T_view_anchor)
                planes, corners = planes + A.T @ H_planes @ A, corners + A.T @ H_corners @ A
                g = g + A.T @ (g_planes + g_corners)
                if apart == 1:
                    spurious = spurious + A.T @ _spurious(found, weight, link.surface) @ A
            H = planes + corners
            step = np.linalg.solve(H + (_DAMPING * np.trace(H) + 1e-9) * np.eye(6), g)
            T = se3.exp(step) @ T
            if np.abs(step).max() < (_STILL if apart == 1 else _NEARLY_STILL):
                break
    return Estimate(se3.nearest(T), planes, spurious, corners)


def _planes(
    found: point_to_plane.Match, gate: float, trust: float
) -> tuple[se3.Matrix6, se3.Twist, point_to_plane.Floats]:
    """Normal equations of the distances to planes, and each one's weight."""
    near = np.abs(found.distance) < np.float32(gate) + 3 * found.sigma
    if np.count_nonzero(near) < 12:
        return np.zeros((6, 6)), np.zeros(6), np.zeros(len(near), np.float32)
    whitened = found.distance / found.sigma
    scale = np.float32(np.clip(1.48 * np.median(np.abs(whitened[near])), _FLOOR, _CEILING))
    ratio = whitened / (scale * np.float32(_REACH))
    weight = np.float32(trust) * near / ((1 + ratio * ratio) * scale * found.sigma) ** 2
    H, g = point_to_plane.equations(found, weight)
    return H, g, weight


def _spurious(
    found: point_to_plane.Match, weight: point_to_plane.Floats, there: point_to_plane.Surface
) -> se3.Matrix6:
    """(6, 6) information that errors of the planes' normals alone would give."""
    slope = there.roughness * found.sigma * (there.intrinsics.fx / found.moved[2])
    return _isotropic(found.moved, weight * (slope * slope / _PLANE_NOISE + _WAVES**2))


def _isotropic(points: point_to_plane.Floats, weight: NDArray[np.floating]) -> se3.Matrix6:
    """(6, 6) information of points that are held in all three directions."""
    p, w = points.astype(np.float64), weight.astype(np.float64)
    total, first, second = w.sum(), p @ w, (p * w) @ p.T
    H = np.zeros((6, 6))
    H[:3, :3] = total * np.eye(3)
    H[:3, 3:] = -se3.hat(first)
    H[3:, :3] = se3.hat(first)
    H[3:, 3:] = np.trace(second) * np.eye(3) - second
    return H


def _corners(
    link: Link, camera: Intrinsics, T_view_camera: se3.Transform, pixel: float
) -> tuple[se3.Matrix6, se3.Twist]:
    """Normal equations of the reprojection errors of a link's corners."""
    if not len(link.points):
        return np.zeros((6, 6)), np.zeros(6)
    R = T_view_camera[:3, :3].T
    q = se3.apply(se3.inverse(T_view_camera), link.points)
    ok = q[:, 2] > 0.05
    z = np.where(ok, q[:, 2], 1.0)
    du = camera.fx * q[:, 0] / z + camera.cx - link.pixels[:, 0]
    dv = camera.fy * q[:, 1] / z + camera.cy - link.pixels[:, 1]
    weight = ok / (1 + (du * du + dv * dv) / (pixel * _REACH) ** 2) ** 2 / pixel**2
    zero = np.zeros_like(z)
    Ju = np.stack([camera.fx / z, zero, -camera.fx * q[:, 0] / z**2], axis=1) @ R
    Jv = np.stack([zero, camera.fy / z, -camera.fy * q[:, 1] / z**2], axis=1) @ R
    J = np.concatenate([Ju, Jv])
    X = np.concatenate([link.points, link.points])
    J = -np.concatenate([J, np.cross(X, J)], axis=1)
    w = np.concatenate([weight, weight])
    return (J * w[:, None]).T @ J, -(J * w[:, None]).T @ np.concatenate([du, dv])
