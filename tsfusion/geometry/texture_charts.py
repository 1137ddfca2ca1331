# SPDX-License-Identifier: MIT
"""Split a mesh into charts, pieces that lie flat without folds, and pack them into texture images (xatlas).

Every triangle is projected along the one of six directions that it faces most: both ways along the three
perpendicular axes that most of the surface follows, as walls and floors do. Neighbours of one direction form
one chart. Tens of thousands of small triangles take a second; a general unwrapper takes a minute and leaves
thousands of charts.
"""

from importlib.util import find_spec
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import MissingDependency
from tsfusion.geometry import mesh_islands

_DIRECTIONS = 600  # directions tried for the main axis
_TURNS = 90  # angles tried for the other axes, one degree each
_NORMALS = 20_000  # largest number of normals used to find the axes
_STEEPEST = 0.2  # least cosine between a triangle's normal and its direction
_NEVER = 9.0  # cost of a direction that is too steep
_SMOOTHNESS = 0.35  # cost of a neighbour with another direction
_SWEEPS = 30
GUARD = 2  # texels around each chart that repeat its border
_NOWHERE = 0xFFFFFFFF


class Charts(NamedTuple):
    """Pieces of a mesh of m faces.

    Attributes:
        number: (m,) int32, the chart of each face.
        corners: (m, 3, 2) float64, metres: each face projected into its chart.
    """

    number: NDArray[np.int32]
    corners: NDArray[np.float64]


