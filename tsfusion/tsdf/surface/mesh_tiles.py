# SPDX-License-Identifier: MIT
"""Mesh a whole map tile by tile, with memory for one tile and the same vertices and triangles as at once.

A tile is a run of blocks in key order. It has the vertices on its blocks' voxel edges and the triangles of
their cells. The last tile comes first: a cell's other vertices lie towards +x, +y, +z, in later tiles. Vertex
numbers count from the end of the whole mesh, because its length is unknown until the last step.
"""

from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.number_ranges import distinct
from tsfusion.geometry.mesh_parts import MeshPart
from tsfusion.tsdf.store.block_store import CELL_STEPS, BlockStore
from tsfusion.tsdf.surface import field_regularizer, mesh_extraction
from tsfusion.tsdf.surface.field_regularizer import SurfaceView
from tsfusion.tsdf.surface.surface_layers import Layer, SolvedBlocks, SolvedGroups

_FARTHEST = int(CELL_STEPS.max())  # largest difference of the keys of blocks that share a cell


class Numbered(NamedTuple):
    """Blocks whose mesh vertices are numbered: (n,) sorted keys, (n, 24) bit planes of edges with a vertex,
    and (n,) the number of the first vertex, counted from the end of the mesh."""

    keys: NDArray[np.int64]
    edges: NDArray[np.uint64]
    first: NDArray[np.int64]

    def before(self, later: "Numbered", last: np.int64) -> "Numbered":
        """Return these blocks followed by the blocks of `later` up to key `last`."""
        n = int(np.searchsorted(later.keys, last, side="right"))
        return Numbered(
            np.concatenate([self.keys, later.keys[:n]]),
            np.concatenate([self.edges, later.edges[:n]]),
            np.concatenate([self.first, later.first[:n]]),
        )

    def numbers(self, vertices: "_Vertices") -> NDArray[np.int64]:
        """Return the (n,) numbers, from the end of the mesh, of vertices on edges of these blocks."""
        at, of = np.unique(np.searchsorted(self.keys, vertices.keys), return_inverse=True)
        rank = np.cumsum(_bits(self.edges[at]), axis=1, dtype=np.int16) - 1
        numbers: NDArray[np.int64] = self.first[at][of] - rank[of, vertices.edges]
        return numbers


class _Vertices(NamedTuple):
    """Vertices of other tiles that a tile's triangles use, (n,) each: key of the block, edge in the block."""

    keys: NDArray[np.int64]
    edges: NDArray[np.int64]

    def of(self, chosen: NDArray[np.bool_]) -> "_Vertices":
        return _Vertices(self.keys[chosen], self.edges[chosen])


_NOBODY = Numbered(np.zeros(0, np.int64), np.zeros((0, 24), np.uint64), np.zeros(0, np.int64))


class MeshRun(NamedTuple):
    """Mesh of consecutive tiles, made without the other tiles.

    Attributes:
        part: the mesh; numbers count from the end of these tiles, 0 = a vertex of later tiles.
        open_at: (n,) indices of these zeros in the corners of all faces.
        open_keys, open_edges: (n,) key of the block, and edge in the block, of these vertices.
        border: the first blocks, whose vertices earlier tiles may need.
        first: key of the first block.
    """

    part: MeshPart
    open_at: NDArray[np.int64]
    open_keys: NDArray[np.int64]
    open_edges: NDArray[np.int64]
    border: Numbered
    first: np.int64


def tiles(store: BlockStore, min_weight: float, view: SurfaceView) -> Iterator[MeshPart]:
    """Yield parts of the mesh that `mesh_extraction.extract` makes of all blocks, the last part first.

    Besides a tile and its neighbours, memory holds the values of up to three layers of blocks, across x.
    """
    keys = np.sort(store.keys)
    for made in _tiles(keys, range(tile_count(len(keys))), store, min_weight, view):
        yield made.part


