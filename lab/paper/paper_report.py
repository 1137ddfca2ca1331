# SPDX-License-Identifier: MIT
"""Results of all runs together: CSV files, figures, `run.json` and the report."""

import base64
import csv
import json
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from lab.paper import paper_figures
from lab.paper.paper_outcome import DELAY, MEMORY, POSES, Outcome, error_until
from lab.paper.paper_runs import MODES, Limits
from lab.paper.paper_verdicts import Findings, Verdict
from tsfusion.core import durable_files
from tsfusion.evaluation.trajectory_error import TrajectoryError
from tsfusion.pipelines.report import page, run_record
from tsfusion.pipelines.report.page import Page

RECORD, REPORT = "run.json", "report.html"
PAPER: dict[str, Any] = {
    "delay_ms": 500.0,
    "keyframes": {"06_KITTI": 428, "07_KITTI": 242},
    "baseline_died_at": {"06_KITTI": 60, "07_KITTI": 25},
}
ERRATA = (
    "Eq. (1) pairs row with cx and fx: the column belongs to x.",
    "Depth is the distance along the optical axis, not along the ray.",
    "Eq. (3) gives every voxel of a signal the same weight; here the weights of the fused values count.",
    "“Total variation” in the text is a squared norm in the formula.",
    "“Support in [5]” means [7], and [21] is named both for CoRBS and for the tool that computes the ATE.",
    "The ATE table is not in our copy of the paper, so our errors stand alone.",
)
_STATISTICS = ("min", "max", "mean", "median", "std", "rmse")


class AteRow(msgspec.Struct, frozen=True):
    """One line of the ATE table."""

    outcome: Outcome
    part: str  # full, cut, corrected
    until_frame: int | None
    error: TrajectoryError


def cut_frames(outcomes: Sequence[Outcome]) -> dict[tuple[str, str, int], int]:
    """The last frame that the unbounded baseline took before it died, by world, map and number of the run.

    Those on a small machine count before those on the whole one; where none died there is no cut.
    """
    found: dict[tuple[str, str, int], int] = {}
    dead = [one for one in outcomes if one.mode == "traditional-unbounded" and one.died_frame is not None]
    for one in sorted(dead, key=lambda one: one.machine.startswith("simulated")):
        assert one.died_frame is not None
        found[one.world, one.map, one.number] = one.died_frame
    return found


def ate_rows(outcomes: Sequence[Outcome], runs: Path) -> Iterator[AteRow]:
    """Errors of all live runs: full, cut at the baseline's end, and after loop closure."""
    cuts = cut_frames(outcomes)
    for one in outcomes:
        if one.ate is not None:
            yield AteRow(one, "full", None, one.ate)
        until = cuts.get((one.world, one.map, one.number))
        cut = None if until is None else error_until(runs / one.name / POSES, until)
        if cut is not None:
            yield AteRow(one, "cut", until, cut)
        if one.corrected is not None:
            yield AteRow(one, "corrected", None, one.corrected)


def cut_errors(rows: Sequence[AteRow]) -> dict[str, float]:
    """RMSE of each run up to the baseline's end; the full one where it had none."""
    found = {row.outcome.name: row.error.rmse for row in rows if row.part == "full"}
    return found | {row.outcome.name: row.error.rmse for row in rows if row.part == "cut"}


