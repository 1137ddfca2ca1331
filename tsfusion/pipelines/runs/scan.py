# SPDX-License-Identifier: MIT
"""A whole scan: a source's frames localised, chosen, sent and fused, and its results left in a folder."""

import dataclasses
import logging
import os
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from tsfusion.client import Client, ClientStats
from tsfusion.core import process
from tsfusion.core.config import ClientConfig, ScanConfig, ServerConfig, VolumeConfig, override
from tsfusion.core.errors import (
    AlignmentRefused,
    DatasetError,
    OutputError,
    SourceError,
    TsfusionError,
    WorldRefused,
)
from tsfusion.core.output_folder import results
from tsfusion.core.readable_numbers import count_of
from tsfusion.datasets.cameras import described
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.origin import world_of
from tsfusion.geometry.sample_ranges import wrong_unit
from tsfusion.geometry.stereo_matching import EXCHANGED, exchanged
from tsfusion.geometry.up_direction import HeldSensor, Up
from tsfusion.pipelines.maps import scan_alignment
from tsfusion.pipelines.maps.scan_alignment import ExistingMap
from tsfusion.pipelines.report import shortfall
from tsfusion.pipelines.runs import engine, map_growth, run_files, scan_results, target_server
from tsfusion.pipelines.runs.engine import Engine, Progress
from tsfusion.pipelines.runs.leftovers import ANSWER_SECONDS, Leftovers
from tsfusion.pipelines.runs.scan_results import MapResult, ScanSummary
from tsfusion.pipelines.runs.target_server import Target
from tsfusion.pipelines.runs.viewer_child import ViewerChild, showing
from tsfusion.scanner.keyframe_selection import KeyframeSelector
from tsfusion.scanner.localization import localizers
from tsfusion.scanner.localization.localizer import Localizer
from tsfusion.scanner.scanner import Scanner, Submap
from tsfusion.scanner.sources.source import Source

OUTDOOR_SENSORS = ("stereo", "lidar")

log = logging.getLogger(__name__)


