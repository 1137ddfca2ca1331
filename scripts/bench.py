# SPDX-License-Identifier: MIT
"""Measure fusion: CPU milliseconds a keyframe and a stage, with accuracy beside the speed.

    python scripts/bench.py                      every case, one JSON line each, a fresh process each
    python scripts/bench.py --list               the cases
    python scripts/bench.py --only 7scenes       those whose name holds a word

Open3D's VoxelBlockGrid runs beside, on the same keyframes with the same range and truncation, where `open3d`
is installed (`pip install '.[bench]'`). Machines differ and are noisy: compare ratios within one run.
Recorded cases need TSFUSION_DATA (default ../shared/data) and are left out, with a word, where it is missing.
"""

import argparse
import importlib.util
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from _peers import DATA, Open3D, surroundings, timed_keyframes, unimportable
from numpy.typing import NDArray

MAX_RANGE, TRUNCATION = 4.0, 4.0  # metres, voxels: the same for every system
HOLD_OUT = 5  # every fifth recorded keyframe is not fused but predicted


@dataclass(frozen=True)
class Case:
    """One measurement: a system, a source of keyframes and settings."""

    name: str
    system: str
    source: str
    voxel_size: float
    settings: dict[str, Any] = field(default_factory=dict)


def cases() -> list[Case]:
    found = []
    for source, sizes in (("7scenes", (0.02, 0.01)), ("room", (0.02,)), ("street", (0.1,))):
        for size in sizes:
            where = f"{source}-{size * 100:g}cm"
            plain = {"color": False, "regularizer": "off"}
            found.append(Case(f"{where}-off", "tsfusion", source, size, plain))
            if source != "street":
                found.append(Case(f"{where}-open3d", "open3d", source, size))
                found.append(Case(f"{where}-color-off", "tsfusion", source, size, {**plain, "color": True}))
                found.append(Case(f"{where}-color-open3d", "open3d", source, size, {"color": True}))
            found.append(Case(f"{where}-ray", "tsfusion", source, size, {**plain, "regularizer": "ray"}))
            found.append(Case(f"{where}-exact", "tsfusion", source, size, {**plain, "bundle": False}))
    return found


