# SPDX-License-Identifier: MIT
"""The front end of one run, as a process of its own: a camera, the localizer, and what it hands keyframes to.

    python lab/paper/paper_frontend.py PLAN.json

The recording plays at its own times. A camera has room for one frame: what came while the localizer was busy
is dropped and counted. In the traditional modes the map is in this process too.
"""

import dataclasses
import os
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

sys.path.append(str(Path(__file__).parents[2]))  # lab is not installed

from lab.paper.paper_events import EventLog
from lab.paper.paper_worlds import PaperWorld, planned_keyframes, stamps_ns
from tsfusion.core import process
from tsfusion.core.config import ClientConfig, ScanConfig, VolumeConfig
from tsfusion.core.errors import FlushTimeout
from tsfusion.datasets import Dataset
from tsfusion.datasets.dataset import frame_of
from tsfusion.geometry.frame import Frame
from tsfusion.scanner.localization import localizers
from tsfusion.scanner.localization.localizer import Localizer, Lost, PoseCorrections, TrackedPose
from tsfusion.scanner.scanner import Scanner
from tsfusion.scanner.sources.source import LiveSource

OUTDOORS = ("stereo", "lidar")
MAP, CORRECTED = "map.tsf", "corrected.npz"
_READ_AHEAD, _READ_NS = 5, 25_000_000  # frames that are read before they are due; time for one


class FrontEndPlan(Struct, frozen=True, kw_only=True):
    """Orders for a front end.

    Attributes:
        folder: where its events, and in the traditional modes its map, go.
        address, control: of a server; None = fusion is in this process.
        bounded: the queue in this process has one place.
        cores: that it may use; None = all.
        drain_s: seconds after the last frame for what waits.
        pace: the recording plays so many times slower.
    """

    world: PaperWorld
    volume: VolumeConfig
    folder: str
    address: str | None = None
    control: str | None = None
    bounded: bool = False
    loop_closure: bool = False
    cores: int | None = None
    drain_s: float = 30.0
    pace: float = 1.0
    client: ClientConfig = ClientConfig()


class LiveRecording(LiveSource):
    """Play a recording at its own times to whoever takes its frames: those that nobody took are gone."""

    def __init__(self, dataset: Dataset, log: EventLog, *, pace: float = 1.0) -> None:
        super().__init__(dataset.name, dataset.sensor)
        self.length = len(dataset)
        self._dataset, self._log, self._pace = dataset, log, pace
        self._stamps = stamps_ns(dataset)
        self.index = -1  # of the frame that was given last
        self.due_ns = 0

    @property
    def late(self) -> int:
        """Frames that were dropped so far."""
        return self.skipped.get("late", 0)

    def __iter__(self) -> Iterator[Frame]:
        """Frames by the clock; files are read while nothing is to be done, as a camera has no files."""
        offsets = ((self._stamps - self._stamps[0]) * self._pace).astype(np.int64)
        read = {index: frame_of(self._dataset, index) for index in range(min(_READ_AHEAD, len(offsets)))}
        following, began = 0, time.monotonic_ns()
        self._log.note("start")
        while following < len(offsets) and not self._closed.is_set():
            due = began + int(offsets[following])
            self._read_on(read, following, due)
            self._closed.wait(max(0.0, (due - time.monotonic_ns()) / 1e9))
            newest = int(np.searchsorted(offsets, time.monotonic_ns() - began, side="right")) - 1
            if newest > following:
                self._skip("late", newest - following)
            self.index = max(newest, following)
            self.due_ns = began + int(offsets[self.index])
            frame = read.pop(self.index) if self.index in read else frame_of(self._dataset, self.index)
            following = self.index + 1
            yield dataclasses.replace(
                frame, timestamp_ns=int(self._stamps[self.index]), captured_ns=self.due_ns
            )

    def _read_on(self, read: dict[int, Frame], following: int, due_ns: int) -> None:
        """Read the files of the frames from `following` on, as long as the next one is not due."""
        for index in [index for index in read if index < following]:
            del read[index]
        for index in range(following, min(following + _READ_AHEAD, len(self._stamps))):
            if index not in read and time.monotonic_ns() + _READ_NS < due_ns:
                read[index] = frame_of(self._dataset, index)


class PlannedKeyframes:
    """Makes keyframes of given frames; of one that was dropped, of the next that comes.

    Args:
        stamps_ns: (n,) ascending nanoseconds, the frames' own.
    """

    def __init__(self, stamps_ns: NDArray[np.int64]) -> None:
        self._stamps, self._next = stamps_ns, 0

    def reason(self, frame: Frame, _T: NDArray[np.float64]) -> str | None:
        """`planned`; None = the frame is before the next of them."""
        is_due = self._next < len(self._stamps) and frame.timestamp_ns >= self._stamps[self._next]
        return "planned" if is_due else None

    def accept(self, frame: Frame, _T: NDArray[np.float64]) -> None:
        """Go on to those after the frame."""
        self._next = int(np.searchsorted(self._stamps, frame.timestamp_ns, side="right"))

    def reset(self) -> None:
        """Go on as before: they are given by time."""


