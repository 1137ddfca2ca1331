# SPDX-License-Identifier: MIT
"""Charts laid side by side on the pages of a texture, by xatlas."""

from importlib.util import find_spec
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import MissingDependency
from tsfusion.geometry.texture_charts import Charts

GUARD = 2  # texels around each chart that repeat its border
_NOWHERE = 0xFFFFFFFF


class ChartPlacement(NamedTuple):
    """Places of m faces on pages.

    Attributes:
        corners: (m, 3, 2) float32, x and y in texels of the face's page; y goes down.
        page: (m,) int32.
        sizes: height and width of each page.
    """

    corners: NDArray[np.float32]
    page: NDArray[np.int32]
    sizes: list[tuple[int, int]]


def check_installed() -> None:
    """Raise MissingDependency without xatlas, before the work that needs it at the end."""
    if find_spec("xatlas") is None:
        raise MissingDependency(
            "a texture needs xatlas, which is not installed (pip install xatlas, or '.[texture]')"
        )


def pack(charts: Charts, faces: NDArray[np.int32], *, texel: float, side: int) -> ChartPlacement:
    """Lay charts out.

    Args:
        texel: edge of a texel, metres.
        side: texels of a page's side, at most; a chart that is larger is made smaller.

    Raises:
        MissingDependency: without xatlas.
    """
    check_installed()
    import xatlas

    # A vertex of each chart that it belongs to.
    key = charts.number[:, None].astype(np.int64) * (int(faces.max()) + 1) + faces
    _, first, place = np.unique(key.ravel(), return_index=True, return_inverse=True)
    flat = charts.corners.reshape(-1, 2)[first]
    atlas = xatlas.Atlas()
    atlas.add_uv_mesh(
        np.ascontiguousarray(flat - flat.min(axis=0), np.float32),
        np.ascontiguousarray(place.reshape(-1, 3), np.uint32),
        charts.number.astype(np.uint32)[:, None],
    )
    options = xatlas.PackOptions()
    options.resolution, options.texels_per_unit, options.padding = side, 1 / texel, 2 * GUARD
    options.bilinear, options.rotate_charts_to_axis = True, False
    atlas.generate(xatlas.ChartOptions(), options)
    _, triangles, uv = atlas.get_mesh(0)
    page = np.asarray(atlas.get_mesh_vertex_assignment(0)[0])[triangles]  # (m, 3)
    corners = np.asarray(uv * np.array([atlas.width, atlas.height]), np.float32)[triangles]
    # Triangles without area have no place of their own: they shrink to the one of a corner.
    placed = page != _NOWHERE
    one = placed.argmax(axis=1)
    rows = np.arange(len(faces))
    corners[~placed] = corners[rows, one].repeat(3, axis=0).reshape(-1, 3, 2)[~placed]
    return _cropped(corners, np.where(placed.any(axis=1), page[rows, one], 0).astype(np.int32), side)


def _cropped(corners: NDArray[np.float32], page: NDArray[np.int32], side: int) -> ChartPlacement:
    """Pages as large as what is on them, up to a side."""
    sizes = []
    for number in range(int(page.max()) + 1):
        of_page = corners[page == number].reshape(-1, 2)
        most = np.ceil(of_page.max(axis=0)) + GUARD if len(of_page) else np.ones(2)
        width, height = np.minimum(most, side).astype(int).tolist()
        sizes.append((height, width))
    return ChartPlacement(corners, page, sizes)
