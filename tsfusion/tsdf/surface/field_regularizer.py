# SPDX-License-Identifier: MIT
"""Read signed distances of a surface from the map, raw or smoothed, and plan the smoothing (the field).

`kernels/surface/field_smoothing.py` solves. The result is a function of the map's sums: the order of
keyframes and threads has no effect. Blocks are solved with a halo of neighbours, which makes the values of a
few blocks nearly equal to those of the whole map (docs/method.md has the error).
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tsfusion.kernels.base.sensor_noise import WEIGHT_ONE
from tsfusion.kernels.integration.integrate import CUBE, QUANTA_PER_VOXEL
from tsfusion.kernels.surface import field_smoothing as kernels
from tsfusion.kernels.surface import normal_smoothing, surface_cells
from tsfusion.tsdf.store.block_store import BlockStore

BATCH = 8192  # blocks solved per step, plus their halo; about 10 kB each
STEPS, LOWEST = 6, 0.015  # Chebyshev steps per round; smallest eigenvalue of M⁻¹A that they damp evenly
STRONG_STEPS, STRONG_LOWEST = 12, 0.02  # after a coarser start: the mesh is 6 % (stereo) from the limit
WIDEST = 1.8  # factor on ε in the first round
LEAST_REACH = 2.0  # voxels
COARSE_FROM = 64.0  # from this λ on, smoothing reaches more voxels than so few iterations do
NORMAL_SAMPLES = 3  # voxels on each side of the surface; fewer would be no ray

WORD = 64  # cells

_KEY_STEP = np.array([1 << 42, 1 << 21, 1], np.int64)  # one block along x, y, z in a packed key
AROUND = np.array([(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1)]) @ _KEY_STEP
SIDES = np.array([sign * step for step in _KEY_STEP for sign in (-1, 1)], np.int64)


Round = tuple[float, float, int]  # ε in quanta, ∞: ω = 1; smallest eigenvalue to damp; steps
_PART = 1 << 14  # blocks per read: they may have to be read from a file


@dataclass(frozen=True)
class FieldSettings:
    """Settings of the surface smoothing (field). `smoothness` is λ against data weights in full-confidence
    samples. `edge` is ε: a second difference above it, voxels, counts as an edge. Each of the `reweightings`
    rounds computes the weights ω from the last solution."""

    smoothness: float
    edge: float
    reweightings: int

    @property
    def reach(self) -> float:
        """Length over which the penalty smooths, voxels; deeper voxels do not move the surface."""
        return max(LEAST_REACH, float(self.smoothness**0.25))

    @property
    def coarser(self) -> int:
        """Number of coarser grid levels: each has cells twice as large, and 1/16 of λ against the data."""
        return int(self.smoothness >= COARSE_FROM)

    def rounds(self, depth: int) -> list[Round]:
        """Return the solver's rounds on a grid level (0 = voxels). ε starts wider, as noise also bends."""
        edge = self.edge * QUANTA_PER_VOXEL * 4**depth
        flat = (math.inf, STRONG_LOWEST, STRONG_STEPS)
        if self.coarser:
            return [flat] * (depth == self.coarser) + [(edge, *flat[1:])] * self.reweightings
        if not self.reweightings:
            return [flat]
        falling = np.linspace(edge, WIDEST * edge, self.reweightings)[::-1].tolist()
        return [(edge, LOWEST, STEPS) for edge in falling]

    @property
    def halo(self) -> int:
        """Width, in blocks, of the border that is solved together with the wanted blocks on each side."""
        return 1 + 2 * self.coarser

    @property
    def rings(self) -> int:
        """Distance, in blocks, beyond which a change of sums moves smoothed values by under 0.01 voxel."""
        return 1 + self.coarser


def solve(
    keys: NDArray[np.int64],
    store: BlockStore,
    min_weight: float,
    out: NDArray[np.float32] | None = None,
    *,
    settings: FieldSettings,
) -> NDArray[np.float32]:
    """Return the smoothed signed distances of blocks, as a `SurfaceView` does: the surface `field`."""
    if out is None:
        out = np.empty((len(keys), CUBE), np.float32)
    for first in range(0, len(keys), BATCH):
        part = keys[first : first + BATCH]
        _solve_batch(part, store, min_weight, settings, out[first : first + len(part)])
    return out[: len(keys)]


