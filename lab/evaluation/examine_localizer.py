# SPDX-License-Identifier: MIT
"""Examine the localizers by variants of recordings, beside other odometry: an ensemble, not one clip.

    python lab/evaluation/examine_localizer.py --out DIR               RGB-D, with and without colour
    python lab/evaluation/examine_localizer.py --out DIR --drives      stereo pairs and LiDAR sweeps
    python lab/evaluation/examine_localizer.py --out DIR --peers       also OpenCV and Open3D (`bench` extra)
    python lab/evaluation/examine_localizer.py --out DIR --write-docs  the table into docs/localization.md
    python lab/evaluation/examine_localizer.py --out DIR --turns       fast turns with and without a gyroscope
    python lab/evaluation/examine_localizer.py --out DIR --loops       corridors before and after loop closure
    python lab/evaluation/examine_localizer.py --out DIR --try rgbd.pose_solver.MIN_OVERLAP=0.2,0.25,0.3

Each scene is played in 24 to 28 variants (parts, strides, directions, light, blur, holes, noise), most of 40
frames, through the `Scanner` of `tsfusion scan` with its settings. Peers play every 6th variant.
`--every N` plays fewer: for a first look, or for the values of `--try`.
Results are kept in DIR, a line each: a second run continues, a changed localizer is examined anew.

`--try` plays each value of a constant, and chooses a value for each scene by the other scenes alone (k-fold):
figures of the chosen values are not tuned to their scenes.

`lost` are frames without a pose in the largest map of a scan. A variant with more than half of its frames
lost counts with an infinite error. Recordings are found under TSFUSION_DATA.
"""

import argparse
import hashlib
import json
import os
import sys
import time
import zlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from importlib import import_module
from itertools import product
from pathlib import Path
from typing import Any

os.environ.update(dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"))

import numpy as np
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "support"))
sys.path.append(str(Path(__file__).parents[2]))  # lab is not installed
from drifting_localizer import Drifting

from lab.evaluation import odometry_peers
from lab.evaluation.drive_variants import LIDAR_VARIANTS, STEREO_VARIANTS
from lab.evaluation.examined_drives import LIDAR, STEREO
from lab.evaluation.examined_scenes import FAST_HZ, SCENES, fast_turns
from lab.evaluation.recording_variants import VARIANTS, Frames, Variant, without_color
from tsfusion.core.config import ScanConfig
from tsfusion.core.errors import DatasetError
from tsfusion.datasets import Synthetic
from tsfusion.evaluation.trajectory_error import absolute_error, umeyama
from tsfusion.geometry import se3
from tsfusion.geometry.se3 import Poses
from tsfusion.scanner import localization
from tsfusion.scanner.localization import localizers
from tsfusion.scanner.localization.localizer import Localizer
from tsfusion.scanner.localization.loop_closure.loop_closing import LoopClosing
from tsfusion.scanner.localization.stereo.stereo_tracker import StereoLocalizer
from tsfusion.scanner.scanner import Scanner, Submap
from tsfusion.scanner.sources.source import RecordedSource
from tsfusion.scanner.tracked_trajectory import TrackedTrajectory

DOCS = Path(__file__).parents[2] / "docs" / "localization.md"
BEGIN, END = "<!-- table: examine_localizer.py{} --write-docs -->", "<!-- end of ensemble{} -->"
OWN, DEPTH_ALONE = "tsfusion", "depth alone"
PEERS = ("OpenCV", "Open3DKeyframes", "Open3DModel")
EVERY, FIRST = 6, 4  # peers play one of so many variants, from this one on
TURNED_ROOMS = (6, 7, 8, 10)
RETURNS = {  # worlds that a scan sees twice: frames; the true poses with drift added instead of a tracker's
    "corridor, two laps": ("corridor", 520, False),
    "corridor, drift added": ("corridor", 340, True),
    "eight identical rooms, drift added": ("rooms", 160, True),
}
LOST_COST = 2.0  # all frames lost cost as much as an error e² = 7 times as large

Row = dict[str, Any]


def variants_of(scene: str) -> dict[str, Variant]:
    """Return the variants that a scene's sensor has."""
    return STEREO_VARIANTS if scene in STEREO else LIDAR_VARIANTS if scene in LIDAR else VARIANTS