def scan(
    source: Source,
    out: str | os.PathLike[str] | None,
    *,
    overwrite: bool = False,
    config: ScanConfig,
    volume: VolumeConfig,
    progress: Progress,
    client: ClientConfig | None = None,
    server: ServerConfig | None = None,
    connect: str | None = None,
    spool: str | os.PathLike[str] = "tsfusion-spool",
    same_frame: bool = False,
    align: bool = False,
    min_weight: float | None = None,
    up: Up | None = None,
    keep_islands: bool | None = None,
    viewer: ViewerChild | None = None,
    warnings: Sequence[str] = (),
    sensor: str | None = None,
) -> ScanSummary:
    """Take a source's frames to its end, or until it is closed, and leave the results in the folder `out`.

    `trajectory.txt`, `keyframes.txt` (and `trajectory-corrected.txt` where loops were closed, `reference.txt`
    where the source has other poses), `delay.csv`, `delay.png`, `growth.csv`, `run.json`, and `report.html`
    with its pictures; with a server of its own also `mesh.ply`, `mesh.glb`, `preview.png` and `map.tsf`. A
    second submap's have `-2` before the ending, and so on.

    Args:
        out: None = a new folder `out/DATE_TIME`; see `output_folder.results`.
        overwrite: whether `out` may hold files, of which those of the same name are replaced.
        volume: the map of the own server; a server at `connect` has its own.
        server: settings of the own server; None = a free port, and a state folder that is thrown away.
        connect: data address of a running server; None starts one for this scan.
        spool: with `connect`, the folder where keyframes wait until they are acknowledged; what earlier
            scans left there goes to its own maps, or waits on.
        same_frame: the scan's coordinate frame is declared to be that of the map, whatever worlds it has.
        align: with `connect`: find the scan's place in the map, if that has a surface, before anything is
            sent. Where that fails the scan goes into a free map.
        min_weight: full-confidence samples a voxel needs to be meshed; None = the sensor's.
        up: away from the ground, in the map's frame; None = it is found.
        keep_islands: see `mesh_files.write`.
        viewer: shows the map while the run lasts.
        warnings: what is odd about the source's frames, for the results.
        sensor: preset that all frames are taken to be of; None = each as it says.

    Raises:
        SourceError: the sensor failed; what came before is in `out`.
        DatasetError: a recording's file cannot be read; likewise.
        InvalidKeyframe: a frame lacks what the localizer needs; likewise.
        OutputError: `out` cannot be written, or no frame could be localised; or the own map has no surface,
            when all else is in `out`.
        TransportError: the server cannot be reached or stopped fusing.
        AlignmentRefused: the place was not found; the scan is in a map of its own.
        WorldRefused: the map has keyframes of another session; those of this scan are in the spool.
    """
    failure: list[Exception] = []
    own = connect is None
    run_files.check_folder(out)
    with results(out, overwrite=overwrite) as (work, folder), ExitStack() as stack:
        frames = _until_failure(iter(source), failure)
        if sensor is not None:
            frames = (dataclasses.replace(frame, sensor=sensor) for frame in frames)
        first = next(frames, None)
        if first is None:
            raise failure[0] if failure else SourceError(f"{source.name} gave no frames")
        if first.left is not None and first.right is not None and exchanged(first.left, first.right):
            raise SourceError(f"{source.name}: {EXCHANGED}")
        if own and first.kind != "pair":
            map_growth.check_fits(first.keyframe(np.eye(4)), volume)
        localizer = localizers.create_localizer(config, first)
        stack.callback(getattr(localizer, "close", lambda: None))
        if own:
            progress.stage(engine.STARTING)
        with (
            target_server.opened(
                connect, work / ".scratch", volume=volume, client=client, server=server, spools=Path(spool)
            ) as target,
            showing(viewer, target, connect or str(folder)),
        ):
            leftovers = Leftovers(target, given=localizer.absolute)
            leftovers.begin()

            frames, map_name = _timely(source, first, frames, config.patience), target.link.map
            unplaced = ""  # why
            if align and (existing := _existing_map(target)) is not None:
                localizer, frames, unplaced = _placed(
                    source, localizer, frames, existing, config=config, volume=volume, tell=progress.stage
                )
                same_frame = not unplaced
                map_name = _other_map(target, unplaced) if unplaced else map_name
            scanner = _open_scanner(
                source, localizer, config, target, leftovers, map_name=map_name, same_frame=same_frame
            )

            def observe() -> ClientStats:
                state = scanner.state()
                progress.update(source.length, state.stats, link=state.link, scan=state)
                return state.stats

            running = Engine(target, observe, lambda: scanner.state().link)
            pace = running.wait_turn if own and not source.live else running.check
            progress.stage(f"scanning {source.name}" + ("" if own else f" into the map {map_name}"))
            started = time.monotonic()
            growth = stack.enter_context(map_growth.watch(target, map_name))
            _run_scanner(scanner, frames, pace, failure)
            peak = process.peak_rss_bytes()
            if not any(submap.located for submap in scanner.submaps):
                raise (failure[0] if failure else _not_localised(scanner, first, config))
            scanner.finish()
            failure = _settle(scanner, running, leftovers, progress, own=own) or failure
            seconds = time.monotonic() - started
            growth.stop()
            progress.stage("writing the results")
            write = partial(
                _write, work, target, sensor=source.sensor,
                up=up, min_weight=min_weight, keep_islands=keep_islands,
            )  # fmt: skip
            meshes: dict[str, Mesh] = {}
            maps = [write(submap, number, meshes) for number, submap in enumerate(scanner.submaps, 1)]
            if own and not any(found.mesh["triangles"] for found in maps if found.mesh):
                stats = scanner.state().stats
                failure.append(OutputError(run_files.no_surface(stats, scanner.first_rejection)))
            records = scan_results.records(scanner.submaps)
            run_files.write_ledger(work, records)
            growth.write_csv(work / "growth.csv")
            result = scan_results.summarise(
                source, scanner, maps, records, folder=folder, camera=_camera(source, first),
                localizer=localizers.localizer_name(config, first), spool=spool, complete=not failure,
                seconds=seconds, peak_rss_bytes=peak, config=config, volume=volume if own else None,
                warnings=warnings, missed=[*map(str, failure), unplaced, target.unkept],
            )  # fmt: skip
        run_files.write_record(work, result)
        run_files.write_report(work, meshes)
    if unplaced and not failure:
        raise AlignmentRefused(f"the scan is in the map {map_name}, as its place was not found: {unplaced}")
    if failure:
        log.warning("the scan ended early: what came before is in %s", folder)
        raise failure[0]
    return result


