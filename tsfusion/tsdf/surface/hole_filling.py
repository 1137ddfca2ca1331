# SPDX-License-Identifier: MIT
"""Close holes with a guess of the surface that continues the field, and mark the guessed triangles.

1. A rim is a seen voxel at which a surface ends: the surface passes it, and a neighbour is unseen.
2. The unseen voxels within half a hole of a rim get values: eq. 3 of the paper with seen voxels as data and
no weight elsewhere, which minimises second differences; a ramp continues unchanged. Seen voxels keep their
values.
3. Marching cubes meshes seen and guessed voxels together. A triangle is guessed if its cell has an unseen
voxel; all others equal those of the mesh without guesses.
4. A guessed patch stays if it closes a hole. Its colours come from its rim.
"""

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import InvalidConfig
from tsfusion.core.number_ranges import distinct
from tsfusion.geometry import mesh_islands
from tsfusion.geometry.mesh import Mesh
from tsfusion.kernels.integration.integrate import CUBE
from tsfusion.kernels.surface import field_smoothing, marching_cubes
from tsfusion.kernels.surface import hole_kernels as kernels
from tsfusion.tsdf.store.block_store import BlockStore
from tsfusion.tsdf.surface import field_regularizer
from tsfusion.tsdf.surface.field_regularizer import SurfaceView, index_of
from tsfusion.tsdf.surface.mesh_extraction import MeshBuffers, extract_rows

MOST_VOXELS = 64
BATCH = 4096  # blocks solved per step, plus their halo
_STIFFEST = 48.0  # largest value of the operator in the preconditioner's units: 4 · 4 per axis
_SOFTEST = 500.0  # smallest eigenvalue of D2ᵀD2 between two fixed ends, times the distance⁴: (4.73)⁴
_SLAB, _SLOPE = 2.5, 0.5  # voxels solved around the plane of a rim, and their growth with distance
_TOLERANCE = 1e-2  # share of the first guess's error that may remain
_SWEEPS = 256  # largest number of sweeps of colours: across the widest hole


def checked(voxels: int) -> int:
    """Check and return the width of holes to close, voxels. Raises InvalidConfig for an impossible width."""
    if not 1 <= voxels <= MOST_VOXELS:
        raise InvalidConfig(f"holes are filled up to 1 to {MOST_VOXELS} voxels, got {voxels}")
    return voxels


def extract_filled(store: BlockStore, min_weight: float, view: SurfaceView, voxels: int) -> Mesh:
    """Return the whole map's mesh with holes up to `voxels` wide closed; `guessed` marks new triangles."""
    own, buffers = np.sort(store.keys), MeshBuffers()
    seen = view(own, store, min_weight)
    more, filled = _fill(own, seen, voxels)
    union = distinct(np.append(own, more))

    def both(
        keys: NDArray[np.int64],
        store: BlockStore,
        min_weight: float,
        out: NDArray[np.float32] | None = None,
    ) -> NDArray[np.float32]:
        assert out is not None  # `mesh_extraction` passes rows
        out[: len(keys)] = np.nan
        out[np.searchsorted(keys, own)] = seen
        if keys is union:
            at = np.searchsorted(keys, more)
            out[at] = np.where(np.isnan(filled), out[at], filled)
        return out[: len(keys)]

    plain, _ = extract_rows(own, store, min_weight, buffers, both, keys=own)
    mesh, _ = extract_rows(union, store, min_weight, buffers, both, keys=union)
    unseen = np.zeros((len(union) + 1, 8), np.uint64)
    bits = np.packbits(~np.isnan(filled), axis=1, bitorder="little")
    unseen[np.searchsorted(union, more)] = bits.view("<u8")
    guessed = np.zeros(len(mesh.faces), np.uint8)
    kernels.mark_guessed_faces(
        len(union), buffers.around.array, unseen, buffers.inside.array, buffers.active.array,
        buffers.first.array, marching_cubes.TRIANGLE_COUNT, guessed,
    )  # fmt: skip
    seen_vertices = np.unique(mesh.faces[guessed == 0])
    mesh.normals[seen_vertices] = plain.normals  # guessed neighbours must not bend them
    guess = replace(mesh, guessed=guessed.astype(bool))
    return with_rim_colors(closing(guess))


