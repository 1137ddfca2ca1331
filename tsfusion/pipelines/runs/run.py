# SPDX-License-Identifier: MIT
"""Carry out a whole run: localise, choose, send and fuse a source's frames; leave results in a folder.

A replay is a scan with given poses that takes every frame.
"""

import dataclasses
import logging
import os
import time
import uuid
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from itertools import chain, islice
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from tsfusion.client import Client, ClientStats
from tsfusion.core import process
from tsfusion.core.config import ClientConfig, ScanConfig, ServerConfig, VolumeConfig, override
from tsfusion.core.errors import (
    AlignmentRefused,
    DatasetError,
    JournalError,
    OutputError,
    SourceError,
    TransportError,
    TsfusionError,
    WorldRefused,
)
from tsfusion.core.output_folder import results
from tsfusion.core.readable_numbers import count_of
from tsfusion.datasets.cameras import described
from tsfusion.datasets.dataset import UNREADABLE
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.origin import Origin, world_of
from tsfusion.geometry.sample_ranges import wrong_unit
from tsfusion.geometry.stereo_matching import EXCHANGED, exchanged
from tsfusion.geometry.up_direction import Up
from tsfusion.journal.journaled_keyframes import LOST
from tsfusion.pipelines.maps import scan_alignment
from tsfusion.pipelines.maps.scan_alignment import ExistingMap
from tsfusion.pipelines.report import latency_ledger, run_record, shortfall
from tsfusion.pipelines.report.run_record import Accuracy, RunKind, RunRecord
from tsfusion.pipelines.runs import engine, map_growth, run_files, target_server
from tsfusion.pipelines.runs.engine import AHEAD, Engine, Progress
from tsfusion.pipelines.runs.leftovers import ANSWER_SECONDS, Leftovers
from tsfusion.pipelines.runs.run_files import WrittenMap, WrittenSubmap
from tsfusion.pipelines.runs.target_server import Target
from tsfusion.pipelines.runs.viewer_child import ViewerChild, showing
from tsfusion.scanner.keyframe_selection import EveryFrame, KeyframeSelector
from tsfusion.scanner.localization import localizers
from tsfusion.scanner.localization.localizer import Localizer
from tsfusion.scanner.scanner import Scanner
from tsfusion.scanner.sources.source import RecordedSource, Source
from tsfusion.wire.messages.messages import KeyframeTimes

_OUTDOOR_SENSORS = ("stereo", "lidar")

log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class RunPlan:
    """Plan of a run: its frames, how poses are found, where keyframes go, and what is made of the map.

    Attributes:
        kind: `scan` localises frames and chooses keyframes; a distant server may fuse them later. `replay`
            takes every frame at its given pose, and always waits for the map and its mesh.
        scan: settings of a scan's localizer and selection of keyframes.
        volume: the map of the own server; a server at `connect` has its own.
        connect: data address of a running server; None starts one for this run.
        server: settings of the own server; None for a free port and a temporary state folder.
        spool: folder where keyframes of a scan with `connect` wait for acknowledgement. Keyframes of earlier
            scans in this folder are sent to their own maps, or wait on.
        same_frame: the user declares that the poses are in the map's frame, whatever worlds the map has.
        align: with `connect`: find the scan's pose in the map, if the map has a surface, before anything is
            sent. If that fails, the scan goes into a free map.
        rate: frames a second that a recording is played at; None = as fast as keyframes are fused.
        max_frames: number of frames to take of the source; None = all.
        sensor: sensor preset for all frames; None for the sensor that each frame names.
        min_weight: full-confidence samples a voxel needs to be meshed; None = the sensor's.
        up: up direction in the map's frame; None to find it.
        keep_islands: see `mesh_finishing.write`.
        distance: (n,) signed metres from (n, 3) points to the true surface, in the frame of given poses;
            None if the surface is unknown.
        warnings: oddities of the frames, a sentence each.
        missed: reasons why the map is wrong or incomplete, a sentence each.
    """

    kind: RunKind = "scan"
    source: Source
    scan: ScanConfig = field(default_factory=ScanConfig)
    volume: VolumeConfig
    client: ClientConfig | None = None
    server: ServerConfig | None = None
    connect: str | None = None
    spool: Path | None = None
    same_frame: bool = False
    align: bool = False
    rate: float | None = None
    max_frames: int | None = None
    sensor: str | None = None
    min_weight: float | None = None
    up: Up | None = None
    keep_islands: bool | None = None
    distance: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None
    warnings: Sequence[str] = ()
    missed: Sequence[str] = ()

    @property
    def length(self) -> int | None:
        """Number of frames; None = unknown."""
        known = self.source.length
        return known if known is None or self.max_frames is None else min(known, self.max_frames)

    @property
    def is_replay(self) -> bool:
        return self.kind == "replay"

    @property
    def is_outdoors(self) -> bool:
        return self.source.sensor in _OUTDOOR_SENSORS

    @property
    def waits_for_map(self) -> bool:
        """True if the run ends when the map has its keyframes, False if it ends when the server has them."""
        return self.connect is None or self.is_replay

    @property
    def outlives(self) -> bool:
        """True if the map outlives the run."""
        kept = self.server is not None and self.server.state != target_server.THROWN_AWAY
        return self.connect is not None or kept