def along_normals(
    keys: NDArray[np.int64],
    store: BlockStore,
    min_weight: float,
    out: NDArray[np.float32] | None = None,
    *,
    smoothness: float,
) -> NDArray[np.float32]:
    """Return signed distances of blocks, smoothed along normals: the `SurfaceView` of the surface `normal`.

    This is eq. 3 of the paper on samples along the gradient.
    """
    centre = np.zeros((NORMAL_SAMPLES + 1, NORMAL_SAMPLES + 1), np.float32)
    for n in range(NORMAL_SAMPLES + 1):
        D2 = np.diff(np.eye(2 * n + 1), 2, axis=0)
        centre[n, : n + 1] = np.linalg.inv(np.eye(2 * n + 1) + smoothness * D2.T @ D2)[n, n:]
    if out is None:
        out = np.empty((len(keys), CUBE), np.float32)
    for first in range(0, len(keys), BATCH):
        part = keys[first : first + BATCH]
        read = around(part, store, 1)
        normal_smoothing.smooth_along_normals(
            index_of(read, part), index_of(read, part[:, None] + AROUND), values_of(read, store, min_weight),
            LEAST_REACH * QUANTA_PER_VOXEL, centre, out[first : first + len(part)],
        )  # fmt: skip
    return out[: len(keys)]