def _fill(
    keys: NDArray[np.int64], seen: NDArray[np.float32], voxels: int
) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
    """Return sorted keys of blocks with guessed values, and their (n, 512) values; NaN without a guess."""
    rims = np.zeros((len(keys), CUBE), np.uint8)
    kernels.find_rims(index_of(keys, keys[:, None] + field_regularizer.AROUND), seen, rims)
    rings = math.ceil(_reach(voxels) / 8)
    wanted = _spread(keys[rims.any(axis=1)], rings)
    found_keys, found = [keys[:0]], [np.zeros((0, CUBE), np.float32)]
    for first in range(0, len(wanted), BATCH):
        part = wanted[first : first + BATCH]
        local = _spread(part, rings + 1)
        local = local[np.isin(local, wanted) | np.isin(local, keys)]
        filled = _solve(part, local, *_taken(local, keys, seen, rims), voxels)
        used = ~np.isnan(filled).all(axis=1)
        found_keys.append(part[used])
        found.append(filled[used])
    return np.concatenate(found_keys), np.concatenate(found)


def _taken(
    local: NDArray[np.int64], keys: NDArray[np.int64], seen: NDArray[np.float32], rims: NDArray[np.uint8]
) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return rows of `seen` and `rims` for the blocks `local`; blocks that are not in `keys` are unseen."""
    at = index_of(keys, local)
    values, marks = np.full((len(local), CUBE), np.nan, np.float32), np.zeros((len(local), CUBE), np.uint8)
    values[at >= 0], marks[at >= 0] = seen[at[at >= 0]], rims[at[at >= 0]]
    return values, marks


def _solve(
    part: NDArray[np.int64],
    local: NDArray[np.int64],
    values: NDArray[np.float32],
    rims: NDArray[np.uint8],
    voxels: int,
) -> NDArray[np.float32]:
    """Return the guessed values of the blocks `part`, from the values of the blocks `local` around them."""
    marks = np.zeros((len(local), CUBE), np.uint8)
    around = index_of(local, local[:, None] + field_regularizer.AROUND)
    kernels.mark_unseen(local, around, values, rims, _ball(voxels), _SLAB, _SLOPE, marks)
    level, layer = _list(local, around, values, marks)
    if level.links.size:
        _relax(level, voxels)
    level.x[layer == kernels.EARLY] = np.nan
    values.fill(np.nan)
    field_smoothing.write_values(level.planes, level.places, level.x, values)
    values[marks != kernels.UNSEEN] = np.nan  # seen or irrelevant
    return values[index_of(local, part)]


def _list(
    local: NDArray[np.int64],
    around: NDArray[np.int32],
    values: NDArray[np.float32],
    marks: NDArray[np.uint8],
) -> tuple[field_regularizer.GridLevel, NDArray[np.int32]]:
    """Return the solver's list of marked voxels and seen neighbours, and the sweep in which each one got its
    first value (0 = seen)."""
    planes, counts = field_regularizer.marks_of(len(local), CUBE)
    kernels.take_marked(around, values, marks, planes, counts)
    level = field_regularizer.GridLevel.make(3, planes, counts)
    layer = np.full(len(level.x), kernels.EARLY, np.int32)
    sides = index_of(local, local[:, None] + field_regularizer.SIDES)
    kernels.list_marked(
        sides, values, marks, level.planes, level.places, level.links, level.y, level.weight, level.x, layer
    )
    sweep = 1
    while level.links.size and kernels.extend(sweep, level.links, layer, level.x):
        sweep += 1
    return level, layer


def _relax(level: field_regularizer.GridLevel, voxels: int) -> None:
    """Solve for the guessed voxels: minimise second differences. A wider hole takes more steps."""
    lowest = _SOFTEST / _STIFFEST / (voxels + 2) ** 4
    steps = math.ceil(0.5 * math.log(2 / _TOLERANCE) / math.sqrt(lowest))
    level.relax(1.0, [(math.inf, lowest, steps)])


def _reach(voxels: int) -> float:
    """Return the distance, voxels, from a rim to the middle of the widest hole, plus half a voxel."""
    return (voxels + 1) / 2 + 0.5


def _ball(voxels: int) -> NDArray[np.int32]:
    """Return the columns, (n, 3), of the ball of voxels to mark around a rim: x, y, and half the height."""
    radius = _reach(voxels)
    n = int(radius)
    x, y = np.mgrid[-n : n + 1, -n : n + 1].reshape(2, -1)
    left = radius**2 - x**2 - y**2
    inside = left >= 0
    return np.stack((x[inside], y[inside], np.sqrt(left[inside])), axis=1).astype(np.int32)


def _spread(keys: NDArray[np.int64], rings: int) -> NDArray[np.int64]:
    """Return sorted keys of all blocks up to `rings` blocks away from `keys`, whether in the map or not."""
    for _ in range(rings):
        keys = distinct(keys[:, None] + field_regularizer.AROUND)
    return keys


def closing(mesh: Mesh) -> Mesh:
    """Return the mesh without guessed patches that close no hole.

    A patch with a free edge is removed: it lies at the border of a scan, or in a too wide hole. So is a patch
    with more triangles than the seen pieces around it, because a small crumb would grow to a bubble.
    """
    assert mesh.guessed is not None
    guess = np.flatnonzero(mesh.guessed)
    edges = _edges(mesh.faces[guess])
    owner = np.tile(np.arange(len(guess), dtype=np.int32), 3)
    key = _keys(edges)
    order = np.argsort(key, kind="stable")
    same = key[order][1:] == key[order][:-1]
    patch = mesh_islands.linked(owner[order][1:][same], owner[order][:-1][same], len(guess))
    alone = np.ones(len(key), bool)
    alone[1:] &= ~same
    alone[:-1] &= ~same
    rim = order[alone]  # edges of a single guessed triangle
    of, at = patch[owner[rim]], edges[rim]
    seen = mesh.faces[~mesh.guessed]
    touched = np.zeros(len(mesh.vertices), bool)
    touched[at] = True
    is_attached = np.isin(key[rim], _keys(_edges(seen[touched[seen].any(axis=1)])))
    size = np.bincount(patch, minlength=len(guess))
    keeps = _size_around(seen, of[is_attached], at[is_attached, 0], mesh) >= np.maximum(size, 1)
    keeps[of[~is_attached]] = False
    kept = ~mesh.guessed
    kept[guess] = keeps[patch]
    closed = mesh.of_faces(kept)
    return closed if keeps[patch].any() else replace(closed, guessed=None)


def _size_around(
    seen: NDArray[np.int32], patch: NDArray[np.int32], vertex: NDArray[np.int32], mesh: Mesh
) -> NDArray[np.int64]:
    """Return for each guessed patch the number of triangles of the seen pieces that touch it."""
    assert mesh.guessed is not None
    label = mesh_islands.pieces(seen, len(mesh.vertices))
    faces = np.bincount(label[seen[:, 0]], minlength=len(label))
    pairs = np.unique(np.stack((patch, label[vertex]), axis=1), axis=0)
    total = np.bincount(pairs[:, 0], faces[pairs[:, 1]], minlength=int(mesh.guessed.sum()))
    return total.astype(np.int64)


def _edges(faces: NDArray[np.int32]) -> NDArray[np.int32]:
    return np.concatenate((faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]))


def _keys(edges: NDArray[np.int32]) -> NDArray[np.int64]:
    keys: NDArray[np.int64] = edges.min(axis=1).astype(np.int64) << 32 | edges.max(axis=1)
    return keys


def with_rim_colors(mesh: Mesh) -> Mesh:
    """Return the mesh with colours on the guessed surface, diffused inward from its rim."""
    if mesh.guessed is None or mesh.colors is None:
        return mesh
    known = np.zeros(len(mesh.vertices), bool)
    known[mesh.faces[~mesh.guessed]] = True
    edges = _edges(mesh.faces[mesh.guessed])
    a, b = np.unique(np.concatenate((edges, edges[:, ::-1])), axis=0).T
    a, b = a[~known[a]], b[~known[a]]
    colors = mesh.colors.astype(np.float64)
    has = known.copy()
    for _ in range(_SWEEPS):
        use = has[b]
        count = np.bincount(a[use], minlength=len(known))
        sums = [np.bincount(a[use], colors[b[use], channel], len(known)) for channel in range(3)]
        reached = count > 0
        change = np.stack(sums, axis=1)[reached] / count[reached, None] - colors[reached]
        colors[reached] += change
        if (reached <= has).all() and (not len(change) or np.abs(change).max() < 0.5):
            break
        has |= reached
    return replace(mesh, colors=np.round(colors).astype(np.uint8))
