# SPDX-License-Identifier: MIT
"""Acceptance of loops: those that odometry allows, that are unique, and that support each other."""

import itertools
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from tsfusion.geometry import se3
from tsfusion.scanner.localization.loop_closure.odometry_drift import OdometryChain
from tsfusion.scanner.localization.loop_closure.pose_graph import PoseGraphEdge, information

GATE = 6.0  # standard deviations by which a loop may contradict the known poses
AMBIGUITY_GATE = 12.0  # deviations up to which another explanation is not ruled out
MIN_SUPPORT = 3  # keyframes whose loops must agree before the first is accepted,
EXPECTED_GATE = 3.0  # or one less within this many deviations of the known poses
SUPPORT_WINDOW = 15  # keyframes for which a loop waits for support
MAX_TWINS = 4  # look-alikes remembered of a place
ROTATION_SIGMA = 0.005  # radians, standard deviation of a loop


@dataclass(frozen=True, eq=False)
class Loop:
    """Claim that keyframe `new` is at `T_old_new` in the axes of `old`, with `sigma` metres of deviation."""

    old: int
    new: int
    T_old_new: se3.Transform
    sigma: float

    @property
    def edge(self) -> PoseGraphEdge:
        """The loop as an edge of the pose graph."""
        return PoseGraphEdge(
            self.old, self.new, self.T_old_new, information(self.sigma, ROTATION_SIGMA), robust=True
        )

    @property
    def covariance(self) -> se3.Matrix6:
        """Covariance (6, 6) of a twist in the axes of `new`."""
        return np.diag([self.sigma**2] * 3 + [ROTATION_SIGMA**2] * 3)


