# SPDX-License-Identifier: MIT
"""Files of a run's folder, read for a report: old runs have fewer, and none of them is required."""

import csv
import re
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import DatasetError, OutputError
from tsfusion.core.output_folder import RECORD
from tsfusion.datasets.trajectory_files import read_poses
from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.se3 import Poses
from tsfusion.geometry.up_direction import Up
from tsfusion.pipelines.report import run_record
from tsfusion.pipelines.report.run_record import MapResult, RunRecord
from tsfusion.wire.messages.messages import KeyframeTimes

Paths = dict[str, tuple[NDArray[np.int64] | None, Poses]]  # of a file's name, timestamps and poses
PATHS = ("trajectory", "trajectory-corrected", "reference", "keyframes")


@dataclass
class MapFindings:
    """A map of a run.

    Attributes:
        mesh: None = the run has none, as it is on a server.
        error_m: (n,) signed metres of the vertices from the true surface; None = nobody knows it.
        paths: trajectories by the name of their file without its ending.
    """

    figures: MapResult
    mesh: Mesh | None = None
    error_m: NDArray[np.float32] | None = None
    paths: Paths = field(default_factory=dict)


@dataclass
class RunFindings:
    """A run.

    Attributes:
        record: its `run.json`.
        times: of its keyframes; empty = not known.
        growth: columns of `growth.csv`; empty = not known.
        files: name and bytes of what is in its folder.
    """

    record: RunRecord
    maps: list[MapFindings]
    times: list[KeyframeTimes]
    growth: dict[str, NDArray[np.float64]]
    files: dict[str, int]


def is_run(folder: Path) -> bool:
    return (folder / RECORD).is_file()


def read(folder: Path, meshes: dict[str, Mesh] | None = None) -> RunFindings:
    """Read the folder of a run.

    Args:
        meshes: those that were just written, by the name of their file; others are read.

    Raises:
        OutputError: when its `run.json` cannot be read or is of no run.
    """
    record = run_record.read(folder)
    maps = []
    for number, one in enumerate(record.maps, 1):
        suffix = "" if number == 1 else f"-{number}"
        found = MapFindings(one)
        found.mesh = _mesh(folder / f"mesh{suffix}.ply", one, meshes or {})
        found.error_m = _errors(folder / f"error{suffix}.npy", found.mesh)
        found.paths = _paths(folder, suffix)
        maps.append(found)
    files = {path.name: path.stat().st_size for path in sorted(folder.iterdir()) if path.is_file()}
    return RunFindings(record, maps, _times(folder / "delay.csv"), _growth(folder / "growth.csv"), files)


def _mesh(path: Path, figures: MapResult, meshes: dict[str, Mesh]) -> Mesh | None:
    if path.name in meshes:
        return meshes[path.name]
    if not path.is_file():
        return None
    import trimesh

    try:
        read = trimesh.load(path, process=False)
        arrays = (np.float32(read.vertices), np.int32(read.faces), np.float32(read.vertex_normals))
    except (ValueError, IndexError, KeyError, AttributeError, OSError) as error:
        raise OutputError(f"cannot read {path}: {error}; is the file damaged?") from error
    if not len(arrays[1]):
        return None
    colors = np.asarray(read.visual.vertex_colors)[:, :3] if read.visual.kind == "vertex" else None
    up = figures.mesh.get("up")
    known = Up(tuple(up["direction"]), up["found_by"]) if up else None
    return Mesh(*arrays, None if colors is None else np.uint8(colors), known_up=known)


def _errors(path: Path, mesh: Mesh | None) -> NDArray[np.float32] | None:
    if mesh is None or not path.is_file():
        return None
    errors: NDArray[np.float32] = np.load(path, allow_pickle=False)
    return errors if errors.shape == (len(mesh.vertices),) else None


def _paths(folder: Path, suffix: str) -> Paths:
    found: Paths = {}
    for name in PATHS:
        path = folder / f"{name}{suffix}.txt"
        if path.is_file():
            try:
                found[name] = read_poses(path)
            except DatasetError as error:
                if path.stat().st_size > 200:  # more than a heading: not just empty
                    raise OutputError(str(error)) from error
    return found


def _times(path: Path) -> list[KeyframeTimes]:
    rows = _rows(path)
    stamps = [name for name in KeyframeTimes.__struct_fields__ if rows and name in rows[0]]
    try:
        return [KeyframeTimes(**{name: int(row[name]) for name in stamps}) for row in rows]
    except (TypeError, ValueError) as error:
        raise OutputError(f"{path} holds a malformed row: {error}") from error


def _growth(path: Path) -> dict[str, NDArray[np.float64]]:
    rows = _rows(path)
    try:
        return {name: np.array([float(row[name]) for row in rows]) for name in (rows[0] if rows else ())}
    except (TypeError, ValueError) as error:
        raise OutputError(f"{path} holds a malformed row: {error}") from error


def _rows(path: Path) -> list[dict[str, str]]:
    if not path.is_file():
        return []
    with path.open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


def date_of(record: RunRecord, path: Path) -> str:
    """Time at which a run ended: as it wrote down, or by its folder's name, or by its file."""
    if record.made is not None and record.made.finished:
        return record.made.finished
    named = re.search(r"(\d{4}-\d{2}-\d{2})_(\d{2})-(\d{2})-\d{2}", path.absolute().name)
    if named:
        return f"{named[1]} {named[2]}:{named[3]}"

    return time.strftime("%Y-%m-%d %H:%M", time.localtime((path / RECORD).stat().st_mtime))