def write_tables(folder: Path, found: Findings, rows: Sequence[AteRow], maps: dict[str, Any]) -> None:
    """Write `delay.csv`, `memory.csv`, `ate.csv` and `surface.csv`."""
    runs = folder / "runs"
    for name in (DELAY, MEMORY):
        _join([(one.name, runs / one.name / name) for one in found.outcomes], folder / name)
    head = [
        "run",
        "world",
        "mode",
        "map",
        "number",
        "part",
        "until_frame",
        *TrajectoryError.__struct_fields__,
    ]
    with durable_files.replacing(folder / "ate.csv") as file:
        lines = [head] + [
            [row.outcome.name, row.outcome.world, row.outcome.mode, row.outcome.map, row.outcome.number,
             row.part, "" if row.until_frame is None else row.until_frame,
             *msgspec.structs.astuple(row.error)]
            for row in rows
        ]  # fmt: skip
        file.write(_csv(lines))
    surfaces = [{"run": "", **row} for row in found.sweep]
    surfaces += [{"run": name, **_flat(row)} for name, row in maps.items()]
    columns = list(dict.fromkeys(key for row in surfaces for key in row)) or ["run"]
    with durable_files.replacing(folder / "surface.csv") as file:
        file.write(_csv([columns, *([row.get(column, "") for column in columns] for row in surfaces)]))


def _flat(row: dict[str, Any]) -> dict[str, Any]:
    """Figures of a map under the names of the sweep's columns."""
    accuracy, normal = row.get("accuracy_mm") or {}, row.get("normal_deg") or {}
    return {
        "method": "live map", "mean_mm": accuracy.get("mean"), "p95_mm": accuracy.get("p95"),
        "precision": row.get("precision"), "completeness": row.get("completeness"),
        "f_score": row.get("f_score"), "normal_deg": normal.get("median"), "triangles": row.get("triangles"),
    }  # fmt: skip


def _join(files: Sequence[tuple[str, Path]], path: Path) -> None:
    """Write the lines of many CSV files as one, with the name of the run before each."""
    lines: list[list[Any]] = []
    for name, each in files:
        if each.is_file():
            with each.open(encoding="utf-8", newline="") as file:
                head, *rest = list(csv.reader(file)) or [[]]
            lines = lines or [["run", *head]]
            lines += ([name, *row] for row in rest)
    with durable_files.replacing(path) as file:
        file.write(_csv(lines or [["run"]]))


def _csv(lines: Sequence[Sequence[Any]]) -> bytes:
    import io

    text = io.StringIO()
    csv.writer(text, lineterminator="\n").writerows(lines)
    return text.getvalue().encode()


def draw(folder: Path, found: Findings) -> dict[str, Path]:
    """Draw the figures; their files by name. None without matplotlib."""
    try:
        import matplotlib  # noqa: F401
    except ImportError:
        return {}
    runs, drawn = folder / "runs", {}
    outdoors = [world for world in found.worlds if world.sensor == "stereo" or "KITTI" in world.stands_for]
    others = [world for world in found.worlds if world not in outdoors]
    jobs = [("figure 3", paper_figures.delays, outdoors), ("figure 4", paper_figures.delays, others)]
    for name, function, worlds in jobs:
        path = folder / f"{name.replace(' ', '')}.png"
        if function(worlds, found.outcomes, runs, path):
            drawn[name] = path
    for world in found.worlds:
        path = folder / f"memory-{world.name}.png"
        if paper_figures.memory(world, found.outcomes, runs, path):
            drawn[f"memory, {world.name}"] = path
    if paper_figures.versatility(found.sweep, folder / "versatility.png"):
        drawn["versatility"] = folder / "versatility.png"
    if paper_figures.surfaces(found.sweep, folder / "surfaces.png"):
        drawn["surfaces"] = folder / "surfaces.png"
    return drawn


def write_record(
    folder: Path, found: Findings, made: dict[str, Verdict], *, limits: Limits, told: dict[str, Any]
) -> None:
    """Write `run.json`.

    Args:
        told: more to keep: calibration, failures, maps, how long what took.
    """
    record = {
        "verdicts": made, "limits": limits, **told, "paper": PAPER,
        "worlds": [msgspec.structs.replace(world, cache="") for world in found.worlds],
        "runs": found.outcomes, "sweep": found.sweep, "versions": run_record.versions(),
        "made": run_record.circumstances(),
    }  # fmt: skip
    with durable_files.replacing(folder / RECORD) as file:
        file.write(msgspec.json.format(msgspec.json.encode(record), indent=2) + b"\n")


