# SPDX-License-Identifier: MIT
"""A map's blocks as arrays of NumPy and of Open3D."""

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry.map_answers import import_open3d
from tsfusion.tsdf.files import voxel_arrays
from tsfusion.tsdf.store.block_store import BlockStore, unpack_keys

SIDE = 8  # voxels
OPEN3D_TRUNCATION = 8.0  # voxels that stand for 1 in Open3D: its `trunc_voxel_multiplier`


class Blocks:
    """The n blocks that a map has now, of 8³ voxels each: [block, x, y, z].

    The centre of voxel (i, j, k) of block b is at (8 · coordinates[b] + (i, j, k) + 0.5) · voxel_size.
    What is stored is shown without copying, read-only: (n, 8, 8, 8) arrays that stay valid whatever the map
    does next. They show what keyframes change in these blocks until the map's memory grows.

    Args:
        store: the blocks of a map; `Volume.blocks()` gives them.

    Attributes:
        coordinates: (n, 3) int32, in units of 8 voxels.
        voxel_size: metres.
        sums: int64, (Σ w·m) · 2²⁷ + Σ w: m in sixtieths of a voxel, w in sixteenths of a full sample.
        color_rgn: int64, (Σ R) · 2⁴⁰ + (Σ G) · 2¹⁶ + n of n votes; None if the map holds no colour.
        color_b: int32, Σ B.
        correction: float32, what smoothing along rays adds to Σ w·m; None if the map does not smooth so.

    Examples:
        >>> volume = tsfusion.Volume(0.05)
        >>> added = volume.integrate(tsfusion.open_dataset("synthetic:room", count=1)[0])
        >>> blocks = volume.blocks()
        >>> blocks.sums.shape == blocks.distance().shape == (len(blocks), 8, 8, 8)
        True
    """

    def __init__(self, store: BlockStore) -> None:
        self._store, self._keys = store, store.keys.copy()
        self.voxel_size = store.voxel_size
        self.sums, self.color_rgn, self.color_b, self.correction = (
            None if (rows := store.shown(name)) is None else rows.reshape(-1, SIDE, SIDE, SIDE)
            for name in ("sums", "color_rgn", "color_b", "correction")
        )

    def __len__(self) -> int:
        return len(self._keys)

    @cached_property
    def coordinates(self) -> NDArray[np.int32]:
        return unpack_keys(self._keys)

    def distance(self) -> NDArray[np.float32]:
        """(n, 8, 8, 8) signed distances along the rays, metres, NaN where unseen: a copy, of now."""
        found: NDArray[np.float32] = self._decoded("tsdf")
        return found

    def weight(self) -> NDArray[np.float32]:
        """(n, 8, 8, 8) votes in full-confidence samples: a copy, of now."""
        found: NDArray[np.float32] = self._decoded("weight")
        return found

    def color(self) -> NDArray[np.uint8] | None:
        """(n, 8, 8, 8, 3) RGB, 0 where none was seen: a copy, of now; None if the map holds none."""
        return self._decoded("color") if self._store.color else None

    def _decoded(self, name: str) -> Any:
        slots = self._store.slots_of(self._keys).astype(np.int64)
        return voxel_arrays.decoded(self._store, slots, name)


def to_voxel_block_grid(store: BlockStore) -> Any:
    """Make an `open3d.t.geometry.VoxelBlockGrid` of the raw values.

    Raises:
        MissingDependency: without Open3D.
    """
    o3d = import_open3d()
    used = store.used()
    names = ["tsdf", "weight", *(["color"] if store.color else [])]
    grid = o3d.t.geometry.VoxelBlockGrid(
        names, [o3d.core.float32] * len(names), [(1,), (1,), (3,)][: len(names)], store.voxel_size, SIDE,
        max(len(used), 1),
    )  # fmt: skip
    if not len(used):
        return grid
    rows, _ = grid.hashmap().activate(o3d.core.Tensor(unpack_keys(store.keys[used])))
    rows = rows.numpy()
    for name in names:
        values = (
            voxel_arrays.decoded(store, used, name)
            .astype(np.float32)
            .reshape(len(used), SIDE, SIDE, SIDE, -1)
        )
        if name == "tsdf":
            values = np.nan_to_num(values / (OPEN3D_TRUNCATION * store.voxel_size), nan=1.0).clip(-1, 1)
        grid.attribute(name).numpy()[rows] = values.transpose(0, 3, 2, 1, 4)  # x runs fastest there
    return grid
