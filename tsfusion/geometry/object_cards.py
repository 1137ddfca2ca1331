# SPDX-License-Identifier: MIT
"""Describe maps, meshes, keyframes and recordings by figures and a picture, for a prompt and a notebook."""

import base64
from abc import ABC, abstractmethod
from collections.abc import Iterable
from contextlib import suppress
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import TsfusionError
from tsfusion.core.readable_numbers import counted

Picture = NDArray[np.uint8]  # (H, W, 3) RGB
_SIDE = 320  # pixels of a picture, at most
_CELL = "text-align:left;padding:2px 12px 2px 0"


class Shown(ABC):
    """Base of objects that describe themselves in one line, and with pictures in a notebook."""

    @abstractmethod
    def _facts(self) -> dict[str, str]:
        """Return the object's figures by name, each as text with its unit."""

    def _pictures(self) -> list[Picture | None]:
        return []

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {', '.join(self._facts().values())}>"

    def _repr_html_(self) -> str:
        import cv2

        kind, cells = type(self).__name__, self._facts().items()
        rows = (f"<tr><th style='{_CELL}'>{name}</th><td>{escape(text)}</td></tr>" for name, text in cells)
        images = []
        for picture in self._pictures():
            if picture is not None:
                png = base64.b64encode(cv2.imencode(".png", picture[..., ::-1])[1].tobytes()).decode()
                images.append(f"<img alt='{kind}' style='margin:4px' src='data:image/png;base64,{png}'>")
        return f"<div><b>{kind}</b><table>{''.join(rows)}</table>{''.join(images)}</div>"


class ShownRecording(Shown):
    """Base of recordings. `name`, `sensor`, `timestamps_ns` and `skipped` are as in a `Dataset`."""

    name: str
    sensor: str
    timestamps_ns: NDArray[np.int64] | None
    skipped: dict[str, int]

    @abstractmethod
    def __len__(self) -> int: ...

    @abstractmethod
    def _first(self) -> Any:
        """Return the first frame or keyframe of the recording."""

    def _facts(self) -> dict[str, str]:
        times = self.timestamps_ns
        took = f" in {(times[-1] - times[0]) / 1e9:.1f} s" if times is not None and len(times) else ""
        left_out = counted(self.skipped)
        facts = {"name": self.name, "frames": f"{len(self)} frames{took}", "sensor": f"sensor {self.sensor}"}
        return {**facts, "left out": f"left out: {left_out}"} if left_out else facts

    def _pictures(self) -> list[Picture | None]:
        with suppress(TsfusionError):  # a first frame that cannot be read has no picture
            return measured(self._first()) if len(self) else []
        return []


def extent(points: NDArray[np.floating]) -> str:
    """Return the size of the box around points (n, 3) in metres, as text."""
    if not len(points):
        return "empty"
    return " × ".join(f"{side:.2f}" for side in np.ptp(points, axis=0)) + " m"


def measured(one: Any) -> list[Picture | None]:
    """Return pictures of a keyframe or frame: depth (near is bright) and colours, or points from above."""
    left = getattr(one, "left", None)  # of a stereo pair
    color = one.color if left is None else np.repeat(left[..., None], 3, axis=2)
    if one.points is not None:
        points = one.points[np.isfinite(one.points).all(axis=1)]
        return [surface(points, None, None)]
    image = one.depth if one.depth is not None else one.disparity
    depth = None if image is None else _grey(_small(image), inverse=one.depth is not None)
    return [depth, None if color is None else np.ascontiguousarray(_small(color)[..., ::-1])]


def surface(
    points: NDArray[np.floating],
    normals: NDArray[np.floating] | None,
    colors: NDArray[np.uint8] | None,
    up: Iterable[float] = (0.0, 0.0, 1.0),
) -> Picture | None:
    """Return a picture of a surface's points, seen obliquely from above; None if no point faces the viewer.

    Args:
        points, normals: (n, 3); None = all face the viewer.
        colors: (n, 3) RGB; None = grey by the light.
        up: direction away from the ground.
    """
    above = np.array(list(up), np.float64)
    side = np.eye(3)[np.argmin(np.abs(above))]
    toward = 1.5 * above + side - (side @ above) * above
    toward /= np.linalg.norm(toward)
    right = np.cross(above, toward) / np.linalg.norm(np.cross(above, toward))
    axes = np.stack([right, -np.cross(toward, right), toward])
    facing = np.ones(len(points)) if normals is None else normals @ toward
    seen = np.flatnonzero(facing > 0)
    if not len(seen):
        return None
    x, y, near = (np.asarray(points, np.float64)[seen] @ axes.T).T
    across = int(np.clip(0.7 * np.sqrt(len(seen)), 8, _SIDE))  # pixels: a point a pixel or more
    pixel = max(np.ptp(x), np.ptp(y), 1e-9) / (across - 1)
    column, row = (((one - one.min()) / pixel).astype(np.intp) for one in (x, y))
    light = 0.4 + 0.6 * facing[seen] if normals is not None else 0.3 + 0.7 * _share(near)
    shade = light[:, None] * (np.full(3, 255) if colors is None else colors[seen])
    picture = np.full((row.max() + 1, column.max() + 1, 3), 255, np.uint8)
    order = np.argsort(near, kind="stable")  # the nearest point of a pixel comes last and stays
    picture[row[order], column[order]] = shade[order]
    zoom = max(1, _SIDE // max(picture.shape[:2]))
    return picture.repeat(zoom, axis=0).repeat(zoom, axis=1)


def _small(image: NDArray[Any]) -> NDArray[Any]:
    step = -(-max(image.shape[:2]) // _SIDE)
    return image[::step, ::step]


def _grey(image: NDArray[Any], *, inverse: bool) -> Picture:
    """Return an image as grey values, where small values are bright if `inverse`; 0 and NaN are black."""
    values = np.nan_to_num(np.asarray(image, np.float64), nan=0.0, posinf=0.0, neginf=0.0)
    there = values > 0
    grey = np.zeros(values.shape)
    share = _share(values[there])
    grey[there] = 60 + 195 * (1 - share if inverse else share)
    return np.repeat(grey[..., None], 3, axis=2).astype(np.uint8)


def _share(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return values scaled to 0 … 1 (the 2nd percentile to the 98th) for a picture."""
    if not len(values):
        return values
    low, high = np.percentile(values, (2, 98))
    return np.asarray(np.clip((values - low) / max(high - low, 1e-9), 0, 1))
