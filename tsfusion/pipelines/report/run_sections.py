# SPDX-License-Identifier: MIT
"""Build the sections of a report that show a run: delay, growth, trajectory error, keyframes, settings."""

import json
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import DatasetError
from tsfusion.core.readable_numbers import counted, figure, grouped, size
from tsfusion.evaluation import trajectory_error
from tsfusion.evaluation.trajectory_error import TrajectoryError
from tsfusion.pipelines.report import charts, latency_ledger, page
from tsfusion.pipelines.report.charts import Axis, Chart
from tsfusion.pipelines.report.run_record import Circumstances, MapFindings, MapResult, RunFindings, RunRecord
from tsfusion.wire.messages.health import Spread, spread
from tsfusion.wire.messages.messages import DELAY, SKIP_REASONS, STAGES, KeyframeTimes

_COLUMNS = 200  # of a chart by keyframe; each column shows several keyframes of a long run
_BINS = 50
_STYLES = dict(zip(STAGES, ("k1", "k2", "k3", "k4", "k5", "k6"), strict=True))
_WAY = ("encode", "wire", "journal", "queue", "fuse")  # the stages whose sum is the delay
_MEANING = {
    "encode": "captured → sent", "wire": "sent → received", "journal": "received → on the disk",
    "queue": "on the disk → fuse start", "fuse": "fuse start → fused",
    "mesh": "fused → noted as changed for viewers",
}  # fmt: skip


def delay(found: RunFindings) -> str:
    """Return the HTML of charts and a table of the keyframes' delay, by stage."""
    record, times = found.record, found.times
    total, figures = record.delay_ms, {name: record.stages_ms.get(name, Spread()) for name in STAGES}
    if not total.count:
        return page.note("Not known: no keyframe was fused while this run was there to see it.")
    if not record.stages_ms:
        figures = {name: spread(latency_ledger.durations_ms(times, *ends)) for name, ends in STAGES.items()}
    known = {name: one for name, one in figures.items() if one.count}
    rows = [(f"{name}: {_MEANING[name]}", *_milliseconds(one)) for name, one in known.items()]
    rows.append(("delay: captured → fused", *_milliseconds(total)))
    styles = [*(_STYLES[name] for name in known), "k0"]
    table = page.table(("milliseconds", "mean", "p50", "p95", "p99", "max"), rows, styles=styles)
    bound = record.clock_bound_ms
    words = "" if bound is None else f"Times between two machines or processes are right to ± {bound:.2f} ms."
    drawn = ""
    if times:
        drawn = _delay_by_keyframe(times) + _delay_histogram(times)
    return f"{drawn}{table}{page.note(words) if words else ''}"


