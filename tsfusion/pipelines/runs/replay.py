# SPDX-License-Identifier: MIT
"""A whole replay: every keyframe of a recorded dataset sent and fused, and its results left in a folder."""

import dataclasses
import logging
import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, nullcontext

import numpy as np
from numpy.typing import NDArray

from tsfusion.client import Client, ClientStats
from tsfusion.core import process
from tsfusion.core.config import ClientConfig, ServerConfig, VolumeConfig
from tsfusion.core.errors import DatasetError, JournalError, OutputError
from tsfusion.core.output_folder import results
from tsfusion.core.readable_numbers import count_of
from tsfusion.datasets import Dataset
from tsfusion.datasets.dataset import UnreadableFrame, force_of, readable
from tsfusion.geometry.keyframe import Keyframe
from tsfusion.geometry.origin import world_of
from tsfusion.geometry.up_direction import HeldSensor, Up
from tsfusion.pipelines.runs import engine, map_growth, replay_results, run_files, target_server
from tsfusion.pipelines.runs.engine import AHEAD, Engine, Progress
from tsfusion.pipelines.runs.replay_results import ReplaySummary
from tsfusion.pipelines.runs.target_server import Target
from tsfusion.pipelines.runs.viewer_child import ViewerChild, showing

log = logging.getLogger(__name__)

_READ_AHEAD = 3  # times as long as the last keyframe took to be read: disks and images differ


def replay(
    dataset: Dataset,
    out: str | os.PathLike[str] | None,
    *,
    overwrite: bool = False,
    volume: VolumeConfig,
    progress: Progress,
    server: ServerConfig | None = None,
    client: ClientConfig | None = None,
    connect: str | None = None,
    same_frame: bool = False,
    rate: float | None = None,
    min_weight: float | None = None,
    up: Up | None = None,
    keep_islands: bool | None = None,
    viewer: ViewerChild | None = None,
    warnings: Sequence[str] = (),
    missed: Sequence[str] = (),
    sensor: str | None = None,
    ended: Callable[[], bool] = bool,
) -> ReplaySummary:
    """Send every keyframe of `dataset` to a server and leave the results in the folder `out`.

    `mesh.ply`, `mesh.glb`, `preview.png`, `keyframes.txt`, `delay.csv`, `delay.png`, `growth.csv`, `run.json`
    and `report.html` with its pictures, with a server of its own also `map.tsf`, and of a world whose surface
    is known `error.npy`, appear together when all of it went well, and not at all otherwise. A keyframe that
    cannot be read is left out and counted; where most cannot, the replay ends, and so it does when `ended`:
    its results say so.

    Args:
        out: None = a new folder `out/DATE_TIME`; see `output_folder.results`.
        overwrite: whether `out` may hold files, of which those of the same name are replaced.
        volume: the map of the own server; a server at `connect` has its own.
        server: settings of the own server; None = a free port, and a state folder that is thrown away.
        connect: data address of a running server; None starts one for this run.
        same_frame: the poses are declared to be in the coordinate frame of the map, whatever worlds it has.
        rate: keyframes per second; None = as fast as they are fused, at most `AHEAD` on their way.
        min_weight: full-confidence samples a voxel needs to be meshed; None = the sensor's.
        up: away from the ground, in the map's frame; None = it is found.
        keep_islands: see `mesh_files.write`.
        viewer: shows the map while the run lasts.
        warnings: what is odd about the recording, for the results.
        missed: what makes the map wrong or incomplete, a sentence each; empty = nothing is known to.
        sensor: preset that all keyframes are taken to be of; None = each as it says.
        ended: whether no more keyframes are wanted.

    Raises:
        OutputError: `out` cannot be written (checked first), or the mesh is empty.
        TransportError: the server cannot be reached, ended, or stopped fusing; WorldRefused: the map has
            keyframes of another world.
        DatasetError, JournalError: most keyframes cannot be read, or a journal's first.
    """
    unread: list[str] = []
    stamps: list[int] = []
    poses: list[NDArray[np.float64]] = []
    run_files.check_folder(out)
    with results(out, overwrite=overwrite) as (work, folder), ExitStack() as watching:
        # A dataset that cannot be read is an error before a server starts.
        begin, first = next(readable(dataset.__getitem__, range(len(dataset))), None) or (0, dataset[0])
        if connect is None:
            map_growth.check_fits(first, volume)
        progress.stage(engine.STARTING if connect is None else f"connecting to {connect}")
        with (
            target_server.opened(
                connect, work / ".scratch", volume=volume, client=client, server=server
            ) as target,
            showing(viewer, target, connect or str(folder)),
        ):
            # A recording leaves nothing out: `wait_turn` keeps the spool short, not the policy.
            world = world_of(dataset)
            sender = target.client(target.link.map, policy="spool_all", world=world, same_frame=same_frame)
            sender.connect()
            _warn_of_keyframes_there(target, same_frame=same_frame)

            def observe() -> ClientStats:
                stats = sender.stats
                progress.update(len(dataset), stats, link=sender.problem)
                return stats

            running = Engine(target, observe, lambda: sender.problem)
            progress.stage(
                f"scanning {dataset.name}" + (f" into the map {target.link.map}" if connect else "")
            )
            held, started = HeldSensor(), time.monotonic()
            growth = watching.enter_context(map_growth.watch(target, target.link.map))
            outlives = connect is not None or (
                server is not None and server.state != target_server.THROWN_AWAY
            )
            with _saying_what_stays(sender, target.link.map) if outlives else nullcontext():
                keyframes = _keyframes(
                    dataset, (begin, first), running, rate=rate, unread=unread, ended=ended
                )
                for index, keyframe in keyframes:
                    running.wait_turn(AHEAD if rate is None else target.link.backlog)
                    of = sensor or keyframe.sensor
                    sender.send(dataclasses.replace(keyframe, captured_ns=time.monotonic_ns(), sensor=of))
                    held.add(keyframe.T_world_camera, dataset.sensor, force_of(dataset, index))
                    stamps.append(keyframe.timestamp_ns)
                    poses.append(keyframe.T_world_camera)
                running.wait_fused()
            if outlives and ended():
                _say_what_stays(sender, target.link.map)
            seconds = time.monotonic() - started
            watching.close()
            peak = process.peak_rss_bytes()  # of sending: drawing the result is not the scanner's work
            progress.stage("writing the results")
            running.wait_meshed([sender])
            target.keep_map(target.link.map, work / run_files.MAP)
            written = run_files.write_map(
                work, target, target.link.map, held,
                world=world, up=up, min_weight=min_weight, keep_islands=keep_islands,
            )  # fmt: skip
        if not len(written.mesh.faces):
            raise OutputError(run_files.no_surface(sender.stats, sender.first_rejection))
        error_mm = replay_results.error_of(dataset, written.mesh)
        result = replay_results.summarise(
            dataset, sender, written, error_mm, folder=folder,
            seconds=seconds, rate=rate, peak_rss_bytes=peak,
            server_start_seconds=target.child.start_seconds if target.child else None,
            warnings=warnings, missed=[*unread, target.unkept, *missed],
            complete=not (unread or ended()),
        )  # fmt: skip
        run_files.write_ledger(work, sender.records)
        growth.write_csv(work / "growth.csv")
        run_files.write_keyframes(work / "keyframes.txt", stamps, poses)
        if error_mm is not None:
            np.save(work / "error.npy", (error_mm / 1000).astype(np.float32))
        run_files.write_record(work, result)
        run_files.write_report(work, {"mesh.ply": written.mesh})
        return result


