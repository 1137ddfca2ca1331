# SPDX-License-Identifier: MIT
"""Add loop closure to any localizer of images with depth."""

import itertools
import logging
import os
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
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

MIN_KEYFRAMES, MIN_WAY = 10, 3.0  # a loop has at least so many keyframes, and metres plus radians of way
MOST_WAITING = 4  # most keyframes that wait for the search thread; then the tracker waits
MAX_CHECKS = 4  # places compared with each keyframe
MAX_LOOPS = 2  # loops of one keyframe; the first is enough if it changes little
NEAR_DISTANCE, NEAR_ANGLE = 1.0, np.radians(30)  # metres, radians: nearer places are compared in any case
WAIT_KEYFRAMES = 10  # keyframes until the next optimisation, after loops that change little
LARGE_CHANGE, LARGE_TURN = 0.04, np.radians(1.0)  # metres, radians: loops that change more do not wait
KEYFRAMES_AN_OPTIMISATION = 50  # an optimisation of 50 keyframes costs as much as the loop search for one
LOST_FRAMES_A_SEARCH = 2  # every second lost frame is searched: a search costs more than tracking
MIN_RELOCALISATION_MATCHES = 30  # matches that must agree when no odometry supports a place
MAX_PLACE_SPREAD = 0.3  # metres between the poses that the places give

log = logging.getLogger(__name__)
Given = ParamSpec("Given")
_NICE = 10  # nice value of the search thread


class LoopClosing:
    """`Localizer` that passes on another one's poses, and corrects them when a place is seen again.

    The poses never jump; `corrections()` returns the corrected ones. Each tracking keyframe with an image and
    depth costs about 30 CPU ms. An optimisation costs 0.15 ms for each keyframe of the graph; with 1,000
    keyframes it runs at most every twentieth time. Memory: 2 KB for each tracking keyframe, and 52 KB for
    each remembered place. Of at most `capacity` places, the one nearest to its neighbours is forgotten first.
    No loops are found among LiDAR frames, which have no image.

    Args:
        localizer: the tracker; its world must stay the same between resets.
        capacity: number of places remembered.
        beside: True searches in another thread, in the keyframes' order, while the tracker goes on. The same
            corrections then come a little later, the last ones after `settle`.

    Raises:
        MissingDependency: scipy is not installed.
    """

    def __init__(
        self,
        localizer: Localizer,
        *,
        capacity: int = CAPACITY,
        beside: bool = False,
    ) -> None:
        pose_graph.require()
        self._localizer, self._capacity = localizer, capacity
        self.absolute = localizer.absolute
        self._search = OrderedWork("loops", MOST_WAITING) if beside else None
        self._forget()

    def _forget(self) -> None:
        self._chain = OdometryChain(OdometryDrift())
        self.consensus = LoopConsensus(self._chain)
        self._places = PlaceIndex(self._capacity)
        self._corrected: dict[int, se3.Transform] = {}
        self._news: deque[PoseCorrections] = deque(maxlen=1)  # not yet returned by `corrections`
        self._optimisation_due = False
        self._optimised_at = 0  # number of keyframes at the last optimisation
        self._lost = 0  # number of frames lost in a row
        self._T_world_tracker: se3.Transform = np.eye(4)  # changes when the tracker is restarted

    @property
    def keyframes(self) -> int:
        """Number of tracking keyframes since the last `reset`."""
        return len(self._corrected)

    def track(self, frame: Frame) -> TrackedPose | Lost:
        """Track with the wrapped localizer. When it is lost, search a known place from which it can go on."""
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
        self._localizer.prepare()

    def settle(self) -> None:
        """Wait until every keyframe so far was compared with earlier places."""
        if self._search is not None:
            self._search.wait()

    def _relocalised(self, frame: Frame, lost: Lost) -> TrackedPose | Lost:
        """Restart the tracker at a place that was seen before. Return Lost if none is found."""
        place = self.relocalise(frame)
        if place is None:
            return lost
        self._localizer.reset()
        begun = self._localizer.track(frame)
        if isinstance(begun, TrackedPose):
            self._T_world_tracker = place.T_world_camera @ se3.inverse(begun.T_world_camera)
        return begun

    def corrections(self) -> PoseCorrections | None:
        """Return all tracking keyframes' poses after the last optimisation, or None if already returned."""
        with suppress(IndexError):
            return self._news.pop()
        return None

    def reset(self) -> None:
        """Forget the world, with its places and corrections."""
        self.settle()
        self._localizer.reset()
        self._forget()

    def relocalise(self, frame: Frame) -> TrackedPose | None:
        """Find a frame's pose by the remembered places alone. Return None unless the place is certain."""
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
        """Return `T_corrected_world` after the last keyframe."""
        last = next(reversed(self._corrected))
        return self._corrected[last] @ se3.inverse(self._chain.poses[last])

    def _keyframe(self, pose: TrackedPose, frame: Frame) -> None:
        T = self._correction() if self._corrected else np.eye(4)
        self._chain.add(pose.anchor, pose.T_world_camera)
        self._corrected[pose.anchor] = T @ pose.T_world_camera
        seen = _described(frame)
        if seen is not None:
            accepted = self.consensus.add(self._loops(pose.anchor, seen))
            self._optimisation_due |= bool(accepted)
            waited = self.keyframes - self._optimised_at
            patience = 0 if any(map(self._changes_much, accepted)) else WAIT_KEYFRAMES
            if self._optimisation_due and waited >= max(
                patience, self.keyframes // KEYFRAMES_AN_OPTIMISATION
            ):
                self._optimise()
            self._remember(pose.anchor, seen)

    def _loops(self, number: int, seen: PlaceView) -> list[Loop]:
        """Return the verified loops from a new keyframe to earlier places."""
        before = self._old_enough(number)
        if before is None:
            return []
        likely = [
            *self._nearby(number, before)[:1],
            *self._places.most_similar(seen, before=before, count=MAX_CHECKS),
        ]
        found: list[Loop] = []
        for place in list(dict.fromkeys(likely))[:MAX_CHECKS]:
            expected = se3.inverse(self._corrected[place]) @ self._corrected[number]
            result = loop_consensus.check_loop(self._places.views[place], seen, expected)
            if result.refused is None and result.T_old_new is not None:
                found.append(Loop(place, number, result.T_old_new, result.sigma))
                if len(found) == MAX_LOOPS or not self._changes_much(found[-1]):
                    break
        return found

    def _old_enough(self, number: int) -> int | None:
        """Return the number below which keyframes may form loops, or None if no keyframe is old enough."""
        ways = self._chain.ways
        earlier = itertools.islice(reversed(ways), MIN_KEYFRAMES, None)
        return next((other + 1 for other in earlier if ways[number] - ways[other] >= MIN_WAY), None)

    def _nearby(self, number: int, before: int) -> list[int]:
        """Return places whose corrected poses are near the keyframe's, the nearest first."""
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
        self._corrected = solution.nodes
        self._optimised_at, self._optimisation_due = self.keyframes, False
        self._news.append(
            PoseCorrections(
                anchors=dict(self._corrected),
                T_corrected_world=self._correction(),
                loops=len(self.consensus.accepted),
            )
        )
        log.debug("closed %d loops: χ² %.1f → %.1f", len(loops), solution.before, solution.after)

    def _remember(self, number: int, seen: PlaceView) -> None:
        if self._places.full:
            self._places.forget(self._dispensable())
        self._places.add(number, seen)

    def _dispensable(self) -> int:
        """Return the place whose removal leaves the smallest gap along the way."""
        places = sorted(self._places.views)
        ways = np.array([self._chain.ways[place] for place in places])
        return places[1 + int(np.argmin(ways[2:] - ways[:-2]))] if len(places) > 2 else places[0]


