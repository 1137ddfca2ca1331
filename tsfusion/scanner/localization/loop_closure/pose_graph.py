# SPDX-License-Identifier: MIT
"""Optimise a pose graph: find the poses that fit measurements between pairs of poses.

The method is sparse Levenberg-Marquardt over SE(3) with analytic Jacobians. Edges marked `robust` (loops) may
be wrong. Graduated non-convexity with truncated least squares finds the wrong ones from any start (Yang,
Antonante, Tzoumas and Carlone, "Graduated Non-Convexity for Robust Spatial Perception", 2020).
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import MissingDependency
from tsfusion.geometry import se3

TRUSTED = 22.5  # χ² of a robust edge, six degrees of freedom; one in a thousand exceeds it
_MOST_ITERATIONS = 300  # linear systems solved
_GROWTH = 1.4  # factor of the control parameter, as in the paper
_FIRST_ITERATIONS = 10  # iterations with all edges, before the search for wrong ones
_MIN_STEP = 1e-9  # metres and radians: a smaller step ends the iterations


@dataclass(frozen=True, eq=False)
class PoseGraphEdge:
    """Measured pose of node `end` in the axes of node `start`.

    Attributes:
        T_start_end: (4, 4), the measured pose.
        information: (6, 6) inverse covariance of the twist `log(T_start_end⁻¹ · T_start⁻¹ T_end)`,
            translation first; the function `information` makes such a matrix.
        robust: True if the measurement may be completely wrong.
    """

    start: int
    end: int
    T_start_end: se3.Transform
    information: se3.Matrix6
    robust: bool = False


@dataclass(frozen=True, eq=False, kw_only=True)
class PoseGraphSolution:
    """Corrected poses.

    Attributes:
        nodes: node → (4, 4), in the order given.
        weights: (edges,) 0 to 1. 0 = found wrong and left out; edges that are not robust have 1.
        before, after: sum of the edges' squared errors times `weights`, at the given and at the found poses.
    """

    nodes: dict[int, se3.Transform]
    weights: NDArray[np.float64]
    before: float
    after: float


def information(translation: float, rotation: float) -> se3.Matrix6:
    """Return the information (6, 6) of independent errors with standard deviations in metres and radians."""
    return np.diag([translation**-2.0] * 3 + [rotation**-2.0] * 3)


def optimise(nodes: Mapping[int, se3.Transform], edges: Sequence[PoseGraphEdge]) -> PoseGraphSolution:
    """Find the poses that fit the edges best. The first node keeps its pose.

    Args:
        nodes: node → (4, 4) start pose; edges must connect each node to the first one.

    Raises:
        MissingDependency: scipy is not installed.
    """
    problem = _NormalEquations(nodes, edges)
    T = np.array([nodes[key] for key in nodes], dtype=np.float64)
    weights = np.ones(len(edges))
    if not edges:
        return PoseGraphSolution(nodes=dict(nodes), weights=weights, before=0, after=0)
    start = problem.chi2(T)
    robust = np.array([edge.robust for edge in edges])
    T, used = problem.descend(T, weights, _FIRST_ITERATIONS)
    chi2 = problem.chi2(T)
    worst = float(chi2[robust].max(initial=0.0))
    if worst > TRUSTED:
        control = TRUSTED / (2 * worst - TRUSTED)
        while used < _MOST_ITERATIONS:
            weights = np.where(robust, _truncated(chi2, control), 1.0)
            T, more = problem.descend(T, weights, min(2, _MOST_ITERATIONS - used))
            used, control, chi2 = used + more, control * _GROWTH, problem.chi2(T)
            if np.isin(weights, (0.0, 1.0)).all():
                break
        weights = np.where(robust & (chi2 > TRUSTED), 0.0, 1.0)
    if used >= _FIRST_ITERATIONS:  # `descend` may have ended too early
        T, _ = problem.descend(T, weights, max(_MOST_ITERATIONS - used, 1))
    return PoseGraphSolution(
        nodes=dict(zip(nodes, T, strict=True)),
        weights=weights,
        before=float(weights @ start),
        after=float(weights @ problem.chi2(T)),
    )


def _truncated(chi2: NDArray[np.float64], control: float) -> NDArray[np.float64]:
    """Return weights of truncated least squares, smoothed by the control parameter (the paper's eq. 14)."""
    inner, outer = control / (control + 1) * TRUSTED, (control + 1) / control * TRUSTED
    between = np.sqrt(TRUSTED * control * (control + 1) / np.maximum(chi2, 1e-300)) - control
    return np.where(chi2 <= inner, 1.0, np.where(chi2 >= outer, 0.0, np.clip(between, 0, 1)))


class _NormalEquations:
    """The edges as arrays, and the sparsity of their normal equations."""

    def __init__(self, nodes: Mapping[int, se3.Transform], edges: Sequence[PoseGraphEdge]) -> None:
        require()
        import scipy.sparse
        import scipy.sparse.linalg

        self._linalg, self._sparse = scipy.sparse.linalg, scipy.sparse
        place = {key: index for index, key in enumerate(nodes)}
        self._start = np.array([place[edge.start] for edge in edges], dtype=np.int64)
        self._end = np.array([place[edge.end] for edge in edges], dtype=np.int64)
        self._inverse = se3.inverse(np.array([e.T_start_end for e in edges]).reshape(-1, 4, 4))
        self._information = np.array([edge.information for edge in edges]).reshape(-1, 6, 6)
        self._size = 6 * (len(nodes) - 1)  # the first node is fixed
        self._lay_out()

    def _lay_out(self) -> None:
        """Find the index in a CSC matrix of each number of the edges' four 6×6 blocks."""
        six = np.arange(6)
        first, second = (6 * (ends[:, None] - 1) + six for ends in (self._start, self._end))  # (m, 6)
        rows, columns = [], []
        for a, b in ((first, first), (first, second), (second, first), (second, second)):
            rows.append(np.repeat(a, 6, axis=1))
            columns.append(np.tile(b, (1, 6)))
        row, column = np.concatenate(rows).ravel(), np.concatenate(columns).ravel()
        self._variable = (row >= 0) & (column >= 0)
        keys = column[self._variable] * self._size + row[self._variable]
        unique, self._slot = np.unique(keys, return_inverse=True)
        column, self._rows = np.divmod(unique, max(self._size, 1))
        self._pointers = np.searchsorted(column, np.arange(self._size + 1))
        self._diagonal = np.flatnonzero(column == self._rows)
        ends = np.concatenate([first, second]).ravel()
        self._known, self._ends = ends >= 0, ends[ends >= 0]

    def errors(self, T: se3.Transform) -> se3.Twist:
        """Return the errors of the edges, (m, 6) twists."""
        return se3.log(self._inverse @ se3.inverse(T[self._start]) @ T[self._end])

    def chi2(self, T: se3.Transform) -> NDArray[np.float64]:
        """Return squared errors, (m,), weighted by the edges' information."""
        return _squares(self.errors(T), self._information)

    def descend(
        self, T: se3.Transform, weights: NDArray[np.float64], steps: int
    ) -> tuple[se3.Transform, int]:
        """Run at most `steps` steps of Levenberg-Marquardt. Return the poses and the number of steps."""
        damping, error = 1e-7, self.errors(T)
        cost = float(weights @ _squares(error, self._information))
        for step in range(steps):
            H, g = self._normal(T, error, weights)
            while damping < 1e9:
                x = self._solve(H, g, damping)
                moved = T.copy()
                moved[1:] = T[1:] @ se3.exp(x.reshape(-1, 6))
                new_error = self.errors(moved)
                new = float(weights @ _squares(new_error, self._information))
                if new <= cost or np.abs(x).max(initial=0.0) < _MIN_STEP:
                    break
                damping = max(damping, 1e-7) * 10
            if new >= cost:
                return T, step + 1
            gained, T, error, cost, damping = cost - new, moved, new_error, new, damping / 10
            if np.abs(x).max() < _MIN_STEP or gained < 1e-10 * cost:
                return T, step + 1
        return T, steps

    def _normal(
        self, T: se3.Transform, error: NDArray[np.float64], weights: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return the values of the CSC matrix JᵀΩJ, and −JᵀΩe."""
        second = se3.right_jacobian_inverse(error)
        first = -second @ se3.adjoint(se3.inverse(T[self._end]) @ T[self._start])
        information = weights[:, None, None] * self._information
        a, b = (J.transpose(0, 2, 1) @ information for J in (first, second))
        blocks = np.concatenate([a @ first, a @ second, b @ first, b @ second])
        H = _sums(self._slot, blocks.ravel()[self._variable], len(self._rows))
        g = np.concatenate([np.einsum("nij,nj->ni", J, error) for J in (a, b)]).ravel()
        return H, -_sums(self._ends, g[self._known], self._size)

    def _solve(self, H: NDArray[np.float64], g: NDArray[np.float64], damping: float) -> NDArray[np.float64]:
        if not self._size:
            return np.zeros(0)
        H = H.copy()
        H[self._diagonal] += damping * H[self._diagonal] + 1e-12
        shape = (self._size, self._size)
        matrix = self._sparse.csc_matrix((H, self._rows, self._pointers), shape=shape)
        factors = self._linalg.splu(
            matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True}
        )
        x: NDArray[np.float64] = factors.solve(g)
        return x


def _sums(places: NDArray[np.int64], values: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    return np.bincount(places, weights=values, minlength=count).astype(np.float64)


def _squares(error: NDArray[np.float64], information: NDArray[np.float64]) -> NDArray[np.float64]:
    result: NDArray[np.float64] = np.einsum("ni,nij,nj->n", error, information, error, optimize=True)
    return result


def require() -> None:
    """Check that scipy is installed. It is imported with the first loop only: it takes 25 MB.

    Raises:
        MissingDependency: scipy is not installed.
    """
    with suppress(ImportError):
        if find_spec("scipy.sparse") is not None:
            return
    raise MissingDependency(
        "pose graphs need scipy; install it with: pip install '.[slam]' in your clone of tsfusion"
    )