def frames_of(scene: str) -> Frames | str:
    """Return the frames of a scene in memory, or why it cannot be opened."""
    try:
        return {**SCENES, **STEREO, **LIDAR}[scene]()
    except (DatasetError, OSError) as error:
        return str(error)


class _NoClient:
    """Client that takes keyframes and corrections, and sends none."""

    def send(self, _keyframe: Any) -> None:
        return None

    def correct(self, _poses: Any, *, T_map_odometry: Any) -> None:
        return None


def play(frames: Frames, localizer: Localizer | None = None) -> Scanner:
    """Scan the frames as `tsfusion scan` does, with its settings, but send nothing."""
    config = ScanConfig()
    localizer = localizer or localizers.create_localizer(config, frames[0])
    connect: Callable[[str], Any] = lambda _name: _NoClient()  # noqa: E731
    outdoors = frames[0].kind in ("pair", "points")
    scanner = Scanner(localizer, config, connect, map_name="map", outdoors=outdoors)
    scanner.run(map(replace, frames), lambda _: None)  # a frame keeps its disparity: each scan has its own
    scanner.finish()
    return scanner


def judged(scanner: Scanner, frames: Frames) -> Row:
    """Return figures of a scan: frames lost, error as tracked and after loops, CPU."""
    largest: Submap = max(scanner.submaps, key=lambda submap: len(submap.located))
    located = largest.located
    row: Row = {
        "frames": len(frames), "lost": len(frames) - len(located), "cpu_ms": scanner.tracking_cpu_ms,
        "loops": largest.corrections.loops if largest.corrections else 0,
        "ate_mm": None, "closed_mm": None, "drift": None, "path": [],
    }  # fmt: skip
    if 2 * len(located) >= len(frames) and len(located) > 1:
        _, truth = located.with_reference()
        row["path"] = _path(located, truth)
        error = absolute_error(located.poses(), truth)
        closed = absolute_error(located.poses(largest.corrections), truth)
        row |= {"ate_mm": 1e3 * error.rmse, "closed_mm": 1e3 * closed.rmse, "drift": error.drift_percent}
    return row


def _path(located: TrackedTrajectory, truth: Poses) -> list[list[float]]:
    """Return timestamp, estimated and true position of each frame: nanoseconds and mm."""
    places = 1e3 * np.hstack([located.poses()[:, :3, 3], truth[:, :3, 3]])
    return [[stamp, *place] for stamp, place in zip(located.stamps_ns, places.round(3).tolist(), strict=True)]


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder of results")
    parser.add_argument("--only", default="", metavar="WORDS", help="scenes whose name has one: a,b")
    parser.add_argument("--peers", action="store_true", help="also OpenCV's and Open3D's odometry")
    parser.add_argument("--drives", action="store_true", help="stereo pairs and LiDAR instead of RGB-D")
    parser.add_argument("--every", type=int, default=1, metavar="N", help="every Nth variant alone")
    parser.add_argument("--turns", action="store_true", help="fast turns with and without a gyroscope")
    parser.add_argument("--loops", action="store_true", help="corridors before and after loop closure")
    parser.add_argument("--try", dest="tried", metavar="NAME=V,V", help="values of a constant")
    parser.add_argument("--write-docs", action="store_true", help=f"put the table into {DOCS.name}")
    options = parser.parse_args()
    known = [*STEREO, *LIDAR] if options.drives else [*SCENES]
    scenes = [name for name in known if any(word in name for word in options.only.split(","))]
    results = Results(options.out / "results.jsonl", every=options.every)
    if options.turns or options.loops:
        print(turns() if options.turns else loops())
        return 0
    if options.tried:
        print(_folds(results, scenes, *options.tried.split("=")))
        return 0
    systems = [OWN] if options.drives else [OWN, DEPTH_ALONE, *(PEERS if options.peers else ())]
    examine(results, scenes, systems, fingerprint())
    text = (drive_report if options.drives else report)(results, fingerprint(), scenes)
    print(text)
    if options.write_docs:
        _write_docs(text, " --drives" if options.drives else "")
    return 0