def run(
    plan: RunPlan,
    out: str | os.PathLike[str] | None,
    progress: Progress,
    *,
    overwrite: bool = False,
    viewer: ViewerChild | None = None,
) -> RunRecord:
    """Take a source's frames to its end, or until it is closed. Leave the results in the folder `out`.

    Each run leaves `keyframes.txt`, `delay.csv`, `delay.png`, `growth.csv`, `run.json` and `report.html` with
    pictures. A scan adds `trajectory.txt`, after loop closures `trajectory-corrected.txt`, and
    `reference.txt` if the source has other poses. An own server adds `map.tsf`. A run that waits for its map
    adds `mesh.ply`, `mesh.glb` and `preview.png`; a known true surface `error.npy`. Files of a second submap
    have `-2` before the ending, and so on. What came before a failure is kept.

    Args:
        out: None = a new folder `out/DATE_TIME`; see `output_folder.results`.
        overwrite: `out` may hold files. Those of the same name are replaced.
        viewer: shows the map while the run lasts.

    Raises:
        SourceError: the sensor failed; what came before is in `out`.
        DatasetError, JournalError: the recording's first frame cannot be read; in a scan also a later one,
            with what came before in `out`. A replay only records this.
        InvalidKeyframe: a frame lacks what the localizer needs; what came before is in `out`.
        OutputError: `out` cannot be written, or no frame could be localised. Or the own map has no surface;
            then all else is in `out`.
        TransportError: the server cannot be reached or stopped fusing.
        AlignmentRefused: the scan's pose in the map was not found; the scan is in a map of its own.
        WorldRefused: the map has keyframes of another session; keyframes of a scan are in the spool.
    """
    run_files.check_folder(out)
    with results(out, overwrite=overwrite) as (work, folder), ExitStack() as stack:
        frames = _PlannedFrames(plan)  # an unreadable source fails before a server starts
        localizer = localizers.create_localizer(frames.scan, frames.first)
        stack.callback(getattr(localizer, "close", lambda: None))
        if plan.waits_for_map:
            progress.stage(engine.STARTING if plan.connect is None else f"connecting to {plan.connect}")
        with (
            target_server.opened(
                plan.connect, work / ".scratch",
                volume=plan.volume, client=plan.client, server=plan.server, spools=plan.spool,
            ) as target,
            showing(viewer, target, plan.connect or str(folder)),
        ):  # fmt: skip
            place = _place(plan, frames, localizer, target, progress.stage)
            active = _ActiveRun(plan, place, frames, target, progress)
            with map_growth.watch(target, place.map_name) as growth:
                active.carry_out()
            progress.stage("writing the results")
            written = active.write(work)
        growth.write_csv(work / "growth.csv")
        error_mm = _error_mm(plan, written[0].in_map)
        if error_mm is not None:
            np.save(work / "error.npy", (error_mm / 1000).astype(np.float32))
        accuracy = None if error_mm is None else Accuracy.of(error_mm)
        record = active.record(folder, written, accuracy)  # when its own server has ended
        run_record.write(work, record)
        meshes = {f"mesh{one.suffix}.ply": one.in_map.mesh for one in written if one.in_map and one.has_mesh}
        run_files.write_report(work, meshes)
    active.raise_failure(folder)
    return record


