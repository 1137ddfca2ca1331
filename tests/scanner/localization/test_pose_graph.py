# SPDX-License-Identifier: MIT
"""Pose graphs: the laws of an optimum, an independent solver, and loops that are wrong."""

import sys
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import least_squares

from tsfusion.core.errors import MissingDependency
from tsfusion.evaluation.trajectory_error import absolute_error
from tsfusion.geometry import se3
from tsfusion.scanner.localization.loop_closure.pose_graph import PoseGraphEdge, information, optimise

TIGHT = information(0.01, 0.002)


def random_poses(rng: np.random.Generator, count: int, size: float = 1.0) -> NDArray[np.float64]:
    return se3.exp(rng.normal(0, size, (count, 6)))


def ring(count: int, *, laps: float = 1.0, radius: float = 5.0) -> NDArray[np.float64]:
    """Poses around a circle, looking along it."""
    poses = []
    for angle in np.linspace(0, 2 * np.pi * laps, count):
        T = se3.exp(np.array([0, 0, 0, 0, 0, angle]))
        T[:3, 3] = T[:3, :3] @ (radius, 0, 0)
        poses.append(T)
    return np.array(poses)


def drifting(
    truth: NDArray[np.float64], rng: np.random.Generator
) -> tuple[dict[int, NDArray[np.float64]], list[PoseGraphEdge]]:
    """Odometry of noise as its edges state: the poses it leads to, and the edges."""
    nodes, edges = {0: truth[0]}, []
    for i in range(len(truth) - 1):
        noise = se3.exp(rng.normal(0, 1, 6) * ([0.01] * 3 + [0.002] * 3))
        step = se3.inverse(truth[i]) @ truth[i + 1] @ noise
        nodes[i + 1] = nodes[i] @ step
        edges.append(PoseGraphEdge(i, i + 1, step, TIGHT))
    return nodes, edges


def loop(truth: NDArray[np.float64], start: int, end: int) -> PoseGraphEdge:
    return PoseGraphEdge(start, end, se3.inverse(truth[start]) @ truth[end], TIGHT, robust=True)


def stacked(nodes: dict[int, NDArray[np.float64]]) -> NDArray[np.float64]:
    return np.array(list(nodes.values()))


def test_a_graph_that_fits_stays_as_it_is():
    truth = random_poses(np.random.default_rng(3), 30)
    edges = [PoseGraphEdge(i, i + 1, se3.inverse(truth[i]) @ truth[i + 1], TIGHT) for i in range(29)]
    found = optimise(dict(enumerate(truth)), [*edges, loop(truth, 0, 29), loop(truth, 25, 4)])
    np.testing.assert_allclose(stacked(found.nodes), truth, atol=1e-12)
    assert found.after < 1e-18


def test_the_first_node_stays_and_the_world_can_be_moved():
    """Gauge: the whole graph moved beforehand is the whole solution moved; nothing else changes."""
    rng = np.random.default_rng(4)
    truth = ring(40)
    nodes, edges = drifting(truth, rng)
    edges.append(loop(truth, 0, 39))
    moved = se3.exp(rng.normal(0, 2, 6))
    one = optimise(nodes, edges)
    two = optimise({key: moved @ T for key, T in nodes.items()}, edges)
    np.testing.assert_array_equal(one.nodes[0], nodes[0])
    np.testing.assert_allclose(stacked(two.nodes), moved @ stacked(one.nodes), atol=1e-6)
    assert two.after == pytest.approx(one.after, rel=1e-6)


def test_names_of_nodes_and_the_order_of_edges_mean_nothing():
    truth = ring(25)
    nodes, edges = drifting(truth, np.random.default_rng(5))
    edges.append(loop(truth, 1, 24))
    renamed = {1000 - 7 * key: T for key, T in nodes.items()}
    again = [replace(e, start=1000 - 7 * e.start, end=1000 - 7 * e.end) for e in edges[::-1]]
    one, two = optimise(nodes, edges), optimise(renamed, again)
    np.testing.assert_allclose(stacked(one.nodes), stacked(two.nodes), atol=1e-6)