@dataclass
class GridLevel:
    """List of the cells to solve at one resolution, with 2^`bits` cells per side of a block.

    `planes`: bit planes of the listed cells; `places`: their indices (`kernels/surface/field_smoothing.py`).
    """

    bits: int
    planes: NDArray[np.uint64]
    places: NDArray[np.int32]
    links: NDArray[np.int32]
    y: NDArray[np.float32]
    weight: NDArray[np.float32]
    x: NDArray[np.float32]

    @classmethod
    def make(cls, bits: int, planes: NDArray[np.uint64], counts: NDArray[np.int32]) -> "GridLevel":
        """Return a list without values for the cells marked in `planes`; `counts`: marks per 64-bit word."""
        places = np.append(0, np.cumsum(counts)).astype(np.int32)
        total = -(-int(places[-1]) // kernels.ABREAST) * kernels.ABREAST
        y, weight, x = (np.zeros(total + 1, np.float32) for _ in range(3))  # the last entry means "none"
        links = np.empty((6, total), np.int32)
        links[:, int(places[-1]) :] = total
        return cls(bits, planes, places[:-1].reshape(counts.shape), links, y, weight, x)

    def relax(
        self, smoothness: float, rounds: Sequence[Round], pause: Callable[[], None] = lambda: None
    ) -> None:
        """Run the solver's rounds of gradient descent; each computes weights ω from the last solution.

        `pause` is called after each launch.
        """
        total = len(self.x)
        omega, bent = np.zeros((3, total), np.float32), np.zeros((3, total), np.float32)
        inverse, step = np.empty(total, np.float32), np.zeros(total, np.float32)
        for edge, lowest, count in rounds:
            kernels.weigh(*self.links, self.x, 1 / edge, self.weight, smoothness, *omega, inverse, *bent)
            pause()
            steps = np.zeros((-(-count // kernels.AT_ONCE), kernels.AT_ONCE, 2), np.float32)
            steps.reshape(-1, 2)[:count] = list(chebyshev(lowest, count))
            for n, some in enumerate(steps):
                kernels.relax(
                    *self.links, self.y, self.weight, *omega, inverse, smoothness, some, int(n == 0),
                    *bent, step, self.x,
                )  # fmt: skip
                pause()


def _solve_batch(
    wanted: NDArray[np.int64],
    store: BlockStore,
    min_weight: float,
    settings: FieldSettings,
    solved: NDArray[np.float32],
) -> None:
    """Write to `solved` the smoothed values of the wanted blocks, solved together with their halo."""
    keys = around(wanted, store, settings.halo)
    is_all = np.array_equal(keys, wanted)
    values = values_of(keys, store, min_weight, solved if is_all else None)
    levels = _list(keys, values, store, settings)
    for depth in range(settings.coarser, -1, -1):
        level = levels[depth]
        if depth < settings.coarser:
            coarse = levels[depth + 1]
            kernels.refine(
                level.bits, coarse.links, coarse.planes, coarse.places, coarse.x,
                level.planes, level.places, level.x,
            )  # fmt: skip
        # Between cells of twice the size a bend is 4 times as large, and the cells are 8 times fewer
        level.relax(settings.smoothness / 2**depth, settings.rounds(depth), store.pause)
    kernels.write_values(levels[0].planes, levels[0].places, levels[0].x, values)
    if not is_all:
        rows = index_of(keys, wanted)
        solved[rows < 0] = np.nan
        solved[rows >= 0] = values[rows[rows >= 0]]


def _list(
    keys: NDArray[np.int64], values: NDArray[np.float32], store: BlockStore, settings: FieldSettings
) -> list[GridLevel]:
    sides = index_of(keys, keys[:, None] + SIDES)
    planes, counts = marks_of(len(keys), CUBE)
    kernels.mark_voxels(values, settings.reach * QUANTA_PER_VOXEL, planes, counts)
    fine = GridLevel.make(3, planes, counts)
    kernels.list_voxels(
        values, store.slots_of(keys), store.sums, sides,
        fine.planes, fine.places, fine.links, fine.y, fine.weight, fine.x,
    )  # fmt: skip
    store.keep_within_memory()
    levels = [fine]
    for _ in range(settings.coarser):
        planes, counts = marks_of(len(keys), 8 ** (fine.bits - 1))
        kernels.mark_parents(fine.bits, fine.planes, planes, counts)
        coarse = GridLevel.make(fine.bits - 1, planes, counts)
        kernels.list_parents(
            fine.bits, sides, fine.planes, fine.places, fine.links, fine.y, fine.weight,
            coarse.planes, coarse.places, coarse.links, coarse.y, coarse.weight, coarse.x,
        )  # fmt: skip
        levels.append(coarse)
        fine = coarse
    return levels


def marks_of(blocks: int, cells: int) -> tuple[NDArray[np.uint64], NDArray[np.int32]]:
    """Return zeroed arrays to mark cells of blocks, one bit each, and to count marks per 64-bit word."""
    shape = blocks, -(-cells // WORD)
    return np.empty(shape, np.uint64), np.empty(shape, np.int32)


def chebyshev(lowest: float, steps: int) -> Iterator[tuple[float, float]]:
    """Yield two factors for each Chebyshev iteration: share of the last step, and gain of the residual.
    Eigenvalues are in [`lowest`, 1]."""
    middle, half = (1 + lowest) / 2, (1 - lowest) / 2
    rho = half / middle
    yield 0.0, 1 / middle
    for _ in range(steps - 1):
        last, rho = rho, 1 / (2 * middle / half - rho)
        yield rho * last, 2 * rho / half


def around(keys: NDArray[np.int64], store: BlockStore, rings: int = 1) -> NDArray[np.int64]:
    """Return the sorted keys of the map's blocks within `rings` blocks of the blocks `keys`, with these."""
    for _ in range(rings):
        most = min(len(AROUND) * len(keys), store.count)
        table = np.zeros(1 << max(4, (2 * most).bit_length()), np.int64)
        found = np.empty(most, np.int64)
        count = surface_cells.collect_around(
            len(keys), np.sort(keys), store.hash_keys, store.hash_slots, table, found
        )
        keys = np.sort(found[:count])
    return keys


def index_of(keys: NDArray[np.int64], queries: NDArray[np.int64]) -> NDArray[np.int32]:
    """Return the index of each query in the sorted `keys`, −1 if absent."""
    if not len(keys):
        return np.full(queries.shape, -1, np.int32)
    at = np.minimum(np.searchsorted(keys, queries), len(keys) - 1)
    return np.where(keys[at] == queries, at, -1).astype(np.int32)


class SurfaceView(Protocol):
    """Function that reads signed distances of blocks from the map, such as `values_of`."""

    def __call__(
        self,
        keys: NDArray[np.int64],
        store: BlockStore,
        min_weight: float,
        out: NDArray[np.float32] | None = None,
    ) -> NDArray[np.float32]:
        """Return (n, 512) values of blocks in quanta (1/60 voxel), NaN where unseen: below `min_weight`.

        Args:
            keys: sorted packed keys; a block that the map does not hold is unseen.
            out: rows to write to, at least n.
        """


def values_of(
    keys: NDArray[np.int64], store: BlockStore, min_weight: float, out: NDArray[np.float32] | None = None
) -> NDArray[np.float32]:
    """Return signed distances as they were fused: the `SurfaceView` of the surface `raw`."""
    if out is None:
        out = np.empty((len(keys), CUBE), np.float32)
    least = max(1, int(np.ceil(min_weight * WEIGHT_ONE)))
    for first in range(0, len(keys), _PART):
        part = keys[first : first + _PART]
        surface_cells.read_values(
            len(part), part, store.hash_keys, store.hash_slots, store.sums, store.correction,
            int(store.corrected), least, out[first : first + len(part)],
        )  # fmt: skip
        store.rest()
    return out[: len(keys)]
