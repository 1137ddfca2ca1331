# SPDX-License-Identifier: MIT
"""Variants of an RGB-D recording: other parts, speeds, directions, light, lenses and noise.

A variant is a function of the frames and a random generator. Poses and intrinsics stay true to the images.
"""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from tsfusion.geometry.frame import Frame
from tsfusion.scanner.localization.rgbd.point_to_plane import deviation

Frames = list[Frame]
Variant = Callable[[Frames, np.random.Generator], Frames]
LENGTH = 40  # frames of a variant that is a part of its recording
_MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])


def part(frames: Frames, share: float, *, stride: int = 1) -> Frames:
    """Return `LENGTH` frames that begin at a share of what is left for the beginning."""
    spare = max(0, len(frames) - LENGTH * stride)
    begin = round(share * spare)
    return frames[begin : begin + LENGTH * stride : stride]


def backwards(frames: Frames) -> Frames:
    """Return the frames in the other order, with the intervals between them."""
    last = frames[-1].timestamp_ns + 1
    return [replace(frame, timestamp_ns=last - frame.timestamp_ns) for frame in reversed(frames)]


def there_and_back(frames: Frames) -> Frames:
    """Return the frames in both orders; none comes twice."""
    way = frames[::2]
    after = way[-1].timestamp_ns
    back = [replace(frame, timestamp_ns=after + frame.timestamp_ns) for frame in backwards(frames[1::2])]
    return [*way, *back]


def mirrored(frame: Frame) -> Frame:
    """Return the frame seen in a mirror: a room that nobody has built."""
    K, T, R = frame.intrinsics, frame.T_world_camera, frame.attitude
    assert K is not None
    assert frame.depth is not None
    return replace(
        frame,
        depth=np.ascontiguousarray(frame.depth[:, ::-1]),
        color=None if frame.color is None else np.ascontiguousarray(frame.color[:, ::-1]),
        intrinsics=structs.replace(K, cx=frame.depth.shape[1] - 1 - K.cx),
        T_world_camera=None if T is None else _MIRROR @ T @ _MIRROR,
        attitude=None if R is None else _MIRROR[:3, :3] @ R @ _MIRROR[:3, :3],
    )


def resized(frame: Frame, factor: float) -> Frame:
    """Return the frame with images `factor` times as large. Depth is taken from the nearest pixel."""
    assert frame.intrinsics is not None
    height, width = frame.shape
    size = round(width * factor), round(height * factor)
    color = None if frame.color is None else cv2.resize(frame.color, size, interpolation=cv2.INTER_AREA)
    depth = cv2.resize(frame.depth, size, interpolation=cv2.INTER_NEAREST_EXACT)
    return replace(frame, depth=depth, color=color, intrinsics=frame.intrinsics.scaled(factor))


def with_depth(frame: Frame, change: Callable[[NDArray[np.float32]], Any]) -> Frame:
    """Return the frame with changed depth, (H, W) float32 metres, 0 = none."""
    assert frame.depth_m is not None
    return replace(frame, depth=np.asarray(change(frame.depth_m.copy()), np.float32), depth_scale=1.0)


def with_color(frame: Frame, change: Callable[[NDArray[np.float32]], Any]) -> Frame:
    """Return the frame with changed colour, (H, W, 3) float32 levels."""
    if frame.color is None:
        return frame
    changed = np.rint(change(frame.color.astype(np.float32)))
    return replace(frame, color=np.clip(changed, 0, 255).astype(np.uint8))


