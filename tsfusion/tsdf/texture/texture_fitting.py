# SPDX-License-Identifier: MIT
"""Fit the poses and exposures of texture images until the images agree on a surface.

Poses are never exact, and colour and depth are often taken some milliseconds apart: on a wall two metres away
half a degree is four pixels. Each image is moved until it agrees with the mean of all others on points of the
surface (Zhou and Koltun 2014, with one pose per image), from coarse to fine. Then one factor per image and
channel makes the exposures equal, by least squares over all points seen twice.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.core.readable_numbers import OnProgress
from tsfusion.geometry import se3
from tsfusion.geometry.keyframe import Keyframe, depth_metres
from tsfusion.kernels.answers import texture_baking

# Levels: blur in pixels of the halved image, and number of rounds.
LEVELS = ((3.0, 12), (1.5, 10), (0.75, 8))
_SIGMA_TURN, _SIGMA_SHIFT = 0.02, 0.02  # usual error of a pose, radians and metres
_STIFFNESS = 100.0  # points of an image that weigh as much as the pose's prior
_MAX_TURN, _MAX_SHIFT = 0.08, 0.12  # radians and metres; an image that moves farther keeps its old pose
_SHARED = 1e-3  # smallest weight of other images for a shared point
_MIN_POINTS = 100  # smallest number of points for moving an image
_OUTLIER = 1.5  # robust standard deviations at which a difference gets half its weight
_FLOOR = 2.0  # grey levels: smaller differences are noise
_DARK, _BRIGHT = 8, 245  # grey levels; only values between them measure brightness
_LOG_NOISE = 0.1  # brightness noise above which a point gets less weight
_EXPOSURE_ROUNDS = 30
_UNIT = 1e5  # pixels per square metre for a weight of 1
_SMALLEST = 8  # smallest side of an image, pixels
_EDGE = 4.0  # distance in pixels from a depth edge for full trust in colour: registration is wrong nearer
_JUMP = 0.05  # share of the depth that counts as an edge
_CLIPPED = 250  # grey levels from which a channel may be clipped
_CLIPPED_TRUST = 0.05


class ImageFit(NamedTuple):
    """Fitted pose and exposure of an image. `gain`: (3,) float32 factors on its RGB."""

    T_camera_world: NDArray[np.float64]
    gain: NDArray[np.float32]


class Visibility(NamedTuple):
    """Limits for a visible point: depth error in metres and as a share of the depth, cosine of the slant."""

    tolerance: float
    relative: float = 0.01
    least_cosine: float = 0.2


class Sighting(NamedTuple):
    """Points that an image sees, and the image, to compare: `gray` has half its size, `color` a quarter."""

    number: int
    start: NDArray[np.float64]  # T_camera_world of its keyframe
    camera: NDArray[np.float32]
    points: NDArray[np.intp]
    weight: NDArray[np.float64]
    gray: NDArray[np.uint8]
    color: NDArray[np.uint8]


class Look(NamedTuple):
    """Surface points as an image shows them: camera coordinates, grey levels, and their slopes per pixel."""

    points: NDArray[np.float64]
    level: NDArray[np.float64]
    slope: tuple[NDArray[np.float64], NDArray[np.float64]]

    def of(self, chosen: NDArray[np.bool_]) -> "Look":
        u, v = self.slope
        return Look(self.points[chosen], self.level[chosen], (u[chosen], v[chosen]))


class Fit(NamedTuple):
    """Fitted images, by index of the keyframe; and pixels per square metre in each point's best view."""

    images: dict[int, ImageFit]
    best: NDArray[np.float32]


class TextureImage(NamedTuple):
    """An image and the quality of its pixels; arrays of H × W.

    Attributes:
        number: index of its keyframe.
        color: (H, W, 3) uint8 RGB.
        depth: float32 metres, 0 = none.
        clearness: float32 from 0 (no depth, or at a depth edge) to 1.
        trust: float32 from 0 to 1; low where a channel is clipped.
        T_camera_world: (4, 4) float64.
        camera: float32 fx, fy, cx, cy.
    """

    number: int
    color: NDArray[np.uint8]
    depth: NDArray[np.float32]
    clearness: NDArray[np.float32]
    trust: NDArray[np.float32]
    T_camera_world: NDArray[np.float64]
    camera: NDArray[np.float32]


