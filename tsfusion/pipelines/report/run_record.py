# SPDX-License-Identifier: MIT
"""Write and read the record of a run, `run.json`; read the other files of a run's folder."""

import csv
import os
import platform
import re
import shlex
import sys
import time
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from tsfusion.core import process
from tsfusion.core.errors import DatasetError, OutputError
from tsfusion.core.headline import Severity
from tsfusion.core.output_folder import RECORD
from tsfusion.core.process import chosen_engine, version_of
from tsfusion.core.readable_numbers import count_of, counted
from tsfusion.datasets.trajectory_files import read_poses
from tsfusion.evaluation.trajectory_error import TrajectoryError
from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.se3 import Poses
from tsfusion.geometry.up_direction import Up
from tsfusion.pipelines.report import shortfall
from tsfusion.wire.messages.health import Spread
from tsfusion.wire.messages.messages import KeyframeTimes

RunKind = Literal["replay", "scan"]
_EARLIER = {"dataset": "source"}  # names that earlier versions wrote → names of today
Paths = dict[str, tuple[NDArray[np.int64] | None, Poses]]  # of a file's name, timestamps and poses
PATHS = ("trajectory", "trajectory-corrected", "reference", "keyframes")


class Verdict(Struct, frozen=True):
    """Judgement on a run in one sentence, by its worst finding.

    Attributes:
        level: severity of the worst finding. With `bad` the command ends with status 1.
        text: without a full stop.
    """

    level: Severity
    text: str

    @property
    def headline(self) -> str:
        """The sentence with a capital and a full stop, for the top of a page."""
        end = "" if self.text.endswith((".", ")")) else "."
        return f"{self.text[:1].upper()}{self.text[1:]}{end if self.level != 'bad' else ''}"


class Circumstances(Struct, frozen=True, kw_only=True):
    """Time and machine of a run's end, and its command. `finished` is local time."""

    finished: str = ""
    command: str = ""  # empty = it was not started by the `tsfusion` command
    host: str = ""
    cpu: str = ""
    cores: int = 0
    memory_bytes: int = 0


class Accuracy(Struct, frozen=True):
    """Distance from the mesh's vertices to the known surface, millimetres."""

    vertices: int
    mean_mm: float
    p50_mm: float
    p95_mm: float
    rmse_mm: float
    max_mm: float

    @classmethod
    def of(cls, error_mm: NDArray[np.float64]) -> "Accuracy":
        """Return the figures of (n,) distances from the known surface, millimetres."""
        p50, p95 = np.percentile(error_mm, (50, 95))
        rmse = np.sqrt(np.mean(error_mm**2))
        figures = (error_mm.mean(), p50, p95, rmse, error_mm.max())
        return cls(len(error_mm), *(round(float(x), 3) for x in figures))


class MapResult(Struct, frozen=True, kw_only=True):
    """Figures of one submap. Figures of the map are empty if a scan sends to a server elsewhere."""

    name: str = ""
    frames: int = 0  # that have a pose
    keyframes: int = 0  # of them, sent to the map
    loops: int = 0  # closed by loop closure
    trajectory_error: TrajectoryError | None = None  # as tracked; None if the source has no poses
    corrected_error: TrajectoryError | None = None  # after loop closure; None without corrections
    # Median of the errors to expect of a pose relative to its tracking keyframe; None = not known
    expected_error_mm: float | None = None
    expected_error_deg: float | None = None
    map_hash: str = ""
    keyframes_moved: int = 0  # number of moves of keyframes to corrected poses
    moving_s: float = 0.0  # seconds for that
    corrections_unavailable: int = 0  # corrected keyframes that could not be moved: the log says why
    blocks: int = 0
    mesh: dict[str, Any] = {}  # `Mesh.figures`, and what `mesh_finishing.write` left out


