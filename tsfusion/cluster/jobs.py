# SPDX-License-Identifier: MIT
"""Jobs that workers do, and what they say meanwhile. A job is files in, files out: it can be done twice.

Whoever does a job writes its files under names that nobody has had before, and `NAME.done`, which lists them,
last. A worker that was taken for dead and went on does no harm.
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
        files: segments, by path or URL.
        file: (n,) which of them each is in; `offsets`: where its record begins.
        poses: (n, 12) float64 as bytes, the upper three rows of T_world_camera.
    """

    files: list[str]
    file: list[int]
    offsets: list[int]
    poses: bytes

    def __len__(self) -> int:
        return len(self.offsets)

    def part(self, first: int, stop: int) -> "JournalKeyframes":
        """Keyframes first … stop-1."""
        poses = self.rows()[first:stop].tobytes()
        return JournalKeyframes(self.files, self.file[first:stop], self.offsets[first:stop], poses)

    def rows(self) -> NDArray[np.float64]:
        """(n, 12)."""
        return np.frombuffer(self.poses, np.float64).reshape(-1, 12)


class DatasetKeyframes(Struct, tag="dataset", frozen=True):
    """Keyframes first … stop-1 of a dataset that `open_dataset` opens with these options.

    `state`: digest of its poses, and of which files it has.
    """

    path: str
    options: dict[str, Any]
    first: int
    stop: int
    state: str = ""

    def __len__(self) -> int:
        return self.stop - self.first

    def part(self, first: int, stop: int) -> "DatasetKeyframes":
        """Keyframes first … stop-1 of these."""
        return msgspec.structs.replace(self, first=self.first + first, stop=self.first + stop)


KeyframeList = JournalKeyframes | DatasetKeyframes


class Job(Struct, frozen=True, kw_only=True):
    """Fields of every job.

    Attributes:
        name: of the job, distinct in its run.
        folder: where its files go.
        worker_memory: bytes that the whole process may take; None = no limit.
        threads: of the kernels.
    """

    name: str
    folder: str
    worker_memory: int | None = None
    threads: int = 1


class FuseJob(Job, tag="fuse", frozen=True, kw_only=True):
    """Make a map of keyframes; one that is larger than memory is left in several files."""

    config: VolumeConfig
    keyframes: list[KeyframeList]
    sensor: str | None = None  # preset that all keyframes are taken to be of; None = each as it says
    world: str = ""  # name of the keyframes' coordinate frame


class Add(Job, tag="add", frozen=True, kw_only=True):
    """Add saved maps, in one file."""

    files: list[str]


class MeshRunJob(Job, tag="run", frozen=True, kw_only=True):
    """Mesh some tiles of a map for `MeshMap` (`tsdf.surface.mesh_tiles`): first ≤ number < stop."""

    file: str
    view: dict[str, Any]
    first: int
    stop: int


class MeshMap(Job, tag="mesh", frozen=True, kw_only=True):
    """Mesh the whole map.

    Attributes:
        file: the map.
        runs: files of its `MeshRunJob` jobs, in their order; none = they are not made.
        view: settings of the surface that differ from the map's.
        up: away from the ground; None = it is found.
        keep_islands: as of `mesh_files.write`.
    """

    file: str
    view: dict[str, Any]
    runs: list[str] = []
    up: Up | None = None
    keep_islands: bool | None = None


class MeshTile(Job, tag="tile", frozen=True, kw_only=True):
    """Mesh the cells of blocks low ≤ (x, y, z) < high of a map, with what lies around them."""

    file: str
    view: dict[str, Any]
    up: Up | None
    low: tuple[int, int, int]
    high: tuple[int, int, int]


AnyJob = FuseJob | Add | MeshRunJob | MeshMap | MeshTile


class JobProgress(Struct, tag="progress", frozen=True):
    """Progress of a job: keyframes read, and those of them in the map."""

    name: str
    read: int
    fused: int


class JobDone(Struct, tag="done", frozen=True, kw_only=True):
    """A job is done.

    Attributes:
        files: that it has written, in its folder; `digests` of their contents.
        left_out: reason → number of keyframes that the map could not take.
        seconds, cpu_seconds: that it took.
        figures: of what it made.
        base_rss, peak_rss: memory of the process when the job began, and the most so far, bytes.
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
    """A job cannot be done, by whomever: `kind` of error, and why."""

    name: str
    kind: str
    why: str


class JobLost(Struct, tag="lost", frozen=True):
    """Whoever did a job has ended before it was done."""

    name: str
    why: str


JobMessage = JobProgress | JobDone | JobFailed | JobLost


def digests(folder: Path, files: Iterable[str]) -> list[str]:
    """Digests of the contents of files; raises OSError where one is missing."""
    found = []
    for name in files:
        digest = hashlib.blake2b(digest_size=16)
        with (folder / name).open("rb") as file:
            while part := file.read(_PART):
                digest.update(part)
        found.append(digest.hexdigest())
    return found


def done_file(folder: Path, name: str) -> Path:
    """File in which a job writes that it is done."""
    return folder / f"{name}.done"
