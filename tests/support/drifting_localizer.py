# SPDX-License-Identifier: MIT
"""A localizer that drifts in a known way."""

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry import se3
from tsfusion.geometry.frame import Frame
from tsfusion.scanner.localization.localizer import Lost, PoseCorrections, TrackedPose


class Drifting:
    """The frames' own poses with drift: 1 cm and 0.2° after a metre, growing with its root, and a bias.

    Every frame is a tracking keyframe.
    """

    absolute = False

    def __init__(self, seed: int = 0) -> None:
        self._rng = np.random.default_rng(seed)
        self._last: NDArray[np.float64] | None = None
        self._number = 0

    def track(self, frame: Frame) -> TrackedPose | Lost:
        truth = frame.T_world_camera
        if truth is None:
            return Lost(reason="the frame says nothing", timestamp_ns=frame.timestamp_ns)
        if self._last is None:
            self._T = np.eye(4)
        else:
            step = se3.inverse(self._last) @ truth
            way = se3.distance(step) + se3.angle(step)
            noise = self._rng.normal(0, 1, 6) * ([0.01] * 3 + [0.003] * 3)
            drift = np.sqrt(way) * noise + way * np.array([0, 0, 4, 0, 1.5, 0]) / 1e3
            self._T = self._T @ step @ se3.exp(drift)
        self._last, self._number = truth, self._number + 1
        return TrackedPose(
            T_world_camera=self._T,
            timestamp_ns=frame.timestamp_ns,
            anchor=self._number,
            T_anchor_camera=np.eye(4),
            starts_anchor=True,
        )

    def corrections(self) -> PoseCorrections | None:
        return None

    def prepare(self) -> None:
        pass

    def settle(self) -> None:
        pass

    def reset(self) -> None:
        self._last = None
