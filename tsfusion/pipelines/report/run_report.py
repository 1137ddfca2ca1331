# SPDX-License-Identifier: MIT
"""The report of a run: what it reached, at a glance and in detail."""

from pathlib import Path
from typing import Any

from tsfusion.core.readable_numbers import count_of, counted, figure, grouped, size
from tsfusion.geometry.mesh import Mesh
from tsfusion.pipelines.report import findings, map_sections, page, run_sections, shortfall
from tsfusion.pipelines.report.findings import MapFindings, RunFindings
from tsfusion.pipelines.report.map_sections import ShownMap
from tsfusion.pipelines.report.page import Page, Pictures

_MOST_MAPS = 4  # that are shown in pictures
_ELSEWHERE = "The map is on its server, so there is no mesh here: `tsfusion mesh` fetches it."
_GONE = "The mesh of this run is no longer in its folder: `tsfusion mesh` makes one of a kept map."


def write(folder: Path, out: Path, *, meshes: dict[str, Mesh] | None = None) -> list[Path]:
    """Write the report of a run: one page, and its pictures as PNG beside it.

    Args:
        folder: of the run's results.
        meshes: that were just written there, by the name of their file; others are read.

    Returns:
        The files written, the page last.

    Raises:
        OutputError: when the results cannot be read, or `out` cannot be written.
    """
    found = findings.read(folder, meshes)
    made, drawn = _page(found, findings.date_of(found.record, folder))
    return page.write(made.html(), drawn, out)


def _page(found: RunFindings, date: str) -> tuple[Page, Pictures]:
    record = found.record
    verdict = shortfall.verdict(record)
    fused, sent = record.get("keyframes_fused", 0), record.get("keyframes_sent", 0)
    count = f"{fused} of {count_of(sent, 'keyframe')} fused"
    version = (record.get("versions") or {}).get("tsfusion", "")
    made = Page(
        title=str(record.get("dataset") or record.get("source")),
        subtitle=f"{_kind(record)} · {count} · {date} · tsfusion {version}",
        verdict=verdict.headline,
        level=verdict.level,
        warnings=_warnings(found),
        tiles=_tiles(found),
        footer=f"From {record.get('folder', '')}/run.json. This file needs no network and no other file.",
    )
    drawn: Pictures = {}
    for number, one in enumerate(found.maps[:_MOST_MAPS], 1):
        suffix = f": map {one.name or number}" if len(found.maps) > 1 else ""
        drawn |= _add_map(made, one, found, suffix=suffix, prefix=f"map{number}-" if number > 1 else "")
    if len(found.maps) > _MOST_MAPS:
        rest = count_of(len(found.maps) - _MOST_MAPS, "more map")
        made.sections.append(("More maps", page.note(f"{rest} of this run: see their files.")))
    made.sections += [
        ("Delay", run_sections.delay(found)),
        ("Map and memory over time", run_sections.growth(found)),
        ("Keyframes", run_sections.keyframes(record)),
        ("Where and with what", run_sections.setting(record)),
        ("Files", run_sections.files(found)),
    ]
    return made, drawn


def _add_map(made: Page, one: MapFindings, found: RunFindings, *, suffix: str, prefix: str) -> Pictures:
    """Add the sections of a map; its pictures."""
    errors = run_sections.trajectory_errors(one, is_given=found.record.get("localizer") == "given")
    if one.mesh is None:
        why = _GONE if one.figures.get("mesh") else _ELSEWHERE
        made.sections += [
            (f"Map{suffix}", page.note(why) + run_sections.map_facts(one.figures)),
            (f"Trajectory{suffix}", map_sections.plan(None, one.paths) + errors),
        ]
        return {}
    shown = ShownMap(one, prefix)
    made.sections += [
        (f"The map from four sides{suffix}", shown.sides() + run_sections.map_facts(one.figures)),
        (f"In 3-D{suffix}", shown.view()),
        (f"Accuracy{suffix}", _accuracy(found.record) + shown.error()),
        (f"Trajectory{suffix}", shown.plan() + errors),
    ]
    return shown.pictures


