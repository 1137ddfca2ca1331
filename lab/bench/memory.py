# SPDX-License-Identifier: MIT
"""Fuse a street that does not fit into the memory it may have, and watch what the process takes.

    python lab/bench/memory.py                              400 keyframes: a table, then one JSON line
    python lab/bench/memory.py --keyframes 2000 --plot docs/images/memory.png
    python lab/bench/memory.py --world room --keyframes 120 --voxel-size 0.01

Forty stereo keyframes of the synthetic street are rendered once and repeated, 40 m further along each time.
The room is the worst case: a Kinect goes round it again and again, and every block comes back each time.
They are fused by one process each: without a bound; with `memory_bytes` at --share of what the map took; and
by Open3D's VoxelBlockGrid, where it is installed. One core is enough; each holds one map at a time.

Resident memory (RSS) is what the system counts of the whole process; `beyond` is that without what Python,
the libraries, the compiled kernels and the keyframes took before the first one was fused. The exit status is
1 when the two maps' hashes differ, when the bounded map takes more than its budget and 200 MB beyond that
start, or when it takes keyframes at less than half the rate.
"""

import argparse
import hashlib
import importlib.util
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec

sys.path.append(str(Path(__file__).parents[2]))  # lab is not installed

from tsfusion.core import process
from tsfusion.geometry.keyframe import Keyframe

SENSORS = {"street": "stereo", "room": "kinect"}
LAP = 40  # keyframes that are rendered
STEP = 1.0  # metres from one to the next
SPARE = 200 << 20  # bytes beside the budget
SAMPLES = 250  # of a curve


class Curve(msgspec.Struct):
    """One map's growth."""

    name: str
    start_rss: int  # bytes before the first keyframe
    keyframes: list[int]
    rss: list[int]  # bytes, the most since the sample before
    seconds: float  # fusing alone
    cpu_seconds: float
    map_bytes: int = 0
    map_hash: str = ""
    budget: int = 0
    mesh_rss: int = 0  # bytes, the most while the mesh was written
    mesh_seconds: float = 0.0
    mesh_digest: str = ""

    @property
    def beyond(self) -> int:
        """Most memory since the start, bytes."""
        return max(self.rss) - self.start_rss


