# SPDX-License-Identifier: MIT
"""Find the pose of a scan in an existing map, from the scan's first keyframes and the map's surface.

Until then the keyframes wait in memory and nothing is sent. Then all are sent with poses in the map.
"""

import math
import signal
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor, Future
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from tsfusion.core import process
from tsfusion.core.config import VolumeConfig
from tsfusion.core.errors import AlignmentRefused
from tsfusion.core.readable_numbers import count_of
from tsfusion.geometry import se3
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.keyframe import Keyframe
from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.se3 import Transform
from tsfusion.scanner.keyframe_selection import KeyframeSelector
from tsfusion.scanner.localization.localizer import Localizer, Lost, PoseCorrections, TrackedPose

FIRST_TRY = 12  # keyframes
_MORE = 1.5  # times as many for the next try
MOST_KEYFRAMES = 120  # that may wait in memory: some 400 MB


class ExistingMap(NamedTuple):
    """The existing map in which a scan is to be found."""

    name: str
    mesh: Mesh
    voxel_size: float


class PlacementTry(NamedTuple):
    """Result of one try: the pose of the scan's world in the map, or the reason why it is unknown."""

    T_map_world: Transform | None
    why: str


@dataclass
class Placing:
    """Pose of a scan's world in a map, and the frames that were taken while it was searched.

    Attributes:
        T_map_world: (4, 4); None if it was not found.
        why: reason why it was not found.
        frames: all frames taken; a frame that is no keyframe has lost its measurement.
        answers: the localizer's answer to each frame.
        keyframes: keyframes with their poses in the localizer's world.
    """

    T_map_world: Transform | None = None
    why: str = "no frame had a pose"
    frames: list[Frame] = field(default_factory=list)
    answers: list[TrackedPose | Lost] = field(default_factory=list)
    keyframes: list[Keyframe] = field(default_factory=list)


def locate(existing: ExistingMap, config: VolumeConfig, keyframes: Sequence[Keyframe]) -> PlacementTry:
    """Find the pose of the keyframes' world in a map. Runs in a process of its own."""
    from tsfusion.pipelines.maps import map_alignment
    from tsfusion.tsdf.volume import Volume

    volume = Volume(config)
    for keyframe in keyframes:
        volume.integrate(keyframe)
    views = [keyframes[index] for index in map_alignment.spread(len(keyframes))]
    scan = map_alignment.map_of_volume("the scan", volume, views)
    there = map_alignment.AlignedMap(
        name=f"the map {existing.name}", mesh=existing.mesh.without_islands(), voxel_size=existing.voxel_size
    )
    try:
        return PlacementTry(np.array(map_alignment.align(there, scan).T_a_b), "")
    except AlignmentRefused as error:
        return PlacementTry(None, str(error))


def find_place(
    existing: ExistingMap,
    config: VolumeConfig,
    localizer: Localizer,
    frames: Iterator[Frame],
    selector: KeyframeSelector,
    *,
    live: bool,
    tell: Callable[[str], None],
) -> Placing:
    """Localise frames until their pose in the map is found, they end, or too many keyframes wait.

    A lost sensor ends the search, too. A live source is read on while a try runs.

    Args:
        config: settings of the temporary map that is made of the scan's keyframes.
        live: True if the source does not wait for its reader.
        tell: gets a line for the user at each try.
    """
    from concurrent.futures import ProcessPoolExecutor  # a megabyte and more; most scans look for no place
    from multiprocessing import get_context

    placing, next_try = Placing(), FIRST_TRY
    running: Future[PlacementTry] | None = None

    def begin() -> Future[PlacementTry]:
        keyframes = list(placing.keyframes)
        tell(f"looking for the place of {count_of(len(keyframes), 'keyframe')} in the map {existing.name}")
        return worker.submit(locate, existing, config, keyframes)

    with ProcessPoolExecutor(1, mp_context=get_context("spawn"), initializer=_begin_worker) as worker:
        for frame in frames:
            lost = _take(frame, localizer, selector, placing)
            count = len(placing.keyframes)
            if running is None and count >= next_try:
                running, next_try = begin(), math.ceil(_MORE * count)
            if running is not None and (not live or running.done()):
                placing.T_map_world, placing.why = _answer(running)
                running = None
            if placing.T_map_world is not None or count >= MOST_KEYFRAMES or (lost and count):
                break
        if running is not None:
            placing.T_map_world, placing.why = _answer(running)
        if placing.T_map_world is None and placing.keyframes:  # last try, with all keyframes
            placing.T_map_world, placing.why = _answer(begin())
    return placing


def _take(frame: Frame, localizer: Localizer, selector: KeyframeSelector, placing: Placing) -> bool:
    """Localise a frame and keep it. Return True if the sensor is lost."""
    found = localizer.track(frame)
    is_lost = isinstance(found, Lost)
    if not isinstance(found, Lost) and selector.reason(frame, found.T_world_camera) is not None:
        selector.accept(frame, found.T_world_camera)
        placing.keyframes.append(frame.keyframe(found.T_world_camera, found.motion))
    else:
        frame = Frame(
            sensor=frame.sensor, timestamp_ns=frame.timestamp_ns, captured_ns=frame.captured_ns,
            T_world_camera=frame.T_world_camera, specific_force=frame.specific_force,
            points=np.empty((0, 3), np.float32),
        )  # fmt: skip
    placing.frames.append(frame)
    placing.answers.append(found)
    return is_lost


def _answer(running: "Future[PlacementTry]") -> PlacementTry:
    try:
        return running.result()
    except BrokenExecutor:
        return PlacementTry(None, "the process that looked for it ended; was there memory enough?")


class PlacedLocalizer:
    """A localizer with poses in the map's frame: the poses of another localizer, moved by `T_map_world`.

    Args:
        localizer: localizer of the scan.
        T_map_world: (4, 4); the identity if no pose was found.
        earlier: answers that `localizer` gave already, for the first frames in order.
    """

    def __init__(
        self, localizer: Localizer, T_map_world: Transform, earlier: Sequence[TrackedPose | Lost]
    ) -> None:
        self.absolute = localizer.absolute
        self._localizer, self._T = localizer, T_map_world
        self._earlier = deque(earlier)

    def track(self, frame: Frame) -> TrackedPose | Lost:
        found = self._earlier.popleft() if self._earlier else self._localizer.track(frame)
        if isinstance(found, Lost):
            return found
        return replace(found, T_world_camera=se3.nearest(self._T @ found.T_world_camera))

    def prepare(self) -> None:
        self._localizer.prepare()

    def settle(self) -> None:
        self._localizer.settle()

    def corrections(self) -> PoseCorrections | None:
        found = None if self._earlier else self._localizer.corrections()
        if found is None:
            return None
        T = self._T
        return replace(
            found,
            anchors={anchor: se3.nearest(T @ pose) for anchor, pose in found.anchors.items()},
            T_corrected_world=se3.nearest(T @ found.T_corrected_world @ se3.inverse(T)),
        )

    def reset(self) -> None:
        """Begin a new world. Its pose in the map is unknown, so it gets a map of its own."""
        self._localizer.reset()
        if not self.absolute:
            self._T = np.eye(4)

    def close(self) -> None:
        """Close what the localizer holds."""
        getattr(self._localizer, "close", lambda: None)()


def _begin_worker() -> None:
    """Ignore Ctrl-C, which the terminal sends to all its processes. End when the scan's process ends."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    process.on_parent_end(signal.SIGKILL)
