# SPDX-License-Identifier: MIT
"""Loop closure around any localizer of images with depth."""

import itertools
import logging
import os
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import ParamSpec

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry import se3
from tsfusion.geometry.frame import Frame
from tsfusion.scanner.localization.localizer import Localizer, Lost, PoseCorrections, TrackedPose
from tsfusion.scanner.localization.loop_closure import loop_consensus, pose_graph
from tsfusion.scanner.localization.loop_closure.loop_consensus import (
    Loop,
    LoopConsensus,
    OdometryChain,
    OdometryDrift,
)
from tsfusion.scanner.localization.loop_closure.place_index import CAPACITY, PlaceIndex, PlaceView, place_view

MIN_KEYFRAMES, MIN_WAY = 10, 3.0  # keyframes, and metres plus radians of way: younger places are no loops
MOST_WAITING = 4  # keyframes that wait for the search beside the tracker; with more the tracker waits
MAX_CHECKS = 4  # places compared with each keyframe
MAX_LOOPS = 2  # of one keyframe; one is enough if it changes little
NEAR_DISTANCE, NEAR_ANGLE = 1.0, np.radians(30)  # metres, radians: places compared whatever they look like
WAIT_KEYFRAMES = 10  # until the next optimisation, for loops that change little
LARGE_CHANGE, LARGE_TURN = 0.04, np.radians(1.0)  # metres, radians: a loop that changes more does not wait
KEYFRAMES_AN_OPTIMISATION = 50  # of this many keyframes costs as much as finding the loops of one
LOST_FRAMES_A_SEARCH = 2  # looking for a place costs more than tracking
MIN_RELOCALISATION_MATCHES = 30  # that must agree where no odometry supports a place
MAX_PLACE_SPREAD = 0.3  # metres between the poses that several places give

log = logging.getLogger(__name__)
Given = ParamSpec("Given")
_NICE = 10  # of the thread


@dataclass(kw_only=True)
class LoopCounts:
    """Counts since the last `reset`."""

    keyframes: int = 0  # tracking keyframes
    checks: int = 0  # places compared
    verified: int = 0  # comparisons that found the same place
    closed: int = 0  # loops accepted
    optimisations: int = 0  # of the pose graph


