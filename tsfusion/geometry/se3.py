# SPDX-License-Identifier: MIT
"""Compute with rigid transforms SE(3) as 4×4 matrices and as twists (ρ, φ), one or many at once.

A twist is 6 float64 numbers: translation ρ (metres), then rotation φ (radians). Conventions and equation
numbers are those of Barfoot, "State Estimation for Robotics" (2017), ch. 7. A factor `exp(twist)` on the left
is a step in the world's axes, on the right a step in the camera's axes. Leading dimensions are batches: every
function takes `(…, 4, 4)` or `(…, 6)` and keeps the `…`.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

Transform = NDArray[np.float64]  # (…, 4, 4)
Poses = NDArray[np.float64]  # (n, 4, 4), T_world_camera of frames or keyframes
Twist = NDArray[np.float64]  # (…, 6)
Matrix6 = NDArray[np.float64]  # (…, 6, 6): adjoints, covariances, information of twists

_HAT = np.array([[0, 0, 0, 0, 0, -1, 0, 1, 0], [0, 0, 1, 0, 0, 0, -1, 0, 0], [0, -1, 0, 1, 0, 0, 0, 0, 0.0]])
_EYE = np.eye(3)
_TINY = 1e-100  # radians: keeps 0 / 0 out of the formulas, which all hold for angles as small as this
_SERIES = 0.02  # radians below which the Jacobian's series are better than its formulas


def hat(v: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the matrix of the cross product with `v`: (…, 3) → (…, 3, 3)."""
    W: NDArray[np.float64] = v @ _HAT
    return W.reshape(*v.shape, 3)


def exp(twist: NDArray[np.floating]) -> Transform:
    """Return the transform of a twist: (…, 6) → (…, 4, 4) (eq. 7.33)."""
    phi = twist[..., 3:]
    angle = _length(phi)[..., None, None]
    a, b = np.sin(angle) / angle, 2 * (np.sin(angle / 2) / angle) ** 2
    W = hat(phi)
    WW = W @ W
    T = _identity(twist.shape[:-1])
    T[..., :3, :3] += a * W + b * WW
    V = _EYE + b * W + (1 - a) / angle**2 * WW
    T[..., :3, 3] = (V @ twist[..., :3, None])[..., 0]
    return T


def log(T: Transform) -> Twist:
    """Return the twist of a transform, with a rotation of at most π: (…, 4, 4) → (…, 6)."""
    phi = rotation_vector(T[..., :3, :3])
    rho = (_left_jacobian_inverse(phi) @ T[..., :3, 3, None])[..., 0]
    return np.concatenate([rho, phi], axis=-1)


def rotation_vector(R: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return a rotation's axis times its angle, at most π: (…, 3, 3) → (…, 3)."""
    axis: NDArray[np.float64] = R.reshape(*R.shape[:-2], 9) @ _HAT.T  # times 2 sin(angle)
    sine = _length(axis) / 2
    cosine = (R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2] - 1) / 2
    angle = np.arctan2(sine, cosine)
    phi: NDArray[np.float64] = axis * (angle / (2 * sine))[..., None]
    obtuse = cosine < 0
    if obtuse.any():  # near π this axis vanishes; R's symmetric part gives the axis without sign
        far, c = R[obtuse], cosine[obtuse][:, None, None]
        squares = (far + far.swapaxes(1, 2)) / 2 - c * _EYE  # (1 - cos) times axis axisᵀ
        longest = squares[np.arange(len(far)), squares.diagonal(axis1=1, axis2=2).argmax(axis=1)]
        way = np.where((longest * axis[obtuse]).sum(axis=1) < 0, -1, 1)
        phi[obtuse] = longest * (way * angle[obtuse] / _length(longest))[:, None]
    return phi


