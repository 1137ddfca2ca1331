# SPDX-License-Identifier: MIT
"""Draw a picture of a mesh on the CPU. Every run ends with such a picture."""

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
_WALL = 0.08  # share of a picture's height: a back face that hides more than this is not drawn
_SHADING = (0.06, 4.0)  # ambient occlusion: its reach as a share of the mesh's diagonal, and its strength


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
    """Draw `mesh` to a PNG file with its up direction upwards (+z if unknown). No partial file is left.

    Wide back faces that hide front faces are left out, so that the viewer sees into rooms.

    Args:
        width: pixels.
        height: pixels.
        camera: None = chosen by `choose_camera`.

    Raises:
        OutputError: for an empty mesh or a path that cannot be written.
    """
    path = Path(path)
    if not len(mesh.faces):
        raise OutputError(f"nothing to draw in {path}: the mesh has no triangles (yet)")
    up = up_of(mesh)
    camera = camera or choose_camera(mesh, up, aspect=width / height)
    write_png(picture(mesh, camera, width, height, up=up), path)
    return path


def up_of(mesh: Mesh) -> NDArray[np.float64]:
    """Return the (3,) direction that is upwards in a picture: `mesh.up`, or +z if that is unknown."""
    return np.array((0.0, 0.0, 1.0) if mesh.up is None else mesh.up.direction)


def picture(
    mesh: Mesh, camera: PreviewCamera, width: int, height: int, *, up: NDArray[np.float64]
) -> NDArray[np.uint8]:
    """Return (height, width, 3) uint8 sRGB: `draw` with smooth edges and ambient occlusion."""
    size = (width * _OVERSAMPLING, height * _OVERSAMPLING)
    image = draw(mesh, camera, *size, up=up, texture=True)
    if has_colors(mesh) or not isinstance(mesh, TexturedMesh):
        _add_backs(
            image,
            draw(Mesh(mesh.vertices, mesh.faces[:, ::-1], -mesh.normals, mesh.colors), camera, *size, up=up),
        )
    from tsfusion.kernels.answers import rasterizer

    reach, strength = _SHADING
    radius = reach * float(np.linalg.norm(np.ptp(core(mesh), axis=0)))
    rasterizer.occlude(image, _OVERSAMPLING, _focal(camera, image.shape[1]), radius, strength)
    return _develop(image, _OVERSAMPLING)


def has_colors(mesh: Mesh) -> bool:
    """True if a mesh has different colours. The map of a LiDAR is grey all over."""
    return mesh.colors is not None and len(mesh.colors) > 0 and bool(np.ptp(mesh.colors, axis=0).any())


def _add_backs(image: NDArray[np.float32], backs: NDArray[np.float32]) -> None:
    """Add back faces to a picture of front faces: those of poles and chairs, not of a wall before a room."""
    import cv2

    depth, near = image[..., 3], backs[..., 3]
    shown = (near > 0) & ((depth == 0) | (near < depth))
    over = (shown & (depth > 0)).astype(np.uint8)
    count, part = cv2.connectedComponents(over)
    side = max(1, int(_WALL * len(image)))
    is_wall = np.zeros(count, bool)
    is_wall[part[cv2.erode(over, np.ones((side, side), np.uint8)) > 0]] = True
    shown &= ~is_wall[part]
    image[shown] = backs[shown]


def draw(
    mesh: Mesh,
    camera: PreviewCamera,
    width: int,
    height: int,
    *,
    up: NDArray[np.float64] | None = None,
    texture: bool = False,
) -> NDArray[np.float32]:
    """Return (height, width, 4) float32: linear RGB in 0…1, and depth z in metres (0 = nothing is seen).

    The bytes do not depend on the thread count: a pixel keeps the smallest depth, then the lowest triangle.

    Args:
        texture: draw the texture of a mesh that has one, instead of the colours at its vertices.
    """
    from tsfusion.kernels.answers import rasterizer

    vertices, seen = _see(mesh, camera, width, height)
    R = camera.T_world_camera[:3, :3]
    image = np.zeros((height, width, 4), np.float32)
    image[..., :3] = BACKGROUND
    up = np.array((0.0, 0.0, 1.0)) if up is None else up
    colors = mesh.colors
    if colors is None or not has_colors(mesh):
        colors = height_colors(mesh.vertices, up)
    is_textured = texture and isinstance(mesh, TexturedMesh)
    if is_textured:
        colors = np.full(mesh.vertices.shape, 255, np.uint8)
    up_camera = R.T @ up
    rasterizer.shade(
        image, seen, vertices, _faces(mesh), _float32(mesh.normals @ R), np.ascontiguousarray(colors),
        _focal(camera, width), *(float(x) for x in up_camera), rasterizer.EMPTY,
    )  # fmt: skip
    if is_textured and isinstance(mesh, TexturedMesh):
        _paint(image, seen, mesh, vertices, _focal(camera, width))
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


