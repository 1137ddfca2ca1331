# SPDX-License-Identifier: MIT
"""The paper's figures, drawn of our runs: delay and memory by mode, and λ over sensors."""

import csv
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from lab.paper.paper_outcome import DELAY, MEMORY, Outcome
from lab.paper.paper_runs import LIVE, MODES
from lab.paper.paper_worlds import PaperWorld

PAPER_MS = 500.0
_COLORS: dict[str, str] = dict(
    zip(LIVE[:6], ("#d55e00", "#e69f00", "#009e73", "#0072b2", "#56b4e9", "#cc79a7"), strict=True)
)
_SENSORS = {"stereo": "#0072b2", "kinect": "#d55e00", "tof": "#d55e00", "lidar": "#009e73"}
_METHODS = {"off": "#d55e00", "regularised": "#0072b2", "vdbfusion": "#009e73", "open3d": "#cc79a7"}
_TICKS_MS = [step * 10**power for power in range(6) for step in (1, 2, 5)]
_MIB = 1 << 20


class DelaySeries(NamedTuple):
    """Delay over the keyframes of a run.

    Attributes:
        number, delay_ms: (n,) of the keyframes that came into the map.
        end: number and delay of the last one of a run that died, where its cross stands; None = it did not.
    """

    label: str
    color: str
    dashed: bool
    number: NDArray[np.int64]
    delay_ms: NDArray[np.float64]
    end: tuple[int, float] | None
    died_of: str


def series_of(outcome: Outcome, rows: Iterable[dict[str, str]]) -> DelaySeries:
    """The series of a run, of the lines of its `delay.csv`."""
    known = [(int(row["seq"]), float(row["delay_ms"])) for row in rows if row["delay_ms"]]
    number, delay = np.array([k for k, _ in known], dtype=np.int64), np.array([d for _, d in known])
    is_small = outcome.machine.startswith("simulated")
    end = None
    if outcome.death:
        end = (int(number[-1]), float(delay[-1])) if known else (0, PAPER_MS)
    # the control of a traditional mode, with all of the machine, is dashed
    dashed = outcome.mode.startswith("traditional") and not is_small
    label = outcome.mode + (" (small machine)" if is_small else " (whole machine)" if dashed else "")
    return DelaySeries(label, _COLORS[outcome.mode], dashed, number, delay, end, outcome.died_of)


def delays(worlds: Sequence[PaperWorld], outcomes: Sequence[Outcome], runs: Path, path: Path) -> bool:
    """Figure 3 or 4: a panel a world, log axis, a cross where a mode died. False = nothing to draw."""
    from matplotlib.figure import Figure

    shown = [world for world in worlds if _of(world, outcomes)]
    if not shown:
        return False
    figure = Figure(figsize=(6.4 * len(shown), 5.4), dpi=130, layout="constrained")
    axes = figure.subplots(1, len(shown), squeeze=False)[0]
    for letter, axis, world in zip("abcdef", axes, shown, strict=False):
        for outcome in _of(world, outcomes):
            _draw_delay(axis, series_of(outcome, _lines(runs / outcome.name / DELAY)))
        axis.axhline(PAPER_MS, color="0.35", linestyle="--", linewidth=1, label="paper: 500 ms on average")
        if world.died_at and world.died_at <= axis.get_xlim()[1]:
            axis.axvline(world.died_at, color="0.35", linestyle=":", linewidth=1,
                         label=f"paper: the baseline ends at keyframe {world.died_at}")  # fmt: skip
        axis.set(yscale="log", xlabel="keyframe", ylabel="delay, ms")
        low, high = axis.get_ylim()
        axis.set_yticks([tick for tick in _TICKS_MS if low <= tick <= high], minor=False)
        axis.yaxis.set_major_formatter("{x:,.0f}")
        axis.yaxis.set_minor_formatter("")
        axis.set_title(f"({letter}) {world.stands_for}: {world.title}", fontsize=9)
        axis.legend(fontsize=7, loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=2)
        axis.grid(True, which="major", alpha=0.3)
    figure.savefig(path)
    return True


def _draw_delay(axis: Any, series: DelaySeries) -> None:
    style = "--" if series.dashed else "-"
    axis.plot(series.number, series.delay_ms, style, color=series.color, linewidth=1.2, label=series.label)
    if series.end is not None:
        axis.plot(*series.end, "x", color=series.color, markersize=11, markeredgewidth=2.5)
        axis.annotate(series.died_of, series.end, textcoords="offset points", xytext=(8, 6), fontsize=8)


