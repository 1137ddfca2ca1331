# SPDX-License-Identifier: MIT
"""Fuse journals and datasets into a map by many workers: fuse shares of keyframes, add them, mesh."""

import hashlib
import os
import shutil
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import msgspec

from tsfusion.cluster import jobs, tiling
from tsfusion.cluster.jobs import JobDone, JobProgress
from tsfusion.cluster.keyframe_sources import WORK, Listed
from tsfusion.cluster.schedulers import CarryingOut, Scheduler
from tsfusion.core import folder_lock, output_folder
from tsfusion.core.config import VIEW_SETTINGS, VolumeConfig
from tsfusion.core.durable_files import make_folder, replacing
from tsfusion.core.errors import InvalidConfig, OutputError, refusals_as
from tsfusion.geometry.up_direction import Up
from tsfusion.pipelines.report import run_record
from tsfusion.pipelines.report.run_record import Circumstances
from tsfusion.pipelines.runs import run_files
from tsfusion.tsdf.files import checkpoint

TILES = "tiles"  # folder of a mesh in tiles
_MOST_KEYFRAMES = 512  # of a job: so many are fused again if its worker is lost
_FAN_IN = 8  # maps added at once: each is read once and needs memory for one chunk
_PLAN = "plan"


class Display(Protocol):
    """Shows the user the progress of a run."""

    def stage(self, text: str) -> None:
        """Announce the next stage of the run."""

    def show_fused(self, read: int, fused: int, total: int) -> None:
        """Show how many keyframes were read, and how many of them are in a map."""

    def show_steps(self, text: str, done: int, total: int) -> None:
        """Show how many of all steps are done; `text` says of what."""


@dataclass(frozen=True, kw_only=True)
class Wishes:
    """Wishes of the user for a run, apart from the settings of the map.

    Attributes:
        up: up direction; None to find it.
        keep_islands: see `mesh_finishing.write`.
        worker_memory: limit of memory for each worker, bytes; None for no limit.
        tile_size: metres, edge of a tile of the mesh. None = tiles of a suitable size, made only if the map
            does not fit into a worker's memory.
        sensor: sensor preset for all keyframes; None for the sensor that each keyframe names.
    """

    up: Up | None = None
    keep_islands: bool | None = None
    worker_memory: int | None = None
    tile_size: float | None = None
    sensor: str | None = None


class FusedRun(msgspec.Struct, frozen=True, kw_only=True):
    """Contents of `run.json`.

    Attributes:
        keyframes: number of keyframes read; `keyframes_fused` of them are in the map.
        keyframes_lost: number (or more) that damage in the journals has destroyed.
        workers, scheduler: number of workers, and the name of their scheduler.
        workers_lost: how often a worker ended before its job was done.
        jobs, jobs_found: number of all jobs, and of those that an earlier run had done.
        seconds: wall time by step; `worker_seconds`: CPU time of its jobs.
        worker_peak_rss: peak memory of any worker, bytes.
        tiles: number of tiles of the mesh.
    """

    kind: str = "fuse"
    sources: list[str]
    folder: str
    keyframes: int
    keyframes_fused: int
    keyframes_rejected: dict[str, int]
    keyframes_lost: int
    map_hash: str
    blocks: int
    workers: int
    scheduler: str
    workers_lost: int
    jobs: int
    jobs_found: int
    seconds: dict[str, float]
    worker_seconds: dict[str, float]
    worker_peak_rss: int
    worker_memory: int | None
    mesh: dict[str, Any]
    tiles: int
    config: dict[str, Any]
    versions: dict[str, str]
    made: Circumstances


@dataclass
class _Clock:
    """Measured time of each step of a run, and memory of its workers."""

    seconds: dict[str, float] = field(default_factory=dict)
    worker_seconds: dict[str, float] = field(default_factory=dict)
    peak_rss: int = 0
    base_rss: int = 0
    jobs: int = 0

    @contextmanager
    def step(self, name: str) -> Iterator[list[JobDone]]:
        """Time a step. The block fills the list with the `JobDone` messages of its jobs."""
        begin, ended = time.monotonic(), list[JobDone]()
        yield ended
        self.seconds[name] = round(time.monotonic() - begin, 3)
        self.worker_seconds[name] = round(sum(one.cpu_seconds for one in ended), 3)
        self.jobs += len(ended)
        self.peak_rss = max([self.peak_rss, *(one.peak_rss for one in ended)])
        self.base_rss = max([self.base_rss, *(one.base_rss for one in ended)])


def check(config: VolumeConfig) -> None:
    """Raise InvalidConfig for settings with which the sum of maps depends on how keyframes are shared out."""
    if config.checked_model().regularizer != "off":
        raise InvalidConfig(
            "smoothing along rays depends on the order of keyframes, so that parts of it do not add up: fuse "
            "with regularizer = off (the surface `field` smooths afterwards)"
        )


