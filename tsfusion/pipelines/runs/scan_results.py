# SPDX-License-Identifier: MIT
"""Results of a scan: the trajectories, and the contents of `run.json`."""

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from msgspec import structs

from tsfusion.core.config import ScanConfig, VolumeConfig
from tsfusion.datasets.dataset import UNREADABLE
from tsfusion.datasets.trajectory_files import write_tum
from tsfusion.evaluation.trajectory_error import TrajectoryError, absolute_error
from tsfusion.geometry.origin import Origin
from tsfusion.pipelines.report import findings, latency_ledger, shortfall
from tsfusion.pipelines.report.findings import Circumstances
from tsfusion.pipelines.report.shortfall import Verdict
from tsfusion.pipelines.runs.run_files import WrittenMap
from tsfusion.scanner.localization.localizer import PoseCorrections
from tsfusion.scanner.scanner import Scanner, Submap
from tsfusion.scanner.sources.source import Source
from tsfusion.wire.messages.keyframe_times import KeyframeTimes, Spread


class MapResult(msgspec.Struct, frozen=True, kw_only=True):
    """One submap in figures. With a server elsewhere, nothing is known of the map itself."""

    name: str
    frames: int  # that have a pose
    keyframes: int  # of them, sent to the map
    loops: int  # closed by loop closure
    trajectory_error: TrajectoryError | None  # as tracked, against the source's own poses; None = it has none
    corrected_error: TrajectoryError | None  # after loop closure; None = there were no corrections
    map_hash: str = ""
    keyframes_moved: int = 0  # times that one was fused anew at a corrected pose
    moving_s: float = 0.0  # seconds for that
    corrections_unavailable: int = 0  # corrected keyframes that could not be moved: the log says why
    blocks: int = 0
    mesh: dict[str, Any] = {}  # `Mesh.figures`, and what `mesh_files.write` left out


class ScanSummary(msgspec.Struct, frozen=True, kw_only=True):
    """Contents of `run.json` of a scan."""

    source: str
    folder: str  # where this file was written
    camera: str = ""  # intrinsics, image size and where they came from; empty = no images
    localizer: str
    # Whether the source was read to its end: false after a failure, and for a recording after Ctrl-C
    complete: bool
    frames: int
    frames_tracked: int
    frames_skipped: dict[str, int]
    keyframes_sent: int
    keyframes_durable: int
    keyframes_fused: int
    keyframes_rejected: dict[str, int]
    keyframes_by_rule: dict[str, int]
    warnings: list[str]  # what is odd about the recording, a sentence each
    missed: str  # what the scan was for and did not reach; empty = it did
    verdict: Verdict | None = None  # the headline; None = not known yet
    left: int  # keyframes still in the spool at the end
    link: str  # why the server took nothing at the end; empty = it did
    seconds: float  # from the first frame until the last keyframe was fused (or acknowledged, elsewhere)
    tracking_cpu_ms: float  # CPU milliseconds of the localizer a frame
    maps: list[MapResult]
    origin_m: tuple[int, int, int] | None = None  # what was taken off given positions; None = nothing
    delay_ms: Spread
    peak_rss_bytes: dict[str, int]
    config: dict[str, Any]
    versions: dict[str, str]
    made: Circumstances | None = None


def write_trajectory(work: Path, submap: Submap, suffix: str) -> None:
    """Write `trajectory.txt` of all frames and `keyframes.txt` of those in the map, in the TUM format.

    Where loops were closed, `trajectory-corrected.txt` too; where the source has poses of its own that are
    not these, `reference.txt`.
    """
    track = submap.located
    stamps, tracked = track.stamps_ns, list(track.poses())
    chosen = np.flatnonzero(track.seqs >= 0).tolist()
    write_tum(work / f"trajectory{suffix}.txt", stamps, tracked)
    write_tum(work / f"keyframes{suffix}.txt", [stamps[i] for i in chosen], [tracked[i] for i in chosen])
    which, references = track.with_reference()
    if len(which) and not np.array_equal(track.poses()[which], references):
        write_tum(work / f"reference{suffix}.txt", [stamps[i] for i in which.tolist()], list(references))
    if submap.corrections is not None and submap.corrections.loops:
        now = list(track.poses(submap.corrections))
        write_tum(work / f"trajectory-corrected{suffix}.txt", stamps, now)


