# SPDX-License-Identifier: MIT
"""Variants of drives, for stereo pairs and for a LiDAR's sweeps: traffic, dirt, rain, holes, noise.

Axes of a LiDAR are x forward, y left, z up. Images of a van are pasted: no light or shadow falls on it.
"""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from lab.evaluation.recording_variants import VARIANTS, Frames, Variant, covered, each, part
from tsfusion.geometry import se3
from tsfusion.geometry.frame import Frame

Points = NDArray[np.float32]  # (n, 3) metres
Place = tuple[float, float]  # metres forward and left of the sensor

WIDTH, TOP, BOTTOM = 2.0, 0.5, 1.6  # metres: a van's width, its roof above and its foot below the sensor
TEXTURE = cv2.resize(np.random.default_rng(6).integers(30, 220, (18, 16), np.uint8), (256, 288))


def ahead(index: int) -> list[Place]:
    """Return the place of a van that drives ahead at the same speed, a metre to and fro."""
    return [(8 + np.sin(index / 3), 0.2)]


def oncoming(index: int) -> list[Place]:
    """Return the places of vans that come by on the left, one every 30 m, at the speed of 2 m a frame."""
    return [(5 + (-2 * index) % 30 + 30 * n, 3.2) for n in range(2)]


def _in_traffic(places: Callable[[int], list[Place]]) -> Variant:
    def variant(frames: Frames, rng: np.random.Generator) -> Frames:
        return [_behind_vans(frame, places(index)) for index, frame in enumerate(part(frames, rng.random()))]

    return variant


def _behind_vans(frame: Frame, places: list[Place]) -> Frame:
    for place in sorted(places, reverse=True):
        frame = _seen_by_lidar(frame, place) if frame.kind == "points" else _seen_by_pair(frame, place)
    return frame


def _seen_by_lidar(frame: Frame, place: Place) -> Frame:
    """Return the sweep with the rays that meet the van's back ending there."""
    assert frame.points is not None
    distance, left = place
    points = frame.points.copy()
    at = points * (distance / np.maximum(points[:, :1], 1e-3))
    meets = (points[:, 0] > distance) & (np.abs(at[:, 1] - left) < WIDTH / 2)
    meets &= (at[:, 2] > -BOTTOM) & (at[:, 2] < TOP)
    points[meets] = at[meets]
    return replace(frame, points=points, color=None)


