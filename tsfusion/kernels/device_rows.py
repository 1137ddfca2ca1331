# SPDX-License-Identifier: MIT
"""Copies of a map's rows, lists and hash on a device, and what its rows hold. Arrays are a device's
(`ti.ndarray`), or the host's that are handed in."""

import taichi as ti

from tsfusion.kernels.integrate import CUBE, lane_weight
from tsfusion.kernels.quick_launch import QuickLaunch
from tsfusion.kernels.space_carving import BITS


@QuickLaunch
@ti.kernel
def write_hash(
    places: ti.types.ndarray(dtype=ti.i32, ndim=1),
    keys: ti.types.ndarray(dtype=ti.i64, ndim=1),
    slots: ti.types.ndarray(dtype=ti.i32, ndim=1),
    hash_keys: ti.types.ndarray(dtype=ti.i64, ndim=1),
    hash_slots: ti.types.ndarray(dtype=ti.i32, ndim=1),
):
    """Write keys and slots to places of the hash from block to slot."""
    for i in range(places.shape[0]):
        hash_keys[places[i]] = keys[i]
        hash_slots[places[i]] = slots[i]


@QuickLaunch
@ti.kernel
def largest_weights(
    sums: ti.types.ndarray(dtype=ti.i64, ndim=2),
    slots: ti.types.ndarray(dtype=ti.i32, ndim=1),
    count: ti.i32,
    found: ti.types.ndarray(dtype=ti.i32, ndim=1),
):
    """`found[i]` = the largest weight lane in block `slots[i]`, of the first `count`."""
    for i in range(count):
        most = 0
        for v in range(CUBE):
            most = ti.max(most, lane_weight(sums[slots[i], v]))
        found[i] = most


@QuickLaunch
@ti.kernel
def add_free_blocks(
    slots: ti.types.ndarray(dtype=ti.i32, ndim=1),
    amounts: ti.types.ndarray(dtype=ti.i64, ndim=1),
    masks: ti.types.ndarray(dtype=ti.i64, ndim=2),
    sign_: ti.i32,
    sums: ti.types.ndarray(dtype=ti.i64, ndim=2),
):
    """Add to the clear voxels of blocks, as `space_carving.add_free_blocks`."""
    for i in range(slots.shape[0] * CUBE):
        n, v = i // CUBE, i % CUBE
        if (masks[n, v // BITS] >> (v % BITS)) & 1 == 1:
            sums[slots[n], v] += sign_ * amounts[n]


@ti.kernel
def read_rows(
    layer: ti.types.ndarray(ndim=2),
    slots: ti.types.ndarray(dtype=ti.i32, ndim=1),
    rows: ti.types.ndarray(ndim=2),
):
    """`rows[i]` = row `slots[i]` of a layer."""
    for i in range(slots.shape[0] * CUBE):
        rows[i // CUBE, i % CUBE] = layer[slots[i // CUBE], i % CUBE]


@ti.kernel
def write_rows(
    layer: ti.types.ndarray(ndim=2),
    slots: ti.types.ndarray(dtype=ti.i32, ndim=1),
    rows: ti.types.ndarray(ndim=2),
):
    """Row `slots[i]` of a layer = `rows[i]`."""
    for i in range(slots.shape[0] * CUBE):
        layer[slots[i // CUBE], i % CUBE] = rows[i // CUBE, i % CUBE]


@ti.kernel
def move_rows(layer: ti.types.ndarray(ndim=2), count: ti.i32, larger: ti.types.ndarray(ndim=2)):
    """Copy the first `count` rows of a layer into a larger one."""
    for i in range(count * CUBE):
        larger[i // CUBE, i % CUBE] = layer[i // CUBE, i % CUBE]


@ti.kernel
def move_list(listed: ti.types.ndarray(ndim=1), larger: ti.types.ndarray(ndim=1)):
    """Copy a list into a larger one."""
    for i in range(listed.shape[0]):
        larger[i] = listed[i]
