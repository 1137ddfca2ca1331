# SPDX-License-Identifier: MIT
"""Compare two maps of one frame: counts of blocks and voxels, and the surface that appeared or vanished."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry.mesh import Mesh
from tsfusion.kernels.base.sensor_noise import WEIGHT_ONE
from tsfusion.kernels.integration.integrate import QUANTA_PER_VOXEL, WEIGHT_BITS, WEIGHT_MASK
from tsfusion.tsdf.store.block_store import BlockStore, pack_keys

_CHUNK = 1024  # blocks per step
_VERTICES = 1 << 16  # per step
UNCHANGED, APPEARED, GONE, NEW, UNSEEN = "unchanged", "appeared", "gone", "new", "not_seen_again"
COLORS = {
    UNCHANGED: (170, 170, 170),
    APPEARED: (40, 170, 60),
    GONE: (220, 50, 40),
    NEW: (70, 110, 220),
    UNSEEN: (230, 180, 50),
}
_KINDS = list(COLORS)


class MapSide(NamedTuple):
    """One of the two maps that are compared, with the weight (full samples) from which a voxel was seen."""

    mesh: Mesh
    store: BlockStore
    min_weight: float


@dataclass(frozen=True, eq=False)
class MapDifference:
    """Difference between a map and a later map in the same coordinate frame.

    A voxel counts if it has votes. Surface of the later map is `unchanged` where the earlier map has a
    surface within the tolerance, `appeared` where the earlier map saw free space, else `new`. Surface of the
    earlier map is `gone` where the later map saw free space, and `not_seen_again` where it saw nothing.
    Without `space_carving`, free space is known only near surfaces: many changes then count as `new` and
    `not_seen_again`.

    Attributes:
        blocks, voxels: numbers that are `same`, `changed`, `only_earlier` and `only_later`.
        area_m2: square metres of surface, by kind.
        mesh: the later surface, and vanished parts of the earlier one; each kind has a colour (`COLORS`).
    """

    blocks: dict[str, int]
    voxels: dict[str, int]
    area_m2: dict[str, float]
    mesh: Mesh

    @property
    def is_same(self) -> bool:
        """True if the maps have the same sums and colours."""
        return not any(count for kind, count in self.blocks.items() if kind != "same")


def count(earlier: BlockStore, later: BlockStore) -> tuple[dict[str, int], dict[str, int]]:
    """Count the blocks and voxels of two maps that are `same`, `changed`, `only_earlier` or `only_later`."""
    slots = [store.used() for store in (earlier, later)]
    keys = [store.keys[used] for store, used in zip((earlier, later), slots, strict=True)]
    _, first, second = np.intersect1d(keys[0], keys[1], assume_unique=True, return_indices=True)
    blocks = {"same": 0, "changed": 0, "only_earlier": 0, "only_later": 0}
    voxels = dict(blocks)
    for kind, store, used, shared in (
        ("only_earlier", earlier, slots[0], first), ("only_later", later, slots[1], second),
    ):  # fmt: skip
        alone = np.delete(used, shared)
        blocks[kind] = len(alone)
        for i in range(0, len(alone), _CHUNK):
            voxels[kind] += int(np.count_nonzero(store.sums[alone[i : i + _CHUNK]]))
    layers = [name for name in earlier.layers() if name in later.layers() and name != "correction"]
    for i in range(0, len(first), _CHUNK):
        here, there = slots[0][first[i : i + _CHUNK]], slots[1][second[i : i + _CHUNK]]
        votes = [store.sums[rows] != 0 for store, rows in ((earlier, here), (later, there))]
        equal = np.logical_and.reduce(
            [earlier.layers()[name][here] == later.layers()[name][there] for name in layers]
        )
        blocks["same"] += int(equal.all(axis=1).sum())
        both = votes[0] & votes[1]
        voxels["same"] += int(np.count_nonzero(both & equal))
        voxels["changed"] += int(np.count_nonzero(both & ~equal))
        voxels["only_earlier"] += int(np.count_nonzero(votes[0] & ~votes[1]))
        voxels["only_later"] += int(np.count_nonzero(votes[1] & ~votes[0]))
    blocks["changed"] = len(first) - blocks["same"]
    return blocks, voxels


def surfaces(earlier: MapSide, later: MapSide, tolerance: float) -> tuple[dict[str, float], Mesh]:
    """Return the square metres of each kind of surface (unchanged, new, gone …), and the coloured mesh.

    `tolerance` is the distance in metres up to which two surfaces are the same.
    """
    kinds = [
        _kinds(earlier.mesh, later, tolerance, (GONE, UNSEEN)),
        _kinds(later.mesh, earlier, tolerance, (APPEARED, NEW)),
    ]
    areas = dict.fromkeys(_KINDS, 0.0)
    for side, of_vertices in zip((earlier, later), kinds, strict=True):
        of_faces, sizes = _of_faces(side.mesh.faces, of_vertices), _areas(side.mesh)
        for index, kind in enumerate(_KINDS):
            if kind != UNCHANGED or side is later:
                areas[kind] += float(sizes[of_faces == index].sum())
    return areas, _painted(earlier.mesh, kinds[0], later.mesh, kinds[1])


def _kinds(mesh: Mesh, other: MapSide, tolerance: float, names: tuple[str, str]) -> NDArray[np.uint8]:
    """Return the kind of surface at each vertex of a mesh, (n,) indices in `_KINDS`, by the other map.

    `names` are the kinds for voxels that the other map saw as free, and did not see.
    """
    free, unseen = map(_KINDS.index, names)
    store, least = other.store, max(1, int(np.ceil(other.min_weight * WEIGHT_ONE)))
    found = np.full(len(mesh.vertices), unseen, np.uint8)
    for i in range(0, len(found) if store.count else 0, _VERTICES):
        chunk = found[i : i + _VERTICES]
        voxels = np.floor(mesh.vertices[i : i + _VERTICES] / np.float64(store.voxel_size)).astype(np.int32)
        slots = store.slots_of(pack_keys(voxels >> 3))
        x, y, z = (voxels & 7).T
        sums = store.sums[np.maximum(slots, 0), x << 6 | y << 3 | z]
        weights = sums & WEIGHT_MASK
        seen = (slots >= 0) & (weights >= least)
        metres = (sums >> WEIGHT_BITS) / np.maximum(weights, 1) * (store.voxel_size / QUANTA_PER_VOXEL)
        chunk[seen & (np.abs(metres) <= tolerance)] = _KINDS.index(UNCHANGED)
        chunk[seen & (metres > tolerance)] = free
    return found


def _of_faces(faces: NDArray[np.int32], of_vertices: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Return the kind of surface of each triangle: that of its vertices if equal, else unchanged."""
    corners = of_vertices[faces]
    same = (corners[:, 0] == corners[:, 1]) & (corners[:, 0] == corners[:, 2])
    return np.where(same, corners[:, 0], np.uint8(_KINDS.index(UNCHANGED)))


def _areas(mesh: Mesh) -> NDArray[np.float64]:
    a, b, c = mesh.vertices[mesh.faces].astype(np.float64).transpose(1, 0, 2)
    return np.asarray(np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2)


def _painted(earlier: Mesh, kinds: NDArray[np.uint8], later: Mesh, later_kinds: NDArray[np.uint8]) -> Mesh:
    """Return the later mesh and the changed faces of the earlier mesh, coloured by kind."""
    faces = earlier.faces[_of_faces(earlier.faces, kinds) != _KINDS.index(UNCHANGED)]
    used, numbers = np.unique(faces, return_inverse=True)
    moved = numbers.reshape(-1, 3).astype(np.int32) + np.int32(len(later.vertices))
    palette = np.array([COLORS[kind] for kind in _KINDS], np.uint8)
    return Mesh(
        np.concatenate([later.vertices, earlier.vertices[used]]),
        np.concatenate([later.faces, moved]),
        np.concatenate([later.normals, earlier.normals[used]]),
        palette[np.concatenate([later_kinds, kinds[used]])],
        known_up=later.up or earlier.up,
    )
