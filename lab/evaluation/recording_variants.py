# SPDX-License-Identifier: MIT
"""Variants of a camera's recording: other parts, speeds, directions, light, lenses and noise.

Those of light are for stereo pairs too. A variant is a function of the frames and a random generator. Poses
and intrinsics stay true to the images.
"""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from msgspec import structs
from numpy.typing import NDArray

from tsfusion.geometry import se3
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
    """Return the frames in the other order, with the intervals between them; a LiDAR spins the other way."""
    last = frames[-1].timestamp_ns + 1
    return [
        replace(
            frame, timestamp_ns=last - frame.timestamp_ns,
            point_times_s=None if frame.point_times_s is None else -frame.point_times_s,
        )
        for frame in reversed(frames)
    ]  # fmt: skip


def there_and_back(frames: Frames) -> Frames:
    """Return the frames in both orders; none comes twice."""
    way = frames[::2]
    after = way[-1].timestamp_ns
    back = [replace(frame, timestamp_ns=after + frame.timestamp_ns) for frame in backwards(frames[1::2])]
    return [*way, *back]


def mirrored(frame: Frame) -> Frame:
    """Return the frame seen in a mirror: a room that nobody has built. A pair's cameras change places."""
    K, T, R = frame.intrinsics, frame.T_world_camera, frame.attitude
    assert K is not None
    if T is not None and frame.kind == "pair":
        assert frame.baseline_fx is not None
        T = T @ se3.transform(np.eye(3), (frame.baseline_fx / K.fx, 0, 0))
    seen = {"depth": frame.depth, "color": frame.color, "left": frame.right, "right": frame.left}
    images: dict[str, Any] = {
        name: np.ascontiguousarray(image[:, ::-1]) for name, image in seen.items() if image is not None
    }
    return replace(
        frame,
        **images,
        intrinsics=structs.replace(K, cx=frame.shape[1] - 1 - K.cx),
        T_world_camera=None if T is None else _MIRROR @ T @ _MIRROR,
        attitude=None if R is None else _MIRROR[:3, :3] @ R @ _MIRROR[:3, :3],
    )


def resized(frame: Frame, factor: float) -> Frame:
    """Return the frame with images `factor` times as large. Depth is taken from the nearest pixel."""
    assert frame.intrinsics is not None
    height, width = frame.shape
    size = round(width * factor), round(height * factor)
    found = {name: getattr(frame, name) for name in ("depth", "color", "left", "right")}
    how = {"depth": cv2.INTER_NEAREST_EXACT}
    images = {
        name: cv2.resize(image, size, interpolation=how.get(name, cv2.INTER_AREA))
        for name, image in found.items()
        if image is not None
    }
    baseline_fx = None if frame.baseline_fx is None else frame.baseline_fx * factor
    return replace(frame, **images, baseline_fx=baseline_fx, intrinsics=frame.intrinsics.scaled(factor))


def with_depth(frame: Frame, change: Callable[[NDArray[np.float32]], Any]) -> Frame:
    """Return the frame with changed depth, (H, W) float32 metres, 0 = none; a pair as it is."""
    if frame.depth_m is None:
        return frame
    return replace(frame, depth=np.asarray(change(frame.depth_m.copy()), np.float32), depth_scale=1.0)


def with_color(frame: Frame, change: Callable[[NDArray[np.float32]], Any]) -> Frame:
    """Return the frame with changed colour, or images of a pair: (H, W, 3) or (H, W) float32 levels."""
    names = ("left", "right") if frame.kind == "pair" else ("color",)
    images = {name: image for name in names if (image := getattr(frame, name)) is not None}
    changed = {name: np.rint(change(image.astype(np.float32))) for name, image in images.items()}
    levels = {name: np.clip(image, 0, 255).astype(np.uint8) for name, image in changed.items()}
    return replace(frame, **levels)


def _jpeg(color: NDArray[np.float32], quality: int) -> Any:
    _, data = cv2.imencode(".jpg", color.astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, quality])
    return cv2.imdecode(data, cv2.IMREAD_UNCHANGED)


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


def _dark(frame: Frame) -> Frame:
    return with_color(with_depth(frame, np.zeros_like), np.zeros_like)


def _late(frames: Frames) -> Frames:
    return [replace(frame, color=before.color) for before, frame in pairwise(frames)]


def without_color(frames: Frames) -> Frames:
    return [replace(frame, color=None) for frame in frames]


def each(change: Callable[[Frame, np.random.Generator], Frame], *, stride: int = 1) -> Variant:
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


def covered(cover: Callable[[Frame], Frame]) -> Variant:
    """Return a variant in which the sensor is covered for three frames."""

    def variant(frames: Frames, rng: np.random.Generator) -> Frames:
        chosen = part(frames, rng.random())
        middle = len(chosen) // 2
        return [cover(frame) if 0 <= i - middle < 3 else frame for i, frame in enumerate(chosen)]

    return variant


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
    "mirrored": each(lambda frame, _: mirrored(frame)),
    "mirrored, every 2nd": each(lambda frame, _: mirrored(frame), stride=2),
    "light goes out by half": _in_light(lambda i, _: (1.0 if i < LENGTH // 2 else 0.5,)),
    "light flickers": _in_light(lambda _, rng: (rng.uniform(0.6, 1.4),)),
    "gamma steps": _in_light(lambda i, _: (1.0, (1.0, 0.6, 1.6)[i // 8 % 3])),
    "JPEG 20": each(lambda frame, _: with_color(frame, lambda color: _jpeg(color, 20))),
    "motion blur": each(_blurred),
    "holes in depth": each(_holed),
    "noise": each(_noisy),
    "noise, other seed": each(_noisy),
    "frames dropped": _dropped,
    "gap": _with_gap,
    "lens covered": covered(_dark),
    "twice the size": each(lambda frame, _: resized(frame, 2)),
    "half the size": each(lambda frame, _: resized(frame, 0.5)),
    "smooth depth": each(lambda frame, _: with_depth(frame, _smooth)),
    "near depth": each(lambda frame, _: with_depth(frame, lambda z: np.where(z < 2.0, z, 0))),
    "late colour": lambda frames, rng: _late(part(frames, rng.random())),
}
