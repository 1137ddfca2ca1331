# SPDX-License-Identifier: MIT
"""A whole scan: a source's frames localised, chosen, sent and fused, and what is left in a folder."""

import dataclasses
import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from itertools import chain
from pathlib import Path
from typing import Protocol

from tsfusion.core import process
from tsfusion.core.config import ClientConfig, ScanConfig, ServerConfig, VolumeConfig
from tsfusion.core.errors import (
    DatasetError,
    FlushTimeout,
    KeyframeRefused,
    OutputError,
    SourceError,
    TransportError,
    TsfusionError,
)
from tsfusion.core.output_folder import building
from tsfusion.geometry.frame import Frame
from tsfusion.pipelines import mesh_preview, replay_results, scan_results, target_server
from tsfusion.pipelines.scan_results import MapResult, ScanSummary
from tsfusion.pipelines.target_server import Destination
from tsfusion.scanner.localization import registry
from tsfusion.scanner.scanner import Scanner, ScanState, Submap
from tsfusion.scanner.sources.source import Source
from tsfusion.wire.curve import client_keys
from tsfusion.wire.queries import fetch_mesh, fetch_status

OUTDOOR_SENSORS = ("stereo", "lidar")
_PATIENCE = 60.0  # seconds without progress before an own server is given up
_LINGER = 10.0  # seconds without progress before what a distant server does not take is left in the spool
_FUSED = 5.0  # seconds for a distant server to say when it fused the last ones: for the figures only
_POLL = 0.05  # seconds

_NO_SURFACE = "the map has no surface to write: {} keyframes fused; scan for longer or lower --min-weight"


class ScanProgress(Protocol):
    """What a scan tells while it goes; the command line draws it."""

    def stage(self, text: str) -> None:
        """Something that takes a while begins."""

    def scan(self, state: ScanState, length: int | None) -> None:
        """After every frame, and while the rest is being fused; `length` of the source, where it is known."""


def scan(
    source: Source,
    out: str | os.PathLike[str],
    *,
    config: ScanConfig,
    volume: VolumeConfig,
    server: ServerConfig | None = None,
    client: ClientConfig | None = None,
    connect: str | None = None,
    spool: str | os.PathLike[str] = "tsfusion-spool",
    min_weight: float | None = None,
    progress: ScanProgress,
) -> ScanSummary:
    """Take a source's frames to its end, or until it is closed, and leave the results in the folder `out`.

    `trajectory.txt`, `keyframes.txt` (and `trajectory-corrected.txt` where loops were closed), `delay.csv`,
    `delay.png` and `run.json`; with a server of its own also `mesh.ply`, `mesh.glb` and `preview.png`. A
    second submap's have `-2` before the ending, and so on.

    Args:
        volume: the map of the own server; a server at `connect` has its own.
        connect: data address of a running server; None starts one for this scan.
        spool: with `connect`, the folder where keyframes wait until they are acknowledged.
        min_weight: full-confidence samples a voxel needs to be meshed; None = the sensor's.

    Raises:
        SourceError: the sensor failed; what came before is in `out`.
        DatasetError: a recording's file cannot be read; likewise.
        InvalidKeyframe: a frame lacks what the localizer needs; likewise.
        OutputError: `out` cannot be written, or no frame could be localised; or the own map has no surface,
            when all else is in `out`.
        TransportError: the server cannot be reached or stopped fusing.
    """
    failure: list[Exception] = []
    with building(out) as work, ExitStack() as stack:
        frames = _until_failure(iter(source), failure)
        first = next(frames, None)
        if first is None:
            raise failure[0] if failure else SourceError(f"{source.name} gave no frames")
        localizer = registry.create_localizer(config, first)
        stack.callback(getattr(localizer, "close", lambda: None))
        if connect is None:
            progress.stage("starting a server (the first start compiles kernels)")
            place = target_server.of_its_own(stack, client, server, volume, work / ".scratch")
        else:
            place = target_server.elsewhere(client, connect, Path(spool))
            if not localizer.absolute:
                target_server.warn_of_another_world(place)
        leftovers, open_client = target_server.opener(stack, place, source)
        scanner = Scanner(
            localizer, config, open_client, map_name=place.link.map, taken=leftovers,
            outdoors=source.sensor in OUTDOOR_SENSORS, most=target_server.MAPS - 1 if place.child else None,
        )  # fmt: skip
        progress.stage(f"scanning {source.name}")
        started = time.monotonic()
        if source.live:
            frames = _fresh(first, frames, config.patience)
        else:
            frames = chain([dataclasses.replace(first, captured_ns=time.monotonic_ns())], frames)
        _run(scanner, frames, _watcher(source, place, progress), failure)
        peak = process.peak_rss_bytes()
        if not any(submap.located for submap in scanner.submaps):
            raise failure[0] if failure else OutputError(_nowhere(scanner.state()))
        scanner.finish()
        _settle(scanner, source, place, progress)
        seconds = time.monotonic() - started
        progress.stage("writing the results")
        maps = [
            _write(
                work,
                place,
                submap,
                f"-{number}" if number > 1 else "",
                sensor=source.sensor,
                min_weight=min_weight,
            )
            for number, submap in enumerate(scanner.submaps, 1)
        ]
        complete = not failure
        if place.child is not None and not any(found.mesh["triangles"] for found in maps if found.mesh):
            failure.append(OutputError(_NO_SURFACE.format(scanner.state().stats.fused)))
        records = scan_results.records(scanner.submaps)
        replay_results.write_ledger(work, records)
        result = scan_results.summarise(
            source, scanner, maps, records,
            localizer=registry.localizer_name(config, first), complete=complete, seconds=seconds,
            peak_rss_bytes=peak, config=config, volume=volume if place.child else None,
        )  # fmt: skip
        stack.close()  # clients and server end before the folder of theirs goes
        if place.child is not None:
            shutil.rmtree(place.spools.parent)
        replay_results.write_record(work, result)
    if failure:
        raise failure[0]
    return result


