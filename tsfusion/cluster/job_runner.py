# SPDX-License-Identifier: MIT
"""Do a job in this process, which starts Taichi."""

import gc
import secrets
import time
from collections import Counter
from collections.abc import Callable, Generator, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from tsfusion.cluster import jobs, keyframe_sources, tiling
from tsfusion.cluster.jobs import AnyJob, JobDone, JobFailed, JobMessage, JobProgress
from tsfusion.core import process
from tsfusion.core.config import VolumeConfig
from tsfusion.core.durable_files import replacing
from tsfusion.core.errors import (
    DecodeError,
    InvalidConfig,
    InvalidKeyframe,
    KeyframeTooLarge,
    MapError,
    MapFull,
    OutputError,
    TsfusionError,
)
from tsfusion.datasets.dataset import UNREADABLE, UnreadableFrame
from tsfusion.geometry import up_direction
from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.mesh_arrays import Provenance
from tsfusion.geometry.mesh_parts import joined
from tsfusion.geometry.up_direction import SensorPosture
from tsfusion.kernels.base import runtime
from tsfusion.pipelines.maps import mesh_finishing
from tsfusion.tsdf.files import checkpoint, saved_map
from tsfusion.tsdf.files.map_history import HELD
from tsfusion.tsdf.files.saved_map_addition import add_files
from tsfusion.tsdf.surface import mesh_tiles
from tsfusion.tsdf.volume import Volume

_PROGRESS_S = 0.2
_SPARE = 0.15  # share of a worker's memory for rays, chunks and what the allocator keeps
_LEAST_MAP_BYTES = 32 << 20
_MESHING = 1.5  # memory to mesh a map in one piece, as a multiple of its blocks' memory
_MESHING_BYTES = 160 << 20  # memory to mesh part by part, beside the blocks
Doing = Generator[JobProgress, None, dict[str, Any]]  # returns fields of `JobDone`


def run(job: AnyJob) -> Iterator[JobMessage]:
    """Do a job. The last message is `JobDone`, or `JobFailed` if no worker can do the job."""
    folder = Path(job.folder)
    begin, cpu = time.monotonic(), time.process_time()
    base = process.rss_bytes()
    try:
        runtime.start(job.threads)
        made = _DOERS[type(job)](job, folder)
        if isinstance(made, Generator):
            made = yield from made
    except (TsfusionError, MemoryError) as error:
        yield JobFailed(job.name, type(error).__name__, str(error))
        return
    try:
        done = JobDone(
            name=job.name,
            seconds=round(time.monotonic() - begin, 3),
            cpu_seconds=round(time.process_time() - cpu, 3),
            base_rss=base,
            peak_rss=process.peak_rss_bytes(),
            digests=jobs.digests(folder, made["files"]),
            **made,
        )
        with replacing(jobs.done_file(folder, job.name)) as file:
            file.write(msgspec.msgpack.encode(done))
    except OSError as error:
        yield JobFailed(job.name, "OutputError", f"cannot write to {folder}: {error.strerror}")
        return
    yield done


def _new(folder: Path, name: str, suffix: str) -> Path:
    """Return a file path that no earlier attempt at the job has used."""
    return folder / f"{name}-{secrets.token_hex(4)}{suffix}"


# --- fusing ---


class _JobParts:
    """Map of a job's keyframes. At its memory limit it is written to a file, and a new map begins."""

    def __init__(self, job: jobs.FuseJob, folder: Path) -> None:
        self._job, self._folder = job, folder
        self._config: VolumeConfig = job.config
        self.files: list[str] = []
        self.fused = 0
        self._volume = Volume(self._config)
        self._budget: int | None = None  # bytes of blocks, once the first keyframe has loaded all else

    def _limit(self) -> None:
        if self._job.worker_memory is not None and self._budget is None:
            self._budget = _budget(self._job.worker_memory) + self._volume.stats().resident_bytes
        if self._budget is not None:
            self._volume.limit_memory(self._budget)

    def add(self, keyframe: Any) -> None:
        """Add a keyframe to the job's map. Raise MapError as `Volume.integrate` does."""
        if self._job.sensor is not None:
            keyframe = replace(keyframe, sensor=self._job.sensor)
        before = self._volume.keyframes
        try:
            self._volume.integrate(keyframe)
            self._limit()
        except KeyframeTooLarge:
            raise
        except (MemoryError, MapFull) as error:
            if not self._volume.stats().blocks:
                raise OutputError(f"one keyframe alone needs more than a worker's memory: {error}") from error
            self.save()
            self.add(keyframe)
        else:
            self.fused += self._volume.keyframes - before

    def save(self, *, is_last: bool = False) -> None:
        """Write the map to a file of its own, and begin another map unless `is_last`."""
        if not self._volume.stats().blocks and self.files:
            return  # no keyframe came after the last save
        path = _new(self._folder, self._job.name, ".tsf")
        self._volume.save(path, {"world": self._job.world} if self._job.world else None)
        self.files.append(path.name)
        if not is_last:
            del self._volume
            gc.collect()  # Taichi's launches leave cycles around their arguments
            process.give_back_memory()
            self._volume = Volume(self._config)
            self._limit()