class _PlannedFrames:
    """Frames of a plan, until their source ends or fails. The error is kept for the end of the run.

    Attributes:
        scan: settings of the localizer.
        first: the first frame, read ahead.
        failure: error of the source; None while it has none.

    Raises:
        SourceError: the source gives no frame, or its left and right images are exchanged.
    """

    def __init__(self, plan: RunPlan) -> None:
        self._source, self._sensor, self._is_replay = plan.source, plan.sensor, plan.is_replay
        self.scan = override(plan.scan, localizer="given") if plan.is_replay else plan.scan
        self.failure: Exception | None = None
        self._rest = self._read(islice(plan.source, plan.max_frames))
        first = next(self._rest, None)
        if first is None:
            raise self.failure or SourceError(f"{plan.source.name} gave no frames")
        if first.left is not None and first.right is not None and exchanged(first.left, first.right):
            raise SourceError(f"{plan.source.name}: {EXCHANGED}")
        if plan.connect is None and first.kind != "pair":
            map_growth.check_fits(first.keyframe(np.eye(4)), plan.volume)
        self.first = first

    @property
    def localizer(self) -> str:
        """Name of the localizer that suits the frames."""
        return localizers.localizer_name(self.scan, self.first)

    @property
    def camera(self) -> str:
        """The source's camera in one line; empty if the source gives points."""
        own: str = getattr(self._source, "camera", "")
        if own or self.first.intrinsics is None:
            return own
        return f"{described(self.first.intrinsics, self.first.shape)}, from its frames"

    def __iter__(self) -> Iterator[Frame]:
        """Yield all frames. Skip a live source's first frame if it grew old while the server started."""
        if not self._source.live:
            yield dataclasses.replace(self.first, captured_ns=time.monotonic_ns())
        else:
            second = next(self._rest, None)
            if second is None or second.timestamp_ns - self.first.timestamp_ns <= 1e9 * self.scan.patience:
                yield self.first
            if second is not None:
                yield second
        yield from self._rest

    def _read(self, frames: Iterator[Frame]) -> Iterator[Frame]:
        try:
            for frame in frames:
                changed: dict[str, Any] = {"sensor": self._sensor} if self._sensor else {}
                if self._is_replay and frame.kind == "pair":  # matching is no part of the delay of a replay
                    changed |= {"left": None, "right": None, "disparity": frame.matched}
                    changed |= {"captured_ns": time.monotonic_ns()}
                yield dataclasses.replace(frame, **changed) if changed else frame
        except (SourceError, DatasetError, JournalError) as error:
            self.failure = error


class _PlacedFrames(NamedTuple):
    """Localizer, frames and map of a run: as planned, or a free map if a scan's pose was not found."""

    localizer: Localizer
    frames: Iterator[Frame]  # from the first frame not sent yet
    map_name: str
    same_frame: bool
    unplaced: str = ""  # why the pose in the map was not found


def _place(
    plan: RunPlan, frames: _PlannedFrames, localizer: Localizer, target: Target, tell: Callable[[str], None]
) -> _PlacedFrames:
    """Find the pose of a scan in the map, if the plan asks for it and the map has a surface.

    Raises:
        AlignmentRefused: the pose was not found, and no other map is free.
    """
    name, taken = target.link.map, iter(frames)
    existing = _existing_map(target) if plan.align else None
    if existing is None:
        return _PlacedFrames(localizer, taken, name, plan.same_frame)
    found = scan_alignment.find_place(
        existing, override(plan.volume, voxel_size=existing.voxel_size), localizer, taken,
        KeyframeSelector(plan.scan, outdoors=plan.is_outdoors), live=plan.source.live, tell=tell,
    )  # fmt: skip
    T, rest = found.T_map_world, chain(found.frames, taken)
    placed = scan_alignment.PlacedLocalizer(localizer, np.eye(4) if T is None else T, found.answers)
    if T is None:
        return _PlacedFrames(placed, rest, _other_map(target, found.why), False, found.why)
    log.info("the place in the map %s is found by %d keyframes", existing.name, len(found.keyframes))
    return _PlacedFrames(placed, rest, name, True)


def _existing_map(target: Target) -> ExistingMap | None:
    """Return the map for a scan to find its pose in, or None if it has no surface: the scan may begin it."""
    name = target.link.map
    if name not in target.health().maps:
        return None
    mesh = target.mesh(name, min_weight=None)
    if not len(mesh.faces):
        return None
    return ExistingMap(name, mesh, target.status(name).config["volume"]["voxel_size"])


def _other_map(target: Target, why: str) -> str:
    """Return the name of a free map for a scan whose pose was not found. `why`: the reason, for the log."""
    name = target.free_map_name()
    if name is None:
        raise AlignmentRefused(f"{why}; nothing was sent, as the server names no free map")
    log.warning("the scan goes into the map %s, as its place was not found: %s", name, why)
    return name