def recording(world: str, count: int, width: int) -> Iterator[Keyframe]:
    """Keyframes of a street of any length, or of laps in a room."""
    from tsfusion.datasets.worlds.synthetic import Synthetic

    path = "tour" if world == "room" else None
    rendered = list(Synthetic(world, SENSORS[world], count=LAP, width=width, path=path))
    for index in range(count):
        keyframe = rendered[index % LAP]
        T = keyframe.T_world_camera.copy()
        if world == "street":
            T[0, 3] += STEP * LAP * (index // LAP)
        yield replace(keyframe, T_world_camera=T)


def grow(name: str, options: argparse.Namespace) -> Curve:
    """Fuse the keyframes in this process."""
    keyframes = recording(options.world, options.keyframes, options.width)
    first = next(keyframes)
    fused = _open3d(options) if name == "Open3D" else _volume(options, options.budget)
    fused.integrate(first)
    curve = Curve(name, process.rss_bytes(), [], [], 0.0, 0.0, budget=options.budget)
    most, every = 0, max(options.keyframes // SAMPLES, 1)
    for index, keyframe in enumerate(keyframes, 2):
        began, cpu = time.monotonic(), time.process_time()
        fused.integrate(keyframe)
        curve.seconds += time.monotonic() - began
        curve.cpu_seconds += time.process_time() - cpu
        most = max(most, process.rss_bytes())
        if index % every == 0:
            curve.keyframes.append(index)
            curve.rss.append(most)
            most = 0
    if name != "Open3D":
        curve.map_bytes, curve.map_hash = fused.stats().bytes, fused.map_hash()
        curve.rss[-1] = max(curve.rss[-1], process.rss_bytes())
    if options.mesh and name != "Open3D":
        with tempfile.TemporaryDirectory(dir=options.cache) as folder:
            _mesh(fused, curve, Path(folder) / "mesh.ply")
    return curve


def _mesh(volume: Any, curve: Curve, path: Path) -> None:
    """Write the mesh, tile by tile where the memory is bounded."""
    Path("/proc/self/clear_refs").write_text("5")  # the peak of the resident memory begins anew
    began = time.monotonic()
    if curve.budget:
        volume.mesh_parts(path.parent).save(path)
    else:
        volume.extract_mesh().save(path)
    curve.mesh_seconds, curve.mesh_rss = time.monotonic() - began, process.peak_rss_bytes()
    curve.mesh_digest = hashlib.blake2b(path.read_bytes(), digest_size=16).hexdigest()


def _volume(options: argparse.Namespace, budget: int) -> Any:
    from tsfusion import Volume

    volume = Volume(
        options.voxel_size,
        sensor=SENSORS[options.world],
        memory_bytes=budget or None,
        cache=options.cache if budget else None,
    )
    volume.warm_up()
    return volume


def _open3d(options: argparse.Namespace) -> Any:
    from lab.bench.peers import Open3D

    return Open3D(options.voxel_size, max_range=30.0, truncation=10.0, color=True)


def measured(name: str, options: argparse.Namespace, budget: int = 0) -> Curve:
    """`grow` in a process of its own."""
    command = [sys.executable, __file__, "--only", name, "--budget", str(budget)]
    for flag in ("world", "keyframes", "voxel_size", "width", "cache"):
        command += [f"--{flag.replace('_', '-')}", str(getattr(options, flag))]
    command += ["--mesh"] * options.mesh
    done = subprocess.run(command, stdout=subprocess.PIPE, check=False)
    if done.returncode:
        raise SystemExit(f"{name} failed with status {done.returncode}")
    return msgspec.json.decode(done.stdout, type=Curve)


def plot(curves: list[Curve], path: Path) -> None:
    """Draw resident memory over keyframes."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 4.2), dpi=110, layout="constrained")
    axis = figure.subplots()
    for curve in curves:
        axis.plot(curve.keyframes, [rss / 1e6 for rss in curve.rss], label=curve.name, linewidth=1.4)
    bounded = next(curve for curve in curves if curve.budget)
    for height, label in (
        (bounded.start_rss + bounded.budget, "start + memory_bytes"),
        (bounded.start_rss + bounded.budget + SPARE, "start + memory_bytes + 200 MB"),
    ):
        axis.axhline(height / 1e6, linewidth=0.8, linestyle="--", color="#8c8c8c", label=label)
    axis.set_xlabel("keyframes")
    axis.set_ylabel("resident memory of the process, MB")
    axis.set_ylim(0)
    axis.spines[["top", "right"]].set_visible(False)
    axis.legend(fontsize=8, frameon=False)
    figure.savefig(path)


def table(curves: list[Curve]) -> str:
    """A line a map."""
    lines = [f"{'':32}{'start':>8}{'most':>8}{'beyond':>8}{'map':>8}  MB   {'CPU s':>8}{'s':>8}"]
    for curve in curves:
        sizes = (curve.start_rss, max(curve.rss), curve.beyond, curve.map_bytes)
        numbers = "".join(f"{size / 1e6:8.0f}" for size in sizes)
        lines.append(f"{curve.name:32}{numbers}       {curve.cpu_seconds:8.1f}{curve.seconds:8.1f}")
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--world", choices=SENSORS, default="street")
    parser.add_argument("--keyframes", type=int, default=400)
    parser.add_argument("--voxel-size", type=float, default=0.15, help="metres")
    parser.add_argument("--width", type=int, default=310, help="of the image, pixels")
    parser.add_argument("--share", type=float, default=0.25, help="of the map that may be in memory")
    parser.add_argument("--cache", default=os.environ.get("TMPDIR", "/var/tmp"), help="folder on a disk")
    parser.add_argument("--plot", type=Path, help="draw the memory over the keyframes into this file")
    parser.add_argument("--mesh", action="store_true", help="write the mesh, too, and compare the files")
    parser.add_argument("--only", help=argparse.SUPPRESS)
    parser.add_argument("--budget", type=int, default=0, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.only:
        print(msgspec.json.encode(grow(options.only, options)).decode())
        return 0
    unbounded = measured("tsfusion", options)
    budget = int(options.share * unbounded.map_bytes)
    bounded = measured(f"tsfusion, memory_bytes={budget / 1e6:.0f} MB", options, budget)
    curves = [unbounded, bounded]
    if options.world == "street" and importlib.util.find_spec("open3d"):
        curves.append(measured("Open3D", options))
    print(table(curves), file=sys.stderr)
    if options.plot:
        plot(curves, options.plot)
    rate = unbounded.seconds / bounded.seconds
    problems = [
        problem
        for is_wrong, problem in (
            (bounded.map_hash != unbounded.map_hash, "the maps differ"),
            (bounded.beyond > budget + SPARE, "the bounded map takes more than its budget and 200 MB"),
            (bounded.mesh_digest != unbounded.mesh_digest, "the meshes differ"),
            (rate < 0.5, "the bounded map takes keyframes at less than half the rate"),
        )
        if is_wrong
    ]
    result = {
        "keyframes": options.keyframes, "voxel_size": options.voxel_size, "map_bytes": unbounded.map_bytes,
        "memory_bytes": budget, "rss_beyond_bytes": bounded.beyond, "rate_ratio": round(rate, 3),
        "cpu_ratio": round(unbounded.cpu_seconds / bounded.cpu_seconds, 3),
        "hash": bounded.map_hash, "mesh": bounded.mesh_digest,
        "mesh_rss_bytes": [unbounded.mesh_rss, bounded.mesh_rss],
        "mesh_seconds": [round(unbounded.mesh_seconds, 1), round(bounded.mesh_seconds, 1)],
        "problems": problems,
    }  # fmt: skip
    print(msgspec.json.encode(result).decode())
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
