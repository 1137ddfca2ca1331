# SPDX-License-Identifier: MIT
"""Frames for the RGB-D tracker's tests, and what it makes of them."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.evaluation.trajectory_error import absolute_error
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.scanner.localization.localizer import Localizer, Lost, TrackedPose

CAMERA = Intrinsics(292.5, 292.5, 159.5, 119.5)


@dataclass
class Track:
    """A localizer's answers, and the true poses of the frames."""

    answers: list[TrackedPose | Lost]
    truth: list[NDArray[np.float64] | None]

    @property
    def lost(self) -> list[int]:
        return [index for index, answer in enumerate(self.answers) if isinstance(answer, Lost)]

    @property
    def poses(self) -> NDArray[np.float64]:
        return np.array([answer.T_world_camera for answer in self.answers if isinstance(answer, TrackedPose)])

    def ate(self, count: int | None = None) -> float:
        """Millimetres, over the first `count` poses."""
        pairs = zip(self.answers, self.truth, strict=True)
        truth = np.array([T for answer, T in pairs if isinstance(answer, TrackedPose)])
        return 1000 * absolute_error(self.poses[:count], truth[:count]).rmse


def track(localizer: Localizer, frames: Iterable[Frame]) -> Track:
    """Every frame, in order; the localizer is not shown where it was."""
    result = Track([], [])
    for frame in frames:
        result.answers.append(localizer.track(replace(frame, T_world_camera=None)))
        result.truth.append(frame.T_world_camera)
    return result


def garbage(like: Frame) -> dict[str, Frame]:
    """Frames without sense, of the same camera."""
    rng, (height, width) = np.random.default_rng(0), like.shape
    flat = np.full((height, width), 500, np.uint16)
    black = np.zeros((height, width, 3), np.uint8)
    noise = rng.integers(400, 4000, flat.shape).astype(np.uint16)
    colors = rng.integers(0, 256, black.shape).astype(np.uint8)
    return {
        "blank depth": replace(like, depth=np.zeros_like(flat)),
        "covered": replace(like, depth=flat, color=black),
        "noise": replace(like, depth=noise, color=colors),
        "grey card": replace(like, depth=flat * 2, color=black + 90),
        "mirrored": replace(like, depth=like.depth[:, ::-1], color=like.color[:, ::-1]),
    }


def wall(shift: int, *, textured: bool, waves: bool, seed: int) -> Frame:
    """A wall two metres in front, seen `shift` pixels further to the right; with a Kinect's noise."""
    rng = np.random.default_rng(seed)
    z = np.full((240, 320), 2.0) + 0.006 * rng.standard_normal((240, 320))
    if waves:  # the sensor's own, the same in every frame
        smooth = cv2.GaussianBlur(np.random.default_rng(5).standard_normal(z.shape), (0, 0), 15)
        z += 0.006 * smooth / smooth.std()
    gray = np.full(z.shape, 120.0)
    if textured:
        blots = cv2.GaussianBlur(np.random.default_rng(1).standard_normal((400, 900)), (0, 0), 2)
        gray += 30 * blots[80:320, 100 + shift : 420 + shift] / blots.std()
    gray = np.clip(gray + 2 * rng.standard_normal(z.shape), 0, 255).astype(np.uint8)
    return Frame(
        sensor="kinect",
        depth=np.rint(z * 1000).astype(np.uint16),
        color=np.repeat(gray[:, :, None], 3, axis=2),
        intrinsics=CAMERA,
    )
