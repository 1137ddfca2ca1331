# SPDX-License-Identifier: MIT
"""Recognise places: describe keyframes, and find the most similar ones with an index."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.core.number_ranges import distinct
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.scanner.localization.features import back_project, bilinear

FEATURES = 500
CAPACITY = 1000  # places remembered, at most
_LEAST = 64  # places that the first table has room for; a multiple of 8

_MIN_SIDE = 32  # pixels of an image's shorter side
_DEPTH_PIXELS = 4800  # pixels of the small depth image, about
_TABLES, _BITS = 8, 14  # hash tables, and bits of their keys
_DEPTH_NOISE = 0.002  # metres at one metre (Khoshelham and Elberink 2012: 0.0014)
_DISPARITY_NOISE = 0.5  # pixels
_MAX_COMMON = 0.3  # a key that a larger share of the places has is ignored


@dataclass(frozen=True, eq=False, kw_only=True)
class PlaceView:
    """Features and a small depth image of a keyframe: 36 KB with 500 features."""

    descriptors: NDArray[np.uint8]  # (n, 32) uint8, ORB (Rublee et al. 2011)
    pixels: NDArray[np.float32]  # (n, 2) float32
    points: NDArray[np.float32]  # (n, 3) float32 in the camera's axes, metres; NaN where there is no depth
    depth_mm: NDArray[np.uint16]  # (h, w) uint16 millimetres, 0 = none: medians over blocks of the image
    intrinsics: Intrinsics  # camera of `pixels`
    small: Intrinsics  # camera of `depth_mm`
    size: tuple[int, int]  # width and height of the image, pixels
    noise: float  # metres of depth error at one metre; grows with the square of the depth
    measured: bool  # True for a depth camera, False for a stereo matcher


def place_view(frame: Frame, depth_m: NDArray[np.float32]) -> PlaceView | None:
    """Describe a frame with (H, W) metres of depth; None without intrinsics or a large enough image.

    A frame without colour has no features.
    """
    K = frame.intrinsics
    if K is None or min(depth_m.shape) < _MIN_SIDE:
        return None
    pixels, descriptors = _features(frame.gray)
    z = bilinear(depth_m, pixels)
    factor = max(1, round(float(np.sqrt(depth_m.size / _DEPTH_PIXELS))))
    return PlaceView(
        descriptors=descriptors,
        pixels=pixels,
        points=back_project(pixels, np.where(z > 0, z, np.nan), K).astype(np.float32),
        depth_mm=_medians(np.where(depth_m < 65, depth_m * 1000, 0).astype(np.uint16), factor),
        intrinsics=K,
        small=K.scaled(1 / factor),
        size=(depth_m.shape[1], depth_m.shape[0]),
        noise=_DEPTH_NOISE if frame.baseline_fx is None else _DISPARITY_NOISE / frame.baseline_fx,
        measured=frame.kind == "depth",
    )


def _features(gray: NDArray[np.uint8] | None) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return (n, 2) pixels and (n, 32) descriptors of ORB; none without an image."""
    none = np.empty((0, 2), np.float32), np.empty((0, 32), np.uint8)
    if gray is None:
        return none
    orb = cv2.ORB_create(nfeatures=FEATURES, fastThreshold=10)  # type: ignore[attr-defined]
    keypoints, descriptors = orb.detectAndCompute(gray, None)
    if descriptors is None:
        return none
    return np.array([point.pt for point in keypoints], np.float32).reshape(-1, 2), descriptors


def _medians(depth: NDArray[np.uint16], factor: int) -> NDArray[np.uint16]:
    """Shrink a depth image to medians of nine pixels a block, 0 unless five of them or more have depth."""
    height, width = depth.shape[0] // factor, depth.shape[1] // factor
    if factor < 3:
        return np.ascontiguousarray(depth[::factor, ::factor][:height, :width])
    offsets = np.rint((factor - 1) / 2 + np.array([-1, 0, 1]) * factor / 3).astype(int)
    blocks = depth[: height * factor, : width * factor].reshape(height, factor, width, factor)
    nine = blocks[:, offsets][:, :, :, offsets].transpose(0, 2, 1, 3).reshape(height, width, 9)
    nine = np.sort(nine, axis=2)
    empty = (nine == 0).sum(axis=2)
    middle = np.take_along_axis(nine, np.minimum((9 + empty) // 2, 8)[:, :, None], axis=2)[:, :, 0]
    return np.where(empty <= 4, middle, np.uint16(0))


class PlaceIndex:
    """Index of places by number, which finds places with similar descriptors.

    Each descriptor votes for the places with a similar one. Similar ones share a key: locality-sensitive
    hashing (Gionis, Indyk and Motwani 1999), eight tables over 14 bits each. Memory: 16 to 33 KB for each
    place beside its view, 1 MB at least.
    """

    def __init__(self, capacity: int = CAPACITY) -> None:
        rng = np.random.default_rng(7)
        self._bits = np.stack([rng.choice(256, _BITS, replace=False) for _ in range(_TABLES)])
        self._capacity = capacity
        self._table = np.zeros((_TABLES << _BITS, _LEAST // 8), np.uint8)  # key → a bit for each place
        self._votes = np.ones(capacity)  # votes are divided by the root of a place's descriptor count
        self._numbers = np.full(capacity, -1, np.int64)
        self.views: dict[int, PlaceView] = {}

    @property
    def full(self) -> bool:
        """True if a place must be forgotten before another is added."""
        return len(self.views) >= self._capacity

    def add(self, number: int, view: PlaceView) -> None:
        """Remember a place under its number. The index must not be full."""
        slot = int(np.flatnonzero(self._numbers < 0)[0])
        self._numbers[slot] = number
        if slot >> 3 == self._table.shape[1]:
            self._table = np.hstack([self._table, np.zeros_like(self._table)])
        self._table[self._keys(view), slot >> 3] |= np.uint8(128 >> (slot & 7))
        self._votes[slot] = np.sqrt(max(len(view.descriptors), 1))
        self.views[number] = view

    def forget(self, number: int) -> None:
        slot = int(np.flatnonzero(self._numbers == number)[0])
        self._numbers[slot] = -1
        self._table[:, slot >> 3] &= np.uint8(255 ^ 128 >> (slot & 7))
        del self.views[number]

    def most_similar(self, view: PlaceView, *, before: int | None = None, count: int = 4) -> list[int]:
        """Return the places (with numbers below `before`) that look most like the view, best first."""
        allowed = self._numbers >= 0
        slots = np.flatnonzero(allowed if before is None else allowed & (self._numbers < before))
        scores = self._votes_for(view)[slots] / self._votes[slots]
        best = np.argsort(-scores, kind="stable")[:count]
        return [int(self._numbers[slots[i]]) for i in best if scores[i] > 0]

    def _keys(self, view: PlaceView) -> NDArray[np.int64]:
        """Return the rows of `_table` for the view's descriptors."""
        bits = np.unpackbits(view.descriptors, axis=1)
        powers = 1 << np.arange(_BITS)
        keys = [(bits[:, chosen] @ powers) + (table << _BITS) for table, chosen in enumerate(self._bits)]
        return distinct(np.concatenate(keys)).astype(np.int64)

    def _votes_for(self, view: PlaceView) -> NDArray[np.float64]:
        rows = np.unpackbits(self._table[self._keys(view)], axis=1)[:, : self._capacity]
        common = rows.sum(axis=1, dtype=np.int32) > max(_MAX_COMMON * len(self.views), 2)
        rows[common] = 0
        votes = np.zeros(self._capacity)
        votes[: rows.shape[1]] = rows.sum(axis=0, dtype=np.float64)
        return votes
