# SPDX-License-Identifier: MIT
"""Small scenes with known answers, rendered by formula."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from tsfusion import Intrinsics, Keyframe, Volume

CAMERA = Intrinsics(120.0, 120.0, 79.5, 59.5)
SHAPE = (120, 160)


def look_at(eye: NDArray[np.float64], target: NDArray[np.float64]) -> NDArray[np.float64]:
    """T_world_camera of a camera at `eye` that looks at `target`, OpenCV axes."""
    forward = (target - eye) / np.linalg.norm(target - eye)
    up = np.array([0.0, 0.0, 1.0]) if abs(forward[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    T[:3, 3] = eye
    return T


def directions(T: NDArray[np.float64]) -> NDArray[np.float64]:
    """(H, W, 3) world directions of the pixels, scaled so that depth is the ray parameter."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    rays = np.dstack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(SHAPE)])
    return rays @ T[:3, :3].T


def sphere_keyframe(T: NDArray[np.float64], radius: float) -> Keyframe:
    """A sphere around the origin, float32 depth."""
    d, o = directions(T), T[:3, 3]
    a, b, c = (d * d).sum(-1), (d @ o), o @ o - radius**2
    inside = b * b - a * c
    depth = np.where(inside > 0, (-b - np.sqrt(np.maximum(inside, 0))) / a, 0).astype(np.float32)
    color = np.full((*SHAPE, 3), (20, 120, 220), np.uint8)  # BGR
    return Keyframe(depth=depth, color=color, intrinsics=CAMERA, T_world_camera=T)


def sphere_views(radius: float, count: int = 26) -> list[Keyframe]:
    """Views from all around (Fibonacci directions), three radii away."""
    i = np.arange(count) + 0.5
    polar, azimuth = np.arccos(1 - 2 * i / count), np.pi * (1 + 5**0.5) * i
    eyes = np.stack([np.cos(azimuth) * np.sin(polar), np.sin(azimuth) * np.sin(polar), np.cos(polar)], axis=1)
    return [sphere_keyframe(look_at(3 * radius * eye, np.zeros(3)), radius) for eye in eyes]


def plane_keyframe(T: NDArray[np.float64], normal: NDArray[np.float64], offset: float) -> Keyframe:
    """The plane normal · p = offset, float32 depth."""
    with np.errstate(divide="ignore"):
        depth = (offset - T[:3, 3] @ normal) / (directions(T) @ normal)
    depth = np.where((depth > 0.1) & (depth < 4), depth, 0).astype(np.float32)
    return Keyframe(depth=depth, intrinsics=CAMERA, T_world_camera=T)


def volume_of(keyframes: Iterable[Keyframe], **settings: object) -> Volume:
    """A map of these keyframes."""
    volume = Volume(**{"voxel_size": 0.02, "threads": 2, **settings})
    for keyframe in keyframes:
        volume.integrate(keyframe)
    return volume


def free_space(volume: Volume) -> dict[int, int]:
    """How many keyframes look through each block, by its key."""
    keys, counts = volume._store.clear.counts()
    return dict(zip(keys.tolist(), counts.tolist(), strict=True))


def tilted_plane(noise: float = 0.0) -> tuple[NDArray[np.float64], list[Keyframe]]:
    """The normal of a plane 0.1 m from the origin, and four views of it with `noise` metres of noise."""
    normal, random = np.array([0.3, -0.2, 0.93]), np.random.default_rng(0)
    normal /= np.linalg.norm(normal)
    eyes = [(0.0, 0.0, 1.5), (0.5, 0.2, 1.5), (-0.4, 0.3, 1.5), (0.1, -0.6, 1.5)]
    poses = [look_at(np.array(eye), np.array([0.1, 0.0, 0.0])) for eye in eyes]
    return normal, [with_noise(plane_keyframe(T, normal, 0.1), noise, random) for T in poses]


def with_noise(keyframe: Keyframe, sigma: float, random: np.random.Generator) -> Keyframe:
    """The same view with Gaussian noise of `sigma` metres on its depth."""
    noisy = keyframe.depth + sigma * random.standard_normal(keyframe.depth.shape)
    depth = np.where(keyframe.depth > 0, noisy, 0).astype(np.float32)
    return Keyframe(depth=depth, intrinsics=keyframe.intrinsics, T_world_camera=keyframe.T_world_camera)