def fuse(
    found: Listed,
    config: VolumeConfig,
    out: Path | None,
    make_scheduler: Callable[[], Scheduler],
    display: Display,
    *,
    wishes: Wishes | None = None,
    overwrite: bool = False,
) -> FusedRun:
    """Fuse keyframes with a scheduler's workers, and leave the results in a folder.

    An interrupted run goes on when it is started again with the same keyframes, settings and folder.

    Args:
        out: folder of `map.tsf`, `mesh.ply`, `mesh.glb`, `run.json`; None = a dated one.
        make_scheduler: starts the scheduler, which is closed at the end.

    Raises:
        InvalidConfig: for settings with which maps of parts do not add up.
        OutputError: when `out` cannot be written, or holds files already; for a map without a surface.
        MapFull, WeightOverflow: when the sum has no room.
        WorkerLost: when several workers, one after the other, end at the same job.
        TsfusionError: any error of a job.
    """
    check(config)
    run_files.check_folder(out)
    with output_folder.results(out, overwrite=overwrite) as (results, folder):
        place = (results if out is None else folder).absolute()  # a dated folder is not found again
        wishes = wishes or Wishes()
        with _workplace(place / WORK, found.fingerprint(config, wishes.sensor)) as work:
            run = _Run(found, config, work, display, wishes)
            with closing(make_scheduler()) as scheduler:
                made = run.carry_out(scheduler, results, folder)
            run_record.write(results, made)
            if out is not None:
                shutil.rmtree(place / TILES, ignore_errors=True)  # of an earlier run that is replaced
        shutil.rmtree(place / WORK, ignore_errors=True)
    return made


@contextmanager
def _workplace(work: Path, fingerprint: str) -> Iterator[Path]:
    """Yield the folder of unfinished work: empty, or as an earlier run with the same plan left it."""
    try:
        make_folder(work)
        lock = folder_lock.hold(work)
    except BlockingIOError as error:
        raise OutputError(
            f"another run works in {work}: wait for its end, or choose another folder"
        ) from error
    except OSError as error:
        raise OutputError(f"cannot write to {work}: {error.strerror}; choose another folder") from error
    with lock:
        plan = work / _PLAN
        with suppress(OSError):
            if plan.read_text(encoding="ascii") == fingerprint:
                yield work
                return
        for path in work.iterdir():
            path.unlink()
        with replacing(plan) as file:
            file.write(fingerprint.encode("ascii"))
        yield work


