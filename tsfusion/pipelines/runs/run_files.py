# SPDX-License-Identifier: MIT
"""Write the files that every run leaves: meshes, pictures, trajectories, the latency ledger, a report."""

import dataclasses
import logging
import math
import os
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsfusion.client import ClientStats
from tsfusion.datasets.dataset import NOMINAL_NS
from tsfusion.datasets.trajectory_files import write_tum
from tsfusion.evaluation.trajectory_error import TrajectoryError, absolute_error
from tsfusion.geometry import up_direction
from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.mesh_arrays import Provenance
from tsfusion.geometry.up_direction import SensorPosture, Up
from tsfusion.journal.state_folder import check_no_map_of_a_server
from tsfusion.pipelines.maps import mesh_finishing
from tsfusion.pipelines.report import latency_ledger, shortfall
from tsfusion.pipelines.report.run_record import MapResult
from tsfusion.pipelines.runs.target_server import Target
from tsfusion.scanner.localization.localizer import PoseCorrections
from tsfusion.scanner.scanner import Submap
from tsfusion.wire.messages.health import Status
from tsfusion.wire.messages.messages import KeyframeTimes

MAP = "map.tsf"
REPORT = "report.html"
NO_SURFACE = "the map has no surface to write"
MORE_SURFACE = (
    "scan more of the scene, lower --min-weight, or raise --voxel-size where measurements are far apart "
    "(0.1 to 0.2 suits a LiDAR)"
)
log = logging.getLogger(__name__)
_MESH_FILES = (("mesh", ".ply"), ("mesh", ".glb"), ("preview", ".png"))


def check_folder(out: str | os.PathLike[str] | None) -> None:
    """Raise OutputError if a run's `map.tsf` would replace the map of a server."""
    if out is not None:
        check_no_map_of_a_server(Path(out).expanduser() / MAP)


class WrittenMap(NamedTuple):
    """A map whose files were written: its status, mesh and the mesh's figures."""

    status: Status
    mesh: Mesh  # with its `up`
    figures: dict[str, Any]  # of the mesh, and what was `left_out` of some files


class WrittenSubmap(NamedTuple):
    """A submap whose files were written. `in_map` is its map, or None if its server was not asked."""

    figures: MapResult
    in_map: WrittenMap | None
    suffix: str

    @property
    def has_mesh(self) -> bool:
        return self.in_map is not None and len(self.in_map.mesh.faces) > 0


def write_submap(
    work: Path,
    submap: Submap,
    target: Target | None,
    suffix: str,
    *,
    sensor: str,
    is_given: bool,
    **more: Any,
) -> WrittenSubmap:
    """Write the trajectories of a submap, and its mesh; have its map saved at the end of the run.

    Args:
        target: server that has the map; None if it is not to be asked.
        suffix: text before the endings of the files.
        sensor: sensor of its frames.
        is_given: see `write_trajectory`.
        more: arguments of `write_map`.
    """
    if not submap.located:
        return WrittenSubmap(_describe(submap, None), None, suffix)
    write_trajectory(work, submap, suffix, is_given=is_given)
    if target is None:
        return WrittenSubmap(_describe(submap, None), None, suffix)
    target.keep_map(submap.name, work / f"map{suffix}.tsf")
    held = SensorPosture()
    poses = submap.located.poses(submap.corrections)
    for T, force in zip(poses, submap.located.forces(), strict=True):
        held.add(T, sensor, force)
    in_map = write_map(work, target, submap.name, held, suffix=suffix, world=submap.client.world, **more)
    return WrittenSubmap(_describe(submap, in_map), in_map, suffix)


def _describe(submap: Submap, in_map: WrittenMap | None) -> MapResult:
    """Return the figures of a submap for the record of the run."""
    figures: dict[str, Any] = {}
    if in_map is not None:
        names = ("map_hash", "keyframes_moved", "moving_s", "corrections_unavailable", "blocks")
        figures = {**{name: getattr(in_map.status, name) for name in names}, "mesh": in_map.figures}
    corrections = submap.corrections
    deviations = submap.located.deviations()
    known = deviations[~np.isnan(deviations).any(axis=1)]
    place, turn = np.median(known, axis=0).tolist() if len(known) else (None, None)
    return MapResult(
        name=submap.name,
        frames=len(submap.located),
        keyframes=int((submap.located.seqs >= 0).sum()),
        loops=corrections.loops if corrections else 0,
        trajectory_error=_error(submap, None),
        corrected_error=_error(submap, corrections) if corrections else None,
        expected_error_mm=place and round(1e3 * place, 3),
        expected_error_deg=turn and round(math.degrees(turn), 4),
        **figures,
    )


