# SPDX-License-Identifier: MIT
"""Hold answers of a map: samples of its distance field, views of cameras, and point clouds."""

import os
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import InvalidConfig, InvalidKeyframe, needing
from tsfusion.geometry import point_files
from tsfusion.geometry.keyframe import MAX_IMAGE_SIDE, Intrinsics, check_intrinsics, check_pose, intrinsics_of
from tsfusion.geometry.mesh_arrays import generator


@dataclass(frozen=True, eq=False)
class Samples:
    """The map's signed distance at points of the world; it is known only near surfaces.

    NaN means unknown, not free: to avoid collisions, use a `DistanceField`.

    Attributes:
        distance: (n,) float32 metres, positive in the free space in front of a surface; NaN if unseen, or
            beyond the band around the surface.
        weight: (n,) float32, in samples of full confidence; 0 without samples.
        gradient: (n, 3) float32, derivative of the distance along x, y, z; NaN if unseen.
        reach: metres in front of a surface up to which distances are known.

    Examples:
        >>> wall = tsfusion.Keyframe(
        ...     depth=np.full((480, 640), 1500, np.uint16),
        ...     intrinsics=tsfusion.Intrinsics(525.0, 525.0, 319.5, 239.5),
        ...     T_world_camera=np.eye(4),
        ... )
        >>> volume = tsfusion.Volume(0.05)
        >>> added = volume.integrate(wall)
        >>> found = volume.sample([[0.0, 0.0, 1.45], [0.0, 0.0, 0.5]])
        >>> found.distance.round(2)  # 5 cm before the wall; farther than the map knows
        array([0.05,  nan], dtype=float32)
        >>> round(found.reach, 3)
        0.15
    """

    distance: NDArray[np.float32]
    weight: NDArray[np.float32]
    gradient: NDArray[np.float32]
    reach: float = 0.0


@dataclass(frozen=True, eq=False)
class View:
    """View of the map's surface by a pinhole camera.

    Attributes:
        depth: (H, W) float32 metres along the optical axis; 0 = nothing hit, as in a keyframe's depth.
        normals: (H, W, 3) float32 unit normals in the world's frame, towards the camera; 0 = nothing hit.
            None if not requested.
        colors: (H, W, 3) uint8 RGB (sRGB), 0 = nothing hit; None if the map has none, or if not requested.

    Examples:
        >>> volume = tsfusion.Volume(0.05)
        >>> keyframe = tsfusion.open_dataset("synthetic:room", count=1)[0]
        >>> added = volume.integrate(keyframe)
        >>> view = volume.raycast(keyframe.intrinsics, keyframe.T_world_camera, keyframe.shape)
        >>> view.depth.shape, view.normals.shape
        ((240, 320), (240, 320, 3))
    """

    depth: NDArray[np.float32]
    normals: NDArray[np.float32] | None = None
    colors: NDArray[np.uint8] | None = None


@dataclass(frozen=True, eq=False)
class PointCloud:
    """Points of the map's surface.

    Attributes:
        points: (n, 3) float32 metres.
        normals: (n, 3) float32, unit length, away from the surface.
        weights: (n,) float32, in samples of full confidence.
        colors: (n, 3) uint8 RGB (sRGB); None if the map holds none.

    Examples:
        >>> volume = tsfusion.Volume(0.05)
        >>> added = volume.integrate(tsfusion.open_dataset("synthetic:room", count=1)[0])
        >>> cloud = volume.point_cloud(min_weight=1.0)
        >>> cloud.points.shape == cloud.normals.shape == cloud.colors.shape
        True
        >>> cloud.save("room.pcd").name
        'room.pcd'
    """

    points: NDArray[np.float32]
    normals: NDArray[np.float32]
    weights: NDArray[np.float32]
    colors: NDArray[np.uint8] | None = None

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write the points with normals and colours as PLY, PCD, LAS or LAZ, in the map's frame.

        Args:
            path: the file; `.ply`, `.pcd`, `.las` or `.laz`.

        Raises:
            OutputError: for another suffix, no points, or a path that cannot be written.
            MissingDependency: for LAS and LAZ without laspy.
        """
        facts = {"generator": generator(), "unit": "metre"}
        return point_files.save(path, self.points, normals=self.normals, colors=self.colors, facts=facts)

    def to_open3d(self) -> Any:
        """Make an `open3d.t.geometry.PointCloud` with `normals`, `weights` and `colors` (float32, 0 to 1).

        Raises MissingDependency without Open3D.
        """
        o3d = import_open3d()
        cloud = o3d.t.geometry.PointCloud(o3d.core.Tensor(self.points))
        cloud.point.normals = o3d.core.Tensor(self.normals)
        cloud.point.weights = o3d.core.Tensor(self.weights[:, None])
        if self.colors is not None:
            cloud.point.colors = o3d.core.Tensor(self.colors / np.float32(255))
        return cloud


def import_open3d() -> Any:
    """Return the module `open3d`. Raises MissingDependency without it."""
    with needing("Open3D is not installed (pip install open3d)"):
        return import_module("open3d")


def checked_points(points: Any) -> NDArray[np.floating]:
    """Return points as contiguous (n, 3) float32 or float64. Raises InvalidConfig for anything else."""
    array = np.asarray(points)
    if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in "fiu":
        raise InvalidConfig(
            f"points must be numbers of shape (n, 3), in metres; got {array.dtype} of shape {array.shape}"
        )
    return np.ascontiguousarray(array, np.float32 if array.dtype == np.float32 else np.float64)


def checked_camera(
    intrinsics: Any, T_world_camera: Any, shape: Any
) -> tuple[Intrinsics, NDArray[np.float64], tuple[int, int]]:
    """Return a camera's checked intrinsics, pose and image (height, width). Raises InvalidConfig."""
    found = intrinsics_of(intrinsics)
    if found is None:
        raise InvalidConfig(
            "intrinsics must be Intrinsics(fx, fy, cx, cy), these four numbers, or the matrix "
            f"[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]; got {' '.join(repr(intrinsics).split())}"
        )
    try:
        found, T = check_intrinsics(found), check_pose(T_world_camera)
    except InvalidKeyframe as error:
        raise InvalidConfig(str(error)) from error
    try:
        height, width = (int(side) for side in shape if side == int(side))
    except (TypeError, ValueError):
        height = width = 0
    if not 1 <= min(height, width) <= max(height, width) <= MAX_IMAGE_SIDE:
        raise InvalidConfig(
            f"shape must be (height, width), 1 to {MAX_IMAGE_SIDE} pixels each; got {shape!r}"
        )
    return found, T, (height, width)
