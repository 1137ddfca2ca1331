# SPDX-License-Identifier: MIT
"""What a scan leaves: trajectories, the mesh of each submap, and `run.json`."""

from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from tsfusion.core.config import ScanConfig, VolumeConfig
from tsfusion.datasets.trajectory_files import write_tum
from tsfusion.evaluation.trajectory_error import TrajectoryError, absolute_error
from tsfusion.geometry.mesh import Mesh
from tsfusion.pipelines import latency_ledger, replay_results
from tsfusion.scanner.localization.localizer import PoseCorrections
from tsfusion.scanner.scanner import Scanner, Submap
from tsfusion.scanner.sources.source import Source
from tsfusion.wire.health import Status
from tsfusion.wire.keyframe_times import KeyframeTimes, Spread


class MapResult(msgspec.Struct, frozen=True, kw_only=True):
    """One submap.

    Attributes:
        trajectory_error: against the source's own poses, as they were tracked; None = it has none.
        corrected_error: the same after loop closure; None = there were no corrections.
        keyframes, blocks, map_hash, mesh: of the own server's map; 0 and empty with a server elsewhere.
    """

    name: str
    frames: int
    keyframes: int
    loops: int
    trajectory_error: TrajectoryError | None
    corrected_error: TrajectoryError | None
    map_hash: str = ""
    blocks: int = 0
    mesh: dict[str, int] = {}


class ScanSummary(msgspec.Struct, frozen=True, kw_only=True):
    """What `run.json` of a scan holds.

    Attributes:
        complete: whether the source came to its end; not so after a failure, or of a recording after Ctrl-C.
        left: keyframes that are still in the spool.
        link: why the server takes nothing at the moment; empty when it does.
        tracking_cpu_ms: CPU milliseconds of the localizer a frame.
    """

    source: str
    localizer: str
    complete: bool
    frames: int
    frames_tracked: int
    frames_skipped: dict[str, int]
    keyframes_sent: int
    keyframes_durable: int
    keyframes_fused: int
    keyframes_rejected: dict[str, int]
    keyframes_by_rule: dict[str, int]
    left: int
    link: str
    seconds: float
    tracking_cpu_ms: float
    maps: list[MapResult]
    delay_ms: Spread
    peak_rss_bytes: dict[str, int]
    config: dict[str, Any]
    versions: dict[str, str]


def write_trajectory(work: Path, submap: Submap, suffix: str) -> None:
    """In the TUM format: `trajectory.txt` of all frames, `keyframes.txt` of those in the map.

    Where loops were closed `trajectory-corrected.txt`, too.
    """
    track = submap.located
    stamps, tracked = track.stamps_ns, list(track.poses())
    chosen = np.flatnonzero(track.seqs >= 0).tolist()
    write_tum(work / f"trajectory{suffix}.txt", stamps, tracked)
    write_tum(work / f"keyframes{suffix}.txt", [stamps[i] for i in chosen], [tracked[i] for i in chosen])
    if submap.corrections is not None and submap.corrections.loops:
        now = list(track.poses(submap.corrections))
        write_tum(work / f"trajectory-corrected{suffix}.txt", stamps, now)


def describe(submap: Submap, status: Status | None, mesh: Mesh | None) -> MapResult:
    """A submap in figures; its map's only where its server was asked."""
    in_map: dict[str, Any] = {}
    if status is not None and mesh is not None:
        in_map = {
            "map_hash": status.map_hash, "blocks": status.blocks,
            "mesh": {"vertices": len(mesh.vertices), "triangles": len(mesh.faces)},
        }  # fmt: skip
    corrections = submap.corrections
    return MapResult(
        name=submap.name,
        frames=len(submap.located),
        keyframes=int((submap.located.seqs >= 0).sum()),
        loops=corrections.loops if corrections else 0,
        trajectory_error=_error(submap, None),
        corrected_error=_error(submap, corrections) if corrections else None,
        **in_map,
    )


def summarise(
    source: Source,
    scanner: Scanner,
    maps: list[MapResult],
    times: list[KeyframeTimes],
    *,
    localizer: str,
    complete: bool,
    seconds: float,
    peak_rss_bytes: int,
    config: ScanConfig,
    volume: VolumeConfig | None,
) -> ScanSummary:
    """A scan in figures."""
    state = scanner.state()
    stats = state.stats
    settings = {"scan": config} if volume is None else {"scan": config, "volume": volume}
    return ScanSummary(
        source=source.name,
        localizer=localizer,
        complete=complete and state.frames >= (source.length or 0),
        frames=state.frames,
        frames_tracked=state.tracked,
        frames_skipped=dict(source.skipped),
        keyframes_sent=stats.sent,
        keyframes_durable=stats.durable,
        keyframes_fused=stats.fused,
        keyframes_rejected={**stats.skipped, **stats.refused, **stats.rejected},
        keyframes_by_rule=state.selected,
        left=stats.waiting,
        link=state.link,
        seconds=round(seconds, 3),
        tracking_cpu_ms=round(scanner.tracking_cpu_ms, 3),
        maps=maps,
        delay_ms=latency_ledger.summarise(times).delay_ms,
        peak_rss_bytes={"client": peak_rss_bytes},
        config={name: msgspec.to_builtins(each) for name, each in settings.items()},
        versions=replay_results.versions(),
    )


def records(submaps: list[Submap]) -> list[KeyframeTimes]:
    """The ledger of all submaps, one after the other."""
    return [record for submap in submaps for record in submap.client.records]


def _error(submap: Submap, corrections: PoseCorrections | None) -> TrajectoryError | None:
    """Against the source's own poses, over the frames that have one."""
    which, references = submap.located.with_reference()
    if len(which) < 2:
        return None
    return absolute_error(submap.located.poses(corrections)[which], references)
