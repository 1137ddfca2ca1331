# SPDX-License-Identifier: MIT
"""Rigid transforms as 4×4 matrices and as twists (ρ, φ): `exp`, `log` and what is needed around them.

A twist is (6,) float64: three of translation (metres), three of rotation (radians). Conventions as in
Barfoot, "State Estimation for Robotics" (2017), ch. 7: `exp(twist)` multiplies from the left for a step in
the world's axes, from the right for one in the camera's.
"""

import numpy as np
from numpy.typing import NDArray

Transform = NDArray[np.float64]  # (4, 4)
_SMALL = 1e-8  # radians


def hat(v: NDArray[np.floating]) -> NDArray[np.float64]:
    """(3,) → the 3×3 matrix of the cross product with it."""
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def exp(twist: NDArray[np.floating]) -> Transform:
    """(6,) twist → (4, 4)."""
    rho, phi = np.asarray(twist, dtype=np.float64)[:3], np.asarray(twist, dtype=np.float64)[3:]
    angle = float(np.linalg.norm(phi))
    W = hat(phi)
    if angle < _SMALL:
        R, V = np.eye(3) + W, np.eye(3) + W / 2
    else:
        a, b = np.sin(angle) / angle, (1 - np.cos(angle)) / angle**2
        R = np.eye(3) + a * W + b * W @ W
        V = np.eye(3) + b * W + (1 - a) / angle**2 * W @ W
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, V @ rho
    return T


def log(T: Transform) -> NDArray[np.float64]:
    """(4, 4) → (6,) twist, with a rotation of at most π."""
    phi = rotation_vector(T[:3, :3])
    angle = float(np.linalg.norm(phi))
    W = hat(phi)
    if angle < _SMALL:
        V_inverse = np.eye(3) - W / 2
    else:
        half = angle / 2
        V_inverse = np.eye(3) - W / 2 + (1 - half / np.tan(half)) / angle**2 * W @ W
    return np.concatenate([V_inverse @ T[:3, 3], phi])


def rotation_vector(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """(3, 3) rotation → (3,) axis times angle, at most π."""
    axis = np.array([R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]])
    sine, cosine = np.linalg.norm(axis) / 2, (np.trace(R) - 1) / 2
    angle = float(np.arctan2(sine, cosine))
    if sine > 1e-6:
        result: NDArray[np.float64] = axis / (2 * sine) * angle
        return result
    if cosine > 0:
        return axis / 2
    # Near π the axis is the largest column of R + I.
    columns = R + np.eye(3)
    longest: NDArray[np.float64] = columns[:, int(np.argmax(np.linalg.norm(columns, axis=0)))]
    longest = longest / np.linalg.norm(longest)
    return longest * angle * (1.0 if axis @ longest >= 0 else -1.0)


def inverse(T: Transform) -> Transform:
    """Of a rigid transform."""
    result = np.eye(4)
    result[:3, :3] = T[:3, :3].T
    result[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return result


def adjoint(T: Transform) -> NDArray[np.float64]:
    """(6, 6): `T exp(x) T⁻¹ = exp(adjoint(T) x)`."""
    R = T[:3, :3]
    A = np.zeros((6, 6))
    A[:3, :3] = A[3:, 3:] = R
    A[:3, 3:] = hat(T[:3, 3]) @ R
    return A


def apply(T: Transform, points: NDArray[np.floating]) -> NDArray[np.float64]:
    """(n, 3) points moved."""
    moved: NDArray[np.float64] = points @ T[:3, :3].T + T[:3, 3]
    return moved


def angle(T: Transform) -> float:
    """Radians of its rotation, 0 to π."""
    return float(np.linalg.norm(rotation_vector(T[:3, :3])))


def distance(T: Transform) -> float:
    """Metres of its translation."""
    return float(np.linalg.norm(T[:3, 3]))


def nearest(T: Transform) -> Transform:
    """The rigid transform nearest to one that has drifted by rounding."""
    U, _, Vt = np.linalg.svd(T[:3, :3])
    result = np.eye(4)
    result[:3, :3] = U @ np.diag([1.0, 1.0, float(np.linalg.det(U @ Vt))]) @ Vt
    result[:3, 3] = T[:3, 3]
    return result
