# SPDX-License-Identifier: MIT
"""Print the summary of a replay or a scan at its end, in a few lines."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from tsfusion.cli import output
from tsfusion.cli.output import counted, grouped, size
from tsfusion.core.headline import MARKS
from tsfusion.core.readable_numbers import count_of
from tsfusion.wire.messages.messages import explained

if TYPE_CHECKING:
    from tsfusion.evaluation.trajectory_error import TrajectoryError
    from tsfusion.pipelines.report.run_record import MapResult, RunRecord


def print_run(run: "RunRecord", spool: Path | None, connect: str | None) -> None:
    """Print a run in a few lines.

    Args:
        spool: folder where a scan's keyframes wait for a server.
        connect: address of the server elsewhere that has the map; None for the run's own server.
    """
    lines = _replay_lines(run) if run.kind == "replay" else _scan_lines(run, spool, connect)
    output.text("\n".join([*_head(run), *lines, _results(run.folder)]), indent=11)


def _replay_lines(run: "RunRecord") -> list[str]:
    delay = run.delay_ms
    lines = [
        f"keyframes  {run.keyframes_fused}/{run.keyframes_sent} fused in {run.seconds:.1f} s, "
        f"lost {sum(run.keyframes_rejected.values())}",
        *_left_out(run),
        f"delay      mean {delay.mean:.0f} ms, p50 {delay.p50:.0f}, p95 {delay.p95:.0f}, "
        f"p99 {delay.p99:.0f}, max {delay.max:.0f}; slope {run.delay_slope_ms_per_keyframe:+.2f} ms/keyframe",
        "stages     "
        + ", ".join(f"{name} {stage.p50:.1f}" for name, stage in run.stages_ms.items())
        + " ms (p50)",
        *mesh_lines(run.mesh),
        f"map        {grouped(run.blocks)} blocks, hash {run.map_hash}",
        "memory     " + ", ".join(f"{name} {size(peak)}" for name, peak in run.peak_rss_bytes.items()),
    ]
    if run.accuracy is not None:
        error = run.accuracy
        lines.append(
            f"accuracy   mean {error.mean_mm:.2f} mm, p50 {error.p50_mm:.2f}, p95 {error.p95_mm:.2f} mm "
            "from the known surface"
        )
    return lines


def _scan_lines(run: "RunRecord", spool: Path | None, connect: str | None) -> list[str]:
    delay = run.delay_ms
    late = f", colour {run.color_delay_ms:+.0f} ms after depth" if run.color_delay_ms else ""
    ended = "" if run.complete else "; the source was not read to its end"
    lines = [
        f"frames     {run.frames_tracked}/{run.frames} localised by {run.localizer}, "
        f"{run.tracking_cpu_ms:.0f} CPU ms each{late}{ended}",
        f"keyframes  {run.keyframes_sent} sent, {run.keyframes_durable} acknowledged, "
        f"{run.keyframes_fused} fused ({counted(run.keyframes_by_rule)}), "
        f"lost {sum(run.keyframes_rejected.values())}",
        f"delay      mean {delay.mean:.0f} ms, p50 {delay.p50:.0f}, p95 {delay.p95:.0f}, max {delay.max:.0f}"
        if delay.count
        else "delay      not known: nothing was fused yet",
        *_left_out(run),
    ]
    for found in run.maps:
        lines += _map_lines(found, given=run.localizer == "given")
    if run.left:
        why = f" ({run.link})" if run.link else ""
        lines.append(
            f"spool      {count_of(run.left, 'keyframe is', 'keyframes are')} not acknowledged{why}: "
            f"`tsfusion spool send --spool {spool}` or the next scan sends them"
        )
    if connect is not None and run.keyframes_durable:
        lines.append(f"mesh       tsfusion mesh {connect} {run.maps[0].name}.glb --map {run.maps[0].name}")
    return lines


def _left_out(run: "RunRecord") -> list[str]:
    """Return lines about frames and keyframes that are not in the map."""
    frames, keyframes = counted(run.frames_skipped), explained(run.keyframes_rejected)
    return [f"left out   {frames}"] * bool(frames) + [f"not in map {keyframes}"] * bool(keyframes)


def _results(folder: str) -> str:
    """Return lines with the files of a run. The report comes last, on its own line."""
    files = sorted(path.name for path in Path(folder).iterdir() if path.is_file())
    rest = " ".join(name for name in files if not name.startswith("report"))
    report = f"\nreport     {folder}/report.html" if "report.html" in files else ""
    return f"results    {folder}/: {rest}{report}"


def mesh_lines(figures: dict[str, Any]) -> list[str]:
    """Return a line about a mesh, and its notes."""
    from tsfusion.geometry.mesh import summarise

    notes = [f"           {note}" for note in mesh_notes(figures)]
    return [f"mesh       {summarise(figures)}", *notes]


def mesh_notes(figures: dict[str, Any]) -> list[str]:
    """Return hints, a line each, about properties of a mesh that the user may want to change."""
    notes = []
    if left_out := figures["left_out"].get("islands"):
        files = " and ".join(figures["left_out"]["files"])
        why = (
            "smaller than --min-component"
            if "min_extent_m" in figures["left_out"]
            else "--keep-islands keeps them"
        )
        notes.append(f"{grouped(left_out)} islands left out of {files} ({why})")
    if texture := figures.get("texture"):
        pages = ", ".join(f"{width}×{height}" for width, height in texture["pages"])
        notes.append(f"texture {pages}; images show {100 * texture['seen']:.0f} % of the surface")
    if figures["up"] is None:
        notes.append("up is not known: GLB and pictures keep the map's axes (--up z, for instance, gives it)")
    return notes


def check(run: "RunRecord") -> None:
    """Raise IncompleteRun if the run fell short of its goal. It gives the last line, and status 1."""
    from tsfusion.core.errors import IncompleteRun

    if run.verdict is not None and run.verdict.level == "bad":
        raise IncompleteRun(run.verdict.text)


def _head(run: "RunRecord") -> list[str]:
    """Return lines with the camera and the verdict. A bad verdict is left to `check`."""
    camera, verdict = [f"camera     {run.camera}"] if run.camera else [], run.verdict
    if verdict is None or verdict.level == "bad":
        return camera
    return [f"{MARKS[verdict.level]} {verdict.headline}", *camera]


def _map_lines(found: "MapResult", *, given: bool) -> list[str]:
    """Return lines about a map. Given poses have no error against themselves."""
    lines = [f"map        {found.name}: {found.frames} frames, {found.keyframes} keyframes"]
    if found.mesh:
        lines += mesh_lines(found.mesh)
    if found.expected_error_mm is not None and found.expected_error_deg is not None:
        lines.append(
            f"expected   {found.expected_error_mm:.3g} mm and {found.expected_error_deg:.3g}° of error "
            "between a frame and its tracking keyframe (median)"
        )
    if found.trajectory_error is not None and not given:
        lines.append(f"ATE        {_ate(found.trajectory_error)}")
    if found.corrected_error is not None:
        lines.append(f"  loops    {_ate(found.corrected_error)} ({found.loops} loops)")
    if stuck := found.corrections_unavailable:
        lines.append(
            f"  not moved {count_of(stuck, 'corrected keyframe')}: the map has them where they were sent"
        )
    if found.keyframes_moved:
        lines.append(f"  moved    {found.keyframes_moved} times a keyframe, in {found.moving_s:.1f} s")
    return lines


def _ate(error: "TrajectoryError") -> str:
    """Return the usual figures of trajectory error on one line, in millimetres below a metre."""
    unit, factor = ("mm", 1000.0) if error.rmse < 1 else ("m", 1.0)
    figures: list[tuple[str, Any]] = [
        (name, factor * getattr(error, name)) for name in ("rmse", "mean", "median", "std", "min", "max")
    ]
    words = ", ".join(f"{name} {value:.3g}" for name, value in figures)
    return f"{words} {unit}; drift {error.drift_percent:.2g} % of {error.length:.3g} m"
