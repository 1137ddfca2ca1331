# SPDX-License-Identifier: MIT
"""Localize the frames of a source, select keyframes, and send them with a client.

The scanner runs on the robot, without Taichi.
"""

import dataclasses
import logging
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field
from itertools import chain, count
from typing import Any, Literal

import msgspec

from tsfusion.client import Client
from tsfusion.core.config import MAP_NAME_LENGTH, ScanConfig
from tsfusion.core.readable_numbers import count_of
from tsfusion.datasets.color_placement import ColorPlace
from tsfusion.delivery.outcomes import ClientStats
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.sweeps import Motion
from tsfusion.scanner.keyframe_selection import KeyframeSelector, Selector
from tsfusion.scanner.localization.localizer import Localizer, Lost, PoseCorrections, TrackedPose
from tsfusion.scanner.tracked_trajectory import TrackedTrajectory

ScannerState = Literal["starting", "tracking", "lost"]

log = logging.getLogger(__name__)


@dataclass(eq=False)
class Submap:
    """Frames tracked in one world (coordinate frame), and the client that sends keyframes to its map."""

    name: str  # name of the submap's map
    client: Client
    located: TrackedTrajectory = field(default_factory=TrackedTrajectory)  # the frames with a pose, in order
    corrections: PoseCorrections | None = None  # the newest from loop closure; None before the first
    corrected_seq: int = 0  # number of the last keyframe in the newest correction that was sent

    def correct(self) -> None:
        """Hand the corrected poses of all keyframes to the client."""
        assert self.corrections is not None
        seqs, poses = self.located.keyframes(self.corrections)
        if len(seqs):
            corrected = dict(zip(seqs.tolist(), poses, strict=True))
            sent = self.client.correct(corrected, T_map_odometry=self.corrections.T_corrected_world)
            if sent is not None:  # None: the spool had no room; `finish` tries again
                self.corrected_seq = int(seqs[-1])


class ScanState(msgspec.Struct, frozen=True, kw_only=True):
    """Progress of a scan, for people and programs."""

    state: ScannerState
    why: str  # reason of the last loss; empty while tracking
    frames: int
    tracked: int
    lost: int
    submap: str
    submaps: int
    selected: dict[str, int]  # selecting rule → number of keyframes
    loops: int  # number of closed loops over all submaps
    stats: ClientStats  # sums over all clients
    link: str  # why the server takes no keyframes at the moment; empty while it takes them
    keyframe_delay_ms: float | None  # from capture to fusion of the newest fused keyframe; None before it