class _ActiveRun:
    """A run whose server is ready: sends keyframes, waits, writes results, and reports what was missed.

    Args:
        frames: frames of the plan's source.
        target: server that keyframes go to.

    Raises:
        WorldRefused: when the map is of another world.
        TransportError: when a replay's server cannot be reached.
    """

    def __init__(
        self, plan: RunPlan, place: _PlacedFrames, frames: _PlannedFrames, target: Target, progress: Progress
    ) -> None:
        self._plan, self._place, self._frames = plan, place, frames
        self._target, self._progress = target, progress
        self._failures: list[Exception] = []  # that end it early
        self._leftovers = Leftovers(target, given=place.localizer.absolute)
        self._leftovers.begin()
        self._scanner = self._open_scanner()
        self._engine = Engine(target, self._observe, lambda: self._scanner.state().link)
        if isinstance(plan.source, RecordedSource):
            plan.source.attend = self._engine.check
        self._begun, self._seconds, self._peak_rss = time.monotonic(), 0.0, 0

    def carry_out(self) -> None:
        """Send all keyframes. Wait until they are in the map, or on the disk of a distant server."""
        into = "" if self._plan.connect is None else f" into the map {self._place.map_name}"
        self._progress.stage(f"scanning {self._plan.source.name}{into}")
        try:
            self._send()
            self._settle()
        except (KeyboardInterrupt, SystemExit):
            self._say_what_stays()
            raise
        self._seconds = time.monotonic() - self._begun
        if not self._is_complete:
            self._say_what_stays()

    def write(self, work: Path) -> list[WrittenSubmap]:
        """Write trajectories, meshes and the latency ledger."""
        plan, submaps = self._plan, self._scanner.submaps
        more = {"up": plan.up, "min_weight": plan.min_weight, "keep_islands": plan.keep_islands}
        asked = self._target if plan.waits_for_map else None
        written = [
            run_files.write_submap(
                work, one, asked, "" if number == 1 else f"-{number}",
                sensor=plan.source.sensor, is_given=plan.is_replay, **more,
            )
            for number, one in enumerate(submaps, 1)
        ]  # fmt: skip
        if plan.waits_for_map and not any(one.has_mesh for one in written):
            stats, why = self._scanner.state().stats, self._scanner.first_rejection
            self._failures.append(OutputError(run_files.no_surface(stats, why)))
        run_files.write_ledger(work, self._times)
        return written

    def raise_failure(self, folder: Path) -> None:
        """Raise the error that ended the run early. That a replay's source failed is only in its record."""
        if self._failures:
            log.warning("the %s ended early: what came before is in %s", self._plan.kind, folder)
            raise self._failures[0]
        if why := self._place.unplaced:
            name = self._place.map_name
            raise AlignmentRefused(f"the scan is in the map {name}, as its place was not found: {why}")

    # --- sending ---

    def _open_scanner(self) -> Scanner:
        plan, place, target = self._plan, self._place, self._target

        def open_client(name: str) -> Client:
            return target.client(
                name,
                # A recording waits, so nothing of it is left out; what a live source gives is thinned.
                policy=None if plan.source.live else "spool_all",
                world=_given_world(place, plan) if place.localizer.absolute else uuid.uuid4().hex,
                same_frame=place.same_frame and name == target.link.map,
            )

        scanner = Scanner(
            place.localizer, plan.scan, open_client, map_name=place.map_name,
            taken=self._leftovers.maps, free_name=target.free_map_name, outdoors=plan.is_outdoors,
            most=None if target.child is None else target_server.MAPS - 1,
            selector=EveryFrame() if plan.is_replay else None,
        )  # fmt: skip
        client = scanner.submaps[0].client
        if plan.is_replay:
            client.connect()
            self._warn_of_keyframes_there()
        client.wait_answer(ANSWER_SECONDS)
        if client.is_of_other_world:
            self._leftovers.finish()
            client.check_world()
        return scanner

    def _warn_of_keyframes_there(self) -> None:
        """Warn if a map has keyframes of earlier runs: given poses must be in its coordinate frame."""
        target, name = self._target, self._place.map_name
        there = target.status(name).keyframes_durable if target.has_map(name) else 0
        if there and not self._place.same_frame:
            log.warning(
                "the map %s has %s already, and these are added to them: their poses must be in the "
                "same coordinate frame (--map NAME names another map, --same-frame says that they are)",
                name, count_of(there, "keyframe"),
            )  # fmt: skip

    def _say_what_stays(self) -> None:
        """Warn that an incomplete replay leaves keyframes in a map that outlives the run."""
        there = self._scanner.state().stats.durable
        if there and self._plan.is_replay and self._plan.outlives:
            log.warning(
                "%s of this recording, or more, are in the map %s and stay there: another replay into it "
                "adds them once more (--map NAME names another map)",
                count_of(there, "keyframe"), self._place.map_name,
            )  # fmt: skip

    def _send(self) -> None:
        """Localise and send frame by frame. An error ends this, but what was localised before is kept."""
        try:
            self._scanner.run(self._place.frames, self._wait_turn)
        except TsfusionError as error:
            is_stuck = self._plan.waits_for_map and isinstance(error, TransportError)
            if is_stuck or not self._is_located:
                raise
            self._failures.append(error)
        self._peak_rss = process.peak_rss_bytes()  # of sending: drawing the result is not the scanner's work
        unread = self._frames.failure
        if not self._is_located:
            raise unread or self._not_localised()
        if unread is not None and not self._plan.is_replay:
            self._failures.insert(0, unread)
        self._scanner.finish()

    def _wait_turn(self, scanner: Scanner) -> None:
        """Wait until a recording's next frame may be sent; a live sensor's frame never waits."""
        if self._plan.waits_for_map and not self._plan.source.live:
            self._engine.wait_turn(AHEAD if self._plan.rate is None else self._target.link.backlog)
        else:
            self._engine.check()
        for submap in scanner.submaps:
            submap.client.check_world()

    def _observe(self) -> ClientStats:
        """Show the progress of the run. Return the counts of all its clients."""
        state = self._scanner.state()
        scan = None if self._plan.is_replay else state
        self._progress.update(self._plan.length, state.stats, link=state.link, scan=scan)
        return state.stats

    def _settle(self) -> None:
        """Wait for all keyframes that are not yet in the map, or on a distant server's disk."""
        clients = [submap.client for submap in self._scanner.submaps]
        if not self._plan.waits_for_map:
            self._progress.stage("sending what is on its way")
            self._engine.wait_acknowledged(clients)
            self._leftovers.finish()
            self._failures = _refused_worlds(clients) or self._failures
            return
        self._progress.stage("fusing what is on its way")
        self._engine.wait_fused()
        if any(submap.corrections for submap in self._scanner.submaps):
            self._progress.stage("moving keyframes to their corrected poses")
            self._engine.wait_settled(clients)
        self._engine.wait_meshed(clients)

    @property
    def _is_located(self) -> bool:
        return any(submap.located for submap in self._scanner.submaps)

    @property
    def _is_complete(self) -> bool:
        source = self._plan.source
        taken = self._scanner.state().frames + source.skipped.get(UNREADABLE, 0)
        return not (self._failures or self._frames.failure) and taken >= (self._plan.length or 0)

    def _not_localised(self) -> OutputError:
        state, first = self._scanner.state(), self._frames.first
        unit = "" if first.kind == "pair" else wrong_unit(first.keyframe(np.eye(4)))
        why = f"the first has {unit}" if unit else state.why
        localizer = self._frames.localizer
        cure = (
            shortfall.cure_of_tracking(localizer)
            if localizer in ("trajectory", "feed", "given") and not unit
            else "check the camera and the depth's unit, or take poses from elsewhere (--trajectory FILE)"
        )
        return OutputError(f"the sensor was not localised in any of {state.frames} frames: {why}; {cure}")

    # --- results ---

    @property
    def _times(self) -> list[KeyframeTimes]:
        """Stamps of the keyframes of all submaps, one submap after the other."""
        return [record for submap in self._scanner.submaps for record in submap.client.records]

    def record(self, folder: Path, written: list[WrittenSubmap], accuracy: Accuracy | None) -> RunRecord:
        """Return the record of the run."""
        plan, scanner, source, first = self._plan, self._scanner, self._plan.source, written[0]
        state, delays = scanner.state(), latency_ledger.summarise(self._times)
        stats, child = state.stats, self._target.child
        clients = [submap.client for submap in scanner.submaps]
        made = RunRecord(
            kind=plan.kind,
            source=source.name,
            folder=str(folder),
            camera=self._frames.camera,
            localizer=self._frames.localizer,
            complete=self._is_complete,
            frames=state.frames,
            frames_tracked=state.tracked,
            frames_skipped=dict(source.skipped),
            keyframes_sent=stats.sent,
            keyframes_durable=stats.durable,
            keyframes_fused=stats.fused,
            keyframes_rejected={**stats.skipped, **stats.refused, **stats.rejected},
            keyframes_by_rule=state.selected,
            warnings=[*plan.warnings, *shortfall.of_sweeps(clients)],
            missed=self._missed(),
            left=stats.waiting,
            link=state.link,
            seconds=round(self._seconds, 3),
            server_start_seconds=None if child is None else round(child.start_seconds, 3),
            tracking_cpu_ms=round(scanner.tracking_cpu_ms, 3),
            color_delay_ms=round(1e3 * scanner.color_delay_s, 1),
            map_hash=first.figures.map_hash,
            blocks=first.figures.blocks,
            mesh=first.figures.mesh,
            accuracy=accuracy,
            maps=[one.figures for one in written],
            origin_m=getattr(Origin.of_world(clients[0].world), "position", None),
            delay_ms=delays.delay_ms,
            delay_slope_ms_per_keyframe=delays.slope_ms_per_keyframe,
            stages_ms=delays.stages_ms,
            clock_bound_ms=delays.clock_bound_ms,
            peak_rss_bytes={**_server_rss(first.in_map), "client": self._peak_rss},
            config=_settings(plan, first.in_map),
            versions=run_record.versions(),
            made=run_record.circumstances(),
        )
        return structs.replace(made, verdict=run_record.verdict(made))

    def _missed(self) -> str:
        """Return in one line how the run fell short of its goal; an empty text if it did not."""
        plan, source, state = self._plan, self._plan.source, self._scanner.state()
        length, unread = self._plan.length or state.frames, self._frames.failure
        ended = f"the replay ended after {state.frames} of {length} keyframes: {unread}"
        tracking = shortfall.of_tracking(
            state.frames, state.tracked, self._scanner.last_loss, localizer=self._frames.localizer,
            maps=sum(bool(submap.located) for submap in self._scanner.submaps),
        )  # fmt: skip
        delivery = shortfall.of_delivery(
            state.stats, spool=plan.spool or "the spool", link=state.link,
            rejection=self._scanner.first_rejection,
        )  # fmt: skip
        return shortfall.together(
            (
                *map(str, self._failures),
                self._place.unplaced,
                tracking,
                delivery,
                shortfall.of_damage(source.skipped.get(LOST, 0)),
                shortfall.of_clock(source.skipped),
                shortfall.of_unreadable(length, source.skipped),
                ended if unread is not None and plan.is_replay else "",
                self._target.unkept,
                *plan.missed,
            )
        )