def _warn_of_keyframes_there(target: Target, *, same_frame: bool) -> None:
    """Warn that given poses are taken for poses in the frame of a map that has keyframes."""
    name = target.link.map
    there = target.status(name).keyframes_durable if target.has_map(name) else 0
    if there and not same_frame:
        log.warning(
            "the map %s has %s already, and these are added to them: their poses must be in the "
            "same coordinate frame (--map NAME names another map, --same-frame says that they are)",
            name, count_of(there, "keyframe"),
        )  # fmt: skip


@contextmanager
def _saying_what_stays(sender: Client, map_name: str) -> Iterator[None]:
    """Where sending is interrupted, warn of what stays in a map that outlives the replay."""
    try:
        yield
    except (KeyboardInterrupt, SystemExit):
        _say_what_stays(sender, map_name)
        raise


def _say_what_stays(sender: Client, map_name: str) -> None:
    if there := sender.stats.durable:
        log.warning(
            "%s of this recording, or more, are in the map %s and stay there: another replay into it "
            "adds them once more (--map NAME names another map)",
            count_of(there, "keyframe"), map_name,
        )  # fmt: skip


def _keyframes(
    dataset: Dataset,
    first: tuple[int, Keyframe],
    running: Engine,
    *,
    rate: float | None,
    unread: list[str],
    ended: Callable[[], bool],
) -> Iterator[tuple[int, Keyframe]]:
    """Yield each keyframe and its index at its time, without those that cannot be read.

    Where most cannot, or a journal is damaged, it ends, `unread`. A sensor that was late does not catch up.

    One that waits for its time is read when that is near: a sensor's next image does not take a core while
    the server fuses the last one, and read at once it added a third to the delay on two cores.
    """
    due, ahead = time.monotonic(), float("inf")
    yield first
    for index in range(first[0] + 1, len(dataset)):
        if rate is not None:
            running.wait_until(due + 1 / rate - ahead, ended)
        if ended():
            return
        began = time.monotonic()
        try:
            keyframe = dataset[index]
        except UnreadableFrame:
            continue
        except (DatasetError, JournalError) as error:
            unread.append(f"keyframe {index} of {len(dataset)} cannot be read, and ended the replay: {error}")
            return
        if rate is not None:
            ahead = _READ_AHEAD * (time.monotonic() - began)
            due = max(due + 1 / rate, time.monotonic())
            running.wait_until(due, ended)
        yield index, keyframe
