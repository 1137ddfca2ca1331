# SPDX-License-Identifier: MIT
"""Render a map's surface as a pinhole camera sees it, cube by cube (`kernels/answers/rasterizer.py`)."""

from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.geometry.map_answers import View
from tsfusion.geometry.mesh import Mesh, concatenated
from tsfusion.kernels.answers import rasterizer
from tsfusion.tsdf.store.block_store import unpack_keys
from tsfusion.tsdf.surface.surface_layers import SurfaceCubes

NEAR = 0.05  # metres; nearer surfaces are not drawn
MOST_TRIANGLES = 1 << 21  # drawn in one call


class _Wanted(NamedTuple):
    normals: bool
    colors: bool


_ALL = _Wanted(normals=True, colors=True)
_NOTHING = Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.float32))


def cast(cubes: SurfaceCubes, *camera: Any, **how: Any) -> View:
    """Return a camera's view of a surface, (H, W). Arguments: of `in_view` and `view_of`."""
    meshes = cubes.meshes.of(in_view(cubes.numbers(), cubes.side_m, *camera))
    return view_of(meshes, cubes.has_color, *camera, **how)


@np.errstate(over="ignore", invalid="ignore")  # an extreme focal length overflows
def view_of(
    meshes: Iterable[Mesh],
    has_color: bool,
    intrinsics: Intrinsics,
    T_world_camera: NDArray[np.float64],
    shape: tuple[int, int],
    *,
    normals: bool = True,
    colors: bool = True,
) -> View:
    """Return one view of several meshes, with depth and, if wanted, images of `normals` and `colors`."""
    wanted = _Wanted(normals, colors and has_color)
    parts = _parts(meshes, wanted)
    seen = look_at(next(parts, _NOTHING), intrinsics, T_world_camera, shape, wanted)
    for mesh in parts:
        seen = _nearer(seen, look_at(mesh, intrinsics, T_world_camera, shape, wanted))
    if wanted.colors and seen.colors is None:
        return View(seen.depth, seen.normals, np.zeros((*shape, 3), np.uint8))
    return seen


def look_at(
    mesh: Mesh,
    intrinsics: Intrinsics,
    T_world_camera: NDArray[np.float64],
    shape: tuple[int, int],
    wanted: _Wanted = _ALL,
) -> View:
    """Return a camera's view of a mesh's front sides, (H, W): depth, and the wanted normals and colours."""
    focal = intrinsics.fx
    seen, vertices, faces = rasterised(mesh, intrinsics, T_world_camera, shape)
    of_normals = mesh.normals if wanted.normals else _NOTHING.normals
    of_colors = mesh.colors if wanted.colors and mesh.colors is not None else np.zeros((0, 3), np.uint8)
    depth = np.zeros(shape, np.float32)
    normals = np.zeros((*shape, 3) if wanted.normals else (1, 1, 3), np.float32)
    colors = np.zeros((*shape, 3) if len(of_colors) else (1, 1, 3), np.uint8)
    rasterizer.look_up(
        seen, vertices, faces, of_normals, of_colors, focal, rasterizer.EMPTY, depth, normals, colors
    )
    return View(depth, normals if wanted.normals else None, colors if len(of_colors) else None)


def rasterised(
    mesh: Mesh, intrinsics: Intrinsics, T_world_camera: NDArray[np.float64], shape: tuple[int, int]
) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.int32]]:
    """Return the z-buffer of `rasterizer.rasterise`, (H, W), vertices in the camera's frame, and the faces.

    The rasteriser supports one focal length and a centred image. Vertices are therefore sheared: x and y
    change so that any pinhole camera becomes such a camera, and z stays the depth.
    """
    height, width = shape
    K, focal = intrinsics, intrinsics.fx
    shear = np.diag([1, K.fy / focal, 1])  # multiplied from the right, because rows are points
    shear[2, :2] = (K.cx - 0.5 * (width - 1)) / focal, (K.cy - 0.5 * (height - 1)) / focal
    from_eye = (mesh.vertices - T_world_camera[:3, 3]).astype(np.float32)
    vertices = from_eye @ (T_world_camera[:3, :3] @ shear).astype(np.float32)
    faces = np.ascontiguousarray(mesh.faces if K.fy > 0 else mesh.faces[:, ::-1], np.int32)
    seen = np.full(shape, rasterizer.EMPTY, np.int64)
    rasterizer.rasterise(seen, vertices, faces, focal, NEAR)
    return seen, vertices, faces


@np.errstate(over="ignore", invalid="ignore")
def in_view(
    numbers: NDArray[np.int64],
    side: float,
    intrinsics: Intrinsics,
    T_world_camera: NDArray[np.float64],
    shape: tuple[int, int],
) -> list[int]:
    """Return the numbers of the cubes, `side` metres wide, that a camera can see, nearest first."""
    centres = (unpack_keys(numbers) + 0.5) * side - T_world_camera[:3, 3]
    centres = centres @ T_world_camera[:3, :3]
    K, (height, width) = intrinsics, shape
    down = np.sort([-0.5 - K.cy, height - 0.5 - K.cy] / np.float64(K.fy))
    planes = np.array([  # normals inwards; through the eye and the image's sides
        (1, 0, (0.5 + K.cx) / K.fx), (-1, 0, (width - 0.5 - K.cx) / K.fx), (0, 1, -down[0]), (0, -1, down[1]),
        (0, 0, 1),
    ])  # fmt: skip
    planes /= np.linalg.norm(planes, axis=1, keepdims=True)
    radius = 0.5 * np.sqrt(3) * side * 1.05  # cells reach one voxel beyond the cube
    shown = np.flatnonzero((centres @ planes.T > -radius).all(axis=1))
    nearest_first = np.argsort(centres[shown, 2], kind="stable")
    visible: list[int] = numbers[shown[nearest_first]].tolist()
    return visible


def _parts(meshes: Iterable[Mesh], wanted: _Wanted) -> Iterator[Mesh]:
    """Join consecutive meshes into meshes of `MOST_TRIANGLES` triangles or more, to render at once."""
    part: list[Mesh] = []
    triangles = 0
    for mesh in meshes:
        normals, colors = mesh.normals if wanted.normals else _NOTHING.normals, mesh.colors
        part.append(Mesh(mesh.vertices, mesh.faces, normals, colors if wanted.colors else None))
        triangles += len(mesh.faces)
        if triangles >= MOST_TRIANGLES:
            yield concatenated(part)
            part, triangles = [], 0
    if triangles:
        yield concatenated(part)


def _nearer(one: View, other: View) -> View:
    is_other = (other.depth > 0) & ((one.depth == 0) | (other.depth < one.depth))
    for ours, theirs in ((one.depth, other.depth), (one.normals, other.normals), (one.colors, other.colors)):
        if ours is not None and theirs is not None:
            ours[is_other] = theirs[is_other]
    return one
