# SPDX-License-Identifier: MIT
"""Rigid transforms: the exponential map and its inverse at every angle, one transform or many."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm

from tsfusion.geometry import se3

ANGLES = [
    0.0, 1e-300, 1e-160, 1e-9, 1e-8, 1e-6, 1e-3, 0.019, 0.021, 0.5, 1.57, 1.58, 3.0,
    np.pi - 1e-3, np.pi - 1e-6, np.pi - 1e-7, np.pi - 1e-9, np.pi,
]  # fmt: skip


def twists_of(angle: float, *batch: int) -> NDArray[np.float64]:
    """(*batch, 6) random twists whose rotations all have this angle, and translations of about a metre."""
    x = np.random.default_rng(1).normal(0, 1, (*batch, 6))
    x[..., 3:] *= angle / np.linalg.norm(x[..., 3:], axis=-1, keepdims=True)
    return x


@pytest.mark.parametrize("angle", ANGLES)
def test_exp_is_the_matrix_exponential_and_log_leads_back(angle):
    for x in twists_of(angle, 20):
        generator = np.zeros((4, 4))
        generator[:3, :3], generator[:3, 3] = se3.hat(x[3:]), x[:3]
        T = se3.exp(x)
        np.testing.assert_allclose(T, expm(generator), atol=3e-15)
        np.testing.assert_allclose(se3.exp(se3.log(T)), T, atol=3e-15)
        if angle < 3:
            np.testing.assert_allclose(se3.log(T), x, atol=1e-14)
        assert abs(se3.angle(T) - angle) < 1e-15 * max(1, angle / 1e-15 * 1e-14)


@pytest.mark.parametrize("angle", ANGLES)
def test_batches_are_single_calls(angle):
    x = twists_of(angle, 4, 5)
    T = se3.exp(x)
    for function, argument, own in (
        (se3.exp, x, (6,)), (se3.right_jacobian_inverse, x, (6,)), (se3.hat, x[..., :3], (3,)),
        (se3.log, T, (4, 4)), (se3.inverse, T, (4, 4)), (se3.adjoint, T, (4, 4)),
        (se3.rotation_vector, T[..., :3, :3], (3, 3)),
    ):  # fmt: skip
        many = function(argument)
        single = np.array([function(one) for one in argument.reshape(20, *own)])
        np.testing.assert_allclose(many, single.reshape(many.shape), rtol=0, atol=1e-15)
        assert function(argument[:0]).shape == (0, *many.shape[1:])


def test_angles_of_a_batch_may_be_of_every_kind():
    x = np.concatenate([twists_of(angle, 3) for angle in ANGLES])
    T = se3.exp(x)
    np.testing.assert_allclose(se3.exp(se3.log(T)), T, atol=3e-15)
    np.testing.assert_allclose(T @ se3.inverse(T), np.tile(np.eye(4), (len(x), 1, 1)), atol=3e-15)
    step = 0.1 * twists_of(0.3, len(x))
    moved = se3.exp((se3.adjoint(T) @ step[..., None])[..., 0])
    np.testing.assert_allclose(T @ se3.exp(step) @ se3.inverse(T), moved, atol=1e-14)


def test_half_turns_about_the_axes_have_a_log():
    for signs in ((1, -1, -1), (-1, 1, -1), (-1, -1, 1)):
        T = np.diag([*signs, 1.0])
        T[:3, 3] = 1, 2, 3
        assert se3.angle(T) == pytest.approx(np.pi, abs=1e-15)
        np.testing.assert_allclose(se3.exp(se3.log(T)), T, atol=1e-15)


@pytest.mark.parametrize("size", [1e-4, 0.019, 0.021, 0.5, 2.0])
def test_the_jacobian_is_the_derivative(size):
    x = twists_of(size, 10)
    J = se3.right_jacobian_inverse(x)
    for k, step in enumerate(np.eye(6) * 1e-6):
        ahead, behind = (se3.log(se3.exp(x) @ se3.exp(sign * step)) for sign in (1, -1))
        np.testing.assert_allclose(J[:, :, k], (ahead - behind) / 2e-6, atol=1e-9)