def _delay_by_keyframe(times: Sequence[KeyframeTimes]) -> str:
    delays = latency_ledger.durations_ms(times, *DELAY)
    columns = min(len(times), _COLUMNS)
    edges = np.linspace(0, len(times), columns + 1)
    which = np.minimum((np.arange(len(times)) * columns) // len(times), columns - 1)
    heights = [_mean(latency_ledger.durations_ms(times, *STAGES[name]), which, columns) for name in _WAY]
    worst = np.full(columns, -np.inf)
    np.fmax.at(worst, which, delays)
    worst[~np.isfinite(worst)] = np.nan
    tops = np.cumsum(heights, axis=0)
    most = max(float(tops.max(initial=0)), float(np.nanmax(worst)) if np.isfinite(worst).any() else 0.0, 1.0)
    chart = Chart(
        Axis(0, len(times), "keyframe", 10),
        Axis(0, most * 1.08, "ms"),
        "Delay by keyframe",
        width=1060,
        height=300,
    )
    for name, low, high in zip(_WAY, np.vstack((np.zeros(columns), tops[:-1])), tops, strict=True):
        chart.bars(edges, low, high, _STYLES[name])
    entries = [(_STYLES[name], name) for name in _WAY]
    per = len(times) / columns
    if per > 1:
        chart.line((edges[:-1] + edges[1:]) / 2, worst, "k0 thin")
        entries.append(("k0 thin", f"slowest of about {per:.0f} keyframes (bars: their mean)"))
    if 1.5 * most > latency_ledger.TARGET_MS:
        chart.level(latency_ledger.TARGET_MS, f"{latency_ledger.TARGET_MS:.0f} ms")
    return page.chart(chart.svg(), "Delay of each keyframe", legend=charts.legend(entries), is_wide=True)


def _delay_histogram(times: Sequence[KeyframeTimes]) -> str:
    delays = latency_ledger.durations_ms(times, *DELAY)
    delays = delays[np.isfinite(delays)]
    if len(delays) < 2:
        return ""
    p50, p95, p99 = np.percentile(delays, (50, 95, 99))
    end = max(min(float(delays.max()), 2.5 * float(p99)), 1e-3)
    bins = int(min(_BINS, max(8, 2 * len(delays) ** 0.5)))
    counts, edges = np.histogram(np.minimum(delays, end), bins=bins, range=(0, end))
    more = "" if end >= delays.max() else " (the last bar: that, or more)"
    chart = Chart(
        Axis(0, end, f"delay, ms{more}", 10), Axis(0, float(counts.max()) * 1.3, "keyframes"),
        "Distribution of the delay", width=1060, height=230,
    )  # fmt: skip
    chart.bars(edges, np.zeros(bins), counts.astype(np.float64), "k5 apart")
    chart.mark(float(p50), f"p50 {p50:.0f} ms")
    chart.mark(min(float(p95), end), f"p95 {p95:.0f} ms", 1)
    return page.chart(chart.svg(), "Its distribution", is_wide=True)


def _mean(values: NDArray[np.float64], which: NDArray[np.int64], columns: int) -> NDArray[np.float64]:
    known = np.isfinite(values)
    count = np.bincount(which[known], minlength=columns)
    total = np.bincount(which[known], values[known].clip(min=0), columns)
    mean: NDArray[np.float64] = total / np.maximum(count, 1)
    return mean


def growth(found: RunFindings) -> str:
    """Return the HTML of charts of blocks, memory and waiting keyframes over time."""
    columns = found.growth
    seconds = columns.get("seconds", np.zeros(0))
    if len(seconds) < 2:
        return page.note("Not known: the run was too short, or is of a version that did not write it down.")
    end = float(seconds.max())
    shown = []
    memory = [  # all zeros if unknown: the server is not the run's own
        (columns[name] / 1e6, style, text)
        for name, style, text in _MEMORY
        if name in columns and columns[name].any()
    ]
    if memory:
        shown.append(_over_time(seconds, end, memory, "MB", "Memory"))
    if "blocks" in columns:
        shown.append(_over_time(seconds, end, [(columns["blocks"], "k5", "")], "blocks of 8³ voxels", "Map"))
    if "waiting" in columns and columns["waiting"].max() > 3:
        waiting = [(columns["waiting"], "k6", "")]
        shown.append(_over_time(seconds, end, waiting, "keyframes", "Keyframes that wait to be fused"))
    return page.pair(*shown)


_MEMORY = (("map_bytes", "k5", "map"), ("server_bytes", "k1", "server, both processes"))


def _over_time(
    seconds: NDArray[np.float64],
    end: float,
    lines: list[tuple[NDArray[np.float64], str, str]],
    unit: str,
    title: str,
) -> str:
    most = max(float(values.max()) for values, _, _ in lines)
    chart = Chart(Axis(0, end, "s"), Axis(0, 1.08 * most or 1.0, unit), title)
    for values, style, _ in lines:
        chart.line(seconds, values, style)
    entries = [(style, text) for _, style, text in lines if text]
    return page.chart(chart.svg(), title, legend=charts.legend(entries) if entries else "")


def trajectory_errors(found: MapFindings, *, is_given: bool) -> str:
    """Return the HTML of trajectory errors, a table and a chart along the path; empty without a reference."""
    rows, lines = [], []
    for key, name, text in _ERRORS:
        error: TrajectoryError | None = getattr(found.figures, key)
        if error is None or is_given:
            continue
        figures = (error.rmse, error.mean, error.median, error.std, error.min, error.max)
        drift, length = f"{figure(error.drift_percent)} %", f"{figure(error.length, 3)} m"
        rows.append((text, *map(_metres, figures), drift, length))
        if (line := _error_along(found, name)) is not None:
            lines.append((*line, f"k{6 if key == 'corrected_error' else 5}", text))
    if not rows:
        return ""
    head = ("absolute trajectory error", "RMSE", "mean", "median", "std", "min", "max", "drift", "length")
    table = page.table(head, rows)
    if not lines:
        return table
    unit, factor = ("mm", 1000.0) if max(float(each[1].max()) for each in lines) < 1 else ("m", 1.0)
    end = max(float(each[0].max()) for each in lines)
    most = factor * max(float(each[1].max()) for each in lines)
    chart = Chart(
        Axis(0, end, "way, m", 10), Axis(0, 1.08 * most, f"error, {unit}"), "Error along the way",
        width=1060, height=250,
    )  # fmt: skip
    for way, along, style, _ in lines:
        chart.line(way, factor * along, style)
    entries = [(style, text) for _, _, style, text in lines]
    return table + page.chart(chart.svg(), "Error along the way", legend=charts.legend(entries), is_wide=True)


_ERRORS = (
    ("trajectory_error", "trajectory", "as tracked"),
    ("corrected_error", "trajectory-corrected", "after loop closure"),
)


def _error_along(found: MapFindings, name: str) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
    """Return path lengths and errors after alignment, metres, of frames with a reference pose, or None."""
    if name not in found.paths or "reference" not in found.paths:
        return None
    (stamps, poses), (stamps_true, truth) = found.paths[name], found.paths["reference"]
    assert stamps is not None  # both are of the TUM format
    assert stamps_true is not None
    try:
        a, b = trajectory_error.associate(stamps, stamps_true, 1000)
    except DatasetError:
        return None
    aligned, places = trajectory_error.aligned_to(poses[a], truth[b])[:, :3, 3], truth[b][:, :3, 3]
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)]), np.linalg.norm(aligned - places, axis=1)


