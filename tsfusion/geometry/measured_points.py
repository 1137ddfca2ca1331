# SPDX-License-Identifier: MIT
"""The points that a keyframe measured."""

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry.keyframe import Keyframe


def depth_metres(keyframe: Keyframe) -> NDArray[np.float64]:
    """(H, W) float64 z of a depth or disparity keyframe; 0 = no return."""
    if keyframe.disparity is not None:
        d = keyframe.disparity * keyframe.disparity_scale
        z = np.divide(keyframe.baseline_fx or 0.0, d, out=np.zeros(keyframe.shape), where=d > 0)
    else:
        z = keyframe.measurement.astype(np.float64)
        if keyframe.measurement.dtype == np.uint16:
            z *= keyframe.depth_scale
    return np.where(np.isfinite(z) & (z > 0), z, 0.0)


def points_camera(keyframe: Keyframe) -> NDArray[np.float64]:
    """(n, 3) float64 of the valid pixels, or of the points, in the sensor's frame."""
    if keyframe.points is not None:
        return keyframe.points.astype(np.float64)
    z, K = depth_metres(keyframe), keyframe.intrinsics
    assert K is not None  # a keyframe with an image has a camera
    v, u = np.nonzero(z)
    z = z[v, u]
    return np.stack([(u - K.cx) / K.fx * z, (v - K.cy) / K.fy * z, z], axis=1)


def points_world(keyframe: Keyframe) -> NDArray[np.float64]:
    """`points_camera`, moved by the keyframe's pose."""
    T = keyframe.T_world_camera
    moved: NDArray[np.float64] = points_camera(keyframe) @ T[:3, :3].T + T[:3, 3]
    return moved