class RunRecord(Struct, frozen=True, kw_only=True):
    """Contents of `run.json`. Figures that older versions did not write have a default."""

    kind: RunKind
    source: str
    folder: str = ""  # where this file was written
    camera: str = ""  # intrinsics, image size and where they came from; empty = no images
    localizer: str = ""
    complete: bool = True  # False after a failure, and for a recording after Ctrl-C
    frames: int = 0
    frames_tracked: int = 0
    frames_skipped: dict[str, int] = {}  # left out, by reason
    keyframes_sent: int
    keyframes_durable: int = 0
    keyframes_fused: int = 0
    keyframes_rejected: dict[str, int] = {}
    keyframes_by_rule: dict[str, int] = {}
    warnings: list[str] = []  # what is odd about the recording, a sentence each
    missed: str = ""  # how the run fell short of its goal, if it did
    verdict: Verdict | None = None  # the headline; None until it is known
    left: int = 0  # keyframes still in the spool at the end
    link: str = ""  # why the server took nothing at the end, if so
    seconds: float = 0.0  # from the first frame until the last keyframe was fused (a scan elsewhere: sent)
    server_start_seconds: float | None = None  # None if the server ran already
    tracking_cpu_ms: float = 0.0  # CPU milliseconds of the localizer a frame
    color_delay_ms: float = 0.0  # by which colour is later than depth, as the localizer estimates it
    map_hash: str = ""  # of the first map, as are `blocks` and `mesh`
    blocks: int = 0
    mesh: dict[str, Any] = {}
    accuracy: Accuracy | None = None  # of the first map's mesh; None if the true surface is unknown
    maps: list[MapResult] = []
    origin_m: tuple[int, int, int] | None = None  # subtracted from given positions; None = nothing
    delay_ms: Spread = Spread()
    delay_slope_ms_per_keyframe: float = 0.0
    stages_ms: dict[str, Spread] = {}
    clock_bound_ms: float | None = None
    peak_rss_bytes: dict[str, int] = {}
    config: dict[str, Any] = {}
    versions: dict[str, str] = {}
    made: Circumstances | None = None


def verdict(record: RunRecord) -> Verdict:
    """Judge a finished run by its record: is it complete, and does anything look wrong?"""
    if record.missed:
        return Verdict("bad", record.missed)
    sent, fused, rejected = record.keyframes_sent, record.keyframes_fused, record.keyframes_rejected
    fate = f"{count_of(sent, 'keyframe was', 'keyframes were')} fused"
    if fused + sum(rejected.values()) < sent == record.keyframes_durable:
        fate = f"{count_of(sent, 'keyframe is', 'keyframes are')} at the server, {fused} fused so far"
        fused = sent
    lost, skipped = record.frames - record.frames_tracked, record.frames_skipped
    notices = [
        "" if record.complete else "the source was not read to its end",
        f"{count_of(lost, 'frame was', 'frames were')} not localised" if lost else "",
        f"frames left out: {counted(skipped)}" if skipped else "",
        f"not in the map: {counted(rejected)}" if rejected else "",
        "see the warnings" if record.warnings else "",
    ]
    if any(notices) or fused < sent:
        return Verdict("notice", shortfall.together((f"{fused} of {fate}", *notices)))
    return Verdict("good", f"complete: all {fate}")


def read(folder: Path) -> RunRecord:
    """Read the record in a run's folder. The run may be of an older version.

    Raises:
        OutputError: when it cannot be read, or is not the record of a run.
    """
    path = folder / RECORD
    try:
        found = msgspec.json.decode(path.read_bytes())
        if not isinstance(found, dict) or not ({"dataset", "source"} & found.keys()):
            raise OutputError(f"{path} is not the record of a run; expected that of replay, scan or demo")
        return msgspec.convert(_of_today(found), RunRecord)
    except (OSError, msgspec.MsgspecError, RecursionError) as error:
        raise OutputError(f"cannot read {path}: {error}; expected the results of a run") from error


