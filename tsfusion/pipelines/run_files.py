# SPDX-License-Identifier: MIT
"""The files that every whole run leaves: meshes with their pictures, the latency ledger, `run.json`."""

import platform
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from tsfusion.client import ClientStats
from tsfusion.core.output_folder import RECORD
from tsfusion.geometry.mesh import Mesh
from tsfusion.pipelines import latency_ledger, mesh_preview
from tsfusion.pipelines.target_server import Target
from tsfusion.wire.health import Status
from tsfusion.wire.keyframe_times import KeyframeTimes

MAP = "map.tsf"


def write_map(
    work: Path,
    target: Target,
    map_name: str,
    ups: Sequence[NDArray[np.float64]],
    *,
    suffix: str = "",
    min_weight: float | None = None,
) -> tuple[Status, Mesh]:
    """Fetch a map's status and mesh; write `mesh.ply`, `mesh.glb` and `preview.png` unless it is empty.

    Args:
        ups: (3,) each, the sensor's upward direction at each keyframe: how to hold the picture.
        suffix: stands before the endings.
        min_weight: full-confidence samples a voxel needs to be meshed; None = the sensor's.
    """
    status = target.status(map_name)
    mesh = target.mesh(map_name, min_weight=min_weight)
    if len(mesh.faces):
        mesh.save(work / f"mesh{suffix}.ply")
        mesh.save(work / f"mesh{suffix}.glb")
        mesh_preview.render(mesh, work / f"preview{suffix}.png", ups=ups)
    return status, mesh


def write_ledger(work: Path, records: list[KeyframeTimes]) -> None:
    """Write `delay.csv` and `delay.png`."""
    latency_ledger.write_csv(records, work / "delay.csv")
    latency_ledger.plot(records, work / "delay.png")


def write_record(work: Path, summary: msgspec.Struct) -> None:
    """Write `run.json`."""
    text = msgspec.json.format(msgspec.json.encode(summary), indent=2)
    (work / RECORD).write_bytes(text + b"\n")


def no_surface(stats: ClientStats) -> str:
    """The error of a run whose map has no triangles."""
    return (
        f"the map has no surface to write: {stats.fused} of {stats.sent} keyframes fused; scan more of the "
        "scene or lower --min-weight"
    )


def versions() -> dict[str, str]:
    """Versions of Python, the platform, tsfusion and the packages it stands on."""
    packages = "tsfusion taichi numpy opencv-python-headless pyzmq trimesh mcap msgspec zstandard"
    found = {"python": platform.python_version(), "platform": platform.platform()}
    for name in packages.split():
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "missing"
    return found
