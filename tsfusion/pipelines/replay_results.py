# SPDX-License-Identifier: MIT
"""What a whole run leaves: the mesh, the ledger, and `run.json`."""

import platform
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import msgspec
import numpy as np
from numpy.typing import NDArray

from tsfusion.client import ClientStats
from tsfusion.core.output_folder import RECORD
from tsfusion.geometry.mesh import Mesh
from tsfusion.pipelines import latency_ledger, mesh_preview
from tsfusion.wire.health import Status
from tsfusion.wire.keyframe_times import KeyframeTimes, Spread


@runtime_checkable
class KnownSurface(Protocol):
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


class RunSummary(msgspec.Struct, frozen=True, kw_only=True):
    """What `run.json` holds."""

    dataset: str
    keyframes_sent: int
    keyframes_fused: int
    keyframes_rejected: dict[str, int]
    seconds: float  # first keyframe handed over → last one fused
    server_start_seconds: float | None  # None: the server was there already
    map_hash: str
    blocks: int
    delay_ms: Spread
    delay_slope_ms_per_keyframe: float
    stages_ms: dict[str, Spread]
    clock_bound_ms: float
    mesh: dict[str, int]
    accuracy: Accuracy | None
    peak_rss_bytes: dict[str, int]
    config: dict[str, Any]
    versions: dict[str, str]


@dataclass(kw_only=True)
class Sent:
    """What a scanner saw of its own run.

    Attributes:
        surface: of the world, where it is known.
        seconds: first keyframe handed over to last one fused.
        rate: keyframes a second that were asked for; None = as fast as they are fused.
        ups: (3,) each, the sensor's upward direction at each keyframe: how to hold the picture.
        peak_rss_bytes: of the scanner, while it scanned: drawing the result is not its work.
    """

    name: str
    stats: ClientStats
    surface: KnownSurface | None = None
    records: list[KeyframeTimes] = field(default_factory=list)
    seconds: float = 0.0
    rate: float | None = None
    ups: list[NDArray[np.float64]] = field(default_factory=list)
    peak_rss_bytes: int = 0


def write_mesh(work: Path, mesh: Mesh, ups: Sequence[NDArray[np.float64]], suffix: str = "") -> None:
    """`mesh.ply`, `mesh.glb` and `preview.png`, with `suffix` before the ending."""
    mesh.save(work / f"mesh{suffix}.ply")
    mesh.save(work / f"mesh{suffix}.glb")
    mesh_preview.render(mesh, work / f"preview{suffix}.png", ups=list(ups))


def write_ledger(work: Path, records: list[KeyframeTimes]) -> None:
    """`delay.csv` and `delay.png`."""
    latency_ledger.write_csv(records, work / "delay.csv")
    latency_ledger.plot(records, work / "delay.png")


def write_record(work: Path, summary: msgspec.Struct) -> None:
    """`run.json`."""
    text = msgspec.json.format(msgspec.json.encode(summary), indent=2)
    (work / RECORD).write_bytes(text + b"\n")


def summarise(sent: Sent, mesh: Mesh, status: Status, start_seconds: float | None) -> RunSummary:
    """A run in figures.

    Args:
        start_seconds: of the own server; None: it was there already.
    """
    delays = latency_ledger.summarise(sent.records)
    return RunSummary(
        dataset=sent.name,
        keyframes_sent=sent.stats.sent,
        keyframes_fused=sent.stats.fused,
        keyframes_rejected={**sent.stats.skipped, **sent.stats.refused, **sent.stats.rejected},
        seconds=round(sent.seconds, 3),
        server_start_seconds=None if start_seconds is None else round(start_seconds, 3),
        map_hash=status.map_hash,
        blocks=status.blocks,
        delay_ms=delays.delay_ms,
        delay_slope_ms_per_keyframe=delays.slope_ms_per_keyframe,
        stages_ms=delays.stages_ms,
        clock_bound_ms=delays.clock_bound_ms,
        mesh={"vertices": len(mesh.vertices), "triangles": len(mesh.faces)},
        accuracy=measure(sent.surface, mesh) if sent.surface else None,
        peak_rss_bytes={**server_rss(status), "client": sent.peak_rss_bytes},
        config={**status.config, "rate": sent.rate},
        versions=versions(),
    )


def server_rss(status: Status) -> dict[str, int]:
    """Peak bytes of gateway and fuser, and as `server` of the two together."""
    gateway, fuser = status.peak_rss_bytes["server"], status.peak_rss_bytes["fuser"]
    return {"server": gateway + fuser, "gateway": gateway, "fuser": fuser}


def measure(surface: KnownSurface, mesh: Mesh) -> Accuracy:
    """How far the mesh's vertices are from the known surface."""
    error_mm = 1000 * np.abs(surface.distance(mesh.vertices.astype(np.float64)))
    p50, p95 = np.percentile(error_mm, (50, 95))
    rmse = np.sqrt(np.mean(error_mm**2))
    figures = [round(float(x), 3) for x in (error_mm.mean(), p50, p95, rmse, error_mm.max())]
    return Accuracy(len(error_mm), *figures)


def versions() -> dict[str, str]:
    """Of Python, the platform, tsfusion and what it stands on."""
    packages = (
        "tsfusion",
        "taichi",
        "numpy",
        "opencv-python-headless",
        "pyzmq",
        "trimesh",
        "mcap",
        "msgspec",
        "zstandard",
    )
    found = {"python": platform.python_version(), "platform": platform.platform()}
    for name in packages:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "missing"
    return found
