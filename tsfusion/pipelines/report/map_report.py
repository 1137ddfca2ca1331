# SPDX-License-Identifier: MIT
"""Write the report of a saved map: its surface, keyframes and sessions, and the state of its journal."""

import time
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from tsfusion.core.readable_numbers import OnProgress, count_of, counted, grouped, size
from tsfusion.geometry.se3 import Poses
from tsfusion.journal import inspection, state_folder
from tsfusion.journal.inspection import JournalInfo
from tsfusion.journal.journaled_keyframes import JournaledKeyframes
from tsfusion.pipelines.maps import saved_maps
from tsfusion.pipelines.maps.saved_maps import MapSummary
from tsfusion.pipelines.report import page, run_record, run_sections
from tsfusion.pipelines.report.map_sections import ShownMap
from tsfusion.pipelines.report.page import Page
from tsfusion.pipelines.report.run_record import MapFindings, MapResult, RunRecord
from tsfusion.tsdf.volume import Volume

_NO_DELAY = "A saved map does not hold when its keyframes were fused: a run's report has that."


class AboutMap(NamedTuple):
    """Facts of a saved map without its voxels; `poses` are those of the keyframes in its journal."""

    summary: MapSummary
    journal: JournalInfo | None
    poses: Poses | None


def read(source: Path, name: str | None, watch: OnProgress = lambda _done, _all: None) -> AboutMap:
    """Read the facts of a saved map; see `saved_maps.find`.

    Raises:
        CheckpointError, JournalError: when the map or its journal cannot be read.
    """
    saved = saved_maps.find(source, name)
    summary = saved_maps.summarise(saved)
    if saved.folder is None or not (saved.folder / state_folder.JOURNAL_FOLDER).is_dir():
        return AboutMap(summary, None, None)
    place = state_folder.find_journal(saved.folder)
    return AboutMap(summary, inspection.summarize(place, watch), JournaledKeyframes(place).rows.matrices)


def write(about: AboutMap, file: Path, out: Path, *, memory_bytes: int | None = None) -> list[Path]:
    """Write the report of a map; see `run_report.write`.

    Args:
        file: the map with all that its journal holds.
        memory_bytes: limit of memory for the map.
    """
    volume = Volume.load(file, memory_bytes=memory_bytes)
    mesh, stats = volume.extract_mesh(), volume.stats()
    in_json = msgspec.to_builtins(mesh.figures)
    figures = MapResult(mesh=in_json, blocks=stats.blocks, map_hash=volume.map_hash())
    found = MapFindings(figures, mesh if len(mesh.faces) else None)
    if about.poses is not None and len(about.poses):
        found.paths["keyframes"] = (None, about.poses)
    made = _page(about, stats.keyframes, in_json)
    drawn: page.Pictures = {}
    if found.mesh is None:
        made.sections.append(
            ("The map", page.note("It has no surface yet.") + run_sections.map_facts(figures))
        )
    else:
        shown = ShownMap(found, "")
        made.sections += [
            ("The map from four sides", shown.sides() + run_sections.map_facts(figures)),
            ("In 3-D", shown.view()),
            ("Keyframes", shown.plan()),
        ]
        drawn = shown.pictures
    made.sections += [
        ("Whose keyframes", _sessions(about)),
        ("Journal", _journal(about.journal)),
        (
            "Delay",
            page.note(_NO_DELAY),
        ),
        ("Where and with what", run_sections.setting(_setting(about.summary))),
    ]
    return page.write(made.html(), drawn, out)


def _page(about: AboutMap, keyframes: int, mesh: dict[str, Any]) -> Page:
    summary, journal = about.summary, about.journal
    damaged = [] if journal is None else [one for one in journal.problems if one.kind == "damage"]
    warnings = [f"The journal is damaged: {one.what} ({one.segment})." for one in damaged]
    if summary.rejected:
        warnings.append(f"Not in the map: {counted(summary.rejected)}.")
    if journal is not None and journal.quarantined:
        warnings.append(
            f"{count_of(len(journal.quarantined), 'keyframe is', 'keyframes are')} in quarantine."
        )
    return Page(
        title=Path(summary.path).absolute().parent.name if about.journal else Path(summary.path).name,
        subtitle=f"Saved map · {time.strftime('%Y-%m-%d %H:%M')}",
        verdict=f"{journal.lost} keyframes are lost, at least."
        if journal is not None and damaged
        else "Every byte is as it was written.",
        level="bad" if damaged else "good",
        warnings=warnings,
        tiles=[
            ("keyframes", grouped(keyframes), f"of {count_of(len(summary.sessions), 'session')}"),
            ("map", run_sections.extent(mesh), f"{grouped(mesh['triangles'])} triangles"),
            ("blocks", grouped(summary.blocks), f"of 8³ voxels of {summary.settings['voxel_size']:g} m"),
            ("map file", size(summary.nbytes), f"voxels in memory {size(summary.voxel_bytes)}"),
            *(
                [("journal", size(journal.nbytes), count_of(len(journal.segments), "file"))]
                if journal
                else []
            ),
        ],
        footer=f"From {summary.path}. This file needs no network and no other file.",
    )


def _sessions(about: AboutMap) -> str:
    if about.journal is None:
        rows = [(one.client or one.session[:8], grouped(one.listed)) for one in about.summary.sessions]
        return page.table(("session", "keyframes"), rows) if rows else page.note("Nobody wrote it down.")
    head = ("session", "first keyframe", "seconds", "keyframes", "corrected", "moved at most", "forgotten")
    rows_of_journal = [
        (
            one.client or one.session[:8],
            time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(one.first_logged_ns / 1e9)),
            f"{(one.last_logged_ns - one.first_logged_ns) / 1e9:.1f}",
            *(grouped(count) for count in (one.keyframes, one.corrected)),
            f"{1000 * one.moved_m:.0f} mm" if one.corrected else "",
            grouped(one.forgotten) if one.forgotten else "",
        )
        for one in about.journal.sessions
    ]
    return page.table(head, rows_of_journal)


def _journal(journal: JournalInfo | None) -> str:
    if journal is None:
        return page.note("This map has no journal beside it.")
    rows = [(one.name, size(one.nbytes), grouped(one.keyframes), one.state) for one in journal.segments]
    return page.table(("file", "size", "keyframes", "state"), rows)


def _setting(summary: MapSummary) -> RunRecord:
    return RunRecord(
        kind="replay", source="", folder=summary.path, config=summary.settings, keyframes_sent=0,
        versions=run_record.versions(),
    )  # fmt: skip