def turns() -> str:
    """Return a table of rooms swung through at 200°/s: with a gyroscope, without, with one askew by 90°."""
    titles = "".join(f"{title:>20}" for title in ("with a gyroscope", "without", "askew by 90°"))
    lines = [f"{'lost, ATE in mm':<32}{titles}"]
    for seed in TURNED_ROOMS:
        frames = fast_turns(seed)
        kinds: list[tuple[str, Frames, Callable[[], Localizer | None]]] = [
            ("", frames, lambda: None), (", depth alone", without_color(frames), lambda: None),
            (", as stereo", frames, StereoLocalizer),
        ]  # fmt: skip
        for (name, seen, localizer), stride in product(kinds, (1, 2, 3)):
            some = seen[::stride]
            rows = [judged(play(each, localizer()), each) for each in (some, blind(some), askew(some))]
            figures = "".join(
                f"{row['lost']:>4} of {len(some)}{_error(row):>10.1f}".rjust(20) for row in rows
            )
            lines.append(f"{f'room {seed}, {FAST_HZ // stride} Hz{name}':<32}{figures}")
    return "\n".join(lines)


def loops() -> str:
    """Return a table of scans that come back: as tracked, and after loop closure."""
    lines = [f"{'ATE, mm':<40}{'frames':>9}{'lost':>6}{'tracked':>9}{'loops':>7}{'after':>9}"]
    for name, (world, count, drifts) in RETURNS.items():
        frames = [*RecordedSource(Synthetic(world, count=count))]
        row = judged(play(frames, LoopClosing(Drifting()) if drifts else None), frames)
        tracked, after = (_error(row, field) for field in ("ate_mm", "closed_mm"))
        lines.append(f"{name:<40}{count:>9}{row['lost']:>6}{tracked:>9.1f}{row['loops']:>7}{after:>9.1f}")
    return "\n".join(lines)


def blind(frames: Frames) -> Frames:
    """Return the frames without a gyroscope."""
    return [replace(frame, attitude=None) for frame in frames]


def askew(frames: Frames) -> Frames:
    """Return the frames with a gyroscope whose axes are wrong by 90°."""
    R = se3.exp(np.array([0, 0, 0, 0, 0, np.pi / 2]))[:3, :3]
    return [
        frame
        if frame.attitude is None
        else replace(frame, attitude=frame.attitude._replace(R=R @ frame.attitude.R @ R.T))
        for frame in frames
    ]


def fingerprint() -> str:
    """Return a key of the localizer's code."""
    code = hashlib.sha256()
    for path in sorted(Path(localization.__path__[0]).rglob("*.py")):
        code.update(path.read_bytes())
    return code.hexdigest()[:10]


class Results:
    """Rows of a file, one JSON line each; what is there is not computed again."""

    def __init__(self, path: Path, *, every: int = 1) -> None:
        self._every = every
        path.parent.mkdir(parents=True, exist_ok=True)
        self._path = path
        lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
        self._rows = {_key(row): row for row in map(json.loads, lines)}

    def variants(self, scene: str) -> list[str]:
        """Return the names of the variants that are played."""
        return list(variants_of(scene))[:: self._every]

    def get(self, key: str, scene: str, system: str, variant: str) -> Row | None:
        return self._rows.get((_code_of(system, key), scene, system, variant))

    def add(self, row: Row) -> None:
        self._rows[_key(row)] = row
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")

    def of(self, key: str, scenes: Iterable[str], system: str) -> list[Row]:
        """Return the rows of a system on all variants of the scenes that were played."""
        places = [(scene, variant) for scene in scenes for variant in self.variants(scene)]
        found = [self.get(key, scene, system, variant) for scene, variant in places]
        return [row for row in found if row is not None]


def _key(row: Row) -> tuple[str, str, str, str]:
    return row["key"], row["scene"], row["system"], row["variant"]


def _code_of(system: str, key: str) -> str:
    return "" if system in PEERS else key


def examine(results: Results, scenes: Sequence[str], systems: Sequence[str], key: str) -> None:
    """Play what is missing in the results."""
    for scene in scenes:
        missing = [
            (system, variant)
            for number, variant in enumerate(results.variants(scene))
            for system in systems
            if (system not in PEERS or number % EVERY == FIRST)
            and not results.get(key, scene, system, variant)
        ]
        frames = frames_of(scene) if missing else []
        if isinstance(frames, str):
            print(f"{scene}: {frames}", file=sys.stderr)
            continue
        began = time.monotonic()
        for system, variant in missing:
            row = _played(frames, scene, system, variant)
            if row is not None:
                results.add({"key": _code_of(system, key), "scene": scene, "system": system,
                             "variant": variant, **row})  # fmt: skip
        print(f"{scene}: {len(missing)} played, {time.monotonic() - began:.0f} s", file=sys.stderr)


