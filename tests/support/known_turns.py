# SPDX-License-Identifier: MIT
"""A turn that is known at every time, and what a gyroscope that sits askew and has a bias says of it."""

from collections.abc import Iterable, Iterator
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry import se3
from tsfusion.geometry.frame import Attitude

STILL_S, END_S, HZ = 0.8, 2.4, 200
BIAS = np.array([0.02, -0.03, 0.01])  # rad/s, in the gyroscope's axes
R_SENSOR_IMU = se3.exp(np.array([0, 0, 0, 0.4, -1.9, 0.7]))[:3, :3]
GRAVITY = np.array([0, 0, 9.81])


def attitude(seconds: float) -> NDArray[np.float64]:
    """R_world_sensor: at rest, then turning by up to 200°/s about axes that change."""
    late = max(seconds - STILL_S, 0.0)
    first, second = 0.9 * (1 - np.cos(3 * late)), 0.4 * (1 - np.cos(5 * late))
    return (se3.exp(np.array([0, 0, 0, 0.2, first, 0])) @ se3.exp(np.array([0, 0, 0, second, 0, -second])))[
        :3, :3
    ]


def measured(seconds: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Force, m/s², and angular velocity, rad/s, in the axes of the inertial unit."""
    turned = attitude(seconds - 5e-5).T @ attitude(seconds + 5e-5)
    rate = se3.rotation_vector(turned) / 1e-4
    return R_SENSOR_IMU.T @ attitude(seconds).T @ GRAVITY, R_SENSOR_IMU.T @ rate + BIAS


def samples(until_s: float = END_S) -> Iterator[tuple[float, NDArray[np.float64], NDArray[np.float64]]]:
    for seconds in np.arange(0, until_s, 1 / HZ).tolist():
        yield seconds, *measured(seconds)


def angle(R: NDArray[np.float64]) -> float:
    return float(np.degrees(np.linalg.norm(se3.rotation_vector(R))))


def assert_known(found: Iterable[tuple[float, Attitude | None]]) -> None:
    """Attitudes at times, s: they turn as the sensor did, to 0.2° a second, once the bias is known."""
    kept = [(seconds, R) for seconds, R in found if seconds > STILL_S - 0.1]
    assert len(kept) > 5
    assert angle(attitude(kept[0][0]).T @ attitude(kept[-1][0])) > 20
    for (begin, before), (end, after) in [*pairwise(kept), (kept[0], kept[-1])]:
        assert before is not None
        assert after is not None
        true = attitude(begin).T @ attitude(end)
        assert angle(true.T @ before.R.T @ after.R) < 0.2 * (end - begin) + 0.01