def _existing_map(target: Target) -> ExistingMap | None:
    """The map to scan into as the server has it now; None = it has no surface yet, and may begin here."""
    name = target.link.map
    if name not in target.health().maps:
        return None
    mesh = target.mesh(name, min_weight=None)
    if not len(mesh.faces):
        return None
    return ExistingMap(name, mesh, target.status(name).config["volume"]["voxel_size"])


def _placed(
    source: Source,
    localizer: Localizer,
    frames: Iterator[Frame],
    existing: ExistingMap,
    *,
    config: ScanConfig,
    volume: VolumeConfig,
    tell: Callable[[str], None],
) -> tuple[Localizer, Iterator[Frame], str]:
    """A localizer in the frame of an existing map, and its frames from the first; or why there is none.

    Where there is none the localizer is in a frame of its own.
    """
    found = scan_alignment.find_place(
        existing, override(volume, voxel_size=existing.voxel_size), localizer, frames,
        KeyframeSelector(config, outdoors=source.sensor in OUTDOOR_SENSORS), live=source.live, tell=tell,
    )  # fmt: skip
    T = np.eye(4) if found.T_map_world is None else found.T_map_world
    if found.T_map_world is not None:
        log.info("the place in the map %s is found by %d keyframes", existing.name, len(found.keyframes))
    placed = scan_alignment.PlacedLocalizer(localizer, T, found.answers)
    return placed, chain(found.frames, frames), found.why if found.T_map_world is None else ""


def _other_map(target: Target, why: str) -> str:
    """The name of a free map, for a scan whose place was not found."""
    name = target.free_map_name()
    if name is None:
        raise AlignmentRefused(f"{why}; nothing was sent, as the server names no free map")
    log.warning("the scan goes into the map %s, as its place was not found: %s", name, why)
    return name


def _open_scanner(
    source: Source,
    localizer: Localizer,
    config: ScanConfig,
    target: Target,
    leftovers: Leftovers,
    *,
    map_name: str,
    same_frame: bool,
) -> Scanner:
    """A scanner that sends to a target; raises WorldRefused at once when the map is of another world."""

    def open_client(name: str) -> Client:
        return target.client(
            name,
            # A recording waits, so nothing of it is left out; what a live source gives is thinned.
            policy=None if source.live else "spool_all",
            world=_given_world(localizer, source) if localizer.absolute else uuid.uuid4().hex,
            same_frame=same_frame and name == target.link.map,
        )

    scanner = Scanner(
        localizer, config, open_client, map_name=map_name,
        taken=leftovers.maps, free_name=target.free_map_name,
        outdoors=source.sensor in OUTDOOR_SENSORS,
        most=None if target.child is None else target_server.MAPS - 1,
    )  # fmt: skip
    client = scanner.submaps[0].client
    client.wait_answer(ANSWER_SECONDS)
    if client.is_of_other_world:
        leftovers.finish()
        client.check_world()
    return scanner


def _given_world(localizer: Localizer, source: Source) -> str:
    """The world of poses that a localizer with its own origin, or the source, gives."""
    return world_of(localizer if hasattr(localizer, "origin") else source)


def _settle(
    scanner: Scanner, running: Engine, leftovers: Leftovers, progress: Progress, *, own: bool
) -> list[Exception]:
    """Wait for all keyframes under way; the refusal of a map of another world, else nothing."""
    clients = [submap.client for submap in scanner.submaps]
    if own:
        progress.stage("fusing what is on its way")
        running.wait_fused()
        if any(submap.corrections for submap in scanner.submaps):
            progress.stage("moving keyframes to their corrected poses")
            running.wait_settled(clients)
        running.wait_meshed(clients)
        return []
    progress.stage("sending what is on its way")
    running.wait_acknowledged(clients)
    leftovers.finish()
    return _refused_worlds(clients)


