# SPDX-License-Identifier: MIT
"""Trajectory error of every localizer on every scene, in one table.

    python lab/evaluation/localization.py                  all scenes
    python lab/evaluation/localization.py --only kitchen   those whose name holds it
    python lab/evaluation/localization.py --json           a JSON line a scene instead
    python lab/evaluation/localization.py --write-docs     the tables of docs/localization.md

Recorded scenes are found under TSFUSION_DATA (default ../shared/data); missing ones are reported.
Every scene runs in a fresh process, with one thread: `cpu_ms` is processor time of the localizer a frame,
`peak_rss_mb` the process's peak while it tracks (where no synthetic world is rendered in it).

Peers are followed frame to frame, with their defaults: Open3D's hybrid odometry (`bench` extra) and OpenCV's.

`mesh`: the kitchen scanned by `tsfusion scan` with its own poses and with the true ones; error of the depth
that either mesh predicts for frames that were not fused.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"))

import msgspec

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "support"))
sys.path.append(str(Path(__file__).parents[2]))  # lab is not installed
from drifting_localizer import Drifting

from lab.bench.peers import DATA, surroundings
from lab.evaluation import odometry_peers
from tsfusion import open_dataset
from tsfusion.cli.check import table
from tsfusion.core import process
from tsfusion.core.config import LocalizerName, ScanConfig
from tsfusion.datasets import Dataset, select
from tsfusion.evaluation.trajectory_error import TrajectoryError, absolute_error
from tsfusion.geometry.frame import Frame
from tsfusion.scanner.localization import localizers
from tsfusion.scanner.localization.localizer import Localizer, Lost
from tsfusion.scanner.localization.loop_closure.loop_closing import LoopClosing
from tsfusion.scanner.sources.source import RecordedSource
from tsfusion.scanner.tracked_trajectory import TrackedTrajectory

DOCS = Path(__file__).parents[2] / "docs" / "localization.md"
BEGIN, END = "<!-- table: python lab/evaluation/localization.py --write-docs -->", "<!-- end of table -->"


class Scene(NamedTuple):
    """One row of the table.

    Attributes:
        loops: whether loops are closed.
        drifting: the true poses with drift added, as the tests of loop closure add it, instead of a
            tracker's.
        peer: another library's odometry instead, by its class in odometry_peers.py.
        bar: metres of RMSE, or percent of drift for `stereo`, that it must stay under; None = none is set.
    """

    name: str
    path: str  # under DATA, or synthetic:…
    localizer: LocalizerName
    options: dict[str, Any] = {}
    part: dict[str, Any] = {}
    loops: bool = False
    drifting: bool = False
    peer: str = ""
    bar: float | None = None

    def open(self) -> Dataset | None:
        synthetic = self.path.startswith("synthetic:")
        if not synthetic and not (DATA / self.path).exists():
            return None
        options = dict(self.options)
        if isinstance(options.get("poses"), str):
            options["poses"] = DATA / options["poses"]
        dataset = open_dataset(self.path if synthetic else DATA / self.path, **options)
        return select(dataset, **self.part)


HANDHELD = {"count": 150, "path": "handheld"}
KITCHEN, ORB = "7scenes/redkitchen", "kitti_odometry/poses_estimated/00_ORB.txt"
SCENES = (
    Scene("kitchen, first 75", KITCHEN, "rgbd", part={"limit": 75}, bar=0.030),
    Scene("kitchen, 125", KITCHEN, "rgbd", bar=0.040),
    Scene("kitchen, every 2nd", KITCHEN, "rgbd", part={"stride": 2}),
    Scene("kitchen, every 3rd", KITCHEN, "rgbd", part={"stride": 3}),
    *(Scene(f"{name}: {peer}", path, "rgbd", options, part, peer=peer)
      for name, path, options, part in (
          ("kitchen, 125", KITCHEN, {}, {}), ("kitchen, every 3rd", KITCHEN, {}, {"stride": 3}),
          ("room", "synthetic:room", HANDHELD, {}), ("room-bare", "synthetic:room-bare", HANDHELD, {}),
          ("room-untextured", "synthetic:room-untextured", HANDHELD, {}),
      ) for peer in ("Open3D", "Open3DIntensity", "Open3DKeyframes", "Open3DModel", "OpenCV")),
    Scene("HoloLens", "hololens", "rgbd"),
    Scene("Redwood living room", "redwood_livingroom1", "rgbd"),
    *(Scene(f"room{name}", f"synthetic:room{name}", "rgbd", HANDHELD, bar=bar)
      for name, bar in (("", 0.003), ("-untextured", 0.005), ("-plain", 0.005), ("-bare", 0.005))),
    Scene("corridor, two laps", "synthetic:corridor", "rgbd", {"count": 520}, loops=True),
    Scene("corridor, drift added", "synthetic:corridor", "given", {"count": 340}, loops=True, drifting=True),
    Scene("identical rooms, drift", "synthetic:rooms", "given", {"count": 160}, loops=True, drifting=True),
    Scene("KITTI 06", "kitti_odometry", "stereo", {"sequence": "06"}, bar=1.0),
    Scene("KITTI 00, LiDAR", "kitti_odometry", "lidar",
          {"sequence": "00", "modality": "lidar", "poses": ORB}, bar=0.15),
    Scene("street, LiDAR", "synthetic:street:lidar", "lidar", {"count": 40, "color": False}),
)  # fmt: skip


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", default="", metavar="WORD", help="scenes whose name holds it")
    parser.add_argument("--json", action="store_true", help="a JSON line a scene")
    parser.add_argument("--write-docs", action="store_true", help=f"put the table into {DOCS.name}")
    parser.add_argument("--scene", type=int, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.scene is not None:
        print(json.dumps(_track(SCENES[options.scene])))
        return 0
    rows = []
    for name, measure in _cases():
        if options.only.lower() not in name.lower():
            continue
        row = measure()
        rows.append(row)
        if options.json:
            print(json.dumps({**row, **surroundings(1)}), flush=True)
        else:
            print(f"{name} …", file=sys.stderr)
    if not options.json:
        print(_report(rows))
    if options.write_docs:
        _write_docs(rows)
    return int(any(row.get("reached") is False for row in rows))


def _cases() -> list[tuple[str, Callable[[], dict[str, Any]]]]:
    scenes = [(scene.name, lambda index=index: _fresh(index)) for index, scene in enumerate(SCENES)]
    return [*scenes, ("mesh", _meshes)]


def _fresh(index: int) -> dict[str, Any]:
    """Run a scene in a process of its own."""
    command = [sys.executable, __file__, "--scene", str(index)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=900, check=False)
    if done.returncode:
        return {"name": SCENES[index].name, "error": done.stderr.strip().splitlines()[-1]}
    row: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return row


def _track(scene: Scene) -> dict[str, Any]:
    """Track one scene from its beginning to its end."""
    import cv2

    cv2.setNumThreads(1)
    dataset = scene.open()
    if dataset is None:
        return {"name": scene.name, "error": f"no {scene.path} in {DATA}"}
    localizer, track, spent, lost = None, TrackedTrajectory(), 0.0, 0
    corrections = None
    for frame in RecordedSource(dataset):
        if localizer is None:
            localizer = _localizer(scene, frame)
        before = time.process_time()
        found = localizer.track(frame)
        corrections = localizer.corrections() or corrections
        spent += time.process_time() - before
        if isinstance(found, Lost):
            lost += 1
            continue
        track.add(found, frame.T_world_camera, None)
    _, truth = track.with_reference()
    error = absolute_error(track.poses(), truth)
    row: dict[str, Any] = {
        "name": scene.name, "localizer": scene.localizer, "frames": len(dataset), "lost": lost,
        "error": None, "ate": msgspec.to_builtins(error), "cpu_ms": 1e3 * spent / len(dataset),
        "peak_rss_mb": process.peak_rss_bytes() / 1e6,
    }  # fmt: skip
    reached = error.rmse
    if scene.loops:
        after = absolute_error(track.poses(corrections), truth)
        row |= {"loops": corrections.loops if corrections else 0, "corrected": msgspec.to_builtins(after)}
        if scene.drifting:
            row |= _verdict(scene, row, error, after)
    elif scene.localizer == "stereo":
        reached = error.drift_percent
    if scene.bar is not None:
        row |= {"bar": scene.bar, "reached": lost == 0 and reached <= scene.bar}
    return row


def _localizer(scene: Scene, first: Frame) -> Localizer:
    if scene.drifting:
        return LoopClosing(Drifting())
    if scene.peer:
        made: Localizer = getattr(odometry_peers, scene.peer)()
        return made
    return localizers.create_localizer(ScanConfig(localizer=scene.localizer, loop_closure=scene.loops), first)


def _verdict(
    scene: Scene, row: dict[str, Any], before: TrajectoryError, after: TrajectoryError
) -> dict[str, Any]:
    """Verdict on loops: they reduce the error, or none was found where all rooms are alike."""
    if "identical" in scene.name:
        return {"bar": "no loop", "reached": row["loops"] == 0}
    return {"bar": "0.3 times", "reached": row["loops"] > 0 and after.rmse <= 0.3 * before.rmse}


def _meshes() -> dict[str, Any]:
    """Scan the kitchen with its own poses and with the true ones; compare the meshes."""
    if not (DATA / KITCHEN).exists():
        return {"name": "mesh", "error": f"no {KITCHEN} in {DATA}"}
    from lab.evaluation.held_out_views import compare_scans

    with tempfile.TemporaryDirectory(prefix="tsfusion-localization-") as folder:
        for name in ("rgbd", "given"):
            command = [
                sys.executable, "-m", "tsfusion", "scan", str(DATA / KITCHEN),
                "--localizer", name, "--voxel-size", "0.02", "--out", str(Path(folder) / name), "--json",
            ]  # fmt: skip
            subprocess.run(command, check=True, capture_output=True, timeout=600)
        folders = [Path(folder) / name for name in ("rgbd", "given")]
        own, given = compare_scans(open_dataset(DATA / KITCHEN), folders, voxel_size=0.02)
    ratio = own["median_mm"] / given["median_mm"]
    return {
        "name": "mesh", "error": None, "own": own, "given": given, "ratio": ratio, "bar": 1.3,
        "reached": ratio <= 1.3,
    }  # fmt: skip


def _report(rows: list[dict[str, Any]]) -> str:
    """Tables of errors and costs, and the scenes that are missing."""
    tracked = [row for row in rows if not row["error"] and "ate" in row]
    lines = []
    if tracked:
        named = []
        for row in tracked:
            named.append((row["name"], _struct(row["ate"])))
            if "corrected" in row:
                named.append((f"  after {row['loops']} loops", _struct(row["corrected"])))
        lines.append(table(named))
        width = max(len(row["name"]) for row in tracked)
        lines += ["", f"{'':<{width}}{'frames':>8}{'lost':>6}{'CPU ms':>8}{'RSS MB':>8}  bar"]
        lines += [
            f"{row['name']:<{width}}{row['frames']:>8}{row['lost']:>6}{row['cpu_ms']:>8.1f}"
            f"{row['peak_rss_mb']:>8.0f}  {_bar(row)}".rstrip()
            for row in tracked
        ]
    for row in rows:
        if row["error"]:
            lines.append(f"{row['name']}: {row['error']}")
        elif "ratio" in row:
            own, given = row["own"], row["given"]
            lines.append(
                f"mesh of the kitchen, depth of frames not fused, median / p90: own poses "
                f"{own['median_mm']:.1f} / {own['p90_mm']:.1f} mm, true ones {given['median_mm']:.1f} / "
                f"{given['p90_mm']:.1f} mm: {row['ratio']:.2f} times"
            )
    return "\n".join(lines)


def _struct(values: dict[str, Any]) -> TrajectoryError:
    return msgspec.convert(values, TrajectoryError)


def _bar(row: dict[str, Any]) -> str:
    if "bar" not in row:
        return ""
    if isinstance(row["bar"], str):
        return f"{row['bar']}: {'reached' if row['reached'] else 'MISSED'}"
    unit = f"{row['bar']:g} %" if row["localizer"] == "stereo" else f"{1000 * row['bar']:g} mm"
    return f"{unit}: {'reached' if row['reached'] else 'MISSED'}"


def _write_docs(rows: list[dict[str, Any]]) -> None:
    text = DOCS.read_text(encoding="utf-8")
    before, rest = text.split(BEGIN)
    after = rest.split(END)[1]
    DOCS.write_text(f"{before}{BEGIN}\n```text\n{_report(rows)}\n```\n{END}{after}", encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