class Source:
    """Keyframes to fuse, keyframes to predict, and the surface's distance where it is known."""

    def __init__(self, name: str, keyframes: int) -> None:
        from tsfusion.datasets import Synthetic, open_dataset

        self.distance: Callable[[NDArray[Any]], NDArray[np.float64]] | None = None
        self.held_out: list[Any] = []
        if name == "7scenes":
            recorded = open_dataset(DATA / "7scenes" / "redkitchen")
            everything = [
                recorded[i] for i in range(min(len(recorded), keyframes * HOLD_OUT // (HOLD_OUT - 1)))
            ]
            self.fused = [k for i, k in enumerate(everything) if i % HOLD_OUT]
            self.held_out = everything[::HOLD_OUT]
            self.sensor = recorded.sensor
        else:
            sensor = "lidar" if name == "street" else "kinect"
            world = Synthetic(world=name, sensor=sensor, count=min(keyframes, 40))
            self.fused = [world[i] for i in range(len(world))]
            self.distance, self.sensor = world.distance, sensor

    def error_mm(self, vertices: NDArray[Any], faces: NDArray[Any]) -> dict[str, float]:
        """How far mesh and truth are apart, millimetres."""
        if self.distance is not None:
            error = np.abs(self.distance(vertices.astype(np.float64))) * 1e3
            return {"mean": round(float(error.mean()), 3), "p95": round(float(np.percentile(error, 95)), 3)}
        import trimesh
        from scipy.spatial import cKDTree

        samples, _ = trimesh.sample.sample_surface(
            trimesh.Trimesh(vertices, faces, process=False), 500_000, seed=0
        )
        distance, _ = cKDTree(samples).query(np.vstack([unseen_points(k) for k in self.held_out]))
        distance *= 1e3
        return {
            "median": round(float(np.median(distance)), 3),
            "p90": round(float(np.percentile(distance, 90)), 3),
        }


def unseen_points(keyframe: Any) -> NDArray[np.float64]:
    """Every 97th valid pixel of a depth keyframe, in the world."""
    z = keyframe.depth.ravel() * keyframe.depth_scale
    index = np.flatnonzero((z > 0) & (z < MAX_RANGE))[::97]
    v, u = np.divmod(index, keyframe.shape[1])
    K, z = keyframe.intrinsics, z[index]
    points = np.stack([(u - K.cx) / K.fx * z, (v - K.cy) / K.fy * z, z], axis=1)
    T = keyframe.T_world_camera
    result: NDArray[np.float64] = points @ T[:3, :3].T + T[:3, 3]
    return result


class Stages:
    """CPU and wall time of each kernel, by wrapping the functions the volume calls."""

    def __init__(self) -> None:
        self.times: dict[str, list[tuple[float, float]]] = {}
        self.keyframes = 0

    @contextmanager
    def watch(self) -> Iterator[None]:
        from tsfusion.kernels import blocks, integrate, points, rays, smooth

        watched: list[tuple[Any, str, str]] = [
            (rays, "rays_from_image", "rays"), (points, "rays_from_points", "rays"),
            (blocks, "insert_blocks", "allocate"), (integrate, "add_rays", "integrate"),
            (integrate, "largest_weights", "check"), (smooth, "smooth_rays", "regularise"),
            (smooth, "commit_votes", "regularise"),
        ]  # fmt: skip
        originals = [(owner, name, getattr(owner, name)) for owner, name, _ in watched]
        for owner, name, stage in watched:
            setattr(owner, name, self._timed(getattr(owner, name), stage))
        try:
            yield
        finally:
            for owner, name, function in originals:
                setattr(owner, name, function)

    def summary(self) -> dict[str, float]:
        """Mean CPU milliseconds a keyframe, by stage."""
        return {
            stage: round(sum(cpu for cpu, _ in times) / self.keyframes * 1e3, 3)
            for stage, times in self.times.items()
        }

    def _timed(self, function: Any, stage: str) -> Any:
        def timed(*arguments: Any) -> Any:
            cpu, wall = time.process_time(), time.perf_counter()
            result = function(*arguments)
            spent = (time.process_time() - cpu, time.perf_counter() - wall)
            self.times.setdefault(stage, []).append(spent)
            return result

        return timed


def run_tsfusion(case: Case, source: Source, threads: int) -> dict[str, Any]:
    started = time.perf_counter()
    from tsfusion import Volume

    settings = {"voxel_size": case.voxel_size, "sensor": source.sensor, "threads": threads, **case.settings}
    if source.sensor == "kinect":
        settings |= {"max_range": MAX_RANGE, "min_support": TRUNCATION, "max_support": TRUNCATION}
    volume = Volume(**settings)
    volume.warm_up()
    start_s = time.perf_counter() - started
    stages = Stages()
    with stages.watch():
        cpu, wall = timed_keyframes(source.fused, volume.integrate, stages.times.clear)
        stages.keyframes = len(cpu)
    mesh_cpu = time.process_time()
    mesh = volume.extract_mesh()
    mesh_cpu = time.process_time() - mesh_cpu
    stats = volume.stats()
    return {
        "keyframe": figures(cpu, wall), "stages_cpu_ms": stages.summary(), "start_s": round(start_s, 2),
        "mesh_cpu_ms": round(mesh_cpu * 1e3, 1), "triangles": len(mesh.faces), "map_bytes": stats.bytes,
        "blocks": stats.blocks, "map_hash": volume.map_hash(),
        "error_mm": source.error_mm(mesh.vertices, mesh.faces),
    }  # fmt: skip


def run_open3d(case: Case, source: Source, threads: int) -> dict[str, Any]:
    os.environ["OMP_NUM_THREADS"] = str(threads)
    system = Open3D(
        case.voxel_size, max_range=MAX_RANGE, truncation=TRUNCATION, color=bool(case.settings.get("color"))
    )
    cpu, wall = timed_keyframes(source.fused, system.integrate)
    mesh_cpu = time.process_time()
    mesh = system.extract_mesh()
    mesh_cpu = time.process_time() - mesh_cpu
    return {
        "keyframe": figures(cpu, wall), "mesh_cpu_ms": round(mesh_cpu * 1e3, 1), "triangles": len(mesh.faces),
        "blocks": system.grid.hashmap().size(), "error_mm": source.error_mm(mesh.vertices, mesh.faces),
    }  # fmt: skip


def figures(cpu: list[float], wall: list[float]) -> dict[str, float]:
    milliseconds = np.array([cpu, wall]) * 1e3
    median, p95 = np.median(milliseconds, axis=1), np.percentile(milliseconds, 95, axis=1)
    return {
        "n": len(cpu), "cpu_ms_median": round(float(median[0]), 2), "cpu_ms_p95": round(float(p95[0]), 2),
        "wall_ms_median": round(float(median[1]), 2), "wall_ms_p95": round(float(p95[1]), 2),
    }  # fmt: skip


def run_case(case: Case, threads: int, keyframes: int) -> dict[str, Any]:
    """Measure one case in this process."""
    source = Source(case.source, keyframes)
    run = run_open3d if case.system == "open3d" else run_tsfusion
    measured = run(case, source, threads)
    return {
        "case": case.name, "system": case.system, "voxel_size": case.voxel_size, "settings": case.settings,
        **measured, **surroundings(threads),
    }  # fmt: skip


def missing(case: Case) -> str | None:
    """Why a case cannot run here, if it cannot."""
    if case.system == "open3d" and (reason := unimportable("open3d")):
        return reason
    if case.source == "7scenes":
        if not (DATA / "7scenes" / "redkitchen").exists():
            return f"no 7scenes/redkitchen in {DATA} (set TSFUSION_DATA)"
        if importlib.util.find_spec("scipy") is None:
            return "scipy is not installed (pip install '.[bench]')"
    return None


def main() -> int:
    assert __doc__ is not None
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--list", action="store_true", help="print the names of the cases")
    parser.add_argument("--only", metavar="WORD", default="", help="cases whose name holds this word")
    parser.add_argument("--threads", type=int, default=os.cpu_count(), help="threads a system may use")
    parser.add_argument("--keyframes", type=int, default=100, help="at most so many a case")
    parser.add_argument("--case", metavar="NAME", help="run this one here, in this process")
    options = parser.parse_args()
    chosen = [c for c in cases() if options.only in c.name and options.case in (None, c.name)]
    if not chosen:
        parser.error(f"no case is named {options.case or options.only!r}; --list shows them")
    if options.list:
        print("\n".join(c.name for c in chosen))
        return 0
    if options.case:
        print(json.dumps(run_case(chosen[0], options.threads, options.keyframes)))
        return 0
    status = 0
    for case in chosen:
        if reason := missing(case):
            print(f"{case.name}: left out, {reason}", file=sys.stderr)
            continue
        command = [sys.executable, __file__, "--case", case.name, "--threads", str(options.threads)]
        status |= subprocess.run([*command, "--keyframes", str(options.keyframes)], check=False).returncode
    return status


if __name__ == "__main__":
    sys.exit(main())