class LoopConsensus:
    """Decide which of the loops that were verified one by one to accept.

    1. The loop must not contradict the odometry, taken over the shortest way: from the start of the loop to
       its end, or through a loop accepted before.
    2. No other explanation may remain: a view that also fits a place elsewhere, or whose place was seen to
       look like another one (a *twin*), is accepted only where odometry rules the other out.
    3. Loops of three keyframes near each other must agree pairwise (Mangelson et al., "Pairwise Consistent
       Measurement Set Maximization", 2018) before any is accepted, or of two where odometry expects them;
       later loops nearby need only agree with one of those.
    """

    def __init__(self, chain: OdometryChain) -> None:
        self._chain = chain
        self.accepted: list[Loop] = []
        self._ends = np.empty((0, 2))  # ways of the accepted loops' ends
        self._waiting: list[Loop] = []
        self._twins: dict[
            int, list[tuple[int, se3.Transform]]
        ] = {}  # place → (another, T_another_place) by looks
        self.refused: dict[str, int] = {}

    def add(self, loops: list[Loop]) -> list[Loop]:
        """Add one keyframe's loops; return the loops to accept now, among them some that waited."""
        if not loops:
            return []
        deviations = [self.deviation(loop.old, loop.new, loop.T_old_new, loop.covariance) for loop in loops]
        allowed = [loop for loop, d in zip(loops, deviations, strict=True) if d <= GATE]
        for loop, d in zip(loops, deviations, strict=True):
            if d > GATE:
                self._count("contradicts the odometry")
                self._remember_twin(loop, allowed)
        if not allowed:
            return []
        if (
            self._ambiguous(allowed)
            or min((d for d in deviations if d > GATE), default=np.inf) < AMBIGUITY_GATE
        ):
            self._count("fits another place too")
            return []
        return [found for loop in allowed for found in self._supported(loop)]

    def deviation(self, old: int, new: int, T_old_new: se3.Transform, covariance: se3.Matrix6) -> float:
        """Standard deviations (the root of χ²) between a claim and the known poses."""
        T, known = self._known(old, new)
        error = se3.log(se3.inverse(T_old_new) @ T)
        return float(np.sqrt(error @ np.linalg.solve(known + covariance, error)))

    def unique(self, place: int) -> bool:
        """True if no other place looks like this one."""
        return place not in self._twins

    def withdraw(self, loop: Loop) -> None:
        """Withdraw a loop that the pose graph found wrong."""
        self.accepted.remove(loop)
        self._count_ends()
        self._count("contradicts other loops")

    def _known(self, old: int, new: int) -> tuple[se3.Transform, se3.Matrix6]:
        """`T_old_new` and covariance over the shortest way."""
        ways = self._chain.ways
        direct = abs(ways[new] - ways[old])
        if self.accepted:
            over = np.abs(self._ends - (ways[old], ways[new])).sum(axis=1)
            best = int(over.argmin())
            if over[best] < direct:
                return self._through(self.accepted[best], old, new)
        return self._chain.between(old, new)

    def _through(self, loop: Loop, old: int, new: int) -> tuple[se3.Transform, se3.Matrix6]:
        """`T_old_new` and covariance by odometry to a loop, over it, and on."""
        first, first_covariance = self._chain.between(old, loop.old)
        last, covariance = self._chain.between(loop.new, new)
        for behind, known in ((last, loop.covariance), (loop.T_old_new @ last, first_covariance)):
            A = se3.adjoint(se3.inverse(behind))
            covariance = covariance + A @ known @ A.T
        return first @ loop.T_old_new @ last, covariance

    def _supported(self, loop: Loop) -> list[Loop]:
        """The loop, with the waiting ones that agree with it, once they are enough."""
        if any(
            self._age(other, loop) <= SUPPORT_WINDOW and self._agree(other, loop) for other in self.accepted
        ):
            self._accept([loop])
            return [loop]
        self._waiting = [w for w in self._waiting if self._age(w, loop) <= SUPPORT_WINDOW]
        friends: list[Loop] = []
        for other in reversed(self._waiting):
            if all(self._agree(other, friend) for friend in [loop, *friends]):
                friends.insert(0, other)
        expected = self.deviation(loop.old, loop.new, loop.T_old_new, loop.covariance) <= EXPECTED_GATE
        if len({loop.new, *(friend.new for friend in friends)}) < MIN_SUPPORT - expected:
            self._waiting.append(loop)
            return []
        self._waiting = [w for w in self._waiting if w not in friends]
        self._accept([*friends, loop])
        return [*friends, loop]

    def _accept(self, loops: list[Loop]) -> None:
        self.accepted += loops
        self._count_ends()

    def _count_ends(self) -> None:
        ways = self._chain.ways
        self._ends = np.array([(ways[loop.old], ways[loop.new]) for loop in self.accepted]).reshape(-1, 2)

    def _age(self, earlier: Loop, later: Loop) -> int:
        return abs(later.new - earlier.new)

    def _agree(self, one: Loop, two: Loop) -> bool:
        T, known = self._through(one, two.old, two.new)
        error = se3.log(se3.inverse(two.T_old_new) @ T)
        return bool(error @ np.linalg.solve(known + two.covariance, error) <= GATE**2)

    def _remember_twin(self, wrong: Loop, right: Iterable[Loop]) -> None:
        """`wrong.old` looks like the place of `new`: seen from there, or from the place it truly is."""
        self._add_twin(wrong.new, wrong.old, wrong.T_old_new)
        for loop in right:
            self._add_twin(loop.old, wrong.old, wrong.T_old_new @ se3.inverse(loop.T_old_new))

    def _add_twin(self, place: int, other: int, T_other_place: se3.Transform) -> None:
        for a, b, T in ((place, other, T_other_place), (other, place, se3.inverse(T_other_place))):
            twins = self._twins.setdefault(a, [])
            twins.append((b, T))
            del twins[:-MAX_TWINS]

    def _ambiguous(self, loops: list[Loop]) -> bool:
        """True if one keyframe's loops leave its pose ambiguous."""
        for one, two in itertools.combinations(loops, 2):
            if not self._agree(one, two):
                self._remember_twin(two, [one])
                return True
        return any(self._has_twin(loop) for loop in loops)

    def _has_twin(self, loop: Loop) -> bool:
        """True if the loop's place looks like another one where the keyframe could as well be."""
        for other, T_other_old in self._twins.get(loop.old, []):
            claim = T_other_old @ loop.T_old_new
            if (
                other != loop.new
                and self.deviation(other, loop.new, claim, 2 * loop.covariance) < AMBIGUITY_GATE
            ):
                return True
        return False

    def _count(self, reason: str) -> None:
        self.refused[reason] = self.refused.get(reason, 0) + 1