def _played(frames: Frames, scene: str, system: str, variant: str) -> Row | None:
    """Play a variant to a system. Return None without the system, or two frames."""
    seed = zlib.crc32(f"{scene}/{variant}".encode())
    chosen = variants_of(scene)[variant](frames, np.random.default_rng(seed))
    if len(chosen) < 2:
        return None
    if system == DEPTH_ALONE:
        chosen = without_color(chosen)
    if system not in PEERS:
        return judged(play(chosen), chosen)
    if system.startswith("Open3D"):
        try:
            import_module("open3d")
        except (ImportError, OSError) as error:
            print(f"{system} is left out: {error}", file=sys.stderr)
            return None
    return judged(play(chosen, getattr(odometry_peers, system)()), chosen)


def report(results: Results, key: str, scenes: Sequence[str]) -> str:
    """Return the ensemble's table: each scene, and all of them beside the peers."""
    own = (OWN, DEPTH_ALONE)
    lines = [
        f"{'ATE, mm':<40}{'variants':>9}{'median':>9}{'worst 10th':>12}{'loops':>9}{'lost':>14}{'CPU ms':>8}"
    ]
    lines += [_line(f"{scene}: {name}", results.of(key, [scene], name)) for scene in scenes for name in own]
    lines += [_line(f"all: {name}", results.of(key, scenes, name)) for name in own]
    lines += _color_lines(results, key, scenes)
    peers = {name: results.of(key, scenes, name) for name in PEERS}
    shared = {_place(row) for rows in peers.values() for row in rows}
    if not shared:
        return "\n".join(lines)
    mine = [row for row in results.of(key, scenes, OWN) if _place(row) in shared]
    lines += [
        "",
        *(_line(f"every {EVERY}th: {name}", rows) for name, rows in {OWN: mine, **peers}.items()),
    ]
    ratios = _ratios(mine, [row for rows in peers.values() for row in rows])
    middle, worst = _percentile(ratios, 50), _percentile(ratios, 90)
    return "\n".join(
        [*lines, f"{OWN} / each variant's best peer: median {middle:.2f}, worst tenth {worst:.2f}"]
    )


def drive_report(results: Results, key: str, scenes: Sequence[str]) -> str:
    """Return the ensemble's table of drives: each scene, and all of a sensor."""
    lines = [
        f"{'drift, % of the way':<40}{'variants':>9}{'median':>9}{'worst 10th':>12}{'ATE, mm':>9}"
        f"{'lost':>14}{'CPU ms':>8}"
    ]
    for name, kind in (("stereo", STEREO), ("LiDAR", LIDAR)):
        some = [scene for scene in scenes if scene in kind]
        for each, of in (*((scene, [scene]) for scene in some), (f"all: {name}", some)):
            lines.append(_line(each, results.of(key, of, OWN), ("drift", "ate_mm"), 2))
    return "\n".join(lines)


def _color_lines(results: Results, key: str, scenes: Sequence[str]) -> list[str]:
    """Return the lines that compare colour with depth alone, on the frames that both have placed."""
    alone = {_place(row): row for row in results.of(key, scenes, DEPTH_ALONE)}
    ratios = {scene: list[float]() for scene in scenes}
    for row in results.of(key, scenes, OWN):
        errors = shared_errors(row, alone[_place(row)]) if _place(row) in alone else None
        if errors is not None:
            ratios[row["scene"]].append(errors[0] / max(errors[1], 1e-3))
    lines = [
        "",
        f"{'colour / depth alone, frames of both':<40}{'variants':>9}{'median':>9}{'worst 10th':>12}",
    ]
    for name, some in {**ratios, "all": [ratio for each in ratios.values() for ratio in each]}.items():
        if some:
            figures = f"{_percentile(some, 50):>9.2f}{_percentile(some, 90):>12.2f}"
            lines.append(f"{name:<40}{len(some):>9}{figures}")
    return lines


def shared_errors(row: Row, other: Row) -> tuple[float, float] | None:
    """Return the errors of two scans on the frames that both have placed, mm; None if these are few."""
    paths = [{stamp: place for stamp, *place in each["path"]} for each in (row, other)]
    shared = [stamp for stamp in paths[0] if stamp in paths[1]]
    if 2 * len(shared) < row["frames"]:
        return None
    first, second = (np.array([path[stamp] for stamp in shared]) for path in paths)
    return _position_error(first), _position_error(second)