def _seen_by_pair(frame: Frame, place: Place) -> Frame:
    """Return the pair with a textured rectangle before what is farther."""
    assert frame.intrinsics is not None
    assert frame.baseline_fx is not None
    K, (distance, left) = frame.intrinsics, place
    middle, half = K.cx - K.fx * left / distance, K.fx * WIDTH / 2 / distance
    rows, columns = TEXTURE.shape
    images = {}
    for name, shift in (("left", 0.0), ("right", frame.baseline_fx / distance)):
        scale = 2 * half / columns, K.fy * (TOP + BOTTOM) / distance / rows
        corner = middle - half - shift, K.cy - K.fy * TOP / distance
        A = np.array([[scale[0], 0, corner[0] + scale[0] / 2], [0, scale[1], corner[1] + scale[1] / 2]])
        image, size = getattr(frame, name).copy(), frame.shape[::-1]
        van = cv2.warpAffine(TEXTURE, A, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        v, u = np.ogrid[: frame.shape[0], : frame.shape[1]]
        inside = (np.abs(u - middle + shift) < half) & (v > corner[1]) & (v < corner[1] + rows * scale[1])
        images[name] = np.where(inside, van, image)
    return replace(frame, color=None, **images)


def _kept(frame: Frame, kept: NDArray[np.bool_]) -> Frame:
    """Return the sweep with these points alone."""
    times = None if frame.point_times_s is None else frame.point_times_s[kept]
    return replace(frame, points=np.asarray(frame.points)[kept], point_times_s=times, color=None)


def _some(choose: Callable[[Points, np.random.Generator], NDArray[np.bool_]]) -> Variant:
    return each(lambda frame, rng: _kept(frame, choose(np.asarray(frame.points), rng)))


def _moved(change: Callable[[Points, np.random.Generator], Points]) -> Variant:
    return each(
        lambda frame, rng: replace(frame, points=change(np.asarray(frame.points), rng).astype(np.float32))
    )


def _turned(T_new_old: se3.Transform) -> Variant:
    """Return a variant in which the sensor has other axes, which may be those of a mirror."""

    def change(frame: Frame, _: np.random.Generator) -> Frame:
        points, T = se3.apply(T_new_old, np.asarray(frame.points)), frame.T_world_camera
        T = None if T is None else T_new_old @ T @ np.linalg.inv(T_new_old)
        return replace(frame, points=points.astype(np.float32), T_world_camera=T)

    return each(change)


def _azimuth(points: Points) -> NDArray[np.float64]:
    return np.asarray(np.degrees(np.arctan2(points[:, 1], points[:, 0])))


def _noisy(points: Points, rng: np.random.Generator) -> Points:
    ranges = np.linalg.norm(points, axis=1, keepdims=True)
    return np.asarray(points * (1 + 0.05 * rng.standard_normal(ranges.shape) / np.maximum(ranges, 0.1)))


def _in_rain(points: Points, rng: np.random.Generator) -> Points:
    """Return 5 % of the rays from drops, at most 10 m away."""
    hit = rng.random((len(points), 1)) < 0.05
    ranges = np.maximum(np.linalg.norm(points, axis=1, keepdims=True), 0.1)
    ranges = np.where(hit, np.minimum(ranges, rng.uniform(1, 10, ranges.shape)) / ranges, 1)
    return np.asarray(points * ranges)


_PATHS = ("whole", "first half", "second half", "every 2nd", "every 3rd", "backwards", "backwards, every 2nd",
          "there and back", "frames dropped", "gap")  # fmt: skip
_LIGHT = ("mirrored", "light goes out by half", "light flickers", "gamma steps", "JPEG 20", "motion blur",
          "noise", "noise, other seed", "lens covered", "half the size")  # fmt: skip
STEREO_VARIANTS: dict[str, Variant] = {
    **{name: VARIANTS[name] for name in (*_PATHS, *_LIGHT)},
    "one camera darker": each(lambda frame, _: replace(frame, right=np.uint8(0.7 * np.asarray(frame.right)))),
    "a van ahead": _in_traffic(ahead),
    "oncoming vans": _in_traffic(oncoming),
}
LIDAR_VARIANTS: dict[str, Variant] = {
    **{name: VARIANTS[name] for name in _PATHS},
    "mirrored": _turned(np.diag([1.0, -1.0, 1.0, 1.0])),
    "tilted by 10°": _turned(se3.exp(np.array([0, 0, 0, 0, np.radians(10), 0]))),
    "times lost": each(lambda frame, _: replace(frame, point_times_s=None)),
    "half of the points": _some(lambda points, rng: rng.random(len(points)) < 0.5),
    "a tenth of the points": _some(lambda points, rng: rng.random(len(points)) < 0.1),
    "a sector lost": _some(lambda points, rng: (_azimuth(points) - rng.uniform(0, 360)) % 360 > 120),
    "120° ahead": _some(lambda points, _: np.abs(_azimuth(points)) < 60),
    "20 m": _some(lambda points, _: np.linalg.norm(points, axis=1) < 20),
    "range noise": _moved(_noisy),
    "range noise, other seed": _moved(_noisy),
    "rain": _moved(_in_rain),
    "covered": covered(lambda frame: _kept(frame, np.arange(frame.shape[0]) < 20)),
    "a van ahead": _in_traffic(ahead),
    "oncoming vans": _in_traffic(oncoming),
}
