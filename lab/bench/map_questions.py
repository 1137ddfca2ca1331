#!/usr/bin/env python3
# SPDX-License-Identifier: MIT
"""How fast and how exactly a map answers in process: one JSON line a question.

    python lab/bench/map_questions.py                          # the synthetic room, whose distances are known
    python lab/bench/map_questions.py --source DATA/7scenes/redkitchen --frames 125

Questions: distances at points near the surface, in random order and block by block; views of 640×480 pixels
from places of the recording. Where Open3D is installed its RaycastingScene (on the same mesh) and
VoxelBlockGrid answer the same. Times are the best of several, CPU and wall clock.
`--threads 1` and `taskset -c 0` give the figures of one core.
"""

import argparse
import json
import os
import time
from collections.abc import Callable, Iterator
from importlib.util import find_spec
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion import Intrinsics, Keyframe, Volume, open_dataset
from tsfusion.datasets.worlds.synthetic import Synthetic

SHAPE = 480, 640
ROOM = "synthetic:room"
REACH = 0.02  # metres: how far from the surface the points are, at most
VIEWS = 4
Row = dict[str, Any]


def best_of(repeats: int, call: Callable[[], Any]) -> tuple[Any, float, float]:
    """The last result of a call, and its least CPU and wall time, milliseconds."""
    cpu, wall, result = np.inf, np.inf, None
    for _ in range(repeats):
        started = time.process_time(), time.perf_counter()
        result = call()
        cpu, wall = min(cpu, time.process_time() - started[0]), min(wall, time.perf_counter() - started[1])
    return result, 1e3 * cpu, 1e3 * wall


def points_near(volume: Volume, count: int) -> NDArray[np.float32]:
    """Points up to `REACH` before and behind the surface."""
    random = np.random.default_rng(0)
    mesh = volume.extract_mesh()
    chosen = random.integers(0, len(mesh.vertices), count)
    off = random.uniform(-REACH, REACH, (count, 1))
    return (mesh.vertices[chosen] + off * mesh.normals[chosen]).astype(np.float32)


def sample_rows(volume: Volume, room: Synthetic | None, options: argparse.Namespace) -> Iterator[Row]:
    """Distances at points: a row a surface and an order."""
    points = points_near(volume, options.points)
    order = np.lexsort(np.floor(points / (8 * volume.config.voxel_size)).T)
    for surface in ("raw", "field"):
        for name, asked in (("random", points), ("coherent", points[order])):
            found, cpu, wall = best_of(options.repeats, lambda: volume.sample(asked, surface=surface))  # noqa: B023
            row: Row = {"question": "sample", "surface": surface, "order": name, "points": len(asked)}
            row |= {"m_points_per_cpu_s": len(asked) / cpu / 1e3, "m_points_per_s": len(asked) / wall / 1e3}
            row["seen"] = np.isfinite(found.distance).mean()
            if room is not None:
                off = np.abs(found.distance - room.distance(asked)) * 1e3
                row |= {"median_mm": np.nanmedian(off), "p90_mm": np.nanpercentile(off, 90)}
            yield row


def view_rows(volume: Volume, keyframes: list[Keyframe], options: argparse.Namespace) -> Iterator[Row]:
    """Views: a row a library and a view."""
    camera = keyframes[0].intrinsics
    assert camera is not None  # of depth images
    camera = camera.scaled(SHAPE[1] / keyframes[0].shape[1])
    for surface in ("raw", "field"):
        for keyframe in keyframes:
            pose = keyframe.T_world_camera
            _, first, _ = best_of(1, lambda: volume.raycast(camera, pose, SHAPE, surface=surface))  # noqa: B023
            view, cpu, wall = best_of(
                options.repeats, lambda: volume.raycast(camera, pose, SHAPE, surface=surface)  # noqa: B023
            )  # fmt: skip
            volume.retract(keyframe)
            volume.integrate(keyframe)
            _, changed, _ = best_of(1, lambda: volume.raycast(camera, pose, SHAPE, surface=surface))  # noqa: B023
            hit = float((view.depth > 0).mean())
            yield {"question": "raycast", "by": "tsfusion", "surface": surface, "first_cpu_ms": first,
                   "cpu_ms": cpu, "wall_ms": wall,
                   "after_keyframe_cpu_ms": changed, "hit": hit}  # fmt: skip
    if find_spec("open3d"):
        for keyframe in keyframes:
            yield from open3d_rows(volume, camera, keyframe.T_world_camera, options.repeats)