class LoopClosing:
    """`Localizer` that passes on another one's poses, and corrects them where a place is seen again.

    Poses never jump; `corrections()` has the corrected ones. Each tracking keyframe with an image
    and depth costs about 30 CPU ms, plus 0.15 ms a keyframe of the graph when it is optimised, which with
    1,000 keyframes is every twentieth time at most. Memory: 52 KB a place, of which at most `capacity`
    are remembered (the one nearest to its neighbours is forgotten), and 2 KB a tracking keyframe.
    No loops are found among LiDAR frames, which have no image.

    Args:
        localizer: the tracker; its world must stay the same between resets.
        drift: uncertainty of its poses.
        capacity: number of places remembered.
        beside: search in a thread of its own, in the keyframes' order, while the tracker goes on; then
            corrections come a little later, and the last ones after `settle`. They are the same.

    Raises:
        MissingDependency: without scipy.
    """

    def __init__(
        self,
        localizer: Localizer,
        *,
        drift: OdometryDrift | None = None,
        capacity: int = CAPACITY,
        beside: bool = False,
    ) -> None:
        pose_graph.require()
        self._localizer, self._drift, self._capacity = localizer, drift or OdometryDrift(), capacity
        self.absolute = localizer.absolute
        self._search = OrderedWork("loops", MOST_WAITING) if beside else None
        self._forget()

    def _forget(self) -> None:
        self._chain = OdometryChain(self._drift)
        self.consensus = LoopConsensus(self._chain)
        self._places = PlaceIndex(self._capacity)
        self._corrected: dict[int, se3.Transform] = {}
        self.counts = LoopCounts()
        self._news: deque[PoseCorrections] = deque(maxlen=1)  # those that `corrections` did not return yet
        self._optimisation_due = False
        self._optimised_at = 0  # keyframes then
        self._lost = 0  # frames, since the last that was not
        self._T_world_tracker: se3.Transform = np.eye(4)  # another where the tracker was restarted

    def track(self, frame: Frame) -> TrackedPose | Lost:
        """Track with the wrapped localizer; when it is lost, search for a known place to go on from."""
        found = self._localizer.track(frame)
        if isinstance(found, Lost):
            self._lost += 1
            found = self._relocalised(frame, found) if self._lost % LOST_FRAMES_A_SEARCH == 0 else found
        if isinstance(found, Lost):
            return found
        self._lost = 0
        pose = replace(found, T_world_camera=self._T_world_tracker @ found.T_world_camera)
        if pose.starts_anchor:
            if self._search is None:
                self._keyframe(pose, frame)
            else:
                self._search.add(self._keyframe, pose, frame)
        return pose

    def prepare(self) -> None:
        """Let the wrapped localizer prepare for the next frame."""
        self._localizer.prepare()

    def settle(self) -> None:
        """Wait until every keyframe so far was compared with the places before it."""
        if self._search is not None:
            self._search.wait()

    def _relocalised(self, frame: Frame, lost: Lost) -> TrackedPose | Lost:
        """Restart the tracker at a place that was seen before."""
        place = self.relocalise(frame)
        if place is None:
            return lost
        self._localizer.reset()
        begun = self._localizer.track(frame)
        if isinstance(begun, TrackedPose):
            self._T_world_tracker = place.T_world_camera @ se3.inverse(begun.T_world_camera)
        return begun

    def corrections(self) -> PoseCorrections | None:
        """Poses of all tracking keyframes after the last optimisation; None if they were returned before."""
        with suppress(IndexError):
            return self._news.pop()
        return None

    def reset(self) -> None:
        """Forget the world, its places and corrections."""
        self.settle()
        self._localizer.reset()
        self._forget()

    def relocalise(self, frame: Frame) -> TrackedPose | None:
        """Find a frame's pose by the remembered places alone; None unless the place is certain."""
        self.settle()
        seen = _described(frame)
        if seen is None:
            return None
        found = []
        for place in self._places.most_similar(seen, count=MAX_CHECKS):
            result = loop_consensus.check_loop(self._places.views[place], seen)
            if (
                result.refused is None
                and result.T_old_new is not None
                and result.inliers >= MIN_RELOCALISATION_MATCHES
            ):
                found.append((place, result.T_old_new))
        if not found or not all(self.consensus.unique(place) for place, _ in found):
            return None
        poses = [self._corrected[place] @ T for place, T in found]
        if any(se3.distance(se3.inverse(poses[0]) @ other) > MAX_PLACE_SPREAD for other in poses[1:]):
            return None
        place, T = found[0]
        return TrackedPose(
            T_world_camera=self._chain.poses[place] @ T,
            timestamp_ns=frame.timestamp_ns,
            anchor=place,
            T_anchor_camera=T,
        )

    def _correction(self) -> se3.Transform:
        """`T_corrected_world` after the last keyframe."""
        last = next(reversed(self._corrected))
        return self._corrected[last] @ se3.inverse(self._chain.poses[last])

    def _keyframe(self, pose: TrackedPose, frame: Frame) -> None:
        T = self._correction() if self._corrected else np.eye(4)
        self._chain.add(pose.anchor, pose.T_world_camera)
        self._corrected[pose.anchor] = T @ pose.T_world_camera
        self.counts.keyframes += 1
        seen = _described(frame)
        if seen is not None:
            accepted = self.consensus.add(self._loops(pose.anchor, seen))
            self.counts.closed += len(accepted)
            self._optimisation_due |= bool(accepted)
            waited = self.counts.keyframes - self._optimised_at
            patience = 0 if any(map(self._changes_much, accepted)) else WAIT_KEYFRAMES
            if self._optimisation_due and waited >= max(
                patience, self.counts.keyframes // KEYFRAMES_AN_OPTIMISATION
            ):
                self._optimise()
            self._remember(pose.anchor, seen)

    def _loops(self, number: int, seen: PlaceView) -> list[Loop]:
        """Verified loops from a new keyframe to earlier places."""
        before = self._old_enough(number)
        if before is None:
            return []
        likely = [
            *self._nearby(number, before)[:1],
            *self._places.most_similar(seen, before=before, count=MAX_CHECKS),
        ]
        found: list[Loop] = []
        for place in list(dict.fromkeys(likely))[:MAX_CHECKS]:
            result = loop_consensus.check_loop(self._places.views[place], seen)
            self.counts.checks += 1
            if result.refused is None and result.T_old_new is not None:
                self.counts.verified += 1
                found.append(Loop(place, number, result.T_old_new, result.sigma))
                if len(found) == MAX_LOOPS or not self._changes_much(found[-1]):
                    break
        return found

    def _old_enough(self, number: int) -> int | None:
        """Number below which keyframes may form loops; None = none is old enough."""
        ways = self._chain.ways
        earlier = itertools.islice(reversed(ways), MIN_KEYFRAMES, None)
        return next((other + 1 for other in earlier if ways[number] - ways[other] >= MIN_WAY), None)

    def _nearby(self, number: int, before: int) -> list[int]:
        """Places whose corrected poses are near the keyframe's, the nearest first."""
        places = [place for place in self._places.views if place < before]
        if not places:
            return []
        here = self._corrected[number]
        poses = np.array([self._corrected[place] for place in places])
        away = np.linalg.norm(poses[:, :3, 3] - here[:3, 3], axis=1) / NEAR_DISTANCE
        cosine = (np.einsum("nij,ij->n", poses[:, :3, :3], here[:3, :3]) - 1) / 2
        turned = np.arccos(np.clip(cosine, -1, 1)) / NEAR_ANGLE
        return [places[i] for i in np.argsort(away + turned) if max(away[i], turned[i]) < 1]

    def _changes_much(self, loop: Loop) -> bool:
        T = se3.inverse(self._corrected[loop.old]) @ self._corrected[loop.new]
        error = se3.inverse(loop.T_old_new) @ T
        return se3.distance(error) > LARGE_CHANGE or se3.angle(error) > LARGE_TURN

    def _optimise(self) -> None:
        loops = self.consensus.accepted
        solution = pose_graph.optimise(self._corrected, [*self._chain.edges, *(loop.edge for loop in loops)])
        for loop, weight in zip(list(loops), solution.weights[len(self._chain.edges) :], strict=True):
            if weight == 0:
                self.consensus.withdraw(loop)
                self.counts.closed -= 1
        self._corrected = solution.nodes
        self.counts.optimisations += 1
        self._optimised_at, self._optimisation_due = self.counts.keyframes, False
        self._news.append(
            PoseCorrections(
                revision=self.counts.optimisations,
                anchors=dict(self._corrected),
                T_corrected_world=self._correction(),
                loops=self.counts.closed,
            )
        )
        log.debug("closed %d loops: χ² %.1f → %.1f", self.counts.closed, solution.before, solution.after)

    def _remember(self, number: int, seen: PlaceView) -> None:
        if self._places.full:
            self._places.forget(self._dispensable())
        self._places.add(number, seen)

    def _dispensable(self) -> int:
        """Place whose removal leaves the smallest gap along the way."""
        places = sorted(self._places.views)
        ways = np.array([self._chain.ways[place] for place in places])
        return places[1 + int(np.argmin(ways[2:] - ways[:-2]))] if len(places) > 2 else places[0]


