# SPDX-License-Identifier: MIT
"""A picture of a mesh, drawn on the CPU: the last step of every run, so that a person can look at it."""

import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.core import durable_files
from tsfusion.core.errors import OutputError
from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.textured_mesh import TexturedMesh, barycentric

BACKGROUND = (0.93, 0.94, 0.96)  # linear RGB
_RAMP = (0.12, 0.8)  # of the colour map: its ends are too dark to shade, and too pale for the background
_OVERSAMPLING = 2
_ELEVATIONS = (28.0, 42.0, 58.0)  # degrees above the ground
_AZIMUTHS = 12
_NEAR = 0.05  # metres
_BAND = 64  # rows of a picture that are painted at a time


@dataclass(frozen=True, eq=False)
class PreviewCamera:
    """Camera of a picture."""

    T_world_camera: NDArray[np.float64]  # (4, 4) float64, OpenCV axes (x right, y down, z forward)
    fov: float = math.radians(50)  # horizontal field of view, radians
    near: float = _NEAR  # metres in front of the eye where drawing starts


def render(
    mesh: Mesh,
    path: str | os.PathLike[str],
    *,
    width: int = 1280,
    height: int = 800,
    camera: PreviewCamera | None = None,
) -> Path:
    """Draw `mesh` to a PNG file, its `up` above (+z where that is not known); complete or not at all.

    Triangles seen from behind are left out, so that a room can be looked into from outside.

    Args:
        width: pixels.
        height: pixels.
        camera: None = chosen by `choose_camera`.

    Raises:
        OutputError: for an empty mesh or a place that cannot be written.
    """
    path = Path(path)
    if not len(mesh.faces):
        raise OutputError(f"nothing to draw in {path}: the mesh has no triangles (yet)")
    up = np.array((0.0, 0.0, 1.0) if mesh.up is None else mesh.up.direction)
    camera = camera or choose_camera(mesh, up, aspect=width / height)
    image = draw(mesh, camera, width * _OVERSAMPLING, height * _OVERSAMPLING, up=up, texture=True)
    _write_png(_develop(image, _OVERSAMPLING), path)
    return path


def draw(
    mesh: Mesh,
    camera: PreviewCamera,
    width: int,
    height: int,
    *,
    up: NDArray[np.float64] | None = None,
    texture: bool = False,
) -> NDArray[np.float32]:
    """(height, width, 4) float32: linear RGB in 0…1 and depth z in metres (0 where nothing is seen).

    The same bytes whatever the thread count: a pixel keeps the smallest depth, then the smallest triangle.

    Args:
        texture: draw the texture of a mesh that has one, instead of the colours at its vertices.
    """
    from tsfusion.kernels import runtime

    runtime.start()
    from tsfusion.kernels import rasterizer

    R = camera.T_world_camera[:3, :3]
    vertices = _float32((mesh.vertices - camera.T_world_camera[:3, 3]) @ R)
    focal = 0.5 * width / math.tan(0.5 * camera.fov)
    seen = np.full((height, width), rasterizer.EMPTY, np.int64)
    faces = np.ascontiguousarray(mesh.faces, np.int32)
    rasterizer.rasterise(seen, vertices, faces, focal, camera.near)
    image = np.zeros((height, width, 4), np.float32)
    image[..., :3] = BACKGROUND
    up = np.array((0.0, 0.0, 1.0)) if up is None else up
    colors = mesh.colors
    if colors is None or not np.ptp(colors, axis=0).any():
        colors = height_colors(mesh.vertices, up)
    is_textured = texture and isinstance(mesh, TexturedMesh)
    if is_textured:
        colors = np.full(mesh.vertices.shape, 255, np.uint8)
    up_camera = R.T @ up
    rasterizer.shade(
        image, seen, vertices, faces, _float32(mesh.normals @ R), np.ascontiguousarray(colors),
        focal, *(float(x) for x in up_camera), rasterizer.EMPTY,
    )  # fmt: skip
    if is_textured and isinstance(mesh, TexturedMesh):
        _paint(image, seen, mesh, vertices, focal)
    return image


def _paint(
    image: NDArray[np.float32],
    seen: NDArray[np.int64],
    mesh: TexturedMesh,
    vertices: NDArray[np.float32],
    focal: float,
) -> None:
    """Multiply the light in a picture by the texture, a band of rows at a time.

    Args:
        vertices: in camera coordinates.
    """
    height, width = seen.shape
    for start in range(0, height, _BAND):
        v, u = np.nonzero(image[start : start + _BAND, :, 3])
        v += start
        face = seen[v, u].astype(np.int32)  # the low half
        ray = np.stack(
            [(u - 0.5 * (width - 1)) / focal, (v - 0.5 * (height - 1)) / focal, np.ones(len(u))], 1
        )
        weight = barycentric(ray, *(vertices[mesh.faces[face, k]].astype(np.float64) for k in range(3)))
        image[v, u, :3] *= (mesh.sample(face, weight) / 255) ** 2.2