class PosedImages(Protocol):
    """Keyframes with poses that can be read several times, in the same order; None is an unusable one."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> Keyframe | None: ...


def fit(
    points: NDArray[np.float32],
    normals: NDArray[np.float32],
    keyframes: PosedImages,
    visibility: Visibility,
    *,
    align: bool = True,
    even: bool = True,
    watch: OnProgress = lambda _done, _all: None,
) -> Fit:
    """Fit the images of keyframes to each other on points of the surface, (n, 3) float32 with unit normals.

    Args:
        align: move the images; otherwise they keep their keyframes' poses.
        even: make their exposures equal.
        watch: called with the finished steps and all steps.
    """
    rounds = sum(rounds for _, rounds in LEVELS) if align else 0
    best = np.zeros(len(points), np.float32)
    sightings = []
    for number, image in enumerate(images(keyframes)):
        sightings.append(sighting(image, points, normals, visibility, best))
        watch(number + 1, len(keyframes) + rounds)
    if not sightings:
        return Fit({}, best)
    poses, done = [one.start for one in sightings], 0
    evened = _gains(points, sightings, poses).mean(axis=1)
    for blur, times in LEVELS if align and len(sightings) > 1 else ():
        blurred = [
            cv2.GaussianBlur(one.gray * gain, (0, 0), blur)
            for one, gain in zip(sightings, evened, strict=True)
        ]
        for _ in range(times):
            poses = _aligned(points, sightings, blurred, poses)
            done += 1
            watch(len(keyframes) + done, len(keyframes) + rounds)
    poses = [_plausible(T, one.start) for T, one in zip(poses, sightings, strict=True)]
    gains = _gains(points, sightings, poses) if even else np.ones((len(poses), 3), np.float32)
    return Fit({one.number: ImageFit(T, g) for one, T, g in zip(sightings, poses, gains, strict=True)}, best)


def sighting(
    image: TextureImage,
    points: NDArray[np.float32],
    normals: NDArray[np.float32],
    visibility: Visibility,
    best: NDArray[np.float32],
) -> Sighting:
    """Return the points that an image sees. Raises `best`, the best quality of each point, in place."""
    found = np.empty((len(points), 3), np.float32)
    T = image.T_camera_world
    texture_baking.look(points, normals, T, T, image.camera, image.depth, image.clearness, *visibility, found)
    np.maximum(best, found[:, 2], out=best)
    seen = np.flatnonzero(found[:, 2])
    gray = cv2.cvtColor(image.color, cv2.COLOR_RGB2GRAY)
    return Sighting(
        image.number,
        T,
        image.camera,
        seen,
        np.sqrt(found[seen, 2].astype(np.float64) / _UNIT),
        cv2.pyrDown(gray),
        cv2.pyrDown(cv2.pyrDown(image.color)),
    )


def _aligned(
    points: NDArray[np.float32],
    sightings: list[Sighting],
    blurred: list[NDArray[np.float32]],
    poses: list[NDArray[np.float64]],
) -> list[NDArray[np.float64]]:
    """Return the images' poses after one step: each image moves towards the mean of the others."""
    total, weight = np.zeros(len(points)), np.zeros(len(points))
    looks = []
    for one, image, T in zip(sightings, blurred, poses, strict=True):
        looks.append(look(points, one, image, T))
        total[one.points] += one.weight * looks[-1].level
        weight[one.points] += one.weight
    moved = []
    for one, T, seen in zip(sightings, poses, looks, strict=True):
        others = weight[one.points] - one.weight
        shared = others > _SHARED
        if shared.sum() >= _MIN_POINTS:
            mean = (total[one.points] - one.weight * seen.level)[shared] / others[shared]
            T = stepped(one, T, seen.of(shared), mean, one.weight[shared])  # noqa: PLW2901
        moved.append(T)
    return _in_place(moved, [one.start for one in sightings])


