# SPDX-License-Identifier: MIT
"""Measures that a wrong pose, camera or unit cannot pass."""

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry.keyframe import Keyframe, depth_metres, points_camera


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
    u = np.rint(q[:, 0] / q[:, 2] * K.fx + K.cx).astype(int)
    v = np.rint(q[:, 1] / q[:, 2] * K.fy + K.cy).astype(int)
    inside = (u >= 0) & (v >= 0) & (u < seen.shape[1]) & (v < seen.shape[0])
    z, found = q[inside, 2], seen[v[inside], u[inside]]
    assert (found > 0).sum() > 1000, "the two views do not overlap"
    return float(np.median(np.abs(z - found)[found > 0]))


def edge_fit(color: NDArray[np.uint8], depth_m: NDArray[np.float32]) -> float:
    """How well two images are registered: the colour's gradient under depth edges, in multiples of its mean.

    About 1 when they have nothing to do with each other, 2 to 4 on real pairs that fit.
    """
    blurred = cv2.GaussianBlur(cv2.cvtColor(color, cv2.COLOR_BGR2GRAY), (0, 0), 1.0)
    across, down = (cv2.Sobel(blurred, cv2.CV_32F, dx, dy) for dx, dy in ((1, 0), (0, 1)))
    gradient = cv2.magnitude(across, down)
    edges = np.zeros(depth_m.shape, bool)  # the near side of every jump in depth by 5 %
    for shift, axis in ((1, 0), (-1, 0), (1, 1), (-1, 1)):
        edges |= (depth_m > 0) & (np.roll(depth_m, shift, axis) > 1.05 * depth_m)
    edges[[0, -1]] = edges[:, [0, -1]] = False
    return float(gradient[edges].mean() / gradient.mean())
