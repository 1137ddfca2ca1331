# SPDX-License-Identifier: MIT
"""Pictures of a mesh for a report: from four sides, coloured by its error, and its plan from above."""

import base64
import dataclasses
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import OutputError
from tsfusion.geometry.color_scales import ramp, rounded_up
from tsfusion.geometry.mesh import Mesh
from tsfusion.pipelines.maps import mesh_preview

SIZE = (840, 560)  # pixels
SIDES = 4
_QUALITY = 88  # of JPEG
_ERROR_SHARE = 98  # percent of the vertices have a colour short of the scale's end
_CELLS = 360  # of a plan's longer side


class ErrorScale(NamedTuple):
    """Colours of an error.

    Attributes:
        end_mm: the error that has the last colour, a round number.
        level: (n,) uint8 of each vertex, 255 = `end_mm` or more.
    """

    end_mm: float
    level: NDArray[np.uint8]

    def colors(self) -> NDArray[np.uint8]:
        """(n, 3) uint8 RGB."""
        return ramp()[self.level]


class Sides:
    """Pictures of a mesh from the side that shows most of it, and from the three others."""

    def __init__(self, mesh: Mesh) -> None:
        self._mesh = mesh
        self._up, self._aspect = mesh_preview.up_of(mesh), SIZE[0] / SIZE[1]
        self.angles = mesh_preview.choose_angles(mesh, self._up, aspect=self._aspect)

    def picture(self, side: int, colors: NDArray[np.uint8] | None = None) -> NDArray[np.uint8]:
        """(height, width, 3) uint8 RGB from one of `SIDES` sides.

        Args:
            colors: (n, 3) uint8 RGB of the vertices, instead of the mesh's own.
        """
        azimuth, elevation = self.angles
        azimuth += side * 2 * math.pi / SIDES
        places = mesh_preview.core(self._mesh)
        camera = mesh_preview.orbit(places, self._up, azimuth, elevation, self._aspect)
        mesh = self._mesh if colors is None else dataclasses.replace(self._mesh, colors=colors)
        return mesh_preview.picture(mesh, camera, *SIZE, up=self._up)


def error_scale(error_mm: NDArray[np.float64]) -> ErrorScale:
    """Colours for (n,) errors in millimetres, nearly all of which fit into the scale."""
    end = rounded_up(float(np.percentile(np.abs(error_mm), _ERROR_SHARE)))
    level = np.minimum(np.abs(error_mm) / end, 1.0)
    return ErrorScale(end, np.round(255 * level).astype(np.uint8))


def plan(places: NDArray[np.float64]) -> tuple[str, NDArray[np.float64]]:
    """How many of (n, 2) places are in each cell, as a picture's URL, and its (2, 2) corners, metres."""
    low, high = np.percentile(places, (0.2, 99.8), axis=0)
    cell = max(float((high - low).max()), 1e-3) / _CELLS
    bins = np.maximum(np.ceil((high - low) / cell), 1).astype(int)
    corners = np.stack((low, low + bins * cell))
    cells = np.floor((places - low) / cell).astype(np.int64)
    inside = ((cells >= 0) & (cells < bins)).all(axis=1)
    numbers = cells[inside, 0] * bins[1] + cells[inside, 1]
    counts = np.bincount(numbers, minlength=int(bins.prod())).reshape(bins)
    dense = np.percentile(counts[counts > 0], 97) if counts.any() else 1.0
    alpha = np.round(210 * np.minimum(counts / dense, 1.0) ** 0.6).astype(np.uint8)
    picture = np.full((*alpha.T.shape, 4), 128, np.uint8)
    picture[..., 3] = alpha.T[::-1]
    return "data:image/png;base64," + base64.b64encode(_encoded(".png", picture)).decode(), corners


def jpeg_url(rgb: NDArray[np.uint8]) -> str:
    """A picture as the URL that holds it."""
    import cv2

    content = _encoded(".jpg", rgb[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])
    return "data:image/jpeg;base64," + base64.b64encode(content).decode("ascii")


def _encoded(suffix: str, picture: NDArray[np.uint8], options: list[int] | None = None) -> bytes:
    import cv2

    done, content = cv2.imencode(suffix, picture, options or [])
    if not done:
        raise OutputError("cannot encode a picture for the report")
    return bytes(content.tobytes())
