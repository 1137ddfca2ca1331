# SPDX-License-Identifier: MIT
"""Measure what is done to a mesh before it is shared: how right a closed hole is, what thinning costs.

    python lab/bench/mesh_sharing.py                    the synthetic room: a table, then one JSON line
    python lab/bench/mesh_sharing.py --map my-map.tsf   thin the mesh of a map, too
    python lab/bench/mesh_sharing.py --memory DATASET   instead of all that, what each step takes of memory

Holes: discs are cut out of every depth image of the synthetic room, in the wall, in the sphere and across an
edge of the box, and closed with `fill_holes`. The distance of the guessed vertices from the true surface
stands beside that of the seen ones within 20 cm of the hole.

Thinning: distances of points on the thinned mesh from the full one and the other way round (from the plane of
the nearest of points 5 mm apart, scipy), the border's edges that are kept, the mean difference of colour
from the nearest vertex of the full mesh, the size of the GLB file, and CPU seconds.

Memory: the dataset is fused with ever smaller voxels. Each step runs in a process of its own, with the map
open; `bytes` is what its peak is above that of a process that opened the map and did nothing.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tsfusion import Mesh, Volume, open_dataset
from tsfusion.core.process import peak_rss_bytes
from tsfusion.datasets import Synthetic
from tsfusion.geometry.keyframe import Keyframe
from tsfusion.geometry.mesh_simplification import border_edges

VOXEL = 0.02
PLACES = {
    "wall": (2.0, 0.3, 1.2),
    "sphere": (0.6, 0.3, 1.0),
    "box edge": (-0.3, 0.6, 0.8),
}
NEAR = 0.2  # metres
SPACING = 0.005  # metres between points on a mesh


def holed(keyframe: Keyframe, place: NDArray[np.float64], width: float) -> Keyframe:
    """The keyframe without what lies within half a width of a place."""
    assert keyframe.depth is not None
    assert keyframe.intrinsics is not None
    K, T = keyframe.intrinsics, keyframe.T_world_camera
    v, u = np.mgrid[: keyframe.depth.shape[0], : keyframe.depth.shape[1]]
    z = keyframe.depth * float(keyframe.depth_scale or 1.0)
    rays = np.dstack([(u - K.cx) / K.fx, (v - K.cy) / K.fy, np.ones(z.shape)])
    world = (rays * z[..., None]) @ T[:3, :3].T + T[:3, 3]
    depth = keyframe.depth.copy()
    depth[np.linalg.norm(world - place, axis=-1) < width / 2] = 0
    return replace(keyframe, depth=depth)


def holes(dataset: Synthetic, widths: list[int]) -> Iterator[dict[str, Any]]:
    """Errors of guessed and seen vertices for each place and width."""
    frames = [dataset[k] for k in range(len(dataset))]
    for name, place in PLACES.items():
        for width in widths:
            volume = Volume(VOXEL)
            for frame in frames:
                volume.integrate(holed(frame, np.array(place), width * VOXEL))
            start = time.process_time()
            mesh = volume.extract_mesh(fill_holes=width + 2)
            seconds = time.process_time() - start
            error = 1e3 * np.abs(dataset.distance(mesh.vertices))
            near = np.linalg.norm(mesh.vertices - np.array(place), axis=1) < NEAR + width * VOXEL / 2
            is_guess = np.zeros(len(mesh.vertices), bool)
            if mesh.guessed is not None:
                is_guess[mesh.faces[mesh.guessed]] = True
                is_guess[mesh.faces[~mesh.guessed]] = False
            guess, seen = error[near & is_guess], error[near & ~is_guess]
            yield {
                "hole": name, "width_voxels": width, "guessed_vertices": len(guess),
                "guessed_mean_mm": mean(guess), "guessed_max_mm": float(guess.max()) if len(guess) else None,
                "seen_mean_mm": mean(seen), "cpu_s": seconds,
            }  # fmt: skip


def mean(values: NDArray[np.float64]) -> float | None:
    return float(values.mean()) if len(values) else None


def on_surface(mesh: Mesh) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points spread evenly over a mesh, and the normals of their triangles."""
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(across, axis=1) / 2
    random = np.random.default_rng(0)
    chosen = random.choice(len(area), int(area.sum() / SPACING**2), p=area / area.sum())
    share = random.random((len(chosen), 2))
    share[share.sum(axis=1) > 1] = 1 - share[share.sum(axis=1) > 1]
    a, b, c = corners[chosen].transpose(1, 0, 2)
    found: NDArray[np.float64] = a + share[:, :1] * (b - a) + share[:, 1:] * (c - a)
    return found, across[chosen] / (2 * area[chosen, None])


def off(
    points: NDArray[np.float64], of: tuple[NDArray[np.float64], NDArray[np.float64]]
) -> NDArray[np.float64]:
    """Distance of points from a surface: from the plane of the nearest of its points, if that is near."""
    distance, nearest = cKDTree(of[0]).query(points)
    plane = np.abs(((points - of[0][nearest]) * of[1][nearest]).sum(axis=1))
    found: NDArray[np.float64] = np.where(distance < 3 * SPACING, plane, distance)
    return found