def _fuse(job: jobs.FuseJob, folder: Path) -> Doing:
    parts, left_out = _JobParts(job, folder), Counter[str]()
    told, read = time.monotonic(), 0
    for keyframe in keyframe_sources.reading(job.keyframes):
        try:
            parts.add(keyframe())
        except (MapError, DecodeError, InvalidKeyframe) as error:
            left_out[str(error)] += 1
        except UnreadableFrame:
            left_out[UNREADABLE] += 1
        read += 1
        if time.monotonic() - told > _PROGRESS_S:
            told = time.monotonic()
            yield JobProgress(job.name, read, parts.fused)
    parts.save(is_last=True)
    return {"files": parts.files, "read": read, "fused": parts.fused, "left_out": dict(left_out)}


def _budget(worker_memory: int, working: int = 0) -> int:
    """Return the number of bytes that blocks may take.

    Args:
        working: bytes that the job needs beside the blocks and the present memory of the process.
    """
    rest = int(worker_memory * (1 - _SPARE)) - process.rss_bytes() - working
    if rest < _LEAST_MAP_BYTES:
        least = (process.rss_bytes() + working + _LEAST_MAP_BYTES) / (1 - _SPARE)
        raise InvalidConfig(
            f"a worker's memory of {worker_memory / 1e6:.0f} MB is too small for this: give --worker-memory "
            f"{least / 1e6 + 1:.0f}MB or more"
        )
    return rest


# --- adding ---


def _add(job: jobs.Add, folder: Path) -> dict[str, Any]:
    path = _new(folder, job.name, ".tsf")
    files = [folder / name for name in job.files]
    header = add_files(files, path)
    return {
        "files": [path.name],
        "figures": {"map_hash": header.map_hash, "blocks": header.blocks, "keyframes": header.keyframes},
    }


# --- meshing ---


def _run(job: jobs.MeshRunJob, folder: Path) -> dict[str, Any]:
    path = _new(folder, job.name, ".npz")
    tiling.write_run(path, tiling.make_run(folder / job.file, range(job.first, job.stop), job.view))
    return {"files": [path.name]}


def _mesh(job: jobs.MeshMap, folder: Path) -> dict[str, Any]:
    if job.runs:
        return _put_together(job, folder)
    budget = None if job.worker_memory is None else _budget(job.worker_memory, _MESHING_BYTES)
    volume = Volume.load(folder / job.file, memory_bytes=budget, cache=job.folder, **job.view)
    prefix = _new(folder, job.name, "")
    origin = volume.provenance()
    if budget is not None and volume.stats().bytes * _MESHING > budget:
        parts = volume.mesh_parts(folder, up=job.up)
        if not parts.faces:
            return {"files": [], "figures": _plain(parts.figures, is_whole=False)}
        parts.provenance = origin
        files = parts.save(prefix.with_suffix(".ply"))
        return {"files": [file.name for file in files], "figures": _plain(parts.figures, is_whole=False)}
    return _written(job, folder, volume.extract_mesh(), origin)


def _put_together(job: jobs.MeshMap, folder: Path) -> dict[str, Any]:
    with checkpoint.reading(folder / job.file, is_checked=True) as (header, _):
        origin = saved_map.provenance(header.meta, header.keyframes, header.map_hash, header.config)
    runs = [tiling.read_run(folder / name) for name in reversed(job.runs)]
    mesh = joined(list(mesh_tiles.together(runs)))
    return _written(job, folder, replace(mesh, held=SensorPosture(header.meta.get(HELD))), origin)


def _written(job: jobs.MeshMap, folder: Path, mesh: Mesh, origin: Provenance) -> dict[str, Any]:
    """Write the files of the whole mesh. Return the fields of the job's `JobDone`."""
    if not len(mesh.faces):
        return {"files": [], "figures": _plain(mesh.figures, is_whole=True)}
    up = up_direction.find(mesh, mesh.held or SensorPosture(), given=job.up)
    mesh = replace(mesh, known_up=up, provenance=origin)
    prefix = _new(folder, job.name, "")
    made = [prefix.with_suffix(suffix) for suffix in (".ply", ".glb")]
    left_out = mesh_finishing.write(mesh, made, keep_islands=job.keep_islands)
    left_out["files"] = [Path(name).suffix for name in left_out["files"]]
    figures = _plain(mesh.figures, is_whole=True, left_out=left_out)
    return {"files": [file.name for file in made], "figures": figures}


def _plain(figures: dict[str, Any], **more: Any) -> dict[str, Any]:
    """Return the figures of a mesh as values that msgpack can encode."""
    found: dict[str, Any] = msgspec.to_builtins({**figures, **more})
    return found


def _tile(job: jobs.MeshTile, folder: Path) -> dict[str, Any]:
    volume = Volume.load_blocks(folder / job.file, job.low, job.high, is_checked=True, **job.view)
    mesh = volume.extract_mesh(blocks=volume.blocks_within(job.low, job.high))
    if not len(mesh.faces):
        return {"files": []}
    mesh = replace(mesh, known_up=job.up)
    path = mesh.save(_new(folder, job.name, ".glb"))
    return {"files": [path.name], "figures": _tile_figures(mesh)}


def _tile_figures(mesh: Mesh) -> dict[str, Any]:
    turned = mesh.vertices.astype(np.float64) @ (np.eye(3) if mesh.up is None else mesh.up.to_y()).T
    return {
        "vertices": len(mesh.vertices),
        "triangles": len(mesh.faces),
        "low": turned.min(axis=0).tolist(),
        "high": turned.max(axis=0).tolist(),
    }


_DOERS: dict[type, Callable[[Any, Path], Doing | dict[str, Any]]] = {
    jobs.FuseJob: _fuse,
    jobs.Add: _add,
    jobs.MeshRunJob: _run,
    jobs.MeshMap: _mesh,
    jobs.MeshTile: _tile,
}
