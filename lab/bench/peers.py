# SPDX-License-Identifier: MIT
"""Other systems behind our verbs, and what every measurement records of its surroundings."""

import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.process import peak_rss_bytes
from tsfusion.geometry.keyframe import depth_metres, points_world
from tsfusion.geometry.mesh import Mesh

ROOT = Path(__file__).parents[2]
sys.path.append(str(ROOT))  # lab is not installed
DATA = Path(os.environ.get("TSFUSION_DATA", ROOT.parent / "shared" / "data"))
WARM_UP = 5  # keyframes not counted


class Open3D:
    """VoxelBlockGrid: projective, 8³ blocks. Set OMP_NUM_THREADS before the first one."""

    def __init__(
        self, voxel_size: float, *, max_range: float, truncation: float, color: bool = False,
        mesh_weight: float = 2.0,
    ) -> None:  # fmt: skip
        import open3d

        o3d: Any = open3d  # whose stubs know too little
        self._o3d, self._color = o3d, color
        self._range, self._truncation = max_range, truncation
        self.mesh_weight = mesh_weight
        channels = (1, 1, 3) if color else (1, 1)
        self.grid = o3d.t.geometry.VoxelBlockGrid(
            attr_names=("tsdf", "weight", "color")[: len(channels)],
            attr_dtypes=(o3d.core.float32,) * len(channels),
            attr_channels=channels, voxel_size=voxel_size, block_resolution=8, block_count=40_000,
            device=o3d.core.Device("CPU:0"),
        )  # fmt: skip

    def integrate(self, keyframe: Any) -> None:
        """Fuse a depth keyframe as it is, or a disparity keyframe as metres."""
        image, Tensor = self._o3d.t.geometry.Image, self._o3d.core.Tensor
        raw, scale = keyframe.depth, 1.0
        if raw is None:
            raw = depth_metres(keyframe).astype(np.float32)
        elif raw.dtype == np.uint16:
            scale = 1 / keyframe.depth_scale
        depth = image(Tensor(np.ascontiguousarray(raw)))
        K, extrinsic = Tensor(keyframe.intrinsics.matrix), Tensor(np.linalg.inv(keyframe.T_world_camera))
        reach = (scale, self._range, self._truncation)
        blocks = self.grid.compute_unique_block_coordinates(depth, K, extrinsic, *reach)
        if self._color:
            of_depth = np.float32 if raw.dtype == np.float32 else np.uint8  # it takes no other pairs
            color = image(Tensor(np.ascontiguousarray(keyframe.color[..., ::-1], of_depth)))
            self.grid.integrate(blocks, depth, color, K, K, extrinsic, *reach)
        else:
            self.grid.integrate(blocks, depth, K, extrinsic, *reach)

    def extract_mesh(self) -> Mesh:
        """The surface of voxels seen `mesh_weight` times; its own default is 3."""
        mesh = self.grid.extract_triangle_mesh(weight_threshold=self.mesh_weight)
        return Mesh(
            mesh.vertex.positions.numpy(), mesh.triangle.indices.numpy().astype(np.int32),
            mesh.vertex.normals.numpy(),
        )  # fmt: skip


class VDBFusion:
    """VDBVolume: every voxel a ray crosses. Points have one origin a scan."""

    def __init__(self, voxel_size: float, *, max_range: float, truncation: float) -> None:
        import vdbfusion

        self._range = max_range
        self._volume = vdbfusion.VDBVolume(voxel_size, truncation * voxel_size, False)

    def integrate(self, keyframe: Any) -> None:
        points, origin = points_world(keyframe), keyframe.T_world_camera[:3, 3]
        near = np.linalg.norm(points - origin, axis=1) < self._range
        self._volume.integrate(points[near], origin)

    def extract_mesh(self) -> Mesh:
        import trimesh

        vertices, faces = self._volume.extract_triangle_mesh(fill_holes=False, min_weight=2.0)
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        return Mesh(
            mesh.vertices.astype(np.float32), mesh.faces.astype(np.int32),
            mesh.vertex_normals.astype(np.float32),
        )  # fmt: skip


def timed_keyframes(
    keyframes: list[Any], *steps: Callable[[Any], Any], after_warm_up: Callable[[], None] = lambda: None
) -> NDArray[np.float64]:
    """(steps, 2, n) seconds of CPU and of wall clock: each keyframe goes through every step in turn; the
    first few are not counted."""
    spent = np.zeros((len(steps), 2, len(keyframes)))
    for i, keyframe in enumerate(keyframes):
        if i == WARM_UP:
            after_warm_up()
        for n, step in enumerate(steps):
            cpu, wall = time.process_time(), time.perf_counter()
            step(keyframe)
            spent[n, :, i] = time.process_time() - cpu, time.perf_counter() - wall
    return spent[:, :, WARM_UP:] if len(keyframes) > WARM_UP else spent


def unimportable(module: str) -> str | None:
    """Why a module cannot be imported, if it cannot; tried in another process."""
    done = subprocess.run(
        [sys.executable, "-c", f"import {module}"], capture_output=True, text=True, check=False
    )
    if not done.returncode:
        return None
    hint = "pip install '.[bench]'" if module in ("open3d", "scipy") else f"pip install {module}"
    return f"{module} cannot be imported ({hint}): {done.stderr.strip().splitlines()[-1]}"


def surroundings(threads: int) -> dict[str, Any]:
    """Where and with what a measurement was taken."""
    return {
        "threads": threads, "machine": f"{platform.machine()}, {os.cpu_count()} cores",
        "peak_rss_bytes": peak_rss_bytes(), "commit": commit(), "versions": versions(),
    }  # fmt: skip


def commit() -> str:
    done = subprocess.run(
        ["git", "-C", str(ROOT), "describe", "--always", "--dirty"],
        capture_output=True,
        text=True,
        check=False,
    )
    return done.stdout.strip() or "unknown"


def versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for name in ("tsfusion", "taichi", "numpy", "open3d", "vdbfusion"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
