# SPDX-License-Identifier: MIT
"""Define the jobs of workers and their messages. A job reads files and writes files, so it can be repeated.

A worker writes a job's files under new names, and last `NAME.done`, which lists them. So a worker that was
thought dead and goes on does no harm.
"""

import hashlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from tsfusion.core.config import VolumeConfig
from tsfusion.geometry.up_direction import Up

_PART = 1 << 20  # bytes that are read at a time


class JournalKeyframes(Struct, tag="journal", frozen=True):
    """Keyframes of a journal at their final poses.

    Attributes:
        files: segments of the journal, by path or URL.
        file: (n,) index into `files` for each keyframe; `offsets`: byte at which its record begins.
        poses: (n, 12) float64 as bytes: the upper three rows of T_world_camera.
    """

    files: list[str]
    file: list[int]
    offsets: list[int]
    poses: bytes

    def __len__(self) -> int:
        return len(self.offsets)

    def part(self, first: int, stop: int) -> "JournalKeyframes":
        """Return keyframes first … stop-1."""
        poses = self.rows()[first:stop].tobytes()
        return JournalKeyframes(self.files, self.file[first:stop], self.offsets[first:stop], poses)

    def rows(self) -> NDArray[np.float64]:
        """Return the poses as an (n, 12) array."""
        return np.frombuffer(self.poses, np.float64).reshape(-1, 12)


class DatasetKeyframes(Struct, tag="dataset", frozen=True):
    """Keyframes first … stop-1 of a dataset that `open_dataset` opens with these options.

    `state` is a digest of its poses and of its files.
    """

    path: str
    options: dict[str, Any]
    first: int
    stop: int
    state: str = ""

    def __len__(self) -> int:
        return self.stop - self.first

    def part(self, first: int, stop: int) -> "DatasetKeyframes":
        """Return keyframes first … stop-1 of these."""
        return msgspec.structs.replace(self, first=self.first + first, stop=self.first + stop)


KeyframeList = JournalKeyframes | DatasetKeyframes


class Job(Struct, frozen=True, kw_only=True):
    """Fields of every job.

    Attributes:
        name: name of the job, unique in its run.
        folder: folder for its files.
        worker_memory: limit of memory for the whole process, bytes; None for no limit.
        threads: number of threads of the kernels.
    """

    name: str
    folder: str
    worker_memory: int | None = None
    threads: int = 1


class FuseJob(Job, tag="fuse", frozen=True, kw_only=True):
    """Job: fuse keyframes into a map. A map larger than memory is written as several files."""

    config: VolumeConfig
    keyframes: list[KeyframeList]
    sensor: str | None = None  # sensor preset for all keyframes; None = as each names
    world: str = ""  # name of the keyframes' coordinate frame


class Add(Job, tag="add", frozen=True, kw_only=True):
    """Job: add saved maps, voxel by voxel, into one file."""

    files: list[str]


class MeshRunJob(Job, tag="run", frozen=True, kw_only=True):
    """Job: mesh the tiles first ≤ number < stop of a map, for a `MeshMap` job to join."""

    file: str
    view: dict[str, Any]
    first: int
    stop: int


class MeshMap(Job, tag="mesh", frozen=True, kw_only=True):
    """Job: mesh the whole map.

    Attributes:
        file: file of the map.
        runs: files of its `MeshRunJob` jobs, in their order; empty without such jobs.
        view: settings of the surface that differ from the map's.
        up: up direction; None to find it.
        keep_islands: see `mesh_finishing.write`.
    """

    file: str
    view: dict[str, Any]
    runs: list[str] = []
    up: Up | None = None
    keep_islands: bool | None = None


class MeshTile(Job, tag="tile", frozen=True, kw_only=True):
    """Job: mesh the blocks low ≤ (x, y, z) < high of a map. Blocks around them are read, too."""

    file: str
    view: dict[str, Any]
    up: Up | None
    low: tuple[int, int, int]
    high: tuple[int, int, int]


AnyJob = FuseJob | Add | MeshRunJob | MeshMap | MeshTile


class JobProgress(Struct, tag="progress", frozen=True):
    """Progress of a job: how many keyframes it has read, and how many of them are in the map."""

    name: str
    read: int
    fused: int


class JobDone(Struct, tag="done", frozen=True, kw_only=True):
    """Message at the end of a job.

    Attributes:
        files: files written, in the job's folder; `digests` are those of their contents.
        left_out: reason → number of keyframes that the map could not take.
        seconds, cpu_seconds: time that the job took.
        figures: figures of the result.
        base_rss, peak_rss: memory of the process when the job began, and its maximum so far, bytes.
    """

    name: str
    files: list[str]
    seconds: float
    cpu_seconds: float
    base_rss: int
    peak_rss: int
    digests: list[str] = []
    read: int = 0
    fused: int = 0
    left_out: dict[str, int] = {}
    figures: dict[str, Any] = {}


class JobFailed(Struct, tag="failed", frozen=True):
    """Message that no worker can do this job: `kind` of error, and why."""

    name: str
    kind: str
    why: str


class JobLost(Struct, tag="lost", frozen=True):
    """Message that the worker of a job has ended before the job was done."""

    name: str
    why: str


JobMessage = JobProgress | JobDone | JobFailed | JobLost


def digests(folder: Path, files: Iterable[str]) -> list[str]:
    """Return hashes of the contents of files. Raise OSError if a file is missing."""
    found = []
    for name in files:
        digest = hashlib.blake2b(digest_size=16)
        with (folder / name).open("rb") as file:
            while part := file.read(_PART):
                digest.update(part)
        found.append(digest.hexdigest())
    return found


def done_file(folder: Path, name: str) -> Path:
    """Return the path of the file that marks a job as done."""
    return folder / f"{name}.done"