def _accuracy(record: dict[str, Any]) -> str:
    """The table of the error where the true surface is known; else a word."""
    known = record.get("accuracy")
    if not known:
        return page.note("The true surface is not known, so there is nothing to compare the mesh with.")
    names = ("mean", "p50", "p95", "rmse", "max")
    head = ("distance from the true surface", *(name.upper() if name == "rmse" else name for name in names))
    row = (f"{grouped(known['vertices'])} vertices", *(f"{known[f'{name}_mm']:.2f} mm" for name in names))
    return page.table(head, [row])


def _kind(record: dict[str, Any]) -> str:
    return "Replay" if "dataset" in record else "Scan"


def _tiles(found: RunFindings) -> list[tuple[str, str, str]]:
    record, first = found.record, found.maps[0] if found.maps else MapFindings("", {})
    fused, sent = record.get("keyframes_fused", 0), record.get("keyframes_sent", 0)
    tiles = [("keyframes fused", grouped(fused), f"of {grouped(sent)} sent")]
    delay = record.get("delay_ms") or {}
    if delay.get("count"):
        tiles.append(("delay, 95 % below", f"{delay['p95']:.0f} ms",
                      f"median {delay['p50']:.0f}, max {delay['max']:.0f} ms"))  # fmt: skip
    if seconds := record.get("seconds"):
        tiles.append(("time", f"{seconds:.1f} s", f"{figure(fused / seconds)} keyframes/s"))
    if mesh := first.figures.get("mesh"):
        triangles = f"{grouped(mesh['triangles'])} triangles"
        tiles.append(("map", run_sections.extent(mesh), triangles))
    if accuracy := record.get("accuracy"):
        tiles.append(
            (
                "error of the surface",
                f"{accuracy['mean_mm']:.2f} mm",
                f"mean; 95 % below {accuracy['p95_mm']:.2f}",
            )
        )
    error = first.figures.get("corrected_error") or first.figures.get("trajectory_error")
    if error and record.get("localizer") != "given":
        unit, factor = ("mm", 1000) if error["rmse"] < 1 else ("m", 1)
        tiles.append(
            (
                "trajectory error",
                f"{figure(factor * error['rmse'], 3)} {unit}",
                f"RMSE over {figure(error['length'], 3)} m",
            )
        )
    peaks = record.get("peak_rss_bytes") or {}
    if "server" in peaks:
        tiles.append(("peak memory", size(peaks["server"]), f"server; client {size(peaks.get('client', 0))}"))
    return tiles


def _warnings(found: RunFindings) -> list[str]:
    record = found.record
    lines = [f"{line[:1].upper()}{line[1:]}." for line in record.get("warnings") or ()]
    if rejected := record.get("keyframes_rejected"):
        lines.append(f"Not in the map: {counted(rejected)}.")
    if skipped := record.get("frames_skipped"):
        lines.append(f"Frames left out: {counted(skipped)}.")
    lost = record.get("frames", 0) - record.get("frames_tracked", 0)
    if lost:
        lines.append(f"{count_of(lost, 'frame was', 'frames were')} not localised.")
    if left := record.get("left"):
        why = f" ({record['link']})" if record.get("link") else ""
        lines.append(f"{count_of(left, 'keyframe is', 'keyframes are')} still in the spool{why}.")
    if (bound := record.get("clock_bound_ms") or 0) > 5:
        lines.append(
            f"The clocks of client and server agree to ± {bound:.1f} ms only: small delays are not exact."
        )
    for one in found.maps:
        if stuck := one.figures.get("corrections_unavailable"):
            lines.append(f"{count_of(stuck, 'corrected keyframe')} could not be moved.")
        if one.mesh is not None and not (one.figures.get("mesh") or {}).get("up"):
            lines.append("Up is not known: pictures have +z above (--up gives it).")
    return lines
