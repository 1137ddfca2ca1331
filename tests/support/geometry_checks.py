# SPDX-License-Identifier: MIT
"""Measures that a wrong pose, camera or unit cannot pass."""

import numpy as np
from numpy.typing import NDArray

from tsfusion.evaluation.view_prediction import depth_metres, points_camera
from tsfusion.geometry.keyframe import Keyframe


def move(T: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    return points @ T[:3, :3].T + T[:3, 3]


def warp_residual(
    a: Keyframe, b: Keyframe, *, T_b_a: NDArray[np.float64] | None = None, max_depth: float = 1e3
) -> float:
    """Median |z predicted - z seen|, metres, of the depth of `a` moved into `b`."""
    if T_b_a is None:
        T_b_a = np.linalg.inv(b.T_world_camera) @ a.T_world_camera
    p = points_camera(a)
    q = move(T_b_a, p[p[:, 2] < max_depth])
    q = q[q[:, 2] > 0.1]
    K, seen = b.intrinsics, depth_metres(b)
    assert K is not None
    u = np.rint(q[:, 0] / q[:, 2] * K.fx + K.cx).astype(int)
    v = np.rint(q[:, 1] / q[:, 2] * K.fy + K.cy).astype(int)
    inside = (u >= 0) & (v >= 0) & (u < seen.shape[1]) & (v < seen.shape[0])
    z, found = q[inside, 2], seen[v[inside], u[inside]]
    assert (found > 0).sum() > 1000, "the two views do not overlap"
    return float(np.median(np.abs(z - found)[found > 0]))