def keyframes(record: RunRecord) -> str:
    """Return the HTML of a table of what became of frames and keyframes."""
    rejected = {
        f"{name} ({SKIP_REASONS[name]})" if name in SKIP_REASONS else name: n
        for name, n in record.keyframes_rejected.items()
    }
    fused, seconds, tracking = record.keyframes_fused, record.seconds, record.tracking_cpu_ms
    found = [  # by a scan
        ("frames", f"{record.frames_tracked} of {record.frames} localised" if record.frames else ""),
        ("localizer", record.localizer),
        ("tracking", f"{tracking:.1f} CPU ms a frame" if tracking else ""),
        ("chosen by", counted(record.keyframes_by_rule)),
    ]
    return page.facts([
        *(found if record.kind == "scan" else ()),
        ("left out", counted(record.frames_skipped)),
        ("keyframes", f"{fused} of {record.keyframes_sent} sent are fused"),
        ("not in the map", counted(rejected)),
        ("time", f"{seconds:.1f} s, {figure(fused / seconds)} keyframes/s" if seconds else ""),
    ])  # fmt: skip


def setting(record: RunRecord) -> str:
    """Return the HTML of a table of a run's machine, software and settings."""
    made = record.made or Circumstances()
    machine = [made.cpu, f"{made.cores} cores" if made.cores else "",
               size(made.memory_bytes) if made.memory_bytes else ""]  # fmt: skip
    rows = [
        ("command", made.command),
        ("camera", record.camera),
        ("folder", record.folder),
        ("machine", ", ".join(filter(None, machine))),
        ("host", made.host),
        ("peak memory", ", ".join(f"{name} {size(peak)}" for name, peak in record.peak_rss_bytes.items())),
        ("software", ", ".join(f"{name} {version}" for name, version in record.versions.items())),
    ]
    settings = json.dumps(record.config, indent=2, ensure_ascii=False)
    return page.facts(rows) + (page.folded("all settings", settings) if record.config else "")


def files(found: RunFindings) -> str:
    """Return the HTML of a table of the folder's files and their sizes."""
    return page.facts((name, size(nbytes)) for name, nbytes in found.files.items())


def map_facts(figures: MapResult) -> str:
    """Return the HTML of a table of a map's figures."""
    mesh = figures.mesh
    size_m = " × ".join(f"{length:.2f}" for length in mesh.get("extent_m", ()))
    up = mesh.get("up")
    islands = mesh.get("islands")
    direction = " ".join(f"{round(x, 3) + 0.0:.3f}" for x in up["direction"]) if up else ""
    moved = figures.keyframes_moved
    return page.facts([
        ("extent", f"{size_m} m" if size_m else ""),
        ("mesh", f"{grouped(mesh['vertices'])} vertices, {grouped(mesh['triangles'])} triangles"
         if mesh else ""),
        ("islands", f"{grouped(islands)} ({grouped(mesh['island_triangles'])} triangles)" if islands else ""),
        ("up", f"{direction} (by {up['found_by']})" if up else ""),
        ("blocks", grouped(figures.blocks) if figures.blocks else ""),
        ("hash", figures.map_hash),
        ("loops closed", str(figures.loops or "")),
        ("keyframes moved", f"{moved} in {figures.moving_s:.1f} s" if moved else ""),
    ])  # fmt: skip


def extent(mesh: dict[str, Any]) -> str:
    """Return the extent of a mesh (its figures) as a short text."""
    lengths = (f"{length:.{0 if length >= 10 else 1}f}" for length in mesh["extent_m"])
    return "\u2009×\u2009".join(lengths) + " m"


def _milliseconds(one: Spread) -> list[str]:
    return [f"{value:.1f}" for value in (one.mean, one.p50, one.p95, one.p99, one.max)]


def _metres(value: float) -> str:
    return f"{1000 * value:.1f} mm" if abs(value) < 1 else f"{value:.2f} m"
