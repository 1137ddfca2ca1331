# SPDX-License-Identifier: MIT
"""Loop closure around any localizer that follows images with depth."""

import itertools
import logging
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry import se3
from tsfusion.geometry.frame import Frame
from tsfusion.scanner.localization.localizer import Localizer, Lost, Pose, PoseCorrections
from tsfusion.scanner.localization.loop_closure import pose_graph, verification
from tsfusion.scanner.localization.loop_closure.loop_consensus import Loop, LoopConsensus
from tsfusion.scanner.localization.loop_closure.odometry_drift import OdometryChain, OdometryDrift
from tsfusion.scanner.localization.loop_closure.place_index import CAPACITY, PlaceIndex, PlaceView, view

_GAP = (10, 3.0)  # keyframes, and metres and radians of way: what is younger is no loop
_CHECKS = 4  # views compared with each keyframe's
_ENOUGH = 2  # loops of one keyframe; one if it says what was known
_NEAR = (1.0, np.radians(30))  # metres and radians: places worth a look whatever they look like
_PATIENCE = 10  # keyframes that loops which change little wait for the next optimisation
_CHANGE = (0.04, np.radians(1.0))  # of metres and radians: a loop that changes more does not wait
_THRIFT = 50  # with so many keyframes an optimisation costs as much as finding one's loops
_TRY_AGAIN = 2  # lost frames: looking for a place costs more than tracking
_RELOCALISED = 30  # matches that must agree where no odometry speaks for a place
_ONE_PLACE = 0.3  # metres between what several of them say

log = logging.getLogger(__name__)


@dataclass(kw_only=True)
class LoopCounts:
    """What happened since the last `reset`: keyframes, views compared, loops that looked right, believed."""

    keyframes: int = 0
    checks: int = 0
    verified: int = 0
    closed: int = 0
    optimisations: int = 0