def _of_today(found: dict[str, Any]) -> dict[str, Any]:
    """Convert the record of an older version, whose figures of the only map were at the top level."""
    kind = "replay" if "dataset" in found else "scan"
    renamed = {"kind": kind} | {_EARLIER.get(name, name): value for name, value in found.items()}
    own = {name: renamed[name] for name in ("map_hash", "blocks", "mesh") if name in renamed}
    return {"maps": [own]} | renamed


def write(work: Path, record: Struct) -> None:
    """Write the record of a run as `run.json` into the folder `work`."""
    text = msgspec.json.format(msgspec.json.encode(record), indent=2)
    (work / RECORD).write_bytes(text + b"\n")


def circumstances() -> Circumstances:
    """Return when, where and by which command this process runs."""
    started = Path(sys.argv[0])
    is_command = started.stem == "tsfusion" or (
        started.name == "__main__.py" and started.parent.name == "tsfusion"
    )
    return Circumstances(
        finished=time.strftime("%Y-%m-%d %H:%M"),
        command=shlex.join(["tsfusion", *sys.argv[1:]]) if is_command else "",
        host=platform.node(),
        cpu=_cpu(),
        cores=os.cpu_count() or 0,
        memory_bytes=process.physical_memory_bytes(),
    )


def _cpu() -> str:
    """Return the name of the processor, or the architecture if the system does not tell the name."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.machine()


def versions() -> dict[str, str]:
    """Return the versions of Python, the platform, tsfusion and its main packages."""
    packages = f"tsfusion {chosen_engine()} numpy opencv-python-headless pyzmq trimesh mcap msgspec zstandard"
    found = {"python": platform.python_version(), "platform": platform.platform()}
    return found | {name: version_of(name) for name in packages.split()}


@dataclass
class MapFindings:
    """Results of one map of a run, as read from the run's folder.

    Attributes:
        mesh: None if the folder has no mesh, for example because the map is on a server.
        error_m: (n,) signed metres of the vertices from the true surface; None if that is unknown.
        paths: trajectories by the name of their file without its ending.
    """

    figures: MapResult
    mesh: Mesh | None = None
    error_m: NDArray[np.float32] | None = None
    paths: Paths = field(default_factory=dict)


@dataclass
class RunFindings:
    """Results of a run, as read from its folder.

    Attributes:
        record: its `run.json`.
        times: stamps of its keyframes; empty if unknown.
        growth: columns of `growth.csv`; empty if unknown.
        files: name and bytes of each file in its folder.
    """

    record: RunRecord
    maps: list[MapFindings]
    times: list[KeyframeTimes]
    growth: dict[str, NDArray[np.float64]]
    files: dict[str, int]


def is_run(folder: Path) -> bool:
    return (folder / RECORD).is_file()


def read_findings(folder: Path, meshes: dict[str, Mesh] | None = None) -> RunFindings:
    """Read the folder of a run.

    Args:
        meshes: meshes just written, by file name; the others are read.

    Raises:
        OutputError: when a file cannot be read, or `run.json` is not the record of a run.
    """
    record = read(folder)
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
        loaded = trimesh.load(path, process=False)
        arrays = (
            np.float32(loaded.vertices),
            np.int32(loaded.faces),
            np.float32(loaded.vertex_normals),
        )
    except (ValueError, IndexError, KeyError, AttributeError, OSError) as error:
        raise OutputError(f"cannot read {path}: {error}; is the file damaged?") from error
    if not len(arrays[1]):
        return None
    colors = np.asarray(loaded.visual.vertex_colors)[:, :3] if loaded.visual.kind == "vertex" else None
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
    """Return the time of a run's end: from its record, else its folder's name, else its file's time."""
    if record.made is not None and record.made.finished:
        return record.made.finished
    named = re.search(r"(\d{4}-\d{2}-\d{2})_(\d{2})-(\d{2})-\d{2}", path.absolute().name)
    if named:
        return f"{named[1]} {named[2]}:{named[3]}"

    return time.strftime("%Y-%m-%d %H:%M", time.localtime((path / RECORD).stat().st_mtime))
