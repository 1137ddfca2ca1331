# SPDX-License-Identifier: MIT
"""A recorded dataset through the whole path: scanner → sockets → journal → fuser → mesh → files."""

import dataclasses
import os
import platform
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import msgspec
import numpy as np
from numpy.typing import NDArray

from tsfusion import __version__, ledger, preview, process
from tsfusion.child import ServerChild, serving
from tsfusion.client import Client
from tsfusion.config import ClientConfig, ServerConfig, VolumeConfig, override
from tsfusion.datasets import Dataset
from tsfusion.errors import FlushTimeout, OutputError, TransportError
from tsfusion.fetch import fetch_mesh, fetch_status
from tsfusion.keyframe import Keyframe
from tsfusion.mesh import Mesh
from tsfusion.results import RECORD, building
from tsfusion.transport import KeyframeTimes, Status, client_keys
from tsfusion.transport.messages import Spread

AHEAD = 3  # keyframes under way when no rate is asked for: fusing, waiting, travelling
PATIENCE = 60.0  # seconds without a newly fused keyframe before a run gives up
_POLL = 0.01  # seconds


class Progress(Protocol):
    """What a run tells while it goes; the command line draws it."""

    def stage(self, text: str) -> None:
        """Something that takes a while begins."""

    def count(self, sent: int, fused: int, total: int) -> None:
        """Keyframes handed over and keyframes in the map, of how many."""


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


class Silent:
    """Progress that nobody watches."""

    def stage(self, text: str) -> None:
        """Nothing."""

    def count(self, sent: int, fused: int, total: int) -> None:
        """Nothing."""


def replay(
    dataset: Dataset,
    out: str | os.PathLike[str],
    *,
    volume: VolumeConfig,
    server: ServerConfig | None = None,
    client: ClientConfig | None = None,
    connect: str | None = None,
    rate: float | None = None,
    min_weight: float | None = None,
    progress: Progress | None = None,
) -> RunSummary:
    """Send every keyframe of `dataset` to a server and leave the results in the folder `out`.

    `mesh.ply`, `mesh.glb`, `preview.png`, `delay.csv`, `delay.png` and `run.json` appear together when all of
    it went well, and not at all otherwise.

    Args:
        volume: the map of the own server; a server at `connect` has its own.
        server: settings of the own server; None = a free port, and a state folder that is thrown away.
        connect: data address of a running server; None starts one for this run.
        rate: keyframes per second; None = as fast as they are fused, at most `AHEAD` on their way.
        min_weight: full-confidence samples a voxel needs to be meshed; None = the sensor's.

    Raises:
        OutputError: `out` cannot be written (checked first), or the mesh is empty.
        TransportError: the server cannot be reached, ended, or stopped fusing.
        DatasetError: a keyframe cannot be read.
    """
    progress = progress or Silent()
    client = client or ClientConfig()
    with building(out) as work:
        scratch = work / ".scratch"
        scratch.mkdir()
        first = dataset[0]  # a dataset that cannot be read is told before a server starts
        place: AbstractContextManager[tuple[ClientConfig, ServerChild | None]]
        if connect is None:
            progress.stage("starting a server (the first start compiles kernels)")
            place = _own_server(client, server, volume, scratch)
        else:
            progress.stage(f"connecting to {connect}")
            place = nullcontext((override(client, address=connect), None))
        with place as (link, child):
            keys = client_keys(link.key, link.server_key)
            # a recording leaves nothing out, however slow the map is
            with Client(
                link.address, spool=scratch / "spool", control=link.control, policy="block", config=link
            ) as scanner:
                scanner.connect()
                run = _Run(dataset, first, scanner, child, progress)
                run.feed(rate)
                progress.stage("fetching the mesh")
                with suppress(FlushTimeout):  # a stamp less in the ledger is no reason to lose the run
                    scanner.wait_meshed()
                run.records = scanner.records
            status = fetch_status(link.address, control=link.control, map_name=link.map, keys=keys)
            mesh = fetch_mesh(
                link.address, control=link.control, map_name=link.map, min_weight=min_weight, keys=keys
            )
        if not len(mesh.faces):
            raise OutputError(
                f"the map has no surface to write: {run.stats.fused} of {run.stats.sent} keyframes fused; "
                "send more of them or lower --min-weight"
            )
        progress.stage("writing the results")
        shutil.rmtree(scratch)
        return _write(work, run, mesh, _summarise(run, mesh, status, child))


@contextmanager
def _own_server(
    client: ClientConfig, server: ServerConfig | None, volume: VolumeConfig, scratch: Path
) -> Iterator[tuple[ClientConfig, ServerChild | None]]:
    """Where to send, and the server that runs there for as long as the block."""
    server = server or ServerConfig(listen="tcp://127.0.0.1:0", state=str(scratch / "state"))
    with serving(server, volume, scratch) as child:
        yield override(client, address=child.listen, control=child.control), child