def _described(frame: Frame) -> PlaceView | None:
    depth = _depth(frame)
    return None if depth is None else place_view(frame, depth)


def _depth(frame: Frame) -> NDArray[np.float32] | None:
    """Return the depth of a frame, (H, W) metres: of a stereo pair by quick matching, at whatever time."""
    disparity = frame.quick_disparity
    if disparity is None or frame.baseline_fx is None:
        return frame.depth_m
    depth = np.zeros_like(disparity)
    np.divide(np.float32(frame.baseline_fx), disparity, out=depth, where=disparity > 0)
    return depth


class OrderedWork:
    """Thread that makes calls one after the other.

    Args:
        name: of the thread.
        most: largest number of unfinished calls; `add` waits until there are fewer.
    """

    def __init__(self, name: str, most: int) -> None:
        self._thread = ThreadPoolExecutor(1, thread_name_prefix=name, initializer=_be_nice)
        self._most = most
        self._waiting: deque[Future[None]] = deque()

    def add(self, call: Callable[Given, None], *args: Given.args, **kwargs: Given.kwargs) -> None:
        """Add a call after the earlier ones. An error of an earlier call is raised here, or by `wait`."""
        while self._waiting and (self._waiting[0].done() or len(self._waiting) >= self._most):
            self._waiting.popleft().result()
        self._waiting.append(self._thread.submit(call, *args, **kwargs))

    def wait(self) -> None:
        while self._waiting:
            self._waiting.popleft().result()


def _be_nice() -> None:
    """Lower the thread's priority below the tracker's, on systems where each thread has a priority."""
    if hasattr(os, "setpriority") and hasattr(os, "sched_setaffinity"):  # Linux
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
