# SPDX-License-Identifier: MIT
"""The map's sums as values: what a surface is made from."""

import taichi as ti

from tsfusion.kernels.blocks import map_find
from tsfusion.kernels.integrate import CUBE, lane_distance, lane_weight
from tsfusion.kernels.traversal import RUN

BANDS = 64  # units of parallel work; fixed, so that nothing depends on the thread count


@ti.kernel
def read_values(
    count: ti.i32,
    keys: ti.types.ndarray(dtype=ti.i64, ndim=1),
    map_keys: ti.types.ndarray(dtype=ti.i64, ndim=1),
    map_slots: ti.types.ndarray(dtype=ti.i32, ndim=1),
    sums: ti.types.ndarray(dtype=ti.i64, ndim=2),
    regularised: ti.types.ndarray(dtype=ti.f32, ndim=2),
    use_regularised: ti.i32,
    min_weight: ti.i32,
    values: ti.types.ndarray(dtype=ti.f32, ndim=2),
):
    """Row r of `values`: smoothed or raw values of block `keys[r]` in quanta; NaN below `min_weight`."""
    mask = map_keys.shape[0] - 1
    for run in range(BANDS * RUN):
        if run % RUN == 0:
            band = run // RUN
            for r in range(count * band // BANDS, count * (band + 1) // BANDS):
                slot = map_find(map_keys, map_slots, mask, keys[r])
                # the inner loops have no branches: LLVM makes vectors of them
                if slot < 0:
                    for o in range(CUBE):
                        values[r, o] = ti.math.nan
                elif use_regularised == 1:
                    for o in range(CUBE):
                        w = lane_weight(sums[slot, o])
                        values[r, o] = ti.select(w >= min_weight, regularised[slot, o], ti.math.nan)
                else:
                    for o in range(CUBE):
                        packed = sums[slot, o]
                        w = lane_weight(packed)
                        value = ti.cast(lane_distance(packed), ti.f32) / ti.cast(w, ti.f32)
                        values[r, o] = ti.select(w >= min_weight, value, ti.math.nan)
