# SPDX-License-Identifier: MIT
"""Colours that a mesh shows a camera, and how near they are to what the camera saw."""

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry import se3
from tsfusion.geometry.keyframe import Intrinsics, Keyframe
from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.textured_mesh import TexturedMesh, barycentric
from tsfusion.tsdf.texture.texture_fitting import TextureImage, image_of

MAX_OFF = 0.05  # metres between the mesh and the measured depth where a pixel is compared
MIN_CLEARNESS = 0.5  # of its depth's edge: there the registration of colour to depth ends


class ShownView(NamedTuple):
    """View of a mesh: (H, W, 3) float32 RGB, 0 to 255, and (H, W) float32 depth in metres, 0 = nothing."""

    color: NDArray[np.float32]
    depth: NDArray[np.float32]


class ColorError(NamedTuple):
    """Peak signal-to-noise ratio in decibels, and structural similarity (1 = equal)."""

    psnr: float
    ssim: float


def shown(
    mesh: Mesh, T_world_camera: NDArray[np.float64], intrinsics: Intrinsics, shape: tuple[int, int]
) -> ShownView:
    """A mesh with its texture, or else its colours at the vertices, as a camera without lamps sees it."""
    from tsfusion.kernels.base import runtime

    runtime.start()
    from tsfusion.kernels.answers import rasterizer
    from tsfusion.tsdf.answers import camera_views

    seen = camera_views.rasterised(mesh, intrinsics, T_world_camera, shape)[0]
    v, u = np.nonzero(seen != rasterizer.EMPTY)
    depth = np.zeros(shape, np.float32)
    depth[v, u] = (seen[v, u] >> 32).astype(np.int32).view(np.float32)
    f, K = seen[v, u].astype(np.int32), intrinsics  # the low half
    ray = np.stack([(u - K.cx) / K.fx, (v - K.cy) / K.fy, np.ones(len(u))], axis=1)
    p = (mesh.vertices.astype(np.float64) - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
    weight = barycentric(ray, *(p[mesh.faces[f, k]] for k in range(3)))
    color = np.zeros((*shape, 3), np.float32)
    color[v, u] = mesh.sample(f, weight) if isinstance(mesh, TexturedMesh) else _mixed(mesh, f, weight)
    return ShownView(color, depth)


def _mixed(mesh: Mesh, face: NDArray[np.int32], weight: NDArray[np.float64]) -> NDArray[np.float64]:
    colors = np.full(mesh.vertices.shape, 128, np.uint8) if mesh.colors is None else mesh.colors
    return np.asarray((weight[..., None] * colors[mesh.faces[face]]).sum(axis=1))


def compared(mesh: Mesh, keyframe: Keyframe, view: ShownView) -> NDArray[np.bool_]:
    """(H, W) bool: pixels where the mesh lies on the measured depth, away from the depth's edges."""
    image = _image(keyframe)
    near = np.abs(image.depth - view.depth) <= MAX_OFF
    return np.asarray((view.depth > 0) & near & (image.clearness >= MIN_CLEARNESS))


def registered(
    keyframe: Keyframe, view: ShownView, where: NDArray[np.bool_]
) -> tuple[NDArray[np.float32], ShownView]:
    """The keyframe's image moved onto what a mesh shows, (H, W, 3) float32 RGB, and that as bright as it.

    The colours' camera may be off its pose, and its exposure is its own; neither says anything about a mesh.
    Both are fitted to what is compared: six numbers of a pose, three factors. NaN where the image ends.
    """
    image, K = _image(keyframe), keyframe.intrinsics
    assert K is not None  # `_image` has checked
    v, u = np.nonzero(where)
    z = view.depth[v, u].astype(np.float64)
    at = np.stack([(u - K.cx) / K.fx * z, (v - K.cy) / K.fy * z, z], axis=1)
    points = se3.apply(keyframe.T_world_camera, at)
    T = _followed(image, points, view.color, (u, v))
    seen = se3.apply(T, points)
    columns, rows = (np.full(where.shape, -9, np.float32) for _ in range(2))
    columns[v, u] = K.fx * seen[:, 0] / seen[:, 2] + K.cx
    rows[v, u] = K.fy * seen[:, 1] / seen[:, 2] + K.cy
    moved = cv2.remap(image.color, columns, rows, cv2.INTER_LINEAR).astype(np.float32)
    inside = (columns >= 0) & (rows >= 0) & (columns <= where.shape[1] - 1) & (rows <= where.shape[0] - 1)
    moved[~inside] = np.nan
    moved = np.asarray(moved, np.float32)
    return moved, as_bright(moved, view, where)


def as_bright(image: NDArray[np.float32], view: ShownView, where: NDArray[np.bool_]) -> ShownView:
    """View of a mesh, as bright as an image of it: RGB times three factors fitted where it is compared."""
    where = where & np.isfinite(image).all(axis=2)
    there, other = image[where], view.color[where]
    factors = (there * other).sum(axis=0) / np.maximum((other * other).sum(axis=0), 1e-9)
    return view._replace(color=(view.color * factors).clip(0, 255).astype(np.float32))


def _followed(
    image: TextureImage,
    points: NDArray[np.float64],
    target: NDArray[np.float32],
    at: tuple[NDArray[np.intp], NDArray[np.intp]],
) -> NDArray[np.float64]:
    """T_camera_world of the colours, moved until they lie on the target at points shown at its pixels."""
    from tsfusion.tsdf.texture import texture_fitting  # Taichi, which `shown` has started

    gray = cv2.cvtColor(image.color, cv2.COLOR_RGB2GRAY)
    wanted = cv2.pyrDown(cv2.cvtColor(target, cv2.COLOR_RGB2GRAY))
    every = np.arange(0, len(points), max(1, len(points) // 30_000))
    few = np.asarray(points[every], np.float32)
    u, v = (x[every] / 2 for x in at)
    weight = np.ones(len(few))
    one = texture_fitting.Sighting(
        image.number, image.T_camera_world, image.camera, np.arange(len(few)), weight, cv2.pyrDown(gray),
        image.color,
    )  # fmt: skip
    T = image.T_camera_world
    for blur, rounds in texture_fitting.LEVELS:
        smooth = cv2.GaussianBlur(one.gray.astype(np.float32), (0, 0), blur)
        level = texture_fitting.sampled(cv2.GaussianBlur(wanted, (0, 0), blur), u, v)
        for _ in range(rounds // 2):
            T = texture_fitting.stepped(one, T, texture_fitting.look(few, one, smooth, T), level, weight)
    return T


def color_error(seen: NDArray[np.float32], view: ShownView, where: NDArray[np.bool_]) -> ColorError:
    """Difference of an image (H, W, 3), RGB of 0 to 255, and what a mesh shows, where it is compared.

    Structural similarity is that of the grey images (Wang et al. 2004: Gaussian window of 11 pixels).
    """
    where = where & np.isfinite(seen).all(axis=2)
    difference = (seen - view.color)[where]
    psnr = 10 * np.log10(255**2 / max(float((difference.astype(np.float64) ** 2).mean()), 1e-12))
    a = cv2.cvtColor(np.nan_to_num(seen), cv2.COLOR_RGB2GRAY).astype(np.float64)
    b = np.where(where, cv2.cvtColor(view.color, cv2.COLOR_RGB2GRAY), a)
    mean_a, mean_b = _window(a), _window(b)
    var_a, var_b = _window(a * a) - mean_a**2, _window(b * b) - mean_b**2
    both = _window(a * b) - mean_a * mean_b
    light, contrast = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    similar = (2 * mean_a * mean_b + light) * (2 * both + contrast)
    similar /= (mean_a**2 + mean_b**2 + light) * (var_a + var_b + contrast)
    return ColorError(float(psnr), float(similar[where].mean()))


def _window(image: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(cv2.GaussianBlur(image, (11, 11), 1.5))


def _image(keyframe: Keyframe) -> TextureImage:
    image = image_of(keyframe, 0)
    if image is None:
        raise ValueError("a view is compared with a keyframe that has depth and colour images")
    return image
