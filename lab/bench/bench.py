# SPDX-License-Identifier: MIT
"""Measure fusion: CPU milliseconds a keyframe and a stage, with accuracy beside the speed.

    python lab/bench/bench.py                      every case, one JSON line each, a fresh process each
    python lab/bench/bench.py --list               the cases
    python lab/bench/bench.py --only 7scenes       those whose name holds a word
    python lab/bench/bench.py --repeat 5           so often, and a line with least and median ratio at the end
    python lab/bench/bench.py --arch cuda          also fused on a device beside, where there is one

Open3D's VoxelBlockGrid runs beside, where `open3d` is installed (`pip install '.[bench]'`): in the same
process, the same keyframes in turn, with the same range and truncation; its mesh is of voxels of weight 1 and
of weight 2 on. In turn each finds the caches full of the other's map. `stream` are the same keyframes with
nothing between them, first all of ours, then all of Open3D's, as a server fuses. `1thread` is one thread on
one pinned core. Machines differ and are noisy: only `ratio` says who is faster. `field` meshes the default
surface, `off` the raw one; `remesh` is the mesh of what a keyframe changed; `floor` the least time that
memory traffic takes.
With `--arch` the same keyframes go in turn to a map on that device; `ratio` has its wall time against the
CPU's; `device` says whether both maps are the same, and how many keyframes a second each takes by itself.
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
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

sys.path.append(str(Path(__file__).parents[2]))  # lab is not installed

from lab.bench.floor import floor
from lab.bench.peers import DATA, Open3D, surroundings, timed_keyframes, unimportable

MAX_RANGE, TRUNCATION = 4.0, 4.0  # metres, voxels: the same for every system
HOLD_OUT = 5  # every fifth recorded keyframe is not fused but predicted


@dataclass(frozen=True)
class Case:
    """One measurement: a source of keyframes and settings."""

    name: str
    source: str
    voxel_size: float
    settings: dict[str, Any] = field(default_factory=dict)
    threads: int | None = None  # None: as the command says
    copies: int = 0  # of the whole scene, elsewhere, that are fused first


PLAIN = {"color": False, "regularizer": "off", "surface": "raw"}
COLORED = {"color": True}


def cases() -> list[Case]:
    found = []
    for source, size in (
        ("7scenes", 0.02),
        ("7scenes", 0.01),
        ("room", 0.02),
        ("street", 0.1),
        ("kitti00", 0.1),
    ):
        where = f"{source}-{size * 100:g}cm"
        found += [
            Case(f"{where}-off", source, size, PLAIN),
            Case(f"{where}-off-1thread", source, size, PLAIN, threads=1),
            Case(f"{where}-ray", source, size, {**PLAIN, "regularizer": "ray"}),
            Case(f"{where}-exact", source, size, {**PLAIN, "bundle": False}),
            Case(f"{where}-field", source, size, {**PLAIN, "surface": "field"}),
        ]
        if source in ("7scenes", "room"):
            found += [
                Case(f"{where}-color-off", source, size, {**PLAIN, **COLORED}),
                Case(f"{where}-color-default", source, size, COLORED),
                Case(f"{where}-carving", source, size, {**PLAIN, "space_carving": True}),
            ]
        if (source, size) == ("7scenes", 0.02):
            found.append(Case(f"{where}-off-20x", source, size, PLAIN, copies=19))
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
        elif name == "kitti00":
            recorded = open_dataset(
                DATA / "kitti_odometry", sequence="00", modality="lidar", poses="poses_estimated/00_ORB.txt"
            )
            self.fused = [recorded[i] for i in range(len(recorded))] * 4  # six scans, again and again
            self.sensor = recorded.sensor
        else:
            sensor = "lidar" if name == "street" else "kinect"
            world = Synthetic(world=name, sensor=sensor, count=min(keyframes, 40))
            self.fused = [world[i] for i in range(len(world))]
            self.distance, self.sensor = world.distance, sensor

    def error_mm(self, vertices: NDArray[Any], faces: NDArray[Any]) -> dict[str, float]:
        """How far mesh and truth are apart, millimetres; nothing where there is no truth."""
        if self.distance is None and not self.held_out:
            return {}
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
        from tsfusion.kernels.base import block_hash
        from tsfusion.kernels.integration import (
            integrate,
            ray_smoothing,
            rays_from_images,
            rays_from_points,
            space_carving,
        )

        watched: list[tuple[Any, str, str]] = [
            (rays_from_images, "rays_from_image", "rays"), (rays_from_points, "rays_from_points", "rays"),
            (block_hash, "insert_blocks", "allocate"), (integrate, "add_rays", "integrate"),
            (integrate, "add_shared_rays", "integrate"),
            (space_carving, "find_clear_depths", "carve"), (space_carving, "list_free_blocks", "carve"),
            (space_carving, "add_free_blocks", "carve"),
            (integrate, "largest_weights", "check"), (ray_smoothing, "smooth_rays", "regularise"),
            (ray_smoothing, "commit_votes", "regularise"),
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


def run_case(case: Case, threads: int, keyframes: int, arch: str) -> dict[str, Any]:
    """Measure one case in this process, with Open3D in turn where it can do the same."""
    threads = case.threads or threads
    os.environ["OMP_NUM_THREADS"] = str(threads)
    if threads == 1 and arch == "cpu":  # the process that has the device would be on the same core
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    source = Source(case.source, keyframes)
    peer = new_peer(case) if source.sensor == "kinect" and not unimportable("open3d") else None
    ours = run(case, source, threads, peer, arch)
    row = {"case": case.name, "voxel_size": case.voxel_size, "settings": case.settings, "ratio": {}, **ours}
    if device := row.get("device"):
        spent = device["keyframe"]["wall_ms_median"] / row["keyframe"]["wall_ms_median"]
        row["ratio"]["device_wall"] = round(spent, 4)
    if peer is not None:
        beside = row["open3d"]
        spent = row["keyframe"]["cpu_ms_median"] / beside["keyframe"]["cpu_ms_median"]
        row["ratio"]["keyframe"] = round(spent, 3)
        beside["stream"] = stream(new_peer(case), source)
        spent = row["stream"]["cpu_ms_median"] / beside["stream"]["cpu_ms_median"]
        row["ratio"]["stream"] = round(spent, 3)
        for weight in (1, 2):
            peer.mesh_weight = float(weight)
            mesh, cpu_ms = timed_mesh(peer.extract_mesh)
            error = source.error_mm(mesh.vertices, mesh.faces)
            beside[f"mesh_weight_{weight}"] = {
                "cpu_ms": cpu_ms, "triangles": len(mesh.faces), "error_mm": error
            }  # fmt: skip
            row["ratio"][f"mesh_weight_{weight}"] = round(row["mesh_cpu_ms"] / cpu_ms, 3)
    return {**row, **surroundings(threads)}


def new_peer(case: Case) -> Open3D:
    """Open3D's map, empty, for the same keyframes."""
    color = bool(case.settings.get("color"))
    return Open3D(case.voxel_size, max_range=MAX_RANGE, truncation=TRUNCATION, color=color)


