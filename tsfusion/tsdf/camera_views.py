# SPDX-License-Identifier: MIT
"""What a pinhole camera sees of a mesh of the map; the work is in `kernels/rasterizer.py`."""

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.geometry.map_answers import View
from tsfusion.geometry.mesh import Mesh
from tsfusion.kernels import rasterizer

NEAR = 0.05  # metres in front of the eye where the view starts


def look_at(
    mesh: Mesh, intrinsics: Intrinsics, T_world_camera: NDArray[np.float64], shape: tuple[int, int]
) -> View:
    """The view of a mesh, (H, W): depth, normals and colours of the first front side.

    The rasteriser knows one focal length and a centred image. A shear of space that keeps z makes any
    pinhole camera such a one.
    """
    height, width = shape
    K, focal = intrinsics, intrinsics.fx
    p = (mesh.vertices.astype(np.float64) - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
    p[:, 0] += (K.cx - 0.5 * (width - 1)) / focal * p[:, 2]
    p[:, 1] = K.fy / focal * p[:, 1] + (K.cy - 0.5 * (height - 1)) / focal * p[:, 2]
    faces = np.ascontiguousarray(mesh.faces if K.fy > 0 else mesh.faces[:, ::-1], np.int32)
    vertices = np.ascontiguousarray(p, np.float32)
    seen = np.full(shape, rasterizer.EMPTY, np.int64)
    rasterizer.rasterise(seen, vertices, faces, focal, NEAR)
    has_color = mesh.colors is not None
    found = View(
        np.zeros(shape, np.float32),
        np.zeros((*shape, 3), np.float32),
        np.zeros((*shape, 3), np.uint8) if has_color else None,
    )
    rasterizer.look_up(
        seen, vertices, faces, mesh.normals, mesh.colors if has_color else np.empty((0, 3), np.uint8), focal,
        rasterizer.EMPTY, found.depth, found.normals,
        found.colors if has_color else np.empty((0, 0, 3), np.uint8),
    )  # fmt: skip
    return found