def _camera(source: Source, first: Frame) -> str:
    """The source's camera in one line; empty = it gives points."""
    own: str = getattr(source, "camera", "")
    if own or first.intrinsics is None:
        return own
    return f"{described(first.intrinsics, first.shape)}, from the source"


def _until_failure(frames: Iterator[Frame], failure: list[Exception]) -> Iterator[Frame]:
    """The frames up to a failure of the source, which is kept: what came before it is not thrown away."""
    try:
        yield from frames
    except (SourceError, DatasetError) as error:
        failure.append(error)


def _timely(source: Source, first: Frame, frames: Iterator[Frame], patience: float) -> Iterator[Frame]:
    """Yield all frames, but not the first of a live source if it grew old while the server started."""
    if not source.live:
        yield dataclasses.replace(first, captured_ns=time.monotonic_ns())
    else:
        second = next(frames, None)
        if second is None or second.timestamp_ns - first.timestamp_ns <= 1e9 * patience:
            yield first
        if second is not None:
            yield second
    yield from frames


def _run_scanner(
    scanner: Scanner, frames: Iterator[Frame], pace: Callable[[], object], failure: list[Exception]
) -> None:
    """Run the scanner; an error ends the scan, but what was localised before is not thrown away."""

    def watch(_: Scanner) -> None:
        pace()
        for submap in scanner.submaps:
            submap.client.check_world()

    try:
        scanner.run(frames, watch)
    except TsfusionError as error:
        if not any(submap.located for submap in scanner.submaps):
            raise
        failure.append(error)


def _not_localised(scanner: Scanner, first: Frame, config: ScanConfig) -> OutputError:
    state = scanner.state()
    unit = "" if first.kind == "pair" else wrong_unit(first.keyframe(np.eye(4)))
    why = f"the first has {unit}" if unit else state.why
    localizer = localizers.localizer_name(config, first)
    cure = (
        shortfall.cure_of_tracking(localizer)
        if localizer in ("trajectory", "feed", "given") and not unit
        else "check the camera and the depth's unit, or take poses from elsewhere (--trajectory FILE)"
    )
    return OutputError(f"the sensor was not localised in any of {state.frames} frames: {why}; {cure}")


def _refused_worlds(clients: list[Client]) -> list[Exception]:
    """The refusal of a map of another world, with the number of keyframes that wait, and where."""
    for client in clients:
        try:
            client.check_world()
        except WorldRefused as error:
            waiting = count_of(client.stats.waiting, "keyframe waits", "keyframes wait")
            kept = f"{waiting} in {client.spool_folder} (`tsfusion spool list`)"
            return [WorldRefused(f"{error}; {kept}")]
    return []


def _write(
    work: Path,
    target: Target,
    submap: Submap,
    number: int,
    meshes: dict[str, Mesh],
    *,
    sensor: str,
    **options: Any,
) -> MapResult:
    """Write the files of one submap, and give its figures.

    Args:
        meshes: takes its mesh, by the name of the file.
        options: as of `run_files.write_map`.
    """
    if not submap.located:
        return scan_results.describe(submap, None)
    suffix = f"-{number}" if number > 1 else ""
    scan_results.write_trajectory(work, submap, suffix)
    if target.child is None:
        return scan_results.describe(submap, None)
    target.keep_map(submap.name, work / f"map{suffix}.tsf")
    held = HeldSensor()
    poses = submap.located.poses(submap.corrections)
    for T, force in zip(poses, submap.located.forces(), strict=True):
        held.add(T, sensor, force)
    written = run_files.write_map(
        work, target, submap.name, held, suffix=suffix, world=submap.client.world, **options
    )
    if len(written.mesh.faces):
        meshes[f"mesh{suffix}.ply"] = written.mesh
    return scan_results.describe(submap, written)