def write_page(
    folder: Path,
    found: Findings,
    made: dict[str, Verdict],
    rows: Sequence[AteRow],
    *,
    limits: Limits,
    told: dict[str, Any],
    drawn: dict[str, Path],
) -> None:
    """Write the report: one page that holds all of its pictures."""
    met = sum(verdict.met is True for verdict in made.values())
    unknown = [name for name, verdict in made.items() if verdict.met is None]
    shown = Page(
        title="The paper's experiments, run again",
        subtitle=f"{len(found.outcomes)} runs · {time.strftime('%Y-%m-%d %H:%M')} · "
        + ", ".join(world.title for world in found.worlds),
        verdict=f"{met} of {len(made)} claims are met as tested here"
        + (f"; {len(unknown)} could not be measured" if unknown else "") + ".",
        level="bad" if unknown else "good", warnings=_warnings(limits, told), tiles=_tiles(found),
        footer=f"From {folder}/run.json. This file needs no network and no other file.",
    )  # fmt: skip
    shown.sections = [
        ("Verdicts", _verdicts(made)),
        ("Figures 3 and 4: delay of each keyframe", _figures(drawn, "figure")),
        ("Figure 5: reconstructions", _reconstructions(folder, found)),
        ("Absolute trajectory error, metres", _ate(rows)),
        ("Memory", _figures(drawn, "memory")),
        ("Versatility: λ and support over three sensors", _figures(drawn, "versatility")),
        ("Surfaces: the whole maps, at true poses", _figures(drawn, "surfaces") + _peers(found)),
        ("Every run", _runs(found)),
        ("Small machines, simulated", _limits(limits, told)),
        ("Errata of the paper", "".join(page.note(line) for line in ERRATA)),
    ]
    page.write(shown.html(), {}, folder / REPORT)


def _warnings(limits: Limits, told: dict[str, Any]) -> list[str]:
    lines = [f"Not made: {name}: {why}" for name, why in told.get("failures", {}).items()]
    if limits.pace != 1:
        lines.append(
            f"The recordings played {limits.pace:g} times slower than they were taken: no real time."
        )
    return lines


def _tiles(found: Findings) -> list[tuple[str, str, str]]:
    tiles = []
    for world in found.worlds:
        runs = [one for one in found.outcomes if (one.world, one.mode) == (world.name, "decentralised")]
        if runs:
            fused, delay = min(one.fused for one in runs), np.mean([one.delay_ms.mean for one in runs])
            note = f"keyframes fused of {runs[0].planned}, {delay:.0f} ms after the sensor"
            tiles.append((world.stands_for or world.name, str(fused), note))
    return tiles


def _verdicts(made: dict[str, Verdict]) -> str:
    state = {True: "met", False: "NOT MET", None: "not measured"}
    return page.facts(
        (f"{name}: {state[verdict.met]}", f"{verdict.words} Wanted: {verdict.wanted}.")
        for name, verdict in made.items()
    )


def _figures(drawn: dict[str, Path], word: str) -> str:
    captions = {
        "figure 3": "Delay from sensor to map, as the paper's figure 3: a cross is where a mode died.",
        "figure 4": "The same for the desk, as the paper's figure 4.",
        "surfaces": "Along a line a voxel needs more and more samples; the dot is the usual number.",
        "versatility": "F-score, and mean error beside that of λ = 0, where the integration is plain.",
    }
    return "".join(
        page.picture(_url(path), captions.get(name, name)) for name, path in drawn.items() if word in name
    )


def _reconstructions(folder: Path, found: Findings) -> str:
    parts = []
    for one in found.outcomes:
        for part in ("whole", "detail"):
            path = folder / "runs" / one.name / f"picture-{part}.png"
            if path.is_file():
                caption = f"{one.world}, {one.mode}, {one.map}: {one.fused} keyframes, {part}"
                parts.append(page.picture(_url(path), caption))
    return page.pair(*parts) if parts else ""


