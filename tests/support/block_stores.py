# SPDX-License-Identifier: MIT
"""Maps made from arrays, without keyframes."""

import numpy as np
from numpy.typing import NDArray

from tsfusion.kernels.base import runtime
from tsfusion.tsdf.store.block_store import BlockStore


def store_of(
    keys: NDArray[np.int64],
    sums: NDArray[np.int64],
    *,
    correction: NDArray[np.float32] | None = None,
    color_rgn: NDArray[np.int64] | None = None,
    color_b: NDArray[np.int64] | None = None,
) -> BlockStore:
    """A map with voxels of 1 m whose block `keys[i]` has slot i and row i of every layer."""
    runtime.start(2)
    store = BlockStore(voxel_size=1.0, color=color_rgn is not None, corrected=correction is not None)
    store.insert(keys)
    layers = {"sums": sums, "correction": correction, "color_rgn": color_rgn, "color_b": color_b}
    for name, array in store.layers().items():
        array[: len(keys)] = layers[name]
    return store
