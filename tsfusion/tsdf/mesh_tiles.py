# SPDX-License-Identifier: MIT
"""The mesh of a whole map in tiles, with memory for one tile: together the same vertices and triangles.

A tile is a run of blocks in the order of their keys: it has the vertices on its blocks' voxel edges and the
triangles of their cells. Tiles come last first: a cell's other vertices lie towards +x, +y, +z, in tiles that
are known by then. Vertices are counted from the end of the whole mesh, whose length shows with the last tile.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry.mesh_parts import MeshPart
from tsfusion.tsdf import field_regularizer, mesh_extraction
from tsfusion.tsdf.block_store import CELL_STEPS, BlockStore
from tsfusion.tsdf.surface_values import SurfaceView

_FARTHEST = int(CELL_STEPS.max())  # what the keys of blocks that share a cell differ by at most


class _Numbered(NamedTuple):
    """Blocks whose vertices have numbers: (n,) sorted keys, (n, 24) edges with a vertex, and (n,) the number
    of the first vertex, from the end."""

    keys: NDArray[np.int64]
    edges: NDArray[np.uint64]
    first: NDArray[np.int64]

    def before(self, later: "_Numbered", last: np.int64) -> "_Numbered":
        """These and the later ones, up to a key."""
        n = int(np.searchsorted(later.keys, last, side="right"))
        return _Numbered(
            np.concatenate([self.keys, later.keys[:n]]),
            np.concatenate([self.edges, later.edges[:n]]),
            np.concatenate([self.first, later.first[:n]]),
        )


def tiles(store: BlockStore, min_weight: float, view: SurfaceView) -> Iterator[MeshPart]:
    """Parts of the mesh that `mesh_extraction.extract` makes of all blocks, the last first.

    Beside a tile and its neighbours, memory holds the values of up to three layers of blocks, across x.
    """
    size = field_regularizer.BATCH
    keys = np.sort(store.keys)
    values = WholeMapValues(keys, view, size)
    buffers = mesh_extraction.MeshBuffers()
    beyond = _Numbered(keys[:0], np.zeros((0, 24), np.uint64), keys[:0])
    done = 0
    for begin in range((len(keys) - 1) // size * size, -1, -size):
        own = keys[begin : begin + size]
        wanted = np.unique((own[:, None] - CELL_STEPS).ravel())  # they share the edges of these blocks
        wanted = wanted[store.slots_of(wanted) >= 0]
        mesh, rows = mesh_extraction.extract_rows(wanted, store, min_weight, buffers, values)
        a = int(np.searchsorted(rows, own[0]))
        b = a + len(own)
        first, edges = buffers.first.array, buffers.edges.array
        (start, face), (end, last_face) = first[a], first[b]
        faces = done + int(end) - mesh.faces[face:last_face].astype(np.int64)
        outside = faces <= done
        local = done + int(end) - faces[outside]
        faces[outside] = _numbers(local, rows, first[: len(rows), 0], edges, beyond)
        yield MeshPart(
            mesh.vertices[start:end],
            faces.astype(np.int32),
            mesh.normals[start:end],
            None if mesh.colors is None else mesh.colors[start:end],
        )
        numbered = _Numbered(own, edges[a:b].copy(), done + int(end) - first[a:b, 0].astype(np.int64))
        beyond = numbered.before(beyond, own[0] + _FARTHEST)
        values.forget_beyond(int(own[0]) + _FARTHEST)
        done += int(end - start)


def _numbers(
    local: NDArray[np.int64],
    rows: NDArray[np.int64],
    first: NDArray[np.int32],
    edges: NDArray[np.uint64],
    known: _Numbered,
) -> NDArray[np.int64]:
    """Numbers from the end of vertices on other tiles' edges, of which a tile knows but its own numbers.

    Args:
        local: (n,) the tile's numbers.
        rows, first, edges: the tile's blocks, their first vertices, and their edges that its cells use.
        known: those blocks with all their edges.
    """
    ids, back = np.unique(local, return_inverse=True)
    row = np.searchsorted(first, ids, side="right") - 1
    blocks, of = np.unique(row, return_inverse=True)
    used = _bits(edges[blocks])
    counts = used.sum(axis=1, dtype=np.int64)
    edge = np.nonzero(used)[1][np.cumsum(counts)[of] - counts[of] + ids - first[row]]
    at = np.searchsorted(known.keys, rows[blocks])
    rank = np.cumsum(_bits(known.edges[at]), axis=1, dtype=np.int16) - 1
    numbers: NDArray[np.int64] = known.first[at][of] - rank[of, edge]
    return numbers[back.reshape(-1)]


def _bits(planes: NDArray[np.uint64]) -> NDArray[np.uint8]:
    """(n, 24) planes of 64 bits → (n, 1536) 0 or 1, in the order of the vertices."""
    octets = np.ascontiguousarray(planes, "<u8").view(np.uint8)
    return np.unpackbits(octets, axis=1, bitorder="little")


class WholeMapValues:
    """A `SurfaceView` whose values are those of the whole map: its blocks are solved in the same batches.

    Of use as long as the map stays as it is.

    Args:
        keys: sorted, of all blocks of the map.
        view: reads the surface.
        size: blocks a batch.
    """

    def __init__(self, keys: NDArray[np.int64], view: SurfaceView, size: int) -> None:
        self._keys, self._view, self._size = keys, view, size
        self._solved: dict[int, NDArray[np.float32]] = {}

    def __call__(
        self,
        keys: NDArray[np.int64],
        store: BlockStore,
        min_weight: float,
        out: NDArray[np.float32] | None = None,
    ) -> NDArray[np.float32]:
        """See `SurfaceView`."""
        assert out is not None  # `mesh_extraction` has rows for them
        at = np.searchsorted(self._keys, keys)
        for number in np.unique(at // self._size).tolist():
            begin = number * self._size
            if number not in self._solved:
                self._solved[number] = self._view(self._keys[begin : begin + self._size], store, min_weight)
            here = at // self._size == number
            out[: len(keys)][here] = self._solved[number][at[here] - begin]
        return out[: len(keys)]

    def forget_beyond(self, key: int) -> None:
        """Let go of batches in which every key is larger."""
        for number in [one for one in self._solved if self._keys[one * self._size] > key]:
            del self._solved[number]

    def forget_before(self, key: int) -> None:
        """Let go of batches that no cell from this key on reads."""
        for number in [one for one in self._solved if self._last(one) < key - _FARTHEST]:
            del self._solved[number]

    def _last(self, number: int) -> int:
        return int(self._keys[min((number + 1) * self._size, len(self._keys)) - 1])