def _given_world(place: _PlacedFrames, plan: RunPlan) -> str:
    """Return the world (coordinate frame) of given poses, as the localizer's or source's origin names it."""
    return world_of(place.localizer if hasattr(place.localizer, "origin") else plan.source)


def _refused_worlds(clients: list[Client]) -> list[Exception]:
    """Return, as a list of errors, that a map refused keyframes of another world; empty without refusal."""
    for client in clients:
        try:
            client.check_world()
        except WorldRefused as error:
            waiting = count_of(client.stats.waiting, "keyframe waits", "keyframes wait")
            kept = f"{waiting} in {client.spool_folder} (`tsfusion spool list`)"
            return [WorldRefused(f"{error}; {kept}")]
    return []


def _server_rss(in_map: WrittenMap | None) -> dict[str, int]:
    """Return peak memory in bytes of `gateway`, `fuser`, and `server` (their sum); empty if unknown."""
    if in_map is None:
        return {}
    gateway, fuser = (in_map.status.peak_rss_bytes[name] for name in ("server", "fuser"))
    return {"server": gateway + fuser, "gateway": gateway, "fuser": fuser}


def _settings(plan: RunPlan, in_map: WrittenMap | None) -> dict[str, Any]:
    """Return the settings of a run: those of its scan, and of the map as its server has it."""
    scan = {} if plan.is_replay else {"scan": msgspec.to_builtins(plan.scan)}
    asked = {"volume": msgspec.to_builtins(plan.volume)} if plan.connect is None else {}
    return {**scan, **asked, **(in_map.status.config if in_map else {}), "rate": plan.rate}


def _error_mm(plan: RunPlan, in_map: WrittenMap | None) -> NDArray[np.float64] | None:
    """Return (n,) millimetres from the mesh's vertices to the true surface; None if it is unknown."""
    if plan.distance is None or in_map is None or not len(in_map.mesh.faces):
        return None
    return 1000 * np.abs(plan.distance(in_map.mesh.vertices.astype(np.float64)))