def find(vertices: NDArray[np.float32], faces: NDArray[np.int32], normals: NDArray[np.float32]) -> Charts:
    """Find a mesh's charts; smoothed borders make them few, and the same mesh has the same charts."""
    corners = vertices.astype(np.float64)[faces]
    flat = _unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    smooth = _unit(normals.astype(np.float64)[faces].sum(axis=1))
    axes = _main_axes(smooth)
    pairs = _neighbours(faces, len(vertices))
    seen_along = _labels(flat @ axes.T, smooth @ axes.T, pairs)
    sideways = np.array([_plane(axis, axes[(2 * (i // 2) + 2) % 6]) for i, axis in enumerate(axes)])
    return Charts(connected(seen_along, pairs), np.einsum("fkx,fax->fka", corners, sideways[seen_along]))


def split(charts: Charts, faces: NDArray[np.int32], vertices: int, covered: NDArray[np.bool_]) -> Charts:
    """Return charts in which `covered` (m,) faces, hidden behind others of their chart, have new charts."""
    label = 2 * charts.number.astype(np.int64) + covered
    return charts._replace(number=connected(label, _neighbours(faces, vertices)))


def connected(label: NDArray[np.integer], pairs: NDArray[np.int32]) -> NDArray[np.int32]:
    """Number the connected pieces of faces with equal labels: (m,) int32. `pairs`: (k, 2) neighbours."""
    a, b = pairs[label[pairs[:, 0]] == label[pairs[:, 1]]].T
    lowest = mesh_islands.pieces(np.stack([a, b, b], axis=1), len(label))
    return np.unique(lowest, return_inverse=True)[1].astype(np.int32)


def _neighbours(faces: NDArray[np.int32], vertices: int) -> NDArray[np.int32]:
    """Return (k, 2) int32 pairs of faces that share an edge."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    key = edges[:, 0].astype(np.int64) * vertices + edges[:, 1]
    order = np.argsort(key, kind="stable")
    face = np.tile(np.arange(len(faces), dtype=np.int32), 3)[order]
    same = np.diff(key[order]) == 0
    return np.stack([face[:-1][same], face[1:][same]], axis=1)


def _main_axes(normals: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (6, 3) unit vectors: the direction of most normals and two across it, each with its opposite."""
    some = normals[:: max(1, len(normals) // _NORMALS)]
    step = np.arange(_DIRECTIONS) + 0.5  # a spiral of even steps over the sphere
    height, turn = 1 - 2 * step / _DIRECTIONS, np.pi * (1 + 5**0.5) * step
    ring = np.sqrt(1 - height**2)
    tried = np.stack([ring * np.cos(turn), ring * np.sin(turn), height], axis=1)
    main = tried[_followed(some, tried).argmax()]
    for _ in range(5):
        along = some @ main
        near = np.abs(along) > 0.95
        if near.any():
            main = _unit((some[near] * np.sign(along[near])[:, None]).sum(axis=0))
    across = _plane(main, np.eye(3)[np.abs(main).argmin()])
    angles = np.radians(np.arange(_TURNS))
    around = np.cos(angles)[:, None] * across[0] + np.sin(angles)[:, None] * across[1]
    second = around[(_followed(some, around) + _followed(some, np.cross(main, around))).argmax()]
    third = np.cross(main, second)
    return np.stack([main, -main, second, -second, third, -third])


def _followed(normals: NDArray[np.float64], directions: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (k,): how many normals are near each direction or its opposite, weighted by nearness."""
    return np.asarray(np.maximum(np.abs(normals @ directions.T) - 0.9, 0).sum(axis=0))


def _plane(axis: NDArray[np.float64], hint: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return (2, 3) unit vectors, right and up for a viewer who looks against `axis`."""
    first = _unit(hint - axis * (axis @ hint))
    return np.stack([first, np.cross(axis, first)])


def _labels(
    flat: NDArray[np.float64], smooth: NDArray[np.float64], pairs: NDArray[np.int32]
) -> NDArray[np.intp]:
    """Choose one of six directions for each face: (m,). `flat`, `smooth`: cosines of its plane, its normals.

    Iterated conditional modes (Besag 1986), half of the faces at a time.
    """
    cost = np.where(flat > _STEEPEST, 1 - smooth, _NEVER)
    label = cost.argmin(axis=1)
    turn = np.arange(len(label)) % 2
    for sweep in range(_SWEEPS):
        votes = np.zeros(len(label) * 6)
        for own, other in ((0, 1), (1, 0)):
            at = pairs[:, own].astype(np.int64) * 6 + label[pairs[:, other]]
            votes += np.bincount(at, minlength=len(votes))
        better = (cost - _SMOOTHNESS * votes.reshape(-1, 6)).argmin(axis=1)
        changed = (better != label) & (turn == sweep % 2)
        label[changed] = better[changed]
    return np.asarray(label, np.intp)


def _unit(vectors: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-12))


class ChartPlacement(NamedTuple):
    """Positions of m faces in texture images (pages).

    Attributes:
        corners: (m, 3, 2) float32, x and y in texels of the face's image; y goes down.
        page: (m,) int32, the image of each face.
        sizes: height and width of each image.
    """

    corners: NDArray[np.float32]
    page: NDArray[np.int32]
    sizes: list[tuple[int, int]]


def check_installed() -> None:
    """Raise MissingDependency without xatlas, before long work that needs it at the end."""
    if find_spec("xatlas") is None:
        raise MissingDependency(
            "a texture needs xatlas, which is not installed: pip install xatlas (on Arm with a C++ compiler)"
        )


def pack(charts: Charts, faces: NDArray[np.int32], *, texel: float, side: int) -> ChartPlacement:
    """Pack charts into images of at most `side`² texels of `texel` metres; too large charts shrink.

    Raises MissingDependency without xatlas.
    """
    check_installed()
    import xatlas

    # One vertex for each chart that has it.
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
    # Triangles without area are not packed: they shrink to the position of a corner.
    placed = page != _NOWHERE
    one = placed.argmax(axis=1)
    rows = np.arange(len(faces))
    corners[~placed] = corners[rows, one].repeat(3, axis=0).reshape(-1, 3, 2)[~placed]
    return _cropped(corners, np.where(placed.any(axis=1), page[rows, one], 0).astype(np.int32), side)


def _cropped(corners: NDArray[np.float32], page: NDArray[np.int32], side: int) -> ChartPlacement:
    """Crop each image to its charts, at most `side` texels a side."""
    sizes = []
    for number in range(int(page.max()) + 1):
        of_page = corners[page == number].reshape(-1, 2)
        most = np.ceil(of_page.max(axis=0)) + GUARD if len(of_page) else np.ones(2)
        width, height = np.minimum(most, side).astype(int).tolist()
        sizes.append((height, width))
    return ChartPlacement(corners, page, sizes)