def _described(frame: Frame) -> PlaceView | None:
    depth = _depth(frame)
    return None if depth is None else place_view(frame, depth)


def _depth(frame: Frame) -> NDArray[np.float32] | None:
    """Depth of a frame, (H, W) metres; of a stereo pair by quick matching."""
    disparity = frame.tracking_disparity
    if disparity is None or frame.baseline_fx is None:
        return frame.depth_m
    depth = np.zeros_like(disparity)
    np.divide(np.float32(frame.baseline_fx), disparity, out=depth, where=disparity > 0)
    return depth


class OrderedWork:
    """Calls that one thread makes, one after the other.

    Args:
        name: of the thread.
        most: number of calls that wait or are under way; `add` waits for room.
    """

    def __init__(self, name: str, most: int) -> None:
        self._thread = ThreadPoolExecutor(1, thread_name_prefix=name, initializer=_be_nice)
        self._most = most
        self._waiting: deque[Future[None]] = deque()

    def add(self, call: Callable[Given, None], *args: Given.args, **kwargs: Given.kwargs) -> None:
        """Have a call made after those before it. An earlier call's error is raised here, or by `wait`."""
        while self._waiting and (self._waiting[0].done() or len(self._waiting) >= self._most):
            self._waiting.popleft().result()
        self._waiting.append(self._thread.submit(call, *args, **kwargs))

    def wait(self) -> None:
        """Wait until all calls were made."""
        while self._waiting:
            self._waiting.popleft().result()


def _be_nice() -> None:
    """Let the tracker's thread go first, where threads have a priority of their own."""
    if hasattr(os, "setpriority") and hasattr(os, "sched_setaffinity"):  # Linux
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
