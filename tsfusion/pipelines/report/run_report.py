# SPDX-License-Identifier: MIT
"""Write the report of a run: an HTML page with its results, first in short, then in detail."""

from pathlib import Path

from tsfusion.core.readable_numbers import count_of, counted, figure, grouped, size
from tsfusion.geometry.mesh import Mesh
from tsfusion.pipelines.report import map_sections, page, run_record, run_sections
from tsfusion.pipelines.report.map_sections import ShownMap
from tsfusion.pipelines.report.page import Page, Pictures
from tsfusion.pipelines.report.run_record import Accuracy, MapFindings, MapResult, RunFindings

_MOST_MAPS = 4  # that are shown in pictures
_ELSEWHERE = "The map is on its server, so there is no mesh here: `tsfusion mesh` fetches it."
_GONE = "The mesh of this run is no longer in its folder: `tsfusion mesh` makes one of a kept map."


def write(folder: Path, out: Path, *, meshes: dict[str, Mesh] | None = None) -> list[Path]:
    """Write the report of a run: one page, and its pictures as PNG beside it.

    Args:
        folder: folder of the run's results.
        meshes: meshes just written there, by file name; the others are read.

    Returns:
        The files written, the page last.

    Raises:
        OutputError: when the results cannot be read, or `out` cannot be written.
    """
    found = run_record.read_findings(folder, meshes)
    made, drawn = _page(found, run_record.date_of(found.record, folder))
    return page.write(made.html(), drawn, out)


def _page(found: RunFindings, date: str) -> tuple[Page, Pictures]:
    record = found.record
    verdict = run_record.verdict(record)
    count = f"{record.keyframes_fused} of {count_of(record.keyframes_sent, 'keyframe')} fused"
    version = record.versions.get("tsfusion", "")
    made = Page(
        title=record.source,
        subtitle=f"{record.kind.title()} · {count} · {date} · tsfusion {version}",
        verdict=verdict.headline,
        level=verdict.level,
        warnings=_warnings(found),
        tiles=_tiles(found),
        footer=f"From {record.folder}/run.json. This file needs no network and no other file.",
    )
    drawn: Pictures = {}
    for number, one in enumerate(found.maps[:_MOST_MAPS], 1):
        suffix = f": map {one.figures.name or number}" if len(found.maps) > 1 else ""
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
    """Add the sections of a map to the page. Return the map's pictures."""
    errors = run_sections.trajectory_errors(one, is_given=found.record.localizer == "given")
    if one.mesh is None:
        why = _GONE if one.figures.mesh else _ELSEWHERE
        made.sections += [
            (f"Map{suffix}", page.note(why) + run_sections.map_facts(one.figures)),
            (f"Trajectory{suffix}", map_sections.plan(None, one.paths) + errors),
        ]
        return {}
    shown = ShownMap(one, prefix)
    made.sections += [
        (f"The map from four sides{suffix}", shown.sides() + run_sections.map_facts(one.figures)),
        (f"In 3-D{suffix}", shown.view()),
        (f"Accuracy{suffix}", _accuracy(found.record.accuracy) + shown.error()),
        (f"Trajectory{suffix}", shown.plan() + errors),
    ]
    return shown.pictures


def _accuracy(known: Accuracy | None) -> str:
    """Return the HTML of the surface's error, or of a note that the true surface is not known."""
    if known is None:
        return page.note("The true surface is not known, so there is nothing to compare the mesh with.")
    head = ("distance from the true surface", "mean", "p50", "p95", "RMSE", "max")
    figures = (known.mean_mm, known.p50_mm, known.p95_mm, known.rmse_mm, known.max_mm)
    return page.table(head, [(f"{grouped(known.vertices)} vertices", *(f"{one:.2f} mm" for one in figures))])


def _tiles(found: RunFindings) -> list[tuple[str, str, str]]:
    record, first = found.record, found.maps[0].figures if found.maps else MapResult()
    fused, delay, accuracy = record.keyframes_fused, record.delay_ms, record.accuracy
    tiles = [("keyframes fused", grouped(fused), f"of {grouped(record.keyframes_sent)} sent")]
    if delay.count:
        more = f"median {delay.p50:.0f}, max {delay.max:.0f} ms"
        tiles.append(("delay, 95 % below", f"{delay.p95:.0f} ms", more))
    if record.seconds:
        tiles.append(("time", f"{record.seconds:.1f} s", f"{figure(fused / record.seconds)} keyframes/s"))
    if first.mesh:
        triangles = f"{grouped(first.mesh['triangles'])} triangles"
        tiles.append(("map", run_sections.extent(first.mesh), triangles))
    if accuracy:
        more = f"mean; 95 % below {accuracy.p95_mm:.2f}"
        tiles.append(("error of the surface", f"{accuracy.mean_mm:.2f} mm", more))
    error = first.corrected_error or first.trajectory_error
    if error and record.localizer != "given":
        unit, factor = ("mm", 1000) if error.rmse < 1 else ("m", 1)
        rmse, length = figure(factor * error.rmse, 3), figure(error.length, 3)
        tiles.append(("trajectory error", f"{rmse} {unit}", f"RMSE over {length} m"))
    peaks = record.peak_rss_bytes
    if "server" in peaks:
        tiles.append(("peak memory", size(peaks["server"]), f"server; client {size(peaks.get('client', 0))}"))
    return tiles


def _warnings(found: RunFindings) -> list[str]:
    record = found.record
    lines = [f"{line[:1].upper()}{line[1:]}." for line in record.warnings]
    if record.keyframes_rejected:
        lines.append(f"Not in the map: {counted(record.keyframes_rejected)}.")
    if record.frames_skipped:
        lines.append(f"Frames left out: {counted(record.frames_skipped)}.")
    if lost := record.frames - record.frames_tracked:
        lines.append(f"{count_of(lost, 'frame was', 'frames were')} not localised.")
    if record.left:
        why = f" ({record.link})" if record.link else ""
        lines.append(f"{count_of(record.left, 'keyframe is', 'keyframes are')} still in the spool{why}.")
    if (bound := record.clock_bound_ms or 0) > 5:
        lines.append(
            f"The clocks of client and server agree to ± {bound:.1f} ms only: small delays are not exact."
        )
    for one in found.maps:
        if stuck := one.figures.corrections_unavailable:
            lines.append(f"{count_of(stuck, 'corrected keyframe')} could not be moved.")
        if one.mesh is not None and not one.figures.mesh.get("up"):
            lines.append("Up is not known: pictures have +z above (--up gives it).")
    return lines
