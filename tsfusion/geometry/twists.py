# SPDX-License-Identifier: MIT
"""`tsfusion.geometry.se3` for many transforms at once: (n, 4, 4) and (n, 6) instead of one.

Twists are (translation, rotation), as there. Formulas: Barfoot, "State Estimation for Robotics" (2017),
chapter 7.
"""

import numpy as np
from numpy.typing import NDArray

Transforms = NDArray[np.float64]  # (n, 4, 4)
Twists = NDArray[np.float64]  # (n, 6)
Blocks = NDArray[np.float64]  # (n, 6, 6)

_SERIES = 0.02  # radians below which the series are better than the formulas


def hat(v: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 3) → (n, 3, 3) matrices of the cross product."""
    W = np.zeros((len(v), 3, 3))
    W[:, 0, 1], W[:, 0, 2], W[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    W -= W.transpose(0, 2, 1).copy()
    return W


def exp(twists: Twists) -> Transforms:
    """(n, 6) → (n, 4, 4)."""
    rho, phi = twists[:, :3], twists[:, 3:]
    a, b, c = _coefficients(phi)[:3]
    W = hat(phi)
    WW = W @ W
    T = np.tile(np.eye(4), (len(twists), 1, 1))
    T[:, :3, :3] += a * W + b * WW
    V = np.eye(3) + b * W + c * WW
    T[:, :3, 3] = np.einsum("nij,nj->ni", V, rho)
    return T


def log(T: Transforms) -> Twists:
    """(n, 4, 4) → (n, 6), with rotations of at most π (less exact within 1e-6 of π)."""
    R = T[:, :3, :3]
    axis = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    sine, cosine = np.linalg.norm(axis, axis=1) / 2, (np.trace(R, axis1=1, axis2=2) - 1) / 2
    angle = np.arctan2(sine, cosine)
    phi = axis * np.divide(angle, 2 * sine, out=np.full_like(sine, 0.5), where=sine > 1e-6)[:, None]
    for i in np.flatnonzero((sine <= 1e-6) & (cosine < 0)):
        columns = R[i] + np.eye(3)
        longest = columns[:, int(np.argmax(np.linalg.norm(columns, axis=0)))]
        phi[i] = angle[i] * longest / np.linalg.norm(longest)
    rho = np.einsum("nij,nj->ni", _left_inverse(phi), T[:, :3, 3])
    return np.concatenate([rho, phi], axis=1)


def inverse(T: Transforms) -> Transforms:
    """Of rigid transforms."""
    result = np.tile(np.eye(4), (len(T), 1, 1))
    R = T[:, :3, :3].transpose(0, 2, 1)
    result[:, :3, :3] = R
    result[:, :3, 3] = -np.einsum("nij,nj->ni", R, T[:, :3, 3])
    return result


def adjoint(T: Transforms) -> Blocks:
    """(n, 6, 6): `T exp(x) T⁻¹ = exp(adjoint(T) x)`."""
    A = np.zeros((len(T), 6, 6))
    A[:, :3, :3] = A[:, 3:, 3:] = T[:, :3, :3]
    A[:, :3, 3:] = hat(T[:, :3, 3]) @ T[:, :3, :3]
    return A


def right_jacobian_inverse(twists: Twists) -> Blocks:
    """(n, 6, 6): `log(exp(x) exp(d)) ≈ x + J d` (eq. 7.94 of −x)."""
    rho, phi = -twists[:, :3], -twists[:, 3:]
    P, W = hat(rho), hat(phi)
    J = _left_inverse(phi)
    _, _, c, d, e = _coefficients(phi)
    WP, PW, WPW = W @ P, P @ W, W @ P @ W
    Q = P / 2 + c * (WP + PW + WPW) + d * (W @ WP + PW @ W - 3 * WPW) + e * (WPW @ W + W @ WPW)
    result = np.zeros((len(twists), 6, 6))
    result[:, :3, :3] = result[:, 3:, 3:] = J
    result[:, :3, 3:] = -J @ Q @ J
    return result


def _left_inverse(phi: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 3, 3) inverses of the left Jacobian of rotations (eq. 7.37)."""
    square = (phi**2).sum(axis=1)
    angle = np.sqrt(square)
    small = angle < _SERIES
    half = np.where(small, 1.0, angle / 2)
    exact = (1 - half / np.tan(half)) / np.where(small, 1.0, square)
    factor = np.where(small, 1 / 12 + square / 720, exact)[:, None, None]
    W = hat(phi)
    return np.eye(3) - W / 2 + factor * (W @ W)


def _coefficients(phi: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Of W, W² in the rotation, and of the three terms of Q (eq. 7.86), each (n, 1, 1)."""
    square = (phi**2).sum(axis=1)[:, None, None]
    angle = np.sqrt(square)
    small = angle < _SERIES
    x = np.where(small, 1.0, angle)
    sine, cosine = np.sin(x), np.cos(x)
    exact = (
        sine / x,
        (1 - cosine) / x**2,
        (x - sine) / x**3,
        (x**2 + 2 * cosine - 2) / (2 * x**4),
        (2 * x - 3 * sine + x * cosine) / (2 * x**5),
    )
    series = (
        1 - square / 6 + square**2 / 120,
        1 / 2 - square / 24 + square**2 / 720,
        1 / 6 - square / 120 + square**2 / 5040,
        1 / 24 - square / 720,
        1 / 120 - square / 2520,
    )
    return [np.where(small, s, f) for s, f in zip(series, exact, strict=True)]