def open3d_rows(
    volume: Volume, camera: Intrinsics, T_world_camera: NDArray[np.float64], repeats: int
) -> Iterator[Row]:
    """A view by Open3D: of the same mesh, and of the same raw values."""
    import open3d as o3d

    to_camera = o3d.core.Tensor.from_numpy(np.linalg.inv(T_world_camera))
    ours = volume.raycast(camera, T_world_camera, SHAPE, surface="raw").depth
    mesh = volume.extract_mesh(surface="raw").to_open3d()
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(mesh)
    middle = camera.matrix + np.array([(0, 0, 0.5), (0, 0, 0.5), (0, 0, 0)])  # its pixels' corners
    rays = scene.create_rays_pinhole(o3d.core.Tensor.from_numpy(middle), to_camera, SHAPE[1], SHAPE[0])
    cast, cpu, wall = best_of(repeats, lambda: scene.cast_rays(rays))
    yield _against("Open3D RaycastingScene", cast["t_hit"].numpy(), ours, cpu, wall)
    grid = volume.to_open3d()
    blocks, K = grid.hashmap().key_tensor(), o3d.core.Tensor.from_numpy(camera.matrix)
    least = volume.model.min_weight
    shown = ["depth", "normal", *(["color"] if volume.config.color else [])]
    cast, cpu, wall = best_of(
        repeats,
        lambda: grid.ray_cast(blocks, K, to_camera, SHAPE[1], SHAPE[0], shown, 1.0, 0.05, 20.0, least, 8.0),
    )
    yield _against("Open3D VoxelBlockGrid", cast["depth"].numpy()[..., 0], ours, cpu, wall)


def _against(
    name: str, depth: NDArray[np.float32], ours: NDArray[np.float32], cpu: float, wall: float
) -> Row:
    depth = np.where(np.isfinite(depth), depth, 0)
    both = (depth > 0) & (ours > 0)
    off = 1e3 * float(np.median(np.abs(depth - ours)[both]))
    return {"question": "raycast", "by": name, "surface": "raw", "cpu_ms": cpu, "wall_ms": wall,
            "hit": float((depth > 0).mean()), "from_ours_median_mm": off}  # fmt: skip


def main() -> None:
    """Fuse, ask and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--source", default=ROOM, help="a recording of depth images; the room without noise")
    parser.add_argument("--noise", action="store_true", help="the room as a Kinect would see it")
    parser.add_argument("--frames", type=int, default=40, help="keyframes of it, evenly")
    parser.add_argument("--voxel-size", type=float, default=0.02, help="metres")
    parser.add_argument("--points", type=int, default=1_000_000)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--threads", type=int, default=len(os.sched_getaffinity(0)))
    options = parser.parse_args()
    is_room = options.source == ROOM
    room = Synthetic("room", count=options.frames, noise=options.noise) if is_room else None
    dataset = room or open_dataset(options.source)
    volume = Volume(options.voxel_size, threads=options.threads)
    indices = np.linspace(0, len(dataset) - 1, min(options.frames, len(dataset)), dtype=int).tolist()
    for index in indices:
        volume.integrate(dataset[index])
    keyframes = [dataset[index] for index in indices[:: -(-len(indices) // VIEWS)]]
    for rows in (sample_rows(volume, room, options), view_rows(volume, keyframes, options)):
        for row in rows:
            rounded = {key: v if isinstance(v, (int, str)) else round(float(v), 3) for key, v in row.items()}
            print(json.dumps({**rounded, "blocks": volume.stats().blocks, "threads": options.threads}))


if __name__ == "__main__":
    main()