class Noted(Localizer):
    """A localizer whose answers are kept until they are noted."""

    def __init__(self, localizer: Localizer) -> None:
        self._localizer, self.absolute = localizer, localizer.absolute
        self.answer: TrackedPose | Lost | None = None

    def track(self, frame: Frame) -> TrackedPose | Lost:
        self.answer = self._localizer.track(frame)
        return self.answer

    def prepare(self) -> None:
        self._localizer.prepare()

    def corrections(self) -> PoseCorrections | None:
        return self._localizer.corrections()

    def settle(self) -> None:
        self._localizer.settle()

    def reset(self) -> None:
        self._localizer.reset()


def main() -> int:
    process.on_parent_end(signal.SIGKILL)
    plan = msgspec.json.decode(Path(sys.argv[1]).read_bytes(), type=FrontEndPlan)
    if plan.cores is not None and hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, sorted(os.sched_getaffinity(0))[: plan.cores])
    run(plan)
    return 0


def run(plan: FrontEndPlan) -> None:
    """Localise the recording live, and hand its keyframes on."""
    folder = Path(plan.folder)
    log = EventLog(folder / "events.jsonl")
    dataset = plan.world.open()
    source = LiveRecording(dataset, log, pace=plan.pace)
    sink: Any = _sink(plan, folder, log)
    localizer, scanner = _scanner(plan, dataset, sink)

    def note(_: Scanner) -> None:
        found, stats = localizer.answer, sink.stats
        T = found.T_world_camera.tolist() if isinstance(found, TrackedPose) else None
        log.note(
            "frame", index=source.index, due_ns=source.due_ns, T_world_camera=T, late=source.late,
            cpu_s=time.process_time(), rss_bytes=process.rss_bytes(), queue=stats.sent - stats.fused,
            queue_bytes=stats.waiting_bytes,
        )  # fmt: skip

    scanner.run(source, note)
    scanner.finish()
    closing = _finish(plan, scanner, sink, folder, log)
    log.note(
        "end", late=source.late, lost=scanner.state().lost, loops=scanner.state().loops,
        peak_rss_bytes=process.peak_rss_bytes(), stats=msgspec.to_builtins(sink.stats), **closing,
    )  # fmt: skip
    if plan.address is not None:
        sink.close()
    log.close()


def _sink(plan: FrontEndPlan, folder: Path, log: EventLog) -> Any:
    if plan.address is None:
        from lab.paper.paper_fusion import FusionBeside

        return FusionBeside(plan.volume, bounded=plan.bounded, log=log)
    from tsfusion.client import Client

    client = Client(plan.address, control=plan.control, spool=folder / "spool", config=plan.client, world="")
    client.connect()
    return client


def _scanner(plan: FrontEndPlan, dataset: Dataset, sink: Any) -> tuple[Noted, Scanner]:
    """The localizer, and the scanner around it. A lost sensor has to be found again in the one map."""
    world = plan.world
    config = ScanConfig(localizer=world.localizer, loop_closure=plan.loop_closure)
    _warm_up(config, dataset)
    localizer = Noted(localizers.create_localizer(config, frame_of(dataset, 0)))
    outdoors = world.sensor in OUTDOORS
    planned = planned_keyframes(dataset, world.keyframes, outdoors=outdoors)
    selector = PlannedKeyframes(stamps_ns(dataset)[planned])
    scanner = Scanner(
        localizer,
        config,
        lambda _name: sink,
        map_name="default",
        outdoors=outdoors,
        most=1,
        selector=selector,
    )
    return localizer, scanner


def _warm_up(config: ScanConfig, dataset: Dataset) -> None:
    """Do all once that is slow the first time: this recording begins on the move."""
    frames = [frame_of(dataset, index) for index in range(min(2, len(dataset)))]
    throwaway = localizers.create_localizer(config, frames[0])
    for frame in frames:
        throwaway.track(frame)
    frames[0].keyframe(np.eye(4))
    getattr(throwaway, "close", lambda: None)()


def _finish(plan: FrontEndPlan, scanner: Scanner, sink: Any, folder: Path, log: EventLog) -> dict[str, Any]:
    """Wait for what is under way; what to say of it."""
    if plan.address is None:
        drained = sink.finish(plan.drain_s, folder / MAP)
        return {"drained": drained, "map_hash": sink.map_hash}
    drained = False
    with suppress(FlushTimeout):
        sink.wait_settled(plan.drain_s)
        drained = True
    for record in sink.records:
        log.note("keyframe", **msgspec.to_builtins(record))
    submap = scanner.submaps[0]
    if submap.corrections is not None:
        stamps, poses = submap.located.stamps_ns, submap.located.poses(submap.corrections)
        np.savez(folder / CORRECTED, stamps=stamps, poses=poses)
    return {"drained": drained}


if __name__ == "__main__":
    sys.exit(main())
