# SPDX-License-Identifier: MIT
"""Posts and a bar before a wall, by formula: scans of a LiDAR, and views of a depth camera."""

import numpy as np
from numpy.typing import NDArray

from tsfusion import Intrinsics, Keyframe

Array = NDArray[np.float64]
POSTS = [(3.03, y) for y in (-1.17, -0.36, 0.52, 1.31)]  # x, y of upright cylinders
BAR_HEIGHT = 0.64  # of a level one, along y, in the plane of the posts
VOXEL = 0.1


def ranges(origin: Array, rays: Array, wall: float, radius: float, *, bar: bool) -> Array:
    """Distances along unit rays (n, 3) to a wall across x, the posts and perhaps the bar."""
    hit = (wall - origin[0]) / rays[:, 0]
    lines = [((0, 1), np.array(post)) for post in POSTS]
    lines += [((0, 2), np.array([POSTS[0][0], BAR_HEIGHT]))] if bar else []
    for axes, place in lines:
        across, to = rays[:, axes], place - origin[list(axes)]
        a, b = (across**2).sum(axis=1), across @ to
        below = b * b - a * (to @ to - radius**2)
        near = (b - np.sqrt(np.maximum(below, 0))) / a
        hit = np.where((below > 0) & (near > 0), np.minimum(hit, near), hit)
    return hit


def scans(gap: float, count: int = 20) -> list[Keyframe]:
    """A LiDAR passes the posts of 5 cm, which stand so far before a wall."""
    turn, rise = np.meshgrid(np.radians(np.arange(-40, 40, 0.25)), np.radians(np.arange(-12, 10, 1.0)))
    rays = np.stack([np.cos(rise) * np.cos(turn), np.cos(rise) * np.sin(turn), np.sin(rise)], -1).reshape(
        -1, 3
    )
    keyframes = []
    for y in np.linspace(-0.9, 0.9, count):
        pose = np.eye(4)
        pose[:3, 3] = -0.5, y, 1.0
        points = rays * ranges(pose[:3, 3], rays, POSTS[0][0] + gap, 0.025, bar=False)[:, None]
        keyframes.append(Keyframe(points=points.astype(np.float32), T_world_camera=pose))
    return keyframes


def views(gap: float, *, color: bool) -> list[Keyframe]:
    """A depth camera passes posts and a bar of 4 cm, which are so far before a wall."""
    camera = Intrinsics(150.0, 150.0, 79.5, 59.5)
    u, v = np.meshgrid(np.arange(160.0), np.arange(120.0))
    rays = np.stack([np.ones_like(u), (79.5 - u) / 150, (59.5 - v) / 150], -1).reshape(-1, 3)
    length = np.linalg.norm(rays, axis=1, keepdims=True)
    keyframes = []
    for y in np.linspace(-0.8, 0.8, 20):
        pose = np.eye(4)
        pose[:3] = [[0, 0, 1, 0.4], [-1, 0, 0, y], [0, -1, 0, 0.9]]
        depth = ranges(pose[:3, 3], rays / length, POSTS[0][0] + gap, 0.02, bar=True) / length[:, 0]
        image = np.full((120, 160, 3), 90, np.uint8) if color else None
        depth = depth.reshape(120, 160).astype(np.float32)
        keyframes.append(Keyframe(depth=depth, intrinsics=camera, T_world_camera=pose, color=image))
    return keyframes