def stream(fuses: Any, source: Source) -> dict[str, float]:
    """Figures of the keyframes that an empty map takes one after the other, with nothing between them."""
    return figures(timed_keyframes(source.fused, fuses.integrate)[0])


def run(case: Case, source: Source, threads: int, peer: Open3D | None, arch: str) -> dict[str, Any]:
    started = time.perf_counter()
    from tsfusion import Volume

    settings = {"voxel_size": case.voxel_size, "sensor": source.sensor, "threads": threads, **case.settings}
    if source.sensor == "kinect":
        settings |= {"max_range": MAX_RANGE, "min_support": TRUNCATION, "max_support": TRUNCATION}
    volume = Volume(**settings)
    volume.warm_up()
    start_s = time.perf_counter() - started
    for copy in range(1, case.copies + 1):
        for keyframe in source.fused:
            volume.integrate(elsewhere(keyframe, 20.0 * copy))
    volume.take_dirty()
    stages = Stages()

    def remesh(_: Any) -> None:
        volume.extract_mesh(blocks=volume.cells_to_mesh(volume.take_dirty()))

    steps: list[Callable[[Any], Any]] = [volume.integrate, remesh]
    if peer:
        steps.append(peer.integrate)
    device = Volume(**settings, arch=arch) if arch != "cpu" else None
    if device is not None:
        steps.append(device.integrate)
    with stages.watch():
        spent = timed_keyframes(source.fused, *steps, after_warm_up=stages.times.clear)
        stages.keyframes = spent.shape[2]
    stages_cpu_ms = stages.summary()
    mesh, mesh_cpu_ms = timed_mesh(volume.extract_mesh)
    stats = volume.stats()
    row = {
        "keyframe": figures(spent[0]), "stream": stream(Volume(**settings), source),
        "stages_cpu_ms": stages_cpu_ms, "start_s": round(start_s, 2),
        "remesh": figures(spent[1]), "mesh_cpu_ms": mesh_cpu_ms, "triangles": len(mesh.faces),
        "map_bytes": stats.bytes, "blocks": stats.blocks, "bytes_per_block": stats.bytes_per_block,
        "map_hash": volume.map_hash(), "error_mm": source.error_mm(mesh.vertices, mesh.faces),
        "floor": floor(volume, source.fused[-1], stages_cpu_ms),
    }  # fmt: skip
    if peer:
        row["open3d"] = {"keyframe": figures(spent[2])}
    if device is not None:
        same = device.map_hash() == row["map_hash"]
        rates = {one: keyframes_per_s(Volume(**settings, arch=one), source.fused) for one in ("cpu", arch)}
        row["device"] = {
            "arch": device.arch, "keyframe": figures(spent[-1]), "same_map": same, "keyframes_per_s": rates
        }  # fmt: skip
    return row


