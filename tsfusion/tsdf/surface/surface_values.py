# SPDX-License-Identifier: MIT
"""Signed distances read from the map's sums: what a surface is made from."""

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tsfusion.kernels.base.sensor_noise import WEIGHT_ONE
from tsfusion.kernels.integration.integrate import CUBE
from tsfusion.kernels.surface import voxel_values
from tsfusion.tsdf.store.block_store import BlockStore

_PART = 1 << 14  # blocks read at a time: they may have to come from a file


class SurfaceView(Protocol):
    """Function that reads signed distances from the map: `values_of`, or one of `field_regularizer`."""

    def __call__(
        self,
        keys: NDArray[np.int64],
        store: BlockStore,
        min_weight: float,
        out: NDArray[np.float32] | None = None,
    ) -> NDArray[np.float32]:
        """(n, 512) values of blocks in quanta, NaN where unseen: below `min_weight` full samples.

        Args:
            keys: sorted packed keys; a block that the map does not hold is unseen.
            out: rows to write to, at least n.
        """


def values_of(
    keys: NDArray[np.int64], store: BlockStore, min_weight: float, out: NDArray[np.float32] | None = None
) -> NDArray[np.float32]:
    """Signed distances as they were fused: the `SurfaceView` of the surface `raw`."""
    if out is None:
        out = np.empty((len(keys), CUBE), np.float32)
    least = max(1, int(np.ceil(min_weight * WEIGHT_ONE)))
    for first in range(0, len(keys), _PART):
        part = keys[first : first + _PART]
        voxel_values.read_values(
            len(part), part, store.hash_keys, store.hash_slots, store.sums, store.correction,
            int(store.corrected), least, out[first : first + len(part)],
        )  # fmt: skip
        store.rest()
    return out[: len(keys)]