class _Run:
    def __init__(
        self, found: Listed, config: VolumeConfig, work: Path, display: Display, wishes: Wishes
    ) -> None:
        self._found, self._config, self._work = found, config, work
        self._display, self._wishes = display, wishes
        self._clock = _Clock()
        self._common: dict[str, Any] = {
            "folder": str(work),
            "worker_memory": wishes.worker_memory,
            "threads": config.threads or 1,
        }
        self._progress: dict[str, JobProgress] = {}

    def carry_out(self, scheduler: Scheduler, results: Path, folder: Path) -> FusedRun:
        """Do all steps, and put the files of the results into `results`."""
        doing = CarryingOut(scheduler, self._work, self._watch)
        with self._clock.step("fusing") as ended:
            ended.extend(self._fuse(doing, scheduler.workers))
        fused = ended
        with self._clock.step("adding") as ended:
            file, added = self._add(doing, [name for one in fused for name in one.files])
            ended.extend(added)
        with checkpoint.reading(self._work / file) as (header, _):
            map_hash, blocks = header.map_hash, header.blocks
        with self._clock.step("meshing") as ended:
            runs = self._mesh_runs(doing, file, blocks, scheduler.workers)
            ended.extend(runs)
            mesh = self._mesh(doing, file, runs)
            ended.append(mesh)
            tiles = self._tiles(doing, file, mesh)
            ended.extend(tiles)
        self._collect(results, file, mesh, tiles)
        left_out = Counter(self._found.left_out)
        for one in fused:
            left_out.update(one.left_out)
        clock = self._clock
        return FusedRun(
            sources=self._found.names,
            folder=str(folder),
            keyframes=sum(one.read for one in fused),
            keyframes_fused=header.keyframes,
            keyframes_rejected=dict(left_out),
            keyframes_lost=self._found.lost,
            map_hash=map_hash,
            blocks=blocks,
            workers=scheduler.workers,
            scheduler=scheduler.name,
            workers_lost=doing.lost,
            jobs=clock.jobs,
            jobs_found=doing.found,
            seconds=clock.seconds,
            worker_seconds=clock.worker_seconds,
            worker_peak_rss=clock.peak_rss,
            worker_memory=self._wishes.worker_memory,
            mesh={name: value for name, value in mesh.figures.items() if name != "is_whole"},
            tiles=sum(bool(one.files) for one in tiles),
            config=msgspec.to_builtins(self._config),
            versions=run_record.versions(),
            made=run_record.circumstances(),
        )

    # --- steps ---

    def _fuse(self, doing: CarryingOut, workers: int) -> list[JobDone]:
        count = self._found.count
        shares = min(count, workers * -(-count // (workers * _MOST_KEYFRAMES)))
        self._display.stage(f"fusing {count} keyframes with {workers} workers")
        todo = [
            jobs.FuseJob(
                name=f"fuse-{number}-of-{shares}",
                config=self._config,
                keyframes=keyframes,
                sensor=self._wishes.sensor,
                world=self._found.world,
                **self._common,
            )
            for number, keyframes in enumerate(self._found.shares(shares))
        ]

        def finished(one: JobDone) -> None:
            self._watch(JobProgress(one.name, one.read, one.fused))

        return doing.do(todo, finished)

    def _watch(self, said: JobProgress) -> None:
        self._progress[said.name] = said
        read, fused = (
            sum(getattr(one, name) for one in self._progress.values()) for name in ("read", "fused")
        )
        self._display.show_fused(read, fused, self._found.count)

    def _add(self, doing: CarryingOut, files: list[str]) -> tuple[str, list[JobDone]]:
        """Add maps in groups until one is left. Return its file, and the `JobDone` messages of the jobs."""
        ended: list[JobDone] = []
        if len(files) > 1:
            self._display.stage(f"adding {len(files)} parts of the map")
        while len(files) > 1:
            groups = [files[i : i + _FAN_IN] for i in range(0, len(files), _FAN_IN)]
            todo = [jobs.Add(name=f"add-{_digest(group)}", files=group, **self._common) for group in groups]
            done = doing.do(todo)
            ended += done
            files = [one.files[0] for one in done]
        return files[0], ended

    def _mesh_runs(self, doing: CarryingOut, file: str, blocks: int, workers: int) -> list[JobDone]:
        """Mesh parts of the whole map by all workers at once, if it fits into a worker's memory."""
        self._display.stage("meshing")
        if self._wishes.worker_memory is not None:
            return []
        return doing.do(
            jobs.MeshRunJob(
                name=f"run-{_digest([file, one.start, one.stop])}",
                file=file,
                view=self._view,
                first=one.start,
                stop=one.stop,
                **self._common,
            )
            for one in tiling.shares(blocks, workers)
        )

    def _mesh(self, doing: CarryingOut, file: str, runs: list[JobDone]) -> JobDone:
        wishes = self._wishes
        (done,) = doing.do(
            [
                jobs.MeshMap(
                    name=f"mesh-{_digest([file, wishes.up, wishes.keep_islands])}",
                    file=file,
                    view=self._view,
                    runs=[one.files[0] for one in runs],
                    up=wishes.up,
                    keep_islands=wishes.keep_islands,
                    **self._common,
                )
            ]
        )
        if not done.files:
            raise OutputError(f"{run_files.NO_SURFACE}: {run_files.MORE_SURFACE}")
        return done

    def _tiles(self, doing: CarryingOut, file: str, mesh: JobDone) -> list[JobDone]:
        wishes = self._wishes
        if wishes.tile_size is None and mesh.figures["is_whole"]:
            return []
        most = tiling.most_blocks(wishes.worker_memory, self._clock.base_rss)
        boxes = tiling.boxes(self._work / file, wishes.tile_size, most)
        given = mesh.figures["up"]
        up = None if given is None else msgspec.convert(given, Up)
        todo = [
            jobs.MeshTile(
                name=f"tile-{_digest([file, box, up])}",
                file=file,
                view=self._view,
                up=up,
                low=box[0],
                high=box[1],
                **self._common,
            )
            for box in boxes
        ]
        self._display.stage(f"meshing {len(todo)} tiles")
        finished = iter(range(1, len(todo) + 1))
        return doing.do(todo, lambda _: self._display.show_steps("tiles", next(finished), len(todo)))

    @property
    def _view(self) -> dict[str, Any]:
        return {name: getattr(self._config, name) for name in VIEW_SETTINGS}

    def _collect(self, results: Path, file: str, mesh: JobDone, tiles: list[JobDone]) -> None:
        """Move the files of the results out of the folder of unfinished work."""
        with refusals_as(OutputError, f"cannot write to {results}"):
            os.replace(self._work / file, results / run_files.MAP)
            for name in mesh.files:
                os.replace(self._work / name, results / f"mesh{Path(name).suffix}")
            made = [one for one in tiles if one.files]
            if made:
                (results / TILES).mkdir()
                for number, one in enumerate(made):
                    os.replace(self._work / one.files[0], results / TILES / f"{number:05}.glb")
                tiling.write_tileset(results / TILES, [one.figures for one in made])


def _digest(what: Any) -> str:
    """Return a hash of a job's input, to name the job by it: a repeated run finds its results."""
    return hashlib.blake2b(msgspec.msgpack.encode(what), digest_size=6).hexdigest()
