# SPDX-License-Identifier: MIT
"""What a surface is made from: the map's layers, and the values read from them."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tsfusion.kernels import voxel_values
from tsfusion.kernels.integrate import CUBE
from tsfusion.kernels.sensor_noise import WEIGHT_ONE

_NO_LAYER = np.zeros((1, CUBE), np.float32)


@dataclass(frozen=True)
class Layers:
    """What a mesh is read from: the map's arrays (slot, 512) and its hash of `count` blocks."""

    sums: NDArray[np.int64]
    color_rgn: NDArray[np.int64] | None
    color_b: NDArray[np.int32]
    correction: NDArray[np.float32] | None
    hash_keys: NDArray[np.int64]
    hash_slots: NDArray[np.int32]
    count: int
    voxel_size: float


class SurfaceView(Protocol):
    """Reads values from the map: `values_of`, or one of `field` with its settings."""

    def __call__(
        self,
        keys: NDArray[np.int64],
        layers: Layers,
        min_weight: float,
        out: NDArray[np.float32] | None = None,
    ) -> NDArray[np.float32]:
        """(n, 512) values of blocks in quanta, NaN where unseen: below `min_weight` full samples.

        Args:
            keys: sorted packed keys; a block that the map does not hold is unseen.
            out: rows to write to, at least n.
        """


def values_of(
    keys: NDArray[np.int64], layers: Layers, min_weight: float, out: NDArray[np.float32] | None = None
) -> NDArray[np.float32]:
    """The `SurfaceView` of what was fused, as it is."""
    if out is None:
        out = np.empty((len(keys), CUBE), np.float32)
    correction = layers.correction
    voxel_values.read_values(
        len(keys), keys, layers.hash_keys, layers.hash_slots, layers.sums,
        _NO_LAYER if correction is None else correction, int(correction is not None),
        max(1, int(np.ceil(min_weight * WEIGHT_ONE))), out,
    )  # fmt: skip
    return out[: len(keys)]