def thinned(mesh: Mesh, targets: list[dict[str, float]]) -> Iterator[dict[str, Any]]:
    """The mesh against simpler ones."""
    full = on_surface(mesh)
    edges = len(border_edges(mesh.faces))
    for target in [{"ratio": 1.0}, *targets]:
        start = time.process_time()
        less = mesh.simplified(**target)  # type: ignore[arg-type]
        seconds = time.process_time() - start
        points = on_surface(less)
        there, back = off(points[0], full), off(full[0], points)
        tint = None
        if mesh.colors is not None and less.colors is not None:
            nearest = cKDTree(mesh.vertices).query(less.vertices)[1]
            tint = float(np.abs(mesh.colors[nearest].astype(float) - less.colors).mean())
        yield {
            "target": " ".join(f"{name} {value:g}" for name, value in target.items()),
            "triangles": len(less.faces), "to_full_mean_mm": 1e3 * float(there.mean()),
            "to_full_max_mm": 1e3 * float(there.max()), "from_full_mean_mm": 1e3 * float(back.mean()),
            "from_full_max_mm": 1e3 * float(back.max()),
            "border_edges": f"{len(border_edges(less.faces))} of {edges}",
            "color_difference": tint, "bytes_glb": len(less.encode(".glb")), "cpu_s": seconds,
        }  # fmt: skip


STEPS = ("nothing", "mesh", "fill_holes", "simplify", "texture")


def step_on(map_file: Path, source: str, step: str) -> dict[str, Any]:
    """One step on a saved map, in this process: its peak, triangles and time."""
    volume = Volume.load(map_file)
    start, mesh = time.process_time(), None
    if step != "nothing":
        given: dict[str, dict[str, Any]] = {"fill_holes": {"fill_holes": 10}}
        given["texture"] = {"texture": open_dataset(source)}
        mesh = volume.extract_mesh(**given.get(step, {}))
    if step == "simplify" and mesh is not None:
        mesh.simplified(ratio=0.25)
    return {
        "step": step,
        "blocks": volume.stats().blocks,
        "map_bytes": volume.stats().bytes,
        "triangles": 0 if mesh is None else len(mesh.faces),
        "cpu_s": time.process_time() - start,
        "peak_bytes": peak_rss_bytes(),
    }


def memory(source: str, sizes: list[float]) -> Iterator[dict[str, Any]]:
    """Memory of each step above that of the open map, with voxels of several sizes."""
    with tempfile.TemporaryDirectory(prefix="tsfusion-memory-") as folder:
        map_file = Path(folder) / "map.tsf"
        for size in sizes:
            dataset = open_dataset(source)
            volume = Volume(size, sensor=dataset.sensor)
            for index in range(len(dataset)):
                volume.integrate(dataset[index])
            volume.save(map_file)
            empty = 0
            for step in STEPS:
                asked = ["--memory", source, "--map", str(map_file), "--step", step]
                command = [sys.executable, __file__, *asked]
                found = json.loads(subprocess.run(command, capture_output=True, check=True).stdout)
                empty = empty or found["peak_bytes"]
                above = found.pop("peak_bytes") - empty
                per_triangle = above / found["triangles"] if found["triangles"] else 0.0
                yield {"voxel_m": size, **found, "bytes": above, "bytes_a_triangle": per_triangle}


def table(rows: list[dict[str, Any]]) -> None:
    print("| " + " | ".join(rows[0]) + " |\n|" + "---|" * len(rows[0]))
    for row in rows:
        cells = [f"{cell:.2f}" if isinstance(cell, float) else str(cell) for cell in row.values()]
        print("| " + " | ".join(cells) + " |")
    print(flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--map", type=Path, help="a saved map whose mesh is thinned, too")
    parser.add_argument("--widths", type=int, nargs="+", default=[5, 10, 20])
    parser.add_argument("--memory", metavar="DATASET", help="measure the memory that each step takes")
    parser.add_argument("--voxel-sizes", type=float, nargs="+", default=[0.04, 0.02, 0.01], help="metres")
    parser.add_argument("--step", choices=STEPS, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.step is not None:
        print(json.dumps(step_on(given.map, given.memory, given.step)))
        return
    if given.memory is not None:
        table(list(memory(given.memory, given.voxel_sizes)))
        return
    dataset = Synthetic("room", "kinect", color=False)
    results: dict[str, list[dict[str, Any]]] = {"holes": list(holes(dataset, given.widths))}
    table(results["holes"])
    if given.map is not None:
        mesh = Volume.load(given.map).extract_mesh().without_islands()
        targets = [{"ratio": 0.5}, {"ratio": 0.25}, {"ratio": 0.2}, {"max_error": 0.002}, {"max_error": 0.01}]
        results["thinned"] = list(thinned(mesh, targets))
        table(results["thinned"])
    print(msgspec.json.encode(results).decode())


if __name__ == "__main__":
    main()