def _see(
    mesh: Mesh, camera: PreviewCamera, width: int, height: int
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Return vertices in camera coordinates (n, 3), and the (height, width) result of `rasterise`."""
    from tsfusion.kernels.answers import rasterizer
    from tsfusion.kernels.base import runtime

    runtime.start()
    T = camera.T_world_camera
    vertices = _float32((mesh.vertices - T[:3, 3]) @ T[:3, :3])
    seen = np.full((height, width), rasterizer.EMPTY, np.int64)
    rasterizer.rasterise(seen, vertices, _faces(mesh), _focal(camera, width), camera.near)
    return vertices, seen


def _focal(camera: PreviewCamera, width: int) -> float:
    """Return the focal length in pixels of a picture of this width."""
    return 0.5 * width / math.tan(0.5 * camera.fov)


def _faces(mesh: Mesh) -> NDArray[np.int32]:
    return np.ascontiguousarray(mesh.faces, np.int32)


def height_colors(vertices: NDArray[np.float32], up: NDArray[np.float64]) -> NDArray[np.uint8]:
    """Return (n, 3) uint8 RGB by height: dark blue is low, light green is high."""
    import cv2

    height = vertices @ up
    low, high = np.percentile(height, (1, 98)) if len(height) else (0.0, 1.0)
    share = ((height - low) / max(high - low, 1e-6)).clip(0, 1)
    level = np.round(255 * (_RAMP[0] + (_RAMP[1] - _RAMP[0]) * share**0.7)).astype(np.uint8).reshape(-1, 1)
    bgr: NDArray[np.uint8] = cv2.applyColorMap(level, cv2.COLORMAP_VIRIDIS) if len(level) else level
    return bgr.reshape(-1, 3)[:, ::-1]


def choose_camera(mesh: Mesh, up: NDArray[np.float64], *, aspect: float) -> PreviewCamera:
    """Return the camera, of a ring of cameras above the mesh, that sees front faces in most pixels."""
    return orbit(core(mesh), up, *choose_angles(mesh, up, aspect=aspect), aspect)


def choose_angles(mesh: Mesh, up: NDArray[np.float64], *, aspect: float) -> tuple[float, float]:
    """Return azimuth and elevation, radians, of the camera that `choose_camera` returns."""
    sample = core(mesh)
    best, best_score = (0.0, 0.0), -1.0
    for elevation in np.radians(_ELEVATIONS):
        for azimuth in np.arange(_AZIMUTHS) * (2 * math.pi / _AZIMUTHS):
            score = _score(mesh, orbit(sample, up, azimuth, elevation, aspect), aspect)
            if score > best_score:
                best, best_score = (float(azimuth), float(elevation)), score
    return best


def _score(mesh: Mesh, camera: PreviewCamera, aspect: float) -> float:
    """Return the share of the pixels that see a front face."""
    from tsfusion.kernels.answers.rasterizer import EMPTY

    _, seen = _see(mesh, camera, int(96 * aspect), 96)
    return float(np.count_nonzero(seen != EMPTY)) / seen.size


def core(mesh: Mesh) -> NDArray[np.float64]:
    """Return fewer than 40 000 vertices without outliers: those near the 3 % to 97 % range of each axis."""
    sample = mesh.vertices[:: max(1, len(mesh.vertices) // 20_000)].astype(np.float64)
    low, high = np.percentile(sample, (3, 97), axis=0)
    margin = 0.05 * (high - low)
    inside = ((sample >= low - margin) & (sample <= high + margin)).all(axis=1)
    return sample[inside] if inside.any() else sample


def orbit(
    points: NDArray[np.float64], up: NDArray[np.float64], azimuth: float, elevation: float, aspect: float
) -> PreviewCamera:
    """Return a camera that looks down on `points` at the given angles, as near as it sees all of them."""
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
    import cv2

    size = (image.shape[1] // factor, image.shape[0] // factor)
    linear = cv2.resize(image[..., :3], size, interpolation=cv2.INTER_AREA)
    encoded = cv2.pow(np.clip(linear, 0, 1, out=linear), 1 / 2.2)
    rgb: NDArray[np.uint8] = cv2.convertScaleAbs(encoded, alpha=255)
    return rgb


def write_png(rgb: NDArray[np.uint8], path: Path) -> None:
    import cv2

    done, encoded = cv2.imencode(".png", rgb[..., ::-1])
    if not done:
        raise OutputError(f"cannot encode the picture {path}")
    with durable_files.written(path) as file:
        file.write(encoded.tobytes())


def _float32(array: NDArray[Any]) -> NDArray[np.float32]:
    return np.ascontiguousarray(array, np.float32)