def transform(R: ArrayLike, t: ArrayLike) -> Transform:
    """Make one (4, 4) transform of a (3, 3) rotation and a (3,) translation."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, t
    return T


def inverse(T: Transform) -> Transform:
    """Return the inverse of a rigid transform: (…, 4, 4)."""
    result = _identity(T.shape[:-2])
    R = T[..., :3, :3].swapaxes(-1, -2)
    result[..., :3, :3] = R
    result[..., :3, 3] = (-R @ T[..., :3, 3, None])[..., 0]
    return result


def adjoint(T: Transform) -> Matrix6:
    """Return the matrix with `T exp(x) T⁻¹ = exp(adjoint(T) x)`: (…, 4, 4) → (…, 6, 6)."""
    R = T[..., :3, :3]
    A = np.zeros((*T.shape[:-2], 6, 6))
    A[..., :3, :3] = A[..., 3:, 3:] = R
    A[..., :3, 3:] = hat(T[..., :3, 3]) @ R
    return A


def right_jacobian_inverse(twist: Twist) -> Matrix6:
    """Return the matrix J with `log(exp(x) exp(d)) ≈ x + J d`: (…, 6) → (…, 6, 6) (eq. 7.94 of −x)."""
    rho, phi = -twist[..., :3], -twist[..., 3:]
    P, W, J = hat(rho), hat(phi), _left_jacobian_inverse(phi)
    c, d, e = _jacobian_coefficients(_length(phi)[..., None, None])
    WP, PW, WPW = W @ P, P @ W, W @ P @ W
    Q = P / 2 + c * (WP + PW + WPW) + d * (W @ WP + PW @ W - 3 * WPW) + e * (WPW @ W + W @ WPW)
    result = np.zeros((*twist.shape, 6))
    result[..., :3, :3] = result[..., 3:, 3:] = J
    result[..., :3, 3:] = -J @ Q @ J
    return result


def apply(T: Transform, points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Move (n, 3) points by one (4, 4) transform."""
    moved: NDArray[np.float64] = points @ T[:3, :3].T + T[:3, 3]
    return moved


def angle(T: Transform) -> float:
    """Return the angle of one transform's rotation, 0 to π radians."""
    return float(np.linalg.norm(rotation_vector(T[:3, :3])))


def distance(T: Transform) -> float:
    """Return the length of one transform's translation, metres."""
    return float(np.linalg.norm(T[:3, 3]))


def nearest(T: Transform) -> Transform:
    """Return the rigid transform nearest to one (4, 4) matrix with rounding errors."""
    U, _, Vt = np.linalg.svd(T[:3, :3])
    result = np.eye(4)
    result[:3, :3] = U @ np.diag([1.0, 1.0, float(np.linalg.det(U @ Vt))]) @ Vt
    result[:3, 3] = T[:3, 3]
    return result


def _identity(batch: tuple[int, ...]) -> Transform:
    T = np.zeros((*batch, 4, 4))
    T.reshape(-1, 16)[:, ::5] = 1
    return T


def _length(v: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the lengths of vectors, at least `_TINY`: (…, 3) → (…)."""
    length: NDArray[np.float64] = np.maximum(np.sqrt(np.einsum("...i,...i", v, v)), _TINY)
    return length


def _left_jacobian_inverse(phi: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (…, 3, 3) inverses of the left Jacobians of rotations (eq. 7.37)."""
    angle = _length(phi)[..., None, None]
    W = hat(phi)
    return _EYE - W / 2 + (1 - angle / 2 / np.tan(angle / 2)) / angle**2 * (W @ W)


def _jacobian_coefficients(angle: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """Return the factors of the three terms of Q (eq. 7.86) for angles (…, 1, 1)."""
    small, square = angle < _SERIES, angle**2
    x = np.where(small, 1.0, angle)
    exact = (
        (x - np.sin(x)) / x**3,
        (x**2 + 2 * np.cos(x) - 2) / (2 * x**4),
        (2 * x - 3 * np.sin(x) + x * np.cos(x)) / (2 * x**5),
    )
    series = (1 / 6 - square / 120 + square**2 / 5040, 1 / 24 - square / 720, 1 / 120 - square / 2520)
    return [np.where(small, s, f) for s, f in zip(series, exact, strict=True)]