class LoopClosing:
    """Passes a localizer's poses through, and finds out where the sensor has been before.

    Poses never jump; `corrections()` says what they should have been. Each tracking keyframe with an image
    and depth costs about 30 CPU ms, plus 0.15 ms a keyframe of the graph when it is optimised, which with
    1,000 keyframes is every twentieth time at most. Memory: 52 KB a place, of which at most `capacity`
    are remembered (then the one that is nearest to its neighbours goes), and 2 KB a tracking keyframe.
    LiDAR frames have no image: they are passed through, and no loop is found.

    Args:
        localizer: what to wrap; its world must stay one between resets.
        drift: how far its poses may be off.
        capacity: places remembered.

    Raises:
        MissingDependency: without scipy.
    """

    def __init__(
        self, localizer: Localizer, *, drift: OdometryDrift | None = None, capacity: int = CAPACITY
    ) -> None:
        pose_graph.require()
        self._localizer, self._drift, self._capacity = localizer, drift or OdometryDrift(), capacity
        self.absolute = localizer.absolute
        self._forget()

    def _forget(self) -> None:
        self._chain = OdometryChain(self._drift)
        self.consensus = LoopConsensus(self._chain)
        self._places = PlaceIndex(self._capacity)
        self._corrected: dict[int, se3.Transform] = {}
        self.counts = LoopCounts()
        self._news = False
        self._due = False
        self._optimised_at = 0  # keyframes then
        self._lost = 0  # frames, since the last that was not
        self._T_world_tracker: se3.Transform = np.eye(
            4
        )  # the tracker's world began anew where it was found again

    def track(self, frame: Frame) -> Pose | Lost:
        """As the wrapped localizer says; a lost one goes on where a place is known again."""
        found = self._localizer.track(frame)
        if isinstance(found, Lost):
            self._lost += 1
            found = self._found_again(frame, found) if self._lost % _TRY_AGAIN == 0 else found
        if isinstance(found, Lost):
            return found
        self._lost = 0
        pose = replace(found, T_world_camera=self._T_world_tracker @ found.T_world_camera)
        if pose.starts_anchor:
            self._keyframe(pose, frame)
        return pose

    def _found_again(self, frame: Frame, lost: Lost) -> Pose | Lost:
        """The tracker's pose after a new beginning at a place that was seen before."""
        place = self.relocalise(frame)
        if place is None:
            return lost
        self._localizer.reset()
        begun = self._localizer.track(frame)
        if isinstance(begun, Pose):
            self._T_world_tracker = place.T_world_camera @ se3.inverse(begun.T_world_camera)
        return begun

    def corrections(self) -> PoseCorrections | None:
        """The poses of all tracking keyframes after the last optimisation; None if that is known already."""
        if not self._news:
            return None
        self._news = False
        return PoseCorrections(
            revision=self.counts.optimisations,
            anchors=dict(self._corrected),
            T_corrected_world=self._correction(),
            loops=self.counts.closed,
        )

    def reset(self) -> None:
        """Forget the world, its places and corrections."""
        self._localizer.reset()
        self._forget()

    def relocalise(self, frame: Frame) -> Pose | None:
        """Where a frame was taken, by the remembered places alone; None where no place is surely its own."""
        seen = _view(frame)
        if seen is None:
            return None
        found = []
        for place in self._places.most_similar(seen, count=_CHECKS):
            result = verification.check(self._places.views[place], seen)
            if result.refused is None and result.T_old_new is not None and result.inliers >= _RELOCALISED:
                found.append((place, result.T_old_new))
        if not found or not all(self.consensus.unique(place) for place, _ in found):
            return None
        poses = [self._corrected[place] @ T for place, T in found]
        if any(se3.distance(se3.inverse(poses[0]) @ other) > _ONE_PLACE for other in poses[1:]):
            return None
        place, T = found[0]
        return Pose(
            T_world_camera=self._chain.poses[place] @ T,
            timestamp_ns=frame.timestamp_ns,
            anchor=place,
            T_anchor_camera=T,
        )

    def _correction(self) -> se3.Transform:
        """`T_corrected_world` after the last keyframe."""
        last = next(reversed(self._corrected))
        return self._corrected[last] @ se3.inverse(self._chain.poses[last])

    def _keyframe(self, pose: Pose, frame: Frame) -> None:
        T = self._correction() if self._corrected else np.eye(4)
        self._chain.add(pose.anchor, pose.T_world_camera)
        self._corrected[pose.anchor] = T @ pose.T_world_camera
        self.counts.keyframes += 1
        seen = _view(frame)
        if seen is not None:
            believed = self.consensus.add(self._loops(pose.anchor, seen))
            self.counts.closed += len(believed)
            self._due |= bool(believed)
            waited = self.counts.keyframes - self._optimised_at
            patience = 0 if any(map(self._changes_much, believed)) else _PATIENCE
            if self._due and waited >= max(patience, self.counts.keyframes // _THRIFT):
                self._optimise()
            self._remember(pose.anchor, seen)

    def _loops(self, number: int, seen: PlaceView) -> list[Loop]:
        """Loops from a new keyframe to places that check out."""
        before = self._old_enough(number)
        if before is None:
            return []
        likely = [
            *self._nearby(number, before)[:1],
            *self._places.most_similar(seen, before=before, count=_CHECKS),
        ]
        found: list[Loop] = []
        for place in list(dict.fromkeys(likely))[:_CHECKS]:
            result = verification.check(self._places.views[place], seen)
            self.counts.checks += 1
            if result.refused is None and result.T_old_new is not None:
                self.counts.verified += 1
                found.append(Loop(place, number, result.T_old_new, result.sigma))
                if len(found) == _ENOUGH or not self._changes_much(found[-1]):
                    break
        return found

    def _old_enough(self, number: int) -> int | None:
        """Keyframes below this number may be loops; None = no one is old enough."""
        ways = self._chain.ways
        earlier = itertools.islice(reversed(ways), _GAP[0], None)
        return next((other + 1 for other in earlier if ways[number] - ways[other] >= _GAP[1]), None)

    def _nearby(self, number: int, before: int) -> list[int]:
        """PlaceIndex that by the corrected poses show the same, the nearest first."""
        places = [place for place in self._places.views if place < before]
        if not places:
            return []
        here = self._corrected[number]
        poses = np.array([self._corrected[place] for place in places])
        away = np.linalg.norm(poses[:, :3, 3] - here[:3, 3], axis=1) / _NEAR[0]
        cosine = (np.einsum("nij,ij->n", poses[:, :3, :3], here[:3, :3]) - 1) / 2
        turned = np.arccos(np.clip(cosine, -1, 1)) / _NEAR[1]
        return [places[i] for i in np.argsort(away + turned) if max(away[i], turned[i]) < 1]

    def _changes_much(self, loop: Loop) -> bool:
        T = se3.inverse(self._corrected[loop.old]) @ self._corrected[loop.new]
        error = se3.inverse(loop.T_old_new) @ T
        return se3.distance(error) > _CHANGE[0] or se3.angle(error) > _CHANGE[1]

    def _optimise(self) -> None:
        loops = self.consensus.believed
        solution = pose_graph.optimise(self._corrected, [*self._chain.edges, *(loop.edge for loop in loops)])
        for loop, weight in zip(list(loops), solution.weights[len(self._chain.edges) :], strict=True):
            if weight == 0:
                self.consensus.disown(loop)
                self.counts.closed -= 1
        self._corrected = solution.nodes
        self.counts.optimisations += 1
        self._optimised_at, self._due, self._news = self.counts.keyframes, False, True
        log.debug("closed %d loops: χ² %.1f → %.1f", self.counts.closed, solution.before, solution.after)

    def _remember(self, number: int, seen: PlaceView) -> None:
        if self._places.full:
            self._places.forget(self._dispensable())
        self._places.add(number, seen)

    def _dispensable(self) -> int:
        """The place that leaves the smallest gap along the way."""
        places = sorted(self._places.views)
        ways = np.array([self._chain.ways[place] for place in places])
        return places[1 + int(np.argmin(ways[2:] - ways[:-2]))] if len(places) > 2 else places[0]


def _view(frame: Frame) -> PlaceView | None:
    depth = _depth(frame)
    return None if depth is None else view(frame, depth)


def _depth(frame: Frame) -> NDArray[np.float32] | None:
    """(H, W) metres; of a stereo pair matched here, quickly."""
    if frame.left is None or frame.right is None or frame.baseline_fx is None:
        return frame.depth_m
    from tsfusion.geometry.stereo_matching import quick_disparity

    disparity = quick_disparity(frame.left, frame.right)
    depth = np.zeros_like(disparity)
    np.divide(np.float32(frame.baseline_fx), disparity, out=depth, where=disparity > 0)
    return depth