def _until_failure(frames: Iterator[Frame], failure: list[Exception]) -> Iterator[Frame]:
    """The frames up to a failure of the source, which is kept: what came before it is not thrown away."""
    try:
        yield from frames
    except (SourceError, DatasetError) as error:
        failure.append(error)


def _fresh(first: Frame, frames: Iterator[Frame], patience: float) -> Iterator[Frame]:
    """A live source's frames, but for the first if it grew old while the server started."""
    second = next(frames, None)
    if second is None or second.timestamp_ns - first.timestamp_ns <= 1e9 * patience:
        yield first
    if second is not None:
        yield second
    yield from frames


def _run(
    scanner: Scanner, frames: Iterator[Frame], watch: Callable[[Scanner], None], failure: list[Exception]
) -> None:
    """Take the frames; what stops that ends the scan, but what was localised before is not thrown away."""
    try:
        scanner.run(frames, watch)
    except TsfusionError as error:
        if not any(submap.located for submap in scanner.submaps):
            raise
        failure.append(error)


def _watcher(source: Source, place: Destination, progress: ScanProgress) -> Callable[[Scanner], None]:
    def watch(scanner: Scanner) -> None:
        if place.child is not None:
            place.child.check()
        progress.scan(scanner.state(), source.length)

    return watch


def _nowhere(state: ScanState) -> str:
    return f"the sensor was not localised in any of {state.frames} frames: {state.why}"


def _settle(scanner: Scanner, source: Source, place: Destination, progress: ScanProgress) -> None:
    """Wait until everything is fused; with a server elsewhere, for as long as it takes any."""
    progress.stage("fusing what is on its way" if place.child else "sending what is on its way")
    patience = _PATIENCE if place.child else _LINGER
    last, moved = (-1, -1), time.monotonic()
    while True:
        state = scanner.state()
        progress.scan(state, source.length)
        stats = state.stats
        done = stats.fused + sum(stats.rejected.values()) if place.child else stats.durable
        lost = sum(stats.refused.values()) + stats.skipped.get("dropped", 0)
        if not stats.waiting and (not place.child or done + lost >= stats.sent):
            break
        if (stats.waiting, done) != last:
            last, moved = (stats.waiting, done), time.monotonic()
        if time.monotonic() - moved > patience:
            if place.child:
                raise TransportError(f"the server has fused nothing for {patience:.0f} s")
            return
        if place.child is not None:
            place.child.check()
        time.sleep(_POLL)
    for submap in scanner.submaps:
        # Stamps and corrections are no reason to lose the scan; what was refused is counted.
        with suppress(FlushTimeout, KeyframeRefused):
            if place.child:
                submap.client.wait_meshed()
            else:
                submap.client.flush()
                submap.client.wait_fused(_FUSED)


def _write(
    work: Path, place: Destination, submap: Submap, suffix: str, *, sensor: str, min_weight: float | None
) -> MapResult:
    """The files of one submap."""
    if submap.located:
        scan_results.write_trajectory(work, submap, suffix)
    if place.child is None or not submap.located:
        return scan_results.describe(submap, None, None)
    link = place.link
    keys = client_keys(link.key, link.server_key)
    status = fetch_status(link.address, control=link.control, map_name=submap.name, keys=keys)
    mesh = fetch_mesh(
        link.address, control=link.control, map_name=submap.name, min_weight=min_weight, keys=keys
    )
    if len(mesh.faces):
        ups = [mesh_preview.sensor_up(T, sensor) for T in submap.located.poses()]
        replay_results.write_mesh(work, mesh, ups, suffix)
    return scan_results.describe(submap, status, mesh)