def tile_count(blocks: int) -> int:
    return -(-blocks // field_regularizer.BATCH)


def run(
    keys: NDArray[np.int64], which: range, store: BlockStore, min_weight: float, view: SurfaceView
) -> MeshRun:
    """Return the mesh of some tiles (numbers `which`) of a map with these sorted block keys. The store need
    only hold `blocks_of_run` and their surroundings."""
    made = list(_tiles(keys, which, store, min_weight, view))[::-1]
    corners = np.array([one.part.faces.size for one in made])
    begin = np.cumsum(corners) - corners
    colors = [one.part.colors for one in made if one.part.colors is not None]
    part = MeshPart(
        np.concatenate([one.part.vertices for one in made]),
        np.concatenate([one.part.faces for one in made]),
        np.concatenate([one.part.normals for one in made]),
        np.concatenate(colors) if colors else None,
    )
    open_at = np.concatenate([at + one.open_at for at, one in zip(begin, made, strict=True)])
    open_keys = np.concatenate([one.open_keys for one in made])
    open_edges = np.concatenate([one.open_edges for one in made])
    return MeshRun(part, open_at, open_keys, open_edges, made[0].border, made[0].first)


def blocks_of_run(keys: NDArray[np.int64], which: range) -> NDArray[np.int64]:
    """Return the keys of the blocks whose values a run of tiles needs: whole batches around its cells."""
    size = field_regularizer.BATCH
    own = keys[which.start * size : which.stop * size]
    low, high = int(own[0]) - 2 * _FARTHEST, int(own[-1]) + _FARTHEST
    begin = int(np.searchsorted(keys, low)) // size * size
    end = -(-int(np.searchsorted(keys, high, side="right")) // size) * size
    return keys[begin:end]


def together(runs: Iterable[MeshRun]) -> Iterator[MeshPart]:
    """Join the runs of a map's tiles, the last run first. Yields the mesh in parts, as `tiles` does."""
    done, known = 0, _NOBODY
    for one in runs:
        faces = one.part.faces.astype(np.int64) + done
        vertices = _Vertices(one.open_keys, one.open_edges)
        faces.reshape(-1)[one.open_at] = known.numbers(vertices)
        yield one.part._replace(faces=faces.astype(np.int32))
        border = one.border._replace(first=one.border.first + done)
        known = border.before(known, one.first + _FARTHEST)
        done += len(one.part.vertices)


def _tiles(
    keys: NDArray[np.int64], which: range, store: BlockStore, min_weight: float, view: SurfaceView
) -> Iterator[MeshRun]:
    """Yield the mesh of single tiles, the last tile first; vertex numbers count from the end of the last."""
    size = field_regularizer.BATCH
    solved = _batches(keys, store, min_weight, view)
    values = SolvedGroups(lambda some: np.searchsorted(keys, some) // size, solved)
    buffers = mesh_extraction.MeshBuffers()
    beyond, done = _NOBODY, 0
    last_key = keys[min(which.stop * size, len(keys)) - 1] if len(keys) else np.int64(0)
    for number in reversed(which):
        begin = number * size
        own = keys[begin : begin + size]
        wanted = distinct(own[:, None] - CELL_STEPS)  # blocks that share edges with these blocks
        wanted = wanted[store.slots_of(wanted) >= 0]
        mesh, rows = mesh_extraction.extract_rows(wanted, store, min_weight, buffers, values)
        a = int(np.searchsorted(rows, own[0]))
        b = a + len(own)
        first, edges = buffers.first.array, buffers.edges.array
        (start, face), (end, last_face) = first[a], first[b]
        faces = (done + int(end) - mesh.faces[face:last_face].astype(np.int64)).reshape(-1)
        outside = np.flatnonzero(faces <= done)
        local = done + int(end) - faces[outside]
        vertices = _vertices(local, rows, first[: len(rows), 0], edges)
        is_open = vertices.keys > last_key
        faces[outside[~is_open]] = beyond.numbers(vertices.of(~is_open))
        faces[outside[is_open]] = 0
        part = MeshPart(
            mesh.vertices[start:end],
            faces.astype(np.int32).reshape(-1, 3),
            mesh.normals[start:end],
            None if mesh.colors is None else mesh.colors[start:end],
        )
        numbered = Numbered(own, edges[a:b].copy(), done + int(end) - first[a:b, 0].astype(np.int64))
        beyond = numbered.before(beyond, own[0] + _FARTHEST)
        yield MeshRun(part, outside[is_open], *vertices.of(is_open), beyond, own[0])
        beyond_key = int(own[0]) + _FARTHEST
        solved.forget([one for one in solved if keys[one * size] > beyond_key])
        done += int(end - start)


def _vertices(
    local: NDArray[np.int64], rows: NDArray[np.int64], first: NDArray[np.int32], edges: NDArray[np.uint64]
) -> _Vertices:
    """Return block and edge of the tile's vertices `local` that belong to other tiles, which number them.

    Args:
        local: (n,) the tile's numbers.
        rows, first, edges: the tile's blocks, their first vertices, and their edges that its cells use.
    """
    ids, back = np.unique(local, return_inverse=True)
    row = np.searchsorted(first, ids, side="right") - 1
    blocks, of = np.unique(row, return_inverse=True)
    used = _bits(edges[blocks])
    counts = used.sum(axis=1, dtype=np.int64)
    edge = np.nonzero(used)[1][np.cumsum(counts)[of] - counts[of] + ids - first[row]]
    back = back.reshape(-1)
    return _Vertices(rows[row][back], edge[back])


def _bits(planes: NDArray[np.uint64]) -> NDArray[np.uint8]:
    """Unpack bit planes of vertices on a block's edges, (n, 24) uint64, to (n, 1536) uint8 0 or 1."""
    octets = np.ascontiguousarray(planes, "<u8").view(np.uint8)
    return np.unpackbits(octets, axis=1, bitorder="little")


def _batches(
    keys: NDArray[np.int64], store: BlockStore, min_weight: float, view: SurfaceView
) -> Layer[SolvedBlocks]:
    """Return the values for the mesh of the whole map, solved in fixed batches of all its blocks."""
    size = field_regularizer.BATCH

    def solved(numbers: Sequence[int]) -> Iterator[SolvedBlocks]:
        for number in numbers:
            own = keys[number * size : (number + 1) * size]
            yield SolvedBlocks(own, view(own, store, min_weight))

    return Layer(store, solved, lambda _: np.arange(tile_count(len(keys))), is_bounded=False)