def memory(world: PaperWorld, outcomes: Sequence[Outcome], runs: Path, path: Path) -> bool:
    """Memory over the time of a world's runs: what lives where, stacked. False = nothing to draw."""
    from matplotlib.figure import Figure

    chosen = _of(world, outcomes)
    if not chosen:
        return False
    columns = min(len(chosen), 3)
    rows = -(-len(chosen) // columns)
    figure = Figure(figsize=(4.6 * columns, 3.1 * rows), dpi=120, layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False, sharey=True).ravel()
    for axis, outcome in zip(axes, chosen, strict=False):
        _draw_memory(axis, outcome, _lines(runs / outcome.name / MEMORY))
    for axis in axes[len(chosen) :]:
        axis.axis("off")
    lines = {line.get_label(): line for axis in axes for line in axis.lines}
    figure.legend(lines.values(), lines.keys(), fontsize=8, loc="outside lower center", ncols=len(lines))
    figure.suptitle(f"memory, {world.title}", fontsize=10)
    figure.savefig(path)
    return True


def _draw_memory(axis: Any, outcome: Outcome, rows: list[dict[str, str]]) -> None:
    for machine, hatch in (("robot", ""), ("server", "//")):
        chosen = [row for row in rows if row["machine"] == machine]
        if not chosen:
            continue
        seconds = [float(row["seconds"]) for row in chosen]
        parts = np.array(
            [
                [float(row[name]) / _MIB for row in chosen]
                for name in ("map_bytes", "queue_bytes", "rss_bytes")
            ]
        )
        axis.plot(seconds, parts[2], color="#0072b2" if hatch else "#222222", label=f"{machine}: resident")
        axis.plot(
            seconds, parts[0], color="#009e73", linestyle="--" if hatch else "-", label=f"{machine}: map"
        )
        if not hatch:
            axis.plot(seconds, parts[1], color="#d55e00", label="robot: queue")
    if outcome.death:
        axis.set_title(f"{outcome.mode}: died of {outcome.died_of}", fontsize=9, color="#d55e00")
    else:
        axis.set_title(outcome.mode + ("" if outcome.machine.startswith("sim") else ", whole"), fontsize=9)
    axis.set(xlabel="s", ylabel="MiB")
    axis.grid(True, alpha=0.3)


def versatility(rows: Sequence[dict[str, Any]], path: Path) -> bool:
    """F-score and mean error over λ: a colour a sensor, a line a support. False = nothing to draw."""
    from matplotlib.figure import Figure

    rays = [row for row in rows if row["method"] == "ray" and row["f_score"] is not None]
    if not rays:
        return False
    figure = Figure(figsize=(12.6, 4.6), dpi=130, layout="constrained")
    axes = figure.subplots(1, 2)
    least = min((row["smoothness"] for row in rays if row["smoothness"]), default=1.0)
    shown = (("f_score", "F-score at one voxel, %"), ("mean_mm", "mean error as a share of λ = 0"))
    for axis, (value, title) in zip(axes, shown, strict=True):
        for sensor in dict.fromkeys(row["sensor"] for row in rays):
            _draw_sensor(axis, sensor, [row for row in rays if row["sensor"] == sensor], value)
        axis.set_xscale("symlog", linthresh=least, linscale=0.6)
        axis.set(xlabel="λ (0 = Curless and Levoy)", ylabel=title)
        axis.grid(True, alpha=0.3)
    axes[1].legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
    figure.suptitle(
        "One regularised per-ray integration for three sensors, by λ and support alone", fontsize=10
    )
    figure.savefig(path)
    return True


def _draw_sensor(axis: Any, sensor: str, rows: list[dict[str, Any]], value: str) -> None:
    """Lines of a sensor; an error is shown beside that without regularisation, as sensors differ much."""
    supports = sorted({row["support"] for row in rows})
    for support, style in zip(supports, (":", "--", "-", "-."), strict=False):
        line = sorted((row["smoothness"], row[value]) for row in rows if row["support"] == support)
        whole = line[0][1] if value == "mean_mm" else 1.0
        label, color = f"{sensor}, support {support:g} voxels", _SENSORS.get(sensor, "0.3")
        axis.plot([x for x, _ in line], [y / whole for _, y in line], style, marker="o", markersize=3.5,
                  color=color, label=label)  # fmt: skip


def surfaces(rows: Sequence[dict[str, Any]], path: Path) -> bool:
    """Precision over completeness: the maps over the weight that a voxel needs, and other systems."""
    from matplotlib.figure import Figure

    whole = [row for row in rows if row["method"] != "ray" and row["f_score"] is not None]
    sensors = list(dict.fromkeys(row["sensor"] for row in whole))
    if not sensors:
        return False
    figure = Figure(figsize=(4.4 * len(sensors), 4.0), dpi=130, layout="constrained")
    for axis, sensor in zip(figure.subplots(1, len(sensors), squeeze=False)[0], sensors, strict=True):
        shown = [row for row in whole if row["sensor"] == sensor]
        for method, color in _METHODS.items():
            line = sorted((r["completeness"], r["precision"]) for r in shown if r["method"] == method)
            if not line:  # a system that is not installed, or does not take this sensor
                continue
            own = [r for r in shown if r["method"] == method and r["min_weight"] is None]
            axis.plot(*np.array(line).reshape(-1, 2).T, "-", color=color, linewidth=1.2, label=method)
            axis.plot([r["completeness"] for r in own], [r["precision"] for r in own], "o", color=color)
        axis.set(title=sensor, xlabel="completeness, %", ylabel="precision, %")
        axis.grid(True, alpha=0.3)
        axis.legend(fontsize=8)
    figure.savefig(path)
    return True


def _of(world: PaperWorld, outcomes: Sequence[Outcome]) -> list[Outcome]:
    """The live runs of a world that are drawn: the first ones, with the regularised map."""
    return [
        one
        for one in outcomes
        if (one.world, one.map, one.number) == (world.name, "regularised", 1)
        if one.mode in _COLORS and one.mode in MODES
    ]


def _lines(path: Path) -> list[dict[str, str]]:
    if not path.is_file():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))