def _ate(rows: Sequence[AteRow]) -> str:
    """A line a mode: the mean over its runs, with the spread of the RMSE."""
    groups: dict[tuple[str, ...], list[AteRow]] = {}
    for row in rows:
        one = row.outcome
        machine = "" if one.machine.startswith("all") else ", small machine"
        part = row.part if row.until_frame is None else f"cut at frame {row.until_frame}"
        groups.setdefault((one.world, one.mode + machine, one.map, part), []).append(row)
    lines = []
    for key, group in groups.items():
        errors = [row.error for row in group]
        means = [f"{np.mean([getattr(error, name) for error in errors]):.4f}" for name in _STATISTICS]
        spread = f"± {np.std([error.rmse for error in errors]):.4f}" if len(errors) > 1 else ""
        drift = f"{np.mean([error.drift_percent for error in errors]):.2f}"
        late = f"{np.mean([row.outcome.late for row in group]):.0f}"
        lines.append((" · ".join(key), *means, spread, drift, late, str(len(errors))))
    head = ("run", *_STATISTICS, "over runs", "drift %", "frames dropped", "runs")
    return page.table(head, lines) + page.note(
        "Of the poses that the live front end gave, after the best rigid motion; frames that it dropped have "
        "none. Cut: up to the last frame that the unbounded baseline took before it died."
    )


def _peers(found: Findings) -> str:
    rows = [row for row in found.sweep if row["method"] != "ray" and row.get("min_weight") is None]
    if not rows:
        return ""
    names = ("f_score", "precision", "completeness", "mean_mm", "normal_deg")
    head = ("surface, true poses", "F", "precision %", "completeness %", "mean mm", "normal °")
    return page.table(
        head,
        [
            (f"{row['sensor']}, {row['method']}", *("" if row[n] is None else f"{row[n]:.1f}" for n in names))
            for row in rows
        ],
    )


def _runs(found: Findings) -> str:
    head = (
        "run",
        "fused",
        "delay ms",
        "p99",
        "slope ms",
        "dropped",
        "cores",
        "robot MiB",
        "server MiB",
        "end",
    )
    lines = [
        (
            one.name, f"{one.fused}/{one.planned}", f"{one.delay_ms.mean:.0f}", f"{one.delay_ms.p99:.0f}",
            f"{one.slope_ms_per_keyframe:+.2f}", str(one.late), f"{one.cores:.2f}",
            f"{one.robot_peak_bytes / 2**20:.0f}", f"{one.server_peak_bytes / 2**20:.0f}",
            one.died_of or ("" if one.drained else "not drained"),
        )
        for one in found.outcomes
    ]  # fmt: skip
    return page.table(head, lines) + page.facts((mode, words) for mode, words in MODES.items())


def _limits(limits: Limits, told: dict[str, Any]) -> str:
    calibrated = told.get("calibration", {})
    return page.facts(
        [
            ("robot of the traditional modes", limits.robot.described),
            ("throttled server", f"{100 * limits.server_share:.0f} % of its time"),
            ("throttled link", f"{limits.link_bytes_per_second / 1e6:g} MB/s, "
             f"{1e3 * limits.link_delay_s:g} ms each way"),
            ("lost packets", f"{100 * limits.lost_share:.0f} %, each sent again 50 ms later, as TCP does"),
            ("calibrated", ", ".join(f"{share} → {got:.2f}" for share, got in calibrated.items())),
        ]
    )  # fmt: skip


def _url(path: Path) -> str:
    return "data:image/png;base64," + base64.b64encode(path.read_bytes()).decode("ascii")


def read_record(folder: Path) -> dict[str, Any]:
    """`run.json` of a folder."""
    found: dict[str, Any] = json.loads((folder / RECORD).read_text(encoding="utf-8"))
    return found