def describe(submap: Submap, in_map: WrittenMap | None) -> MapResult:
    """A submap in figures.

    Args:
        in_map: its map, written; None = its server was not asked.
    """
    figures: dict[str, Any] = {}
    if in_map is not None:
        status = in_map.status
        names = ("map_hash", "keyframes_moved", "moving_s", "corrections_unavailable", "blocks")
        figures = {**{name: getattr(status, name) for name in names}, "mesh": in_map.figures}
    corrections = submap.corrections
    return MapResult(
        name=submap.name,
        frames=len(submap.located),
        keyframes=int((submap.located.seqs >= 0).sum()),
        loops=corrections.loops if corrections else 0,
        trajectory_error=_error(submap, None),
        corrected_error=_error(submap, corrections) if corrections else None,
        **figures,
    )


def summarise(
    source: Source,
    scanner: Scanner,
    maps: list[MapResult],
    times: list[KeyframeTimes],
    *,
    folder: Path,
    camera: str,
    localizer: str,
    spool: str | os.PathLike[str],
    complete: bool,
    seconds: float,
    peak_rss_bytes: int,
    config: ScanConfig,
    volume: VolumeConfig | None,
    warnings: Sequence[str],
    missed: Sequence[str],
) -> ScanSummary:
    """A scan in figures.

    Args:
        missed: what else the scan has missed, a sentence each.
    """
    state = scanner.state()
    stats = state.stats
    settings = {"scan": config} if volume is None else {"scan": config, "volume": volume}
    tracking = shortfall.of_tracking(
        state.frames, state.tracked, scanner.last_loss, localizer=localizer,
        maps=sum(bool(submap.located) for submap in scanner.submaps),
    )  # fmt: skip
    made = ScanSummary(
        source=source.name,
        folder=str(folder),
        camera=camera,
        localizer=localizer,
        complete=complete and state.frames + source.skipped.get(UNREADABLE, 0) >= (source.length or 0),
        frames=state.frames,
        frames_tracked=state.tracked,
        frames_skipped=dict(source.skipped),
        keyframes_sent=stats.sent,
        keyframes_durable=stats.durable,
        keyframes_fused=stats.fused,
        keyframes_rejected={**stats.skipped, **stats.refused, **stats.rejected},
        keyframes_by_rule=state.selected,
        warnings=[*warnings, *shortfall.of_sweeps([submap.client for submap in scanner.submaps])],
        missed=shortfall.together(
            (
                *missed,
                tracking,
                shortfall.of_delivery(stats, spool=spool, link=state.link, rejection=scanner.first_rejection),
                shortfall.of_clock(source.skipped),
                shortfall.of_unreadable(source.length or state.frames, source.skipped),
            )
        ),
        left=stats.waiting,
        link=state.link,
        seconds=round(seconds, 3),
        tracking_cpu_ms=round(scanner.tracking_cpu_ms, 3),
        maps=maps,
        origin_m=getattr(Origin.of_world(scanner.submaps[0].client.world), "position", None),
        delay_ms=latency_ledger.summarise(times).delay_ms,
        peak_rss_bytes={"client": peak_rss_bytes},
        config={name: msgspec.to_builtins(each) for name, each in settings.items()},
        versions=findings.versions(),
        made=findings.circumstances(),
    )
    return structs.replace(made, verdict=shortfall.verdict(msgspec.to_builtins(made)))


def records(submaps: list[Submap]) -> list[KeyframeTimes]:
    """Stamps of all submaps' keyframes, one submap after the other."""
    return [record for submap in submaps for record in submap.client.records]


def _error(submap: Submap, corrections: PoseCorrections | None) -> TrajectoryError | None:
    """Error against the source's own poses, over the frames that have one; None = fewer than two have."""
    which, references = submap.located.with_reference()
    if len(which) < 2:
        return None
    return absolute_error(submap.located.poses(corrections)[which], references)