class Scanner:
    """Localize frames and send keyframes.

    While the sensor is lost, nothing is sent. After `patience` seconds of the frames' clock without a pose,
    the localizer begins a new world. The keyframes of that world go into another map: NAME-2, NAME-3, …; this
    map is opened when the first pose in the new world is found.

    Args:
        localizer: finds the pose of each frame.
        config: rules of keyframe selection, and `patience`.
        connect: opens a client that sends to the map of a given name.
        map_name: name of the first submap's map.
        taken: map names that no submap may get.
        free_name: asks for an unused map name; it returns None if nobody can tell one.
        outdoors: see `KeyframeSelector`.
        most: largest number of submaps; after the last one begins, a lost sensor must be found in that one
            again. None = no limit.
        selector: chooses the keyframes; None = `KeyframeSelector` with the config's rules.
    """

    color_delay_s = 0.0  # of the newest pose

    def __init__(
        self,
        localizer: Localizer,
        config: ScanConfig,
        connect: Callable[[str], Client],
        *,
        map_name: str,
        taken: Collection[str] = (),
        free_name: Callable[[], str | None] = lambda: None,
        outdoors: bool = False,
        most: int | None = None,
        selector: Selector | None = None,
    ) -> None:
        self._localizer, self._config, self._most = localizer, config, most
        self._connect, self._map_name, self._taken = connect, map_name, {map_name, *taken}
        self._free_name = free_name
        self._selector = selector or KeyframeSelector(config, outdoors=outdoors)
        # First frame of a world, kept until the next pose gives the motion during its sweep
        self._waiting: tuple[TrackedPose, Frame] | None = None
        self._next: str | None = None  # map name of the submap that starts with the next pose
        self._lost_since: int | None = None
        self._why = ""
        self.last_loss = ""  # reason; empty = the sensor was never lost
        self._state: ScannerState = "starting"
        self._frames = self._lost = 0
        self._tracking_cpu = 0.0
        self._selected: Counter[str] = Counter()
        self.submaps: list[Submap] = [Submap(map_name, connect(map_name))]

    def run(self, frames: Iterable[Frame], watch: Callable[["Scanner"], None]) -> None:
        """Process every frame, and call `watch` after each."""
        for frame in frames:
            self.process(frame)
            watch(self)
        self._take_waiting(None)

    def process(self, frame: Frame) -> None:
        """Localize a frame, and send it if it is a keyframe; then let the localizer prepare for the next."""
        before = time.thread_time()
        found = self._localizer.track(frame)
        self._tracking_cpu += time.thread_time() - before
        self._frames += 1
        if isinstance(found, Lost):
            self._handle_lost(found, frame)
        else:
            self._handle_pose(found, frame)
        before = time.thread_time()
        self._localizer.prepare()
        self._tracking_cpu += time.thread_time() - before
        self._correct_if_known()

    def finish(self) -> None:
        """Correct also the keyframes after the last loop closure. Call it after the last frame."""
        self._take_waiting(None)
        self._localizer.settle()
        self._correct_if_known()
        for submap in self.submaps:
            if submap.corrections is not None and submap.located.last_seq > submap.corrected_seq:
                submap.correct()

    @property
    def first_rejection(self) -> str:
        """Reason why a map first rejected a keyframe; empty if none was rejected."""
        return next(filter(None, (submap.client.first_rejection for submap in self.submaps)), "")

    @property
    def tracking_cpu_ms(self) -> float:
        """CPU milliseconds for each frame on the localizer's own thread."""
        return 1000 * self._tracking_cpu / max(self._frames, 1)

    def state(self) -> ScanState:
        clients = [submap.client for submap in self.submaps]
        return ScanState(
            state=self._state,
            why=self._why,
            frames=self._frames,
            tracked=self._frames - self._lost,
            lost=self._lost,
            submap=self._next or self.submaps[-1].name,
            submaps=len(self.submaps) + (self._next is not None),
            selected=dict(self._selected),
            loops=sum(submap.corrections.loops for submap in self.submaps if submap.corrections),
            stats=_total([client.stats for client in clients]),
            link=clients[-1].problem,
            keyframe_delay_ms=_newest_delay(clients[-1]),
        )

    def _handle_pose(self, pose: TrackedPose, frame: Frame) -> None:
        if self._state == "lost":
            log.info("the sensor is found again")
        self._state, self._why, self._lost_since = "tracking", "", None
        self.color_delay_s = pose.color_delay_s
        if self._next is not None:
            self.submaps.append(Submap(self._next, self._connect(self._next)))
            self._next = None
        follows = self._localizer.absolute or self.submaps[-1].located or self._waiting is not None
        if frame.point_times_s is not None and pose.motion is None and not follows:
            self._waiting = pose, frame
        else:
            self._take_waiting(pose.motion)
            self._take(pose, frame)

    def _take_waiting(self, motion: Motion | None) -> None:
        """Take the frame that waits for the motion during its sweep, if there is one; None = unknown."""
        if self._waiting is not None:
            (pose, frame), self._waiting = self._waiting, None
            self._take(dataclasses.replace(pose, motion=motion), frame)

    def _take(self, pose: TrackedPose, frame: Frame) -> None:
        """Store the pose of a frame, and send the frame if it is a keyframe."""
        submap, T = self.submaps[-1], pose.T_world_camera
        reason = self._selector.reason(frame, T)
        seq = None
        if reason is not None:
            self._selected[reason] += 1
            self._selector.accept(frame, T)
            placed = ColorPlace().registered(frame, pose.T_then_now)
            seq = submap.client.send(placed.keyframe(T, pose.motion))
        submap.located.add(pose, frame.T_world_camera, seq, frame.specific_force)

    def _handle_lost(self, lost: Lost, frame: Frame) -> None:
        self._lost += 1
        if self._state == "tracking":
            log.warning("the sensor is lost: %s", lost.reason)
        self._why = self.last_loss = lost.reason
        self._state = "lost" if self.submaps[-1].located and self._next is None else "starting"
        if self._lost_since is None:
            self._lost_since = frame.timestamp_ns
        seconds = (frame.timestamp_ns - self._lost_since) / 1e9
        may_begin = not self._localizer.absolute and len(self.submaps) != self._most
        if self._state == "lost" and seconds >= self._config.patience and may_begin:
            self._begin_submap(seconds)

    def _begin_submap(self, seconds: float) -> None:
        names = filter(None, chain([self._free_name()], map(self._name, count(2))))
        name = next(name for name in names if name not in self._taken)
        self._taken.add(name)
        self._take_waiting(None)
        self._localizer.settle()
        self._correct_if_known()
        log.warning("lost for %.1f s (%s): later keyframes go into a new map, %s", seconds, self._why, name)
        self._localizer.reset()
        self._selector.reset()
        self._state, self._lost_since, self._next = "starting", None, name

    def _name(self, number: int) -> str:
        suffix = f"-{number}"
        return self._map_name[: MAP_NAME_LENGTH - len(suffix)] + suffix

    def _correct_if_known(self) -> None:
        corrections, submap = self._localizer.corrections(), self.submaps[-1]
        if corrections is None:
            return
        before = submap.corrections.loops if submap.corrections else 0
        submap.corrections = corrections
        if corrections.loops > before:
            log.info("a place was seen again: %s closed", count_of(corrections.loops, "loop"))
        submap.correct()


def _total(stats: list[ClientStats]) -> ClientStats:
    """Return the sums of several clients' counts, with the first state that is not "ok"."""

    def together(values: list[Any]) -> Any:
        if isinstance(values[0], dict):
            return dict(sum(map(Counter, values), Counter()))
        if isinstance(values[0], int):
            return sum(values)
        return next((value for value in values if value != "ok"), "ok")

    names = ClientStats.__struct_fields__
    return ClientStats(*(together([getattr(each, name) for each in stats]) for name in names))


def _newest_delay(client: Client) -> float | None:
    record = client.newest_fused
    if record is None or not record.captured_ns:
        return None
    return (record.fused_ns - record.captured_ns) / 1e6