class _Run:
    """The scanner's loop: hand keyframes over at their time, and watch what becomes of them."""

    def __init__(
        self,
        dataset: Dataset,
        first: Keyframe,
        scanner: Client,
        child: ServerChild | None,
        progress: Progress,
    ) -> None:
        self.dataset = dataset
        self.ups: list[NDArray[np.float64]] = []
        self.seconds = 0.0
        self.peak_rss_bytes = 0  # while scanning: drawing the result is not a scanner's work
        self.records: list[KeyframeTimes] = []
        self.rate: float | None = None
        self.stats = scanner.stats
        self._first = first
        self._scanner = scanner
        self._child = child
        self._progress = progress
        self._done = 0
        self._moved = 0.0

    def feed(self, rate: float | None) -> None:
        """Send every keyframe and wait until each is fused or refused."""
        self.rate = rate
        self._progress.stage(f"scanning {self.dataset.name}")
        keyframe = self._first
        started = due = self._moved = time.monotonic()
        for index in range(len(self.dataset)):
            keyframe = self.dataset[index] if index else keyframe
            if rate is None:
                self._wait(partial(self._may_send, index))
            elif index:
                due = max(due + 1 / rate, time.monotonic())  # a sensor that was late does not catch up
                self._wait(partial(_is_time, due), patience=None)
            self._scanner.send(dataclasses.replace(keyframe, captured_ns=time.monotonic_ns()))
            self.ups.append(preview.sensor_up(keyframe.T_world_camera, self.dataset.sensor))
        self._wait(lambda: self._done >= len(self.dataset))
        self.seconds = time.monotonic() - started
        self.peak_rss_bytes = process.peak_rss_bytes()

    def _may_send(self, index: int) -> bool:
        return index - self._done < AHEAD

    def _wait(self, ready: Callable[[], bool], *, patience: float | None = PATIENCE) -> None:
        while True:
            self._look()
            if ready():
                return
            if patience is not None and time.monotonic() - self._moved > patience:
                raise TransportError(f"the server has fused nothing for {patience:.0f} s")
            time.sleep(_POLL)

    def _look(self) -> None:
        stats = self.stats = self._scanner.stats
        done = stats.fused + sum(map(_total, (stats.refused, stats.rejected, stats.skipped)))
        if done != self._done:
            self._done, self._moved = done, time.monotonic()
        self._progress.count(stats.sent, stats.fused, len(self.dataset))
        if self._child is not None:
            self._child.check()


def _total(counts: dict[str, int]) -> int:
    return sum(counts.values())


def _is_time(due: float) -> bool:
    return time.monotonic() >= due


def _write(work: Path, run: _Run, mesh: Mesh, summary: RunSummary) -> RunSummary:
    mesh.save(work / "mesh.ply")
    mesh.save(work / "mesh.glb")
    preview.render(mesh, work / "preview.png", ups=run.ups)
    ledger.write_csv(run.records, work / "delay.csv")
    ledger.plot(run.records, work / "delay.png")
    text = msgspec.json.format(msgspec.json.encode(summary), indent=2)
    (work / RECORD).write_bytes(text + b"\n")
    return summary


def _summarise(run: _Run, mesh: Mesh, status: Status, child: ServerChild | None) -> RunSummary:
    delays = ledger.summarise(run.records)
    dataset = run.dataset
    surface = dataset if isinstance(dataset, KnownSurface) else None
    return RunSummary(
        dataset=dataset.name,
        keyframes_sent=run.stats.sent,
        keyframes_fused=run.stats.fused,
        keyframes_rejected={**run.stats.skipped, **run.stats.refused, **run.stats.rejected},
        seconds=round(run.seconds, 3),
        server_start_seconds=round(child.start_seconds, 3) if child else None,
        map_hash=status.map_hash,
        blocks=status.blocks,
        delay_ms=delays.delay_ms,
        delay_slope_ms_per_keyframe=delays.slope_ms_per_keyframe,
        stages_ms=delays.stages_ms,
        clock_bound_ms=delays.clock_bound_ms,
        mesh={"vertices": len(mesh.vertices), "triangles": len(mesh.faces)},
        accuracy=measure(surface, mesh) if surface else None,
        peak_rss_bytes={**_server_rss(status), "client": run.peak_rss_bytes},
        config={**status.config, "rate": run.rate},
        versions=versions(),
    )


def _server_rss(status: Status) -> dict[str, int]:
    """Gateway and fuser, and as `server` the two together."""
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
        "taichi",
        "numpy",
        "opencv-python-headless",
        "pyzmq",
        "trimesh",
        "mcap",
        "msgspec",
        "zstandard",
    )
    found = {"tsfusion": __version__, "python": platform.python_version(), "platform": platform.platform()}
    for name in packages:
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            found[name] = "missing"
    return found