def test_a_loop_spreads_the_error_evenly():
    """A straight chain whose ends are known a metre shorter: each step gives up its equal share."""
    step = se3.exp(np.array([1.0, 0, 0, 0, 0, 0]))
    nodes = {i: se3.exp(np.array([float(i), 0, 0, 0, 0, 0])) for i in range(11)}
    edges = [PoseGraphEdge(i, i + 1, step, information(0.1, 0.01)) for i in range(10)]
    ends = se3.exp(np.array([9.0, 0, 0, 0, 0, 0]))
    found = optimise(nodes, [*edges, PoseGraphEdge(0, 10, ends, information(1e-4, 1e-4))])
    np.testing.assert_allclose(stacked(found.nodes)[:, 0, 3], np.arange(11) * 0.9, atol=1e-5)
    np.testing.assert_allclose(stacked(found.nodes)[:, 1:3, 3], 0, atol=1e-9)


def test_the_optimum_is_that_of_a_general_solver():
    """The cost, written down plainly, handed to scipy's dense least squares with numeric derivatives."""
    rng = np.random.default_rng(6)
    truth = ring(9, radius=1.0)
    nodes, edges = drifting(truth, rng)
    weight = rng.normal(0, 1, (6, 6))
    weight = weight @ weight.T + np.eye(6)  # a covariance that mixes translation and rotation
    edges += [PoseGraphEdge(8, 0, se3.inverse(truth[8]) @ truth[0], 100 * weight), loop(truth, 2, 7)]
    square_roots = [np.linalg.cholesky(edge.information).T for edge in edges]

    def residuals(x: NDArray[np.float64]) -> NDArray[np.float64]:
        T = {0: nodes[0], **{i: nodes[i] @ se3.exp(x[6 * i - 6 : 6 * i]) for i in range(1, 9)}}
        return np.concatenate([
            root @ se3.log(se3.inverse(e.T_start_end) @ se3.inverse(T[e.start]) @ T[e.end])
            for e, root in zip(edges, square_roots, strict=True)
        ])  # fmt: skip

    theirs = least_squares(residuals, np.zeros(48), xtol=1e-14, ftol=1e-14, gtol=1e-12)
    ours = optimise(nodes, edges)
    assert ours.after == pytest.approx(2 * theirs.cost, rel=1e-8)
    assert ours.after < 0.2 * ours.before
    for i in range(1, 9):
        expected = nodes[i] @ se3.exp(theirs.x[6 * i - 6 : 6 * i])
        np.testing.assert_allclose(ours.nodes[i], expected, atol=1e-6)


@pytest.mark.parametrize("wrong", [1, 3])
def test_loops_that_are_wrong_are_left_out(wrong):
    rng = np.random.default_rng(7)
    truth = ring(160, laps=2.0)
    nodes, edges = drifting(truth, rng)
    edges += [loop(truth, i, i + 80) for i in range(0, 80, 8)]
    expected = optimise(nodes, edges)
    false = [
        PoseGraphEdge(int(i), int(i + 40), se3.exp(rng.normal(0, 0.2, 6)), TIGHT, robust=True)
        for i in rng.choice(110, wrong, replace=False)
    ]
    found = optimise(nodes, [*edges, *false])
    assert (found.weights[-wrong:] == 0).all()
    assert (found.weights[:-wrong] == 1).all()
    np.testing.assert_allclose(stacked(found.nodes), stacked(expected.nodes), atol=1e-5)
    before, after = (absolute_error(stacked(n), truth).rmse for n in (nodes, found.nodes))
    assert after < 0.5 * before


def test_a_trusted_edge_is_never_left_out():
    truth = ring(20)
    nodes, edges = drifting(truth, np.random.default_rng(8))
    wrong = PoseGraphEdge(0, 19, se3.exp(np.array([3.0, 0, 0, 0, 0, 0])), TIGHT)
    found = optimise(nodes, [*edges, wrong])
    assert (found.weights == 1).all()
    assert np.linalg.norm((se3.inverse(found.nodes[0]) @ found.nodes[19])[:3, 3] - (3, 0, 0)) < 1.0


def test_small_graphs():
    start = se3.exp(np.array([1.0, 2, 3, 0.1, 0.2, 0.3]))
    alone = optimise({5: start}, [])
    np.testing.assert_array_equal(alone.nodes[5], start)
    assert alone.after == 0
    step = se3.exp(np.array([0.5, 0, 0, 0, 1.0, 0]))
    pair = optimise({5: start, 2: np.eye(4)}, [PoseGraphEdge(5, 2, step, TIGHT, robust=True)])
    np.testing.assert_allclose(pair.nodes[2], start @ step, atol=1e-9)


def test_without_scipy_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "scipy", None)
    monkeypatch.setitem(sys.modules, "scipy.sparse", None)
    with pytest.raises(MissingDependency, match=r"pip install '.\[slam\]'"):
        optimise({0: np.eye(4)}, [])