def _position_error(places: NDArray[np.float64]) -> float:
    """Return the error of (n, 6) estimated and true positions after the best rigid motion."""
    T, _ = umeyama(places[:, :3], places[:, 3:])
    off = places[:, :3] @ T[:3, :3].T + T[:3, 3] - places[:, 3:]
    return float(np.sqrt((off**2).sum(axis=1).mean()))


def _place(row: Row) -> tuple[str, str]:
    return row["scene"], row["variant"]


def _line(
    name: str, rows: Sequence[Row], fields: Sequence[str] = ("ate_mm", "closed_mm"), digits: int = 1
) -> str:
    if not rows:
        return f"{name:<40}{'not played':>20}"
    errors, closed = ([_error(row, field) for row in rows] for field in fields)
    lost, frames = (sum(row[field] for row in rows) for field in ("lost", "frames"))
    cpu = np.mean([row["cpu_ms"] for row in rows])
    return (
        f"{name:<40}{len(rows):>9}{_percentile(errors, 50):>9.{digits}f}"
        f"{_percentile(errors, 90):>12.{digits}f}{_percentile(closed, 50):>9.1f}"
        f"{f'{lost} / {frames}':>14}{cpu:>8.1f}"
    )


def _error(row: Row, field: str = "ate_mm") -> float:
    return float("inf") if row[field] is None else float(row[field])


def _percentile(values: Sequence[float], percent: float) -> float:
    return float(np.percentile(values, percent, method="higher"))


def _ratios(own: Sequence[Row], others: Sequence[Row]) -> list[float]:
    """Return each variant's error as a share of the best peer's; 0 where no peer holds on."""
    best = {_place(row): [_error(one) for one in others if _place(one) == _place(row)] for row in own}
    return [
        _error(row) / min(best[_place(row)]) if np.isfinite(min(best[_place(row)])) else 0.0 for row in own
    ]


def cost(rows: Sequence[Row]) -> float:
    """Return the mean of log error and `LOST_COST` times the share of frames lost; less is better."""
    errors = [np.clip(_error(row), 0.1, 1e3) for row in rows]
    return float(np.mean(np.log(errors)) + LOST_COST * np.mean([row["lost"] / row["frames"] for row in rows]))


def _folds(results: Results, scenes: Sequence[str], name: str, values: str) -> str:
    """Play each value of a constant; choose a value for each scene by the other scenes; judge it there."""
    place, _, constant = name.rpartition(".")
    module = import_module(f"tsfusion.scanner.localization.{place}")
    usual, costs = getattr(module, constant), dict[str, list[float]]()
    for value in (str(usual), *values.split(",")):
        setattr(module, constant, type(usual)(value))
        key = fingerprint() if value == str(usual) else f"{fingerprint()} {name}={value}"
        systems = [OWN] if scenes[0] in {**STEREO, **LIDAR} else [OWN, DEPTH_ALONE]
        examine(results, scenes, systems, key)
        rows = ([row for system in systems for row in results.of(key, [s], system)] for s in scenes)
        costs[value] = [cost(each) for each in rows]
    setattr(module, constant, usual)
    lines = [f"{value}: cost {np.mean(each):.3f}" for value, each in costs.items()]
    chosen = []
    for index, scene in enumerate(scenes):
        others = {value: np.delete(each, index).sum() for value, each in costs.items()}
        best = min(others, key=others.__getitem__)
        chosen.append(costs[best][index])
        lines.append(
            f"{scene}: by the others {best}, {chosen[-1]:.3f}; {usual}, {costs[str(usual)][index]:.3f}"
        )
    return "\n".join([*lines, f"held out: {np.mean(chosen):.3f}; {usual}: {np.mean(costs[str(usual)]):.3f}"])


def _write_docs(table: str, which: str) -> None:
    text, begin, end = DOCS.read_text(encoding="utf-8"), BEGIN.format(which), END.format(which)
    before, rest = text.split(begin)
    after = rest.split(end)[1]
    DOCS.write_text(f"{before}{begin}\n```text\n{table}\n```\n{end}{after}", encoding="utf-8")


if __name__ == "__main__":
    import cv2

    cv2.setNumThreads(1)
    sys.exit(main())
