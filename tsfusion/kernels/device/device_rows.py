# SPDX-License-Identifier: MIT
"""Copy and measure a map's rows, lists and hash on a device. Arrays are in device memory (`ti.ndarray`), or
NumPy arrays of the host."""

import taichi as ti

from tsfusion.kernels import ANY, I32, I64, ANYx2, I64x2
from tsfusion.kernels.base.quick_launch import QuickLaunch
from tsfusion.kernels.integration.integrate import CUBE, lane_weight
from tsfusion.kernels.integration.space_carving import BITS


@QuickLaunch
@ti.kernel
def write_hash(places: I32, keys: I64, slots: I32, hash_keys: I64, hash_slots: I32):
    """Write keys and slots to indices of the hash from block to slot."""
    for i in range(places.shape[0]):
        hash_keys[places[i]] = keys[i]
        hash_slots[places[i]] = slots[i]


@QuickLaunch
@ti.kernel
def largest_weights(sums: I64x2, slots: I32, count: ti.i32, found: I32):
    """Write the largest weight in block `slots[i]` to `found[i]`, for the first `count` slots."""
    for i in range(count):
        most = 0
        for v in range(CUBE):
            most = ti.max(most, lane_weight(sums[slots[i], v]))
        found[i] = most


@QuickLaunch
@ti.kernel
def add_free_blocks(slots: I32, amounts: I64, masks: I64x2, sign_: ti.i32, sums: I64x2):
    """Add to the clear voxels of blocks, as `space_carving.add_free_blocks`."""
    for i in range(slots.shape[0] * CUBE):
        n, v = i // CUBE, i % CUBE
        if (masks[n, v // BITS] >> (v % BITS)) & 1 == 1:
            sums[slots[n], v] += sign_ * amounts[n]


@ti.kernel
def read_rows(layer: ANYx2, slots: I32, rows: ANYx2):
    """Copy row `slots[i]` of a layer to `rows[i]`."""
    for i in range(slots.shape[0] * CUBE):
        rows[i // CUBE, i % CUBE] = layer[slots[i // CUBE], i % CUBE]


@ti.kernel
def write_rows(layer: ANYx2, slots: I32, rows: ANYx2):
    """Copy `rows[i]` to row `slots[i]` of a layer."""
    for i in range(slots.shape[0] * CUBE):
        layer[slots[i // CUBE], i % CUBE] = rows[i // CUBE, i % CUBE]


@ti.kernel
def move_rows(layer: ANYx2, count: ti.i32, larger: ANYx2):
    """Copy the first `count` rows of a layer into a larger layer."""
    for i in range(count * CUBE):
        larger[i // CUBE, i % CUBE] = layer[i // CUBE, i % CUBE]


@ti.kernel
def move_list(listed: ANY, larger: ANY):
    """Copy a list into a larger list."""
    for i in range(listed.shape[0]):
        larger[i] = listed[i]