def look(
    points: NDArray[np.float32], one: Sighting, image: NDArray[np.float32], T: NDArray[np.float64]
) -> Look:
    """Return grey levels and slopes at points (n, 3) in a blurred half-size image; T is T_camera_world."""
    p = _camera_points(points, one, T)
    u, v = (x / 2 for x in pixels(one, p))  # `pyrDown` keeps the centres of even pixels
    slopes = [sampled(image, u + a, v + b) - sampled(image, u - a, v - b) for a, b in ((1, 0), (0, 1))]
    return Look(p, sampled(image, u, v), (slopes[0] / 4, slopes[1] / 4))  # between pixels 4 apart


def stepped(
    one: Sighting,
    T: NDArray[np.float64],
    seen: Look,
    target: NDArray[np.float64],
    weight: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Return T_camera_world after a Gauss-Newton step that brings the grey levels seen nearer to `target`."""
    value, (x, y, z) = seen.level, seen.points.T
    own, other = (np.average(level, weights=weight) for level in (value, target))
    spread = np.sqrt(np.average((target - other) ** 2, weights=weight))
    gain = np.clip(spread / max(np.sqrt(np.average((value - own) ** 2, weights=weight)), 1e-6), 0.7, 1.4)
    r = gain * (value - own) - (target - other)
    scale = 1.48 * np.median(np.abs(r)) + _FLOOR
    weight = weight / (1 + (r / (_OUTLIER * scale)) ** 2)
    jx, jy = (gain * slope * focal / z for slope, focal in zip(seen.slope, one.camera, strict=False))
    jz = -(jx * x + jy * y) / z
    J = np.stack([jx, jy, jz, y * jz - z * jy, z * jx - x * jz, x * jy - y * jx], axis=1)
    prior = _STIFFNESS * scale**2 / np.repeat((_SIGMA_SHIFT**2, _SIGMA_TURN**2), 3)
    H = (J * weight[:, None]).T @ J + np.diag(prior)
    g = (J * weight[:, None]).T @ r + prior * se3.log(T @ se3.inverse(one.start))
    return np.asarray(se3.exp(-np.linalg.solve(H, g)) @ T)


def _in_place(
    poses: list[NDArray[np.float64]], start: list[NDArray[np.float64]]
) -> list[NDArray[np.float64]]:
    """Return the poses without their common motion since `start`, which the images cannot show."""
    starts, moved = np.stack(start), np.stack(poses)
    about = se3.transform(np.eye(3), se3.inverse(starts)[:, :3, 3].mean(axis=0))
    moves = se3.log(se3.inverse(about) @ se3.inverse(moved) @ starts @ about)
    common = about @ se3.exp(moves.mean(axis=0)) @ se3.inverse(about)
    return list(moved @ common)


def _plausible(T: NDArray[np.float64], T0: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the new pose T, or the old pose T0 if the step between them is implausibly large."""
    twist = se3.log(T @ se3.inverse(T0))
    far = np.linalg.norm(twist[:3]) > _MAX_SHIFT or np.linalg.norm(twist[3:]) > _MAX_TURN
    return T0 if far or not np.isfinite(twist).all() else T


def _gains(
    points: NDArray[np.float32], sightings: list[Sighting], poses: list[NDArray[np.float64]]
) -> NDArray[np.float32]:
    """Return factors on RGB, (n, 3) float32, that make the images equally bright on the same points.

    The logarithm of a brightness is the sum of an image's and a point's term, solved in turn, robustly.
    """
    count, image, point, level = len(sightings), [], [], []
    for number, (one, T) in enumerate(zip(sightings, poses, strict=True)):
        u, v = (x / 4 for x in pixels(one, _camera_points(points, one, T)))
        color = np.stack([sampled(one.color[..., k], u, v) for k in range(3)], axis=1)
        inside = (u >= 0) & (v >= 0) & (u <= one.color.shape[1] - 1) & (v <= one.color.shape[0] - 1)
        good = inside & (color.min(axis=1) >= _DARK) & (color.max(axis=1) <= _BRIGHT)
        image.append(np.full(good.sum(), number))
        point.append(one.points[good])
        level.append(np.log(color[good]))
    of, at, seen = np.concatenate(image), np.concatenate(point), np.concatenate(level)
    found = np.zeros((count, 3))
    for channel in range(3):
        log, own = seen[:, channel], found[:, channel]
        weight = np.ones(len(log))
        for _ in range(_EXPOSURE_ROUNDS):
            sums = [np.bincount(at, w, len(points)) for w in (weight * (log - own[of]), weight)]
            rest = log - own[of] - (sums[0] / np.maximum(sums[1], 1e-9))[at]
            weight = 1 / (1 + (rest / _LOG_NOISE) ** 2)
            own += np.bincount(of, weight * rest, count) / (np.bincount(of, weight, count) + 1)
            own -= np.average(own, weights=np.bincount(of, minlength=count) + 1)
    return np.exp(-found).astype(np.float32)


def _camera_points(points: NDArray[np.float32], one: Sighting, T: NDArray[np.float64]) -> NDArray[np.float64]:
    p = points[one.points] @ T[:3, :3].T + T[:3, 3]
    p[:, 2] = np.maximum(p[:, 2], 0.05)
    return np.asarray(p)


def pixels(one: Sighting, p: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    fx, fy, cx, cy = one.camera
    return fx * p[:, 0] / p[:, 2] + cx, fy * p[:, 1] / p[:, 2] + cy


def sampled(
    image: NDArray[np.generic], u: NDArray[np.float64], v: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return an image's values at columns u and rows v, interpolated, (k,) float64; outside: the border's."""
    height, width = image.shape
    u, v = np.clip(u, 0, width - 1.001), np.clip(v, 0, height - 1.001)
    i, j = u.astype(np.intp), v.astype(np.intp)
    s, t = u - i, v - j
    flat, at = image.ravel(), j * width + i
    above = (1 - s) * flat[at] + s * flat[at + 1]
    below = (1 - s) * flat[at + width] + s * flat[at + width + 1]
    return np.asarray((1 - t) * above + t * below)


def images(keyframes: PosedImages, chosen: Sequence[int] | None = None) -> Iterator[TextureImage]:
    """Yield keyframes with depth and colour images, one at a time; `chosen`: their indices, None = all."""
    for index in range(len(keyframes)) if chosen is None else chosen:
        found = image_of(keyframes[index], index)
        if found is not None:
            yield found


def image_of(keyframe: Keyframe | None, index: int) -> TextureImage | None:
    """Return the texture image of a keyframe; None without colour or depth (LiDAR), or if it is tiny."""
    if keyframe is None or keyframe.color is None or keyframe.intrinsics is None:
        return None
    if min(keyframe.shape) < _SMALLEST:
        return None
    depth = depth_metres(keyframe).astype(np.float32)
    K = keyframe.intrinsics
    color = np.ascontiguousarray(keyframe.color[..., ::-1])
    clipped = color.max(axis=2) >= _CLIPPED
    return TextureImage(
        index,
        color,
        depth,
        clearness_of(depth),
        np.where(clipped, np.float32(_CLIPPED_TRUST), np.float32(1)),
        se3.inverse(keyframe.T_world_camera),
        np.array([K.fx, K.fy, K.cx, K.cy], np.float32),
    )


def clearness_of(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return (H, W) float32: 0 without depth or at a depth edge, 1 some pixels away from the edge."""
    square = np.ones((3, 3))
    least = cv2.erode(np.where(depth > 0, depth, np.float32(1e9)), square)
    most = cv2.dilate(depth, square)
    inner = (depth > 0) & (most - least < _JUMP * most)
    away = cv2.distanceTransform(inner.astype(np.uint8), cv2.DIST_L2, 3)
    return np.asarray(np.minimum(away / _EDGE, 1), np.float32)
