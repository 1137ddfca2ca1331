# SPDX-License-Identifier: MIT
"""Figures of a replay, and the contents of its `run.json`."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import msgspec
import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from tsfusion.client import Client
from tsfusion.datasets import Dataset
from tsfusion.datasets.cameras import camera_line
from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.origin import Origin, world_of
from tsfusion.journal.journaled_keyframes import LOST
from tsfusion.pipelines.report import findings, latency_ledger, shortfall
from tsfusion.pipelines.report.findings import Circumstances
from tsfusion.pipelines.report.shortfall import Verdict
from tsfusion.pipelines.runs.run_files import WrittenMap
from tsfusion.wire.messages.health import Status
from tsfusion.wire.messages.keyframe_times import Spread


@runtime_checkable
class DatasetWithSurface(Protocol):
    """A dataset of a world whose surface is known."""

    def distance(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n,) signed metres from (n, 3) points to the true surface."""


class Accuracy(msgspec.Struct, frozen=True):
    """Distance from the mesh's vertices to the known surface, millimetres."""

    vertices: int
    mean_mm: float
    p50_mm: float
    p95_mm: float
    rmse_mm: float
    max_mm: float


class ReplaySummary(msgspec.Struct, frozen=True, kw_only=True):
    """Contents of `run.json` of a replay."""

    dataset: str
    folder: str  # where this file was written
    camera: str = ""  # intrinsics, image size and where they came from; empty = no images
    keyframes_sent: int
    keyframes_fused: int
    keyframes_rejected: dict[str, int]
    frames_skipped: dict[str, int]  # left out at opening, by reason
    warnings: list[str]  # a sentence each
    complete: bool = True  # whether all keyframes were read: false after Ctrl-C or a failure
    missed: str  # what the run was for and did not reach; empty = it did
    verdict: Verdict | None = None  # the headline; None = not known yet
    seconds: float  # first keyframe handed over → last one fused
    server_start_seconds: float | None  # None: the server was there already
    map_hash: str
    blocks: int
    delay_ms: Spread
    delay_slope_ms_per_keyframe: float
    stages_ms: dict[str, Spread]
    clock_bound_ms: float
    origin_m: tuple[int, int, int] | None = None  # what was taken off the positions; None = nothing
    mesh: dict[str, Any]  # `Mesh.figures`, and what `mesh_files.write` left out
    accuracy: Accuracy | None
    peak_rss_bytes: dict[str, int]
    config: dict[str, Any]
    versions: dict[str, str]
    made: Circumstances | None = None


def summarise(
    dataset: Dataset,
    sender: Client,
    written: WrittenMap,
    error_mm: NDArray[np.float64] | None,
    *,
    folder: Path,
    seconds: float,
    rate: float | None,
    peak_rss_bytes: int,
    server_start_seconds: float | None,
    warnings: Sequence[str],
    missed: Sequence[str],
    complete: bool,
) -> ReplaySummary:
    """A replay in figures.

    Args:
        written: the map that the keyframes went into.
        error_mm: of its mesh's vertices (`error_of`); None = the true surface is not known.
        folder: of the results.
        seconds: from the first keyframe handed over to the last one fused.
        rate: keyframes a second that were asked for; None = as fast as they are fused.
        peak_rss_bytes: of the sending process.
        server_start_seconds: of the own server; None = the server was there already.
        warnings: what is odd about the recording, a sentence each.
        missed: what else the replay has missed, a sentence each.
        complete: whether all keyframes were read.
    """
    status, _, figures = written
    stats, delays = sender.stats, latency_ledger.summarise(sender.records)
    made = ReplaySummary(
        dataset=dataset.name,
        folder=str(folder),
        camera=camera_line(dataset),
        keyframes_sent=stats.sent,
        keyframes_fused=stats.fused,
        keyframes_rejected={**stats.skipped, **stats.refused, **stats.rejected},
        frames_skipped=dict(dataset.skipped),
        warnings=[*warnings, *shortfall.of_sweeps([sender])],
        complete=complete,
        missed=shortfall.together(
            (
                shortfall.of_delivery(
                    stats, spool="the spool", link=sender.problem, rejection=sender.first_rejection
                ),
                shortfall.of_damage(dataset.skipped.get(LOST, 0)),
                shortfall.of_unreadable(len(dataset), dataset.skipped),
                shortfall.of_clock(dataset.skipped),
                *missed,
            )
        ),
        seconds=round(seconds, 3),
        server_start_seconds=None if server_start_seconds is None else round(server_start_seconds, 3),
        map_hash=status.map_hash,
        blocks=status.blocks,
        delay_ms=delays.delay_ms,
        delay_slope_ms_per_keyframe=delays.slope_ms_per_keyframe,
        stages_ms=delays.stages_ms,
        clock_bound_ms=delays.clock_bound_ms,
        origin_m=getattr(Origin.of_world(world_of(dataset)), "position", None),
        mesh=figures,
        accuracy=None if error_mm is None else measure(error_mm),
        peak_rss_bytes={**server_rss(status), "client": peak_rss_bytes},
        config={**status.config, "rate": rate},
        versions=findings.versions(),
        made=findings.circumstances(),
    )
    return structs.replace(made, verdict=shortfall.verdict(msgspec.to_builtins(made)))


def server_rss(status: Status) -> dict[str, int]:
    """Peak memory in bytes of gateway and fuser, and as `server` their sum."""
    gateway, fuser = status.peak_rss_bytes["server"], status.peak_rss_bytes["fuser"]
    return {"server": gateway + fuser, "gateway": gateway, "fuser": fuser}


def error_of(dataset: Dataset, mesh: Mesh) -> NDArray[np.float64] | None:
    """(n,) millimetres from the mesh's vertices to the true surface; None = it is not known."""
    if not isinstance(dataset, DatasetWithSurface):
        return None
    return 1000 * np.abs(dataset.distance(mesh.vertices.astype(np.float64)))


def measure(error_mm: NDArray[np.float64]) -> Accuracy:
    """Figures of (n,) distances from the true surface, millimetres."""
    p50, p95 = np.percentile(error_mm, (50, 95))
    rmse = np.sqrt(np.mean(error_mm**2))
    figures = [round(float(x), 3) for x in (error_mm.mean(), p50, p95, rmse, error_mm.max())]
    return Accuracy(len(error_mm), *figures)