def keyframes_per_s(volume: Any, keyframes: list[Any]) -> float:
    """How many keyframes an empty map takes a second, one after the other and nothing else between."""
    began = time.perf_counter()
    for keyframe in keyframes:
        volume.integrate(keyframe)
    return round(len(keyframes) / (time.perf_counter() - began), 1)


def elsewhere(keyframe: Any, metres: float) -> Any:
    """The keyframe, moved along x."""
    T = keyframe.T_world_camera.copy()
    T[0, 3] += metres
    return replace(keyframe, T_world_camera=T)


def timed_mesh(extract: Callable[[], Any]) -> tuple[Any, float]:
    """A mesh, and the least CPU milliseconds of three goes."""
    spent = []
    for _ in range(3):
        begun = time.process_time()
        mesh = extract()
        spent.append(time.process_time() - begun)
    return mesh, round(min(spent) * 1e3, 1)


def figures(seconds: NDArray[np.float64]) -> dict[str, float]:
    """Median and p95 of (2, n) CPU and wall seconds."""
    milliseconds = seconds * 1e3
    median, p95 = np.median(milliseconds, axis=1), np.percentile(milliseconds, 95, axis=1)
    return {
        "n": seconds.shape[1], "cpu_ms_median": round(float(median[0]), 2),
        "cpu_ms_p95": round(float(p95[0]), 2), "wall_ms_median": round(float(median[1]), 2),
        "wall_ms_p95": round(float(p95[1]), 2),
    }  # fmt: skip


def missing(case: Case, arch: str) -> str | None:
    """Why a case cannot run here, if it cannot."""
    if arch != "cpu" and (case.settings.get("regularizer", "off") != "off" or case.copies):
        return "a device fuses without smoothing along rays, and copies of a scene are for the CPU"
    folder = {"7scenes": "7scenes/redkitchen", "kitti00": "kitti_odometry"}.get(case.source)
    if folder and not (DATA / folder).exists():
        return f"no {folder} in {DATA} (set TSFUSION_DATA)"
    if case.source == "7scenes" and importlib.util.find_spec("scipy") is None:
        return "scipy is not installed (pip install '.[bench]')"
    return None


def has_device(arch: str) -> bool:
    """True if a map can be on such a device."""
    from tsfusion import Volume

    return bool(Volume(arch=arch).arch == arch)


def main() -> int:
    assert __doc__ is not None
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--list", action="store_true", help="print the names of the cases")
    parser.add_argument("--only", metavar="WORD", default="", help="cases whose name holds this word")
    parser.add_argument("--threads", type=int, default=os.cpu_count(), help="threads a system may use")
    parser.add_argument("--repeat", type=int, default=1, help="run every case so often")
    parser.add_argument("--keyframes", type=int, default=100, help="at most so many a case")
    parser.add_argument("--arch", default="cpu", help="a device to fuse on beside: cuda, vulkan")
    parser.add_argument("--case", metavar="NAME", help="run this one here, in this process")
    options = parser.parse_args()
    chosen = [c for c in cases() if options.only in c.name and options.case in (None, c.name)]
    if not chosen:
        parser.error(f"no case is named {options.case or options.only!r}; --list shows them")
    if options.list:
        print("\n".join(c.name for c in chosen))
        return 0
    if options.case:
        print(json.dumps(run_case(chosen[0], options.threads, options.keyframes, options.arch)))
        return 0
    if options.arch != "cpu" and not has_device(options.arch):
        print(f"left out, there is no {options.arch} device that fuses as the CPU does", file=sys.stderr)
        return 0
    if reason := unimportable("open3d"):
        print(f"without Open3D beside: {reason}", file=sys.stderr)
    status = 0
    for case in chosen:
        if reason := missing(case, options.arch):
            print(f"{case.name}: left out, {reason}", file=sys.stderr)
            continue
        command = [sys.executable, __file__, "--case", case.name, "--threads", str(options.threads)]
        command += ["--keyframes", str(options.keyframes), "--arch", options.arch]
        rows: list[dict[str, Any]] = []
        for _ in range(options.repeat):
            done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=False)
            print(done.stdout, end="", flush=True)
            status |= done.returncode
            rows += map(json.loads, done.stdout.splitlines())
        if len(rows) > 1:
            print(json.dumps({"case": case.name, **spread(rows)}), flush=True)
    return status


def spread(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Least and median of the ratios and of our own milliseconds over several runs of a case."""
    figures = {f"ratio {name}": [row["ratio"][name] for row in rows] for name in rows[0].get("ratio", {})}
    figures |= {
        "keyframe_cpu_ms": [row["keyframe"]["cpu_ms_median"] for row in rows],
        "mesh_cpu_ms": [row["mesh_cpu_ms"] for row in rows],
    }
    return {
        name: {"least": min(values), "median": round(float(np.median(values)), 3)}
        for name, values in figures.items()
    }


if __name__ == "__main__":
    sys.exit(main())