def _jpeg(frame: Frame, quality: int) -> Frame:
    if frame.color is None:
        return frame
    _, data = cv2.imencode(".jpg", frame.color, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return replace(frame, color=np.asarray(cv2.imdecode(data, cv2.IMREAD_COLOR), np.uint8))


def _blurred(frame: Frame, rng: np.random.Generator) -> Frame:
    """Blur along a line in a random direction, a 60th to a 30th of the width long."""
    length = frame.shape[1] * rng.uniform(1 / 60, 1 / 30)
    angle, side = rng.uniform(0, np.pi), 2 * round(length / 2) + 3
    kernel = np.zeros((side, side), np.float32)
    reach = length / 2 * np.array([np.cos(angle), np.sin(angle)])
    first, last = (np.rint(side // 2 + sign * reach).astype(int).tolist() for sign in (-1, 1))
    cv2.line(kernel, first, last, 1.0)
    return with_color(frame, lambda color: cv2.filter2D(color, -1, kernel / kernel.sum()))


def _holed(frame: Frame, rng: np.random.Generator) -> Frame:
    """Lose the depth of a dozen ellipses, a third of the image."""

    def change(depth: NDArray[np.float32]) -> NDArray[np.float32]:
        height, width = depth.shape
        for _ in range(12):
            center = int(rng.integers(width)), int(rng.integers(height))
            axes = (int(width * rng.uniform(0.05, 0.15)), int(height * rng.uniform(0.05, 0.2)))
            cv2.ellipse(depth, center, axes, float(rng.uniform(0, 180)), 0, 360, 0.0, -1)
        return depth

    return with_depth(frame, change)


def _noisy(frame: Frame, rng: np.random.Generator) -> Frame:
    """Add the noise of structured light to depth, and five levels to colour."""
    noise = rng.standard_normal(frame.shape).astype(np.float32)
    frame = with_depth(frame, lambda z: np.where(z > 0, np.maximum(z + noise * deviation(z), 0), 0))
    return with_color(frame, lambda color: color + 5 * rng.standard_normal(color.shape).astype(np.float32))


def _smooth(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Average depth over a 30th of the width, also across outlines, as a phone does."""
    known, size = (depth > 0).astype(np.float32), (max(3, depth.shape[1] // 30),) * 2
    share = cv2.blur(known, size)
    return np.where(depth > 0, cv2.blur(depth, size) / np.maximum(share, 1e-6), 0)


def _covered(frame: Frame) -> Frame:
    return with_color(with_depth(frame, np.zeros_like), np.zeros_like)


def _late(frames: Frames) -> Frames:
    return [replace(frame, color=before.color) for before, frame in pairwise(frames)]


def without_color(frames: Frames) -> Frames:
    return [replace(frame, color=None) for frame in frames]


def _each(change: Callable[[Frame, np.random.Generator], Frame], *, stride: int = 1) -> Variant:
    return lambda frames, rng: [change(frame, rng) for frame in part(frames, rng.random(), stride=stride)]


def _lit(frame: Frame, gain: float, gamma: float = 1.0) -> Frame:
    return with_color(frame, lambda color: 255 * np.minimum(gain * color / 255, 1) ** gamma)


def _in_light(light: Callable[[int, np.random.Generator], tuple[float, ...]]) -> Variant:
    """Return a variant in which frame i has the gain, and the gamma, of `light(i, rng)`."""
    return lambda frames, rng: [
        _lit(frame, *light(index, rng)) for index, frame in enumerate(part(frames, rng.random()))
    ]


def _dropped(frames: Frames, rng: np.random.Generator) -> Frames:
    """Drop every fourth frame, at random."""
    return [frame for frame in part(frames, rng.random()) if rng.random() > 0.25]


def _with_gap(frames: Frames, rng: np.random.Generator) -> Frames:
    """Drop five frames in the middle."""
    chosen = part(frames, rng.random())
    return chosen[: len(chosen) // 2] + chosen[len(chosen) // 2 + 5 :]


def _covered_lens(frames: Frames, rng: np.random.Generator) -> Frames:
    """Cover the lens for three frames."""
    chosen = part(frames, rng.random())
    middle = len(chosen) // 2
    return [_covered(frame) if 0 <= i - middle < 3 else frame for i, frame in enumerate(chosen)]


VARIANTS: dict[str, Variant] = {
    "whole": lambda frames, _: frames,
    "beginning": lambda frames, _: part(frames, 0),
    "end": lambda frames, _: part(frames, 1),
    "first half": lambda frames, rng: part(frames[: len(frames) // 2], rng.random()),
    "second half": lambda frames, rng: part(frames[len(frames) // 2 :], rng.random()),
    "every 2nd": lambda frames, rng: part(frames, rng.random(), stride=2),
    "every 3rd": lambda frames, rng: part(frames, rng.random(), stride=3),
    "backwards": lambda frames, rng: backwards(part(frames, rng.random())),
    "backwards, every 2nd": lambda frames, rng: backwards(part(frames, rng.random(), stride=2)),
    "there and back": lambda frames, rng: there_and_back(part(frames, rng.random())),
    "mirrored": _each(lambda frame, _: mirrored(frame)),
    "mirrored, every 2nd": _each(lambda frame, _: mirrored(frame), stride=2),
    "light goes out by half": _in_light(lambda i, _: (1.0 if i < LENGTH // 2 else 0.5,)),
    "light flickers": _in_light(lambda _, rng: (rng.uniform(0.6, 1.4),)),
    "gamma steps": _in_light(lambda i, _: (1.0, (1.0, 0.6, 1.6)[i // 8 % 3])),
    "JPEG 20": _each(lambda frame, _: _jpeg(frame, 20)),
    "motion blur": _each(_blurred),
    "holes in depth": _each(_holed),
    "noise": _each(_noisy),
    "noise, other seed": _each(_noisy),
    "frames dropped": _dropped,
    "gap": _with_gap,
    "lens covered": _covered_lens,
    "twice the size": _each(lambda frame, _: resized(frame, 2)),
    "half the size": _each(lambda frame, _: resized(frame, 0.5)),
    "smooth depth": _each(lambda frame, _: with_depth(frame, _smooth)),
    "near depth": _each(lambda frame, _: with_depth(frame, lambda z: np.where(z < 2.0, z, 0))),
    "late colour": lambda frames, rng: _late(part(frames, rng.random())),
}