def _error(submap: Submap, corrections: PoseCorrections | None) -> TrajectoryError | None:
    """Return the trajectory's error against the source's poses, or None if fewer than two frames have one."""
    which, references = submap.located.with_reference()
    if len(which) < 2:
        return None
    return absolute_error(submap.located.poses(corrections)[which], references)


def write_map(
    work: Path,
    target: Target,
    map_name: str,
    held: SensorPosture,
    *,
    suffix: str = "",
    world: str = "",
    up: Up | None = None,
    min_weight: float | None = None,
    keep_islands: bool | None = None,
) -> WrittenMap:
    """Fetch a map's status and mesh; write `mesh.ply`, `mesh.glb` and `preview.png` unless it is empty.

    Args:
        held: poses and forces of the sensor, to find the up direction.
        suffix: text before the endings of the files.
        world: name of the coordinate frame of the poses; empty = that of poses given from elsewhere.
        up: up direction in the map's frame; None to find it.
        min_weight: full-confidence samples a voxel needs to be meshed; None = the sensor's.
        keep_islands: see `mesh_finishing.write`.
    """
    status = target.status(map_name)
    mesh = target.mesh(map_name, min_weight=min_weight)
    left_out: dict[str, Any] = {}
    if len(mesh.faces):
        mesh = dataclasses.replace(
            mesh,
            known_up=up_direction.find(mesh, held, given=up),
            provenance=_provenance(status, target, world),
        )
        files = [work / f"{name}{suffix}{ending}" for name, ending in _MESH_FILES]
        left_out = mesh_finishing.write(mesh, files, keep_islands=keep_islands)
    return WrittenMap(status, mesh, {**mesh.figures, "left_out": left_out})


def _provenance(status: Status, target: Target, world: str) -> Provenance:
    """Return the origin of a run's mesh for its files; it has no hash if others may have changed the map."""
    is_own = target.child is not None
    return Provenance(
        source=f"map {status.map}",
        keyframes=status.keyframes_fused,
        map_hash=status.map_hash if is_own else None,
        world=world,
        voxel_size=status.config["volume"]["voxel_size"],
    )


def write_ledger(work: Path, records: list[KeyframeTimes]) -> None:
    """Write the latency ledger: `delay.csv`, and `delay.png` if matplotlib is installed."""
    latency_ledger.write_csv(records, work / "delay.csv")
    if find_spec("matplotlib") is not None:
        latency_ledger.plot(records, work / "delay.png")


def write_trajectory(work: Path, submap: Submap, suffix: str, *, is_given: bool) -> None:
    """Write poses in the TUM format: `keyframes.txt` of those in the map, `trajectory.txt` of all frames.

    After loop closures, also write `trajectory-corrected.txt`. If the source has other poses of its own, also
    write `reference.txt`.

    Args:
        is_given: every frame is a keyframe at the source's pose. Then `keyframes.txt` says all.
    """
    track = submap.located
    poses, chosen = track.poses(), np.flatnonzero(track.seqs >= 0)
    which, references = track.with_reference()
    stamps = np.array(track.stamps_ns, np.int64)
    if is_given and (np.diff(stamps[chosen]) <= 0).any():  # as in a recording without times: they are made up
        stamps = NOMINAL_NS * np.arange(1, len(stamps) + 1)
    _write_tum(work / f"keyframes{suffix}.txt", stamps[chosen], poses[chosen])
    if is_given:
        return
    _write_tum(work / f"trajectory{suffix}.txt", stamps, poses)
    if len(which) and not np.array_equal(poses[which], references):
        _write_tum(work / f"reference{suffix}.txt", stamps[which], references)
    if submap.corrections is not None and submap.corrections.loops:
        _write_tum(work / f"trajectory-corrected{suffix}.txt", stamps, track.poses(submap.corrections))


def _write_tum(path: Path, stamps_ns: NDArray[np.int64], poses: NDArray[np.float64]) -> None:
    write_tum(path, stamps_ns.tolist(), list(poses))


def write_report(work: Path, meshes: dict[str, Mesh]) -> None:
    """Write `report.html` and its pictures. A failure is only logged, because the results are complete.

    Args:
        meshes: meshes just written to `work`, by file name.
    """
    from tsfusion.pipelines.report import run_report

    try:
        run_report.write(work, work / REPORT, meshes=meshes)
    except Exception:
        log.exception("the report could not be written; `tsfusion report` tries again")


def no_surface(stats: ClientStats, rejection: str) -> str:
    """Return the error message of a run whose map has no triangles.

    Args:
        rejection: why the map rejected the first keyframe that it rejected; empty if it took all.
    """
    if lost := shortfall.of_disk(stats):
        return f"{NO_SURFACE}: {lost}"
    why = rejection if not stats.fused and rejection else MORE_SURFACE
    return f"{NO_SURFACE}: {stats.fused} of {stats.sent} keyframes fused; {why}"