def height_colors(vertices: NDArray[np.float32], up: NDArray[np.float64]) -> NDArray[np.uint8]:
    """(n, 3) uint8 RGB for a mesh without colour: dark blue is low, light green high."""
    import cv2

    height = vertices @ up
    low, high = np.percentile(height, (1, 98)) if len(height) else (0.0, 1.0)
    share = ((height - low) / max(high - low, 1e-6)).clip(0, 1)
    level = np.round(255 * (_RAMP[0] + (_RAMP[1] - _RAMP[0]) * share**0.7)).astype(np.uint8).reshape(-1, 1)
    bgr: NDArray[np.uint8] = cv2.applyColorMap(level, cv2.COLORMAP_VIRIDIS) if len(level) else level
    return bgr.reshape(-1, 3)[:, ::-1]


def choose_camera(mesh: Mesh, up: NDArray[np.float64], *, aspect: float) -> PreviewCamera:
    """The view from above, among a ring of them, in which most of the picture shows a front side."""
    sample = _core(mesh.vertices)
    best, best_score = PreviewCamera(np.eye(4)), -1.0
    for elevation in _ELEVATIONS:
        for azimuth in np.arange(_AZIMUTHS) * (2 * math.pi / _AZIMUTHS):
            camera = _orbit(sample, up, azimuth, math.radians(elevation), aspect)
            score = _score(mesh, camera, aspect)
            if score > best_score:
                best, best_score = camera, score
    return best


def _score(mesh: Mesh, camera: PreviewCamera, aspect: float) -> float:
    """The share of the pixels that see a front side."""
    depth = draw(mesh, camera, int(96 * aspect), 96)[..., 3]
    return float(np.count_nonzero(depth)) / depth.size


def _core(vertices: NDArray[np.float32]) -> NDArray[np.float64]:
    """At most 20 000 vertices without the strays: those about the 3 % to 97 % range of each axis."""
    sample = vertices[:: max(1, len(vertices) // 20_000)].astype(np.float64)
    low, high = np.percentile(sample, (3, 97), axis=0)
    margin = 0.05 * (high - low)
    inside = ((sample >= low - margin) & (sample <= high + margin)).all(axis=1)
    return sample[inside] if inside.any() else sample


def _orbit(
    points: NDArray[np.float64], up: NDArray[np.float64], azimuth: float, elevation: float, aspect: float
) -> PreviewCamera:
    """A camera that looks down on `points` at the given angles, as near as shows all of them."""
    east = np.cross(up, (0.0, 1.0, 0.0) if abs(up[1]) < 0.9 else (1.0, 0.0, 0.0))
    east /= np.linalg.norm(east)
    north = np.cross(up, east)
    level = math.cos(azimuth) * east + math.sin(azimuth) * north
    forward = -(math.cos(elevation) * level + math.sin(elevation) * up)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack((right, np.cross(forward, right), forward), axis=1)
    tan_x = math.tan(0.5 * PreviewCamera.fov) * 0.95
    tan_y = tan_x / aspect
    x, y, z = (points @ T[:3, :3]).T
    # The smallest wedge around all points, per axis: where its two planes meet is the eye.
    left, rightmost = (x + tan_x * z).min(), (x - tan_x * z).max()
    top, bottom = (y + tan_y * z).min(), (y - tan_y * z).max()
    eye_x, eye_y = 0.5 * (left + rightmost), 0.5 * (top + bottom)
    eye_z = min((left - rightmost) / (2 * tan_x), (top - bottom) / (2 * tan_y))
    T[:3, 3] = T[:3, :3] @ (eye_x, eye_y, eye_z)
    return PreviewCamera(T)


def _develop(image: NDArray[np.float32], factor: int) -> NDArray[np.uint8]:
    """Average `factor`² samples a pixel and encode as sRGB-like (gamma 2.2) 8-bit RGB."""
    height, width = image.shape[0] // factor, image.shape[1] // factor
    linear = image[..., :3].reshape(height, factor, width, factor, 3).mean(axis=(1, 3))
    encoded: NDArray[np.uint8] = np.round(255 * linear.clip(0, 1) ** (1 / 2.2)).astype(np.uint8)
    return encoded


def _write_png(rgb: NDArray[np.uint8], path: Path) -> None:
    import cv2

    done, encoded = cv2.imencode(".png", rgb[..., ::-1])
    if not done:
        raise OutputError(f"cannot encode the picture {path}")
    try:
        with durable_files.replacing(path) as file:
            file.write(encoded.tobytes())
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}") from error


def _float32(array: NDArray[Any]) -> NDArray[np.float32]:
    return np.ascontiguousarray(array, np.float32)
