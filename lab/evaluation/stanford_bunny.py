# SPDX-License-Identifier: MIT
"""The Stanford bunny's range scans as keyframes: real rays that do not meet in one point.

The Cyberware scanner sweeps a laser plane along x and sees it through a camera: rays are exactly parallel
in x, and in y they fan out from a line parallel to the x axis, fitted to the scans' rows (residual < 0.1 mm).
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry.keyframe import Keyframe
from tsfusion.geometry.trajectory import rigid

LENS_Y, LENS_Z = 0.179, 1.32  # metres, scan frame: where the rays of one column meet


def scans(folder: Path) -> Iterator[Keyframe]:
    """Yield one keyframe a scan named in `data/bun.conf` whose file is present.

    `folder` is `stanford_bunny`. Points and per-point origins are in the scan frame, metres; the world is
    that of `reconstruction/bun_zipper.ply`.
    """
    conf = folder / "data" / "bun.conf"
    for line in conf.read_text(encoding="ascii").splitlines():
        words = line.split()
        if not words or words[0] != "bmesh" or not (folder / "data" / words[1]).exists():
            continue
        yield scan(folder / "data" / words[1], pose(np.array(words[2:], dtype=np.float64)))


def scan(path: Path, T_world_scan: NDArray[np.float64]) -> Keyframe:
    """One range image with the ray origin of every point."""
    points = read_points(path)
    origins = np.empty_like(points)
    origins[:, 0] = points[:, 0]
    origins[:, 1:] = LENS_Y, LENS_Z
    return Keyframe(points=points, origins=origins, T_world_camera=T_world_scan, sensor="scanner")


def read_points(path: Path) -> NDArray[np.float32]:
    """The (N, 3) float32 vertices of an ASCII PLY file, metres."""
    head, body = path.read_bytes().replace(b"\r\n", b"\n").split(b"end_header\n", 1)
    count = next(int(line.split()[-1]) for line in head.splitlines() if line.startswith(b"element vertex"))
    rows = body.split(b"\n", count)[:count]
    return np.array([row.split()[:3] for row in rows], dtype=np.float64).astype(np.float32)


def pose(translation_quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """`tx ty tz qx qy qz qw` of bun.conf → (4, 4) T_world_scan; its quaternion is the conjugate of ours."""
    q = translation_quaternion[3:] / np.linalg.norm(translation_quaternion[3:])
    return rigid(q * (-1, -1, -1, 1), translation_quaternion[:3])


def reference(folder: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices (n, 3) and faces (m, 3) of the zippered reference mesh, metres."""
    import trimesh

    mesh = trimesh.load(folder / "reconstruction" / "bun_zipper.ply", process=False)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)
