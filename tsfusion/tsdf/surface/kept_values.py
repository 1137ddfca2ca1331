# SPDX-License-Identifier: MIT
"""A surface's values, kept block by block while the map grows: for who meshes again what has changed."""

import numpy as np
from numpy.typing import NDArray

from tsfusion.kernels.integration.integrate import CUBE
from tsfusion.tsdf.store.block_store import BlockStore
from tsfusion.tsdf.store.growing_array import GrowingArray
from tsfusion.tsdf.surface.surface_values import SurfaceView

MOST_BLOCKS = 1 << 14  # 32 MB


class KeptValues:
    """A `SurfaceView` that solves a block once, until it is told that its values are others.

    A block beside a changed one keeps what it had where that is to a hundredth of a voxel what it would be
    now: `ReadableMap.cells_to_mesh` names the others.

    Args:
        view: reads the surface.
    """

    def __init__(self, store: BlockStore, view: SurfaceView) -> None:
        self._store, self._view = store, view
        self._values = GrowingArray((CUBE,), np.float32, 0)
        self.clear()

    def clear(self) -> None:
        """Forget every block."""
        self._drops = self._store.drops
        self._rows = np.zeros(0, np.int32)  # of each slot of the map
        self._free = np.arange(MOST_BLOCKS, dtype=np.int32)[::-1]
        self._values = GrowingArray((CUBE,), np.float32, 0)

    def forget(self, keys: NDArray[np.int64]) -> None:
        """Solve these blocks anew when they are asked for."""
        if self._drops != self._store.drops:  # blocks have other slots now
            self.clear()
        slots = self._store.slots_of(keys)
        slots = slots[(slots >= 0) & (slots < len(self._rows))]
        rows = self._rows[slots]
        self._rows[slots] = -1
        self._free = np.concatenate([self._free, rows[rows >= 0]])

    def __call__(
        self,
        keys: NDArray[np.int64],
        store: BlockStore,
        min_weight: float,
        out: NDArray[np.float32] | None = None,
    ) -> NDArray[np.float32]:
        """See `SurfaceView`; `store` is the map that this follows."""
        out = np.empty((len(keys), CUBE), np.float32) if out is None else out[: len(keys)]
        self.forget(keys[:0])
        slots = store.slots_of(keys)
        more = store.count - len(self._rows)
        self._rows = np.concatenate([self._rows, np.full(max(more, 0), -1, np.int32)])
        rows = np.where(slots >= 0, self._rows[slots], -1)
        lacking = rows < 0
        if not lacking.all():
            np.take(self._values.array, rows, axis=0, out=out, mode="clip")
        if lacking.any():
            solved = self._view(keys[lacking], store, min_weight)
            out[lacking] = solved
            self._keep(slots[lacking], solved)
        return out

    def _keep(self, slots: NDArray[np.int32], solved: NDArray[np.float32]) -> None:
        """Note what blocks have; when there is no room left, these are the first of a new start."""
        count = len(slots)
        if (slots < 0).any() or count > MOST_BLOCKS:
            return
        if count > len(self._free):
            known = len(self._rows)
            self.clear()
            self._rows = np.full(known, -1, np.int32)
        self._free, taken = self._free[: len(self._free) - count], self._free[len(self._free) - count :]
        self._values.reserve(int(taken.max(initial=-1)) + 1)
        self._values.array[taken] = solved
        self._rows[slots] = taken
