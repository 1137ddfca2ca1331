# SPDX-License-Identifier: MIT
"""A recorded dataset through the whole path: scanner → sockets → journal → fuser → mesh → files."""

import dataclasses
import os
import shutil
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext, suppress
from functools import partial
from typing import Protocol

from tsfusion.client import Client
from tsfusion.core import process
from tsfusion.core.config import ClientConfig, ServerConfig, VolumeConfig, override
from tsfusion.core.errors import FlushTimeout, OutputError, TransportError
from tsfusion.core.output_folder import building
from tsfusion.datasets import Dataset
from tsfusion.geometry.keyframe import Keyframe
from tsfusion.pipelines import mesh_preview, replay_results
from tsfusion.pipelines.replay_results import KnownSurface, RunSummary, Sent
from tsfusion.pipelines.target_server import ServerChild, own_server
from tsfusion.wire.curve import client_keys
from tsfusion.wire.queries import fetch_mesh, fetch_status

AHEAD = 3  # keyframes under way when no rate is asked for: fusing, waiting, travelling
PATIENCE = 60.0  # seconds without a newly fused keyframe before a run gives up
_POLL = 0.01  # seconds


class Progress(Protocol):
    """What a run tells while it goes; the command line draws it."""

    def stage(self, text: str) -> None:
        """Something that takes a while begins."""

    def count(self, sent: int, fused: int, total: int) -> None:
        """Keyframes handed over and keyframes in the map, of how many."""


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
            place = own_server(client, server, volume, scratch)
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
                run.sent.records = scanner.records
            status = fetch_status(link.address, control=link.control, map_name=link.map, keys=keys)
            mesh = fetch_mesh(
                link.address, control=link.control, map_name=link.map, min_weight=min_weight, keys=keys
            )
        if not len(mesh.faces):
            raise OutputError(
                f"the map has no surface to write: {run.sent.stats.fused} of {run.sent.stats.sent} keyframes "
                "fused; send more of them or lower --min-weight"
            )
        progress.stage("writing the results")
        shutil.rmtree(scratch)
        result = replay_results.summarise(run.sent, mesh, status, child.start_seconds if child else None)
        replay_results.write_mesh(work, mesh, run.sent.ups)
        replay_results.write_ledger(work, run.sent.records)
        replay_results.write_record(work, result)
        return result


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
        surface = dataset if isinstance(dataset, KnownSurface) else None
        self.sent = Sent(name=dataset.name, stats=scanner.stats, surface=surface)
        self._first = first
        self._scanner = scanner
        self._child = child
        self._progress = progress
        self._done = 0
        self._moved = 0.0

    def feed(self, rate: float | None) -> None:
        """Send every keyframe and wait until each is fused or refused."""
        self.sent.rate = rate
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
            self.sent.ups.append(mesh_preview.sensor_up(keyframe.T_world_camera, self.dataset.sensor))
        self._wait(lambda: self._done >= len(self.dataset))
        self.sent.seconds = time.monotonic() - started
        self.sent.peak_rss_bytes = process.peak_rss_bytes()

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
        stats = self.sent.stats = self._scanner.stats
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
