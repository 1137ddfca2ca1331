# SPDX-License-Identifier: MIT
"""Compute a slice of the map: a grid of cells, each a column of samples between two heights."""

import taichi as ti

from tsfusion.kernels import F32, I32, I64, U8, F32x2, I32x2, I64x2
from tsfusion.kernels.base.block_hash import map_find
from tsfusion.kernels.base.quick_launch import runs, unit_of
from tsfusion.kernels.base.voxel_traversal import VOXEL_LIMIT, block_key, offset_in_block, vec3i
from tsfusion.kernels.integration.integrate import QUANTA_PER_VOXEL, lane_weight
from tsfusion.kernels.surface.surface_cells import BANDS, distance_as_float, held, is_clear

vec3d = ti.types.vector(3, ti.f64)


@ti.kernel
def read_columns(
    cells: I32, width: ti.i32, row: ti.i32, column: ti.i32, across: ti.i32, heights: ti.i32, corner: vec3d,
    along_row: vec3d, along_column: vec3d, along_height: vec3d, map_keys: I64, map_slots: I32, sums: I64x2,
    correction: F32x2, corrected: ti.i32, color_rgn: I64x2, hits: I32x2, layers: ti.i32, shows_surface: U8,
    clear_keys: I64, clear_slots: I32, clear_counts: I32, min_weight: ti.i32, values: F32, seen: I32,
):  # fmt: skip
    """Write `values`: the smallest signed distance (`held`), in voxels, among a cell's seen samples, NaN
    without any. Write `seen`: the number of samples that were seen, or lie in a wholly free block. Cell n of
    `cells` is (`row` + n // `width`, `column` + n % `width`). It has `across`² columns of `heights` samples,
    `along_row`, `along_column`, `along_height` apart, in voxels, from `corner` on."""
    mask = map_keys.shape[0] - 1
    for run in range(runs(BANDS)):  # run loop: kernels/base/quick_launch.py
        band = unit_of(run, BANDS)
        if band < BANDS:
            count = cells.shape[0]
            last, slot, clear = vec3i(2147483647), -1, 0
            for n in range(count * band // BANDS, count * (band + 1) // BANDS):
                cell = cells[n]
                first_row = (row + cell // width) * across
                first_column = (column + cell % width) * across
                least, number = ti.math.nan, 0
                for line in range(across * across):
                    r, c = first_row + line // across, first_column + line % across
                    foot = corner + along_row * ti.cast(r, ti.f64) + along_column * ti.cast(c, ti.f64)
                    for h in range(heights):
                        place = foot + along_height * ti.cast(h, ti.f64)
                        if ti.max(ti.abs(place[0]), ti.abs(place[1]), ti.abs(place[2])) < VOXEL_LIMIT - 1:
                            voxel = ti.floor(place, ti.i32)
                            block = voxel >> 3
                            if block[0] != last[0] or block[1] != last[1] or block[2] != last[2]:
                                last = block
                                key = block_key(voxel)
                                slot = map_find(map_keys, map_slots, mask, key)
                                clear = is_clear(
                                    key, slot, shows_surface, clear_keys, clear_slots, clear_counts
                                )
                            is_seen = 0
                            if slot >= 0:
                                o = offset_in_block(voxel)
                                packed = sums[slot, o]
                                w = lane_weight(packed)
                                if w >= min_weight:
                                    distance = distance_as_float(packed)
                                    if corrected == 1:
                                        distance += correction[slot, o]
                                    value = distance / ti.cast(w, ti.f32) / QUANTA_PER_VOXEL
                                    value = held(value, slot, o, color_rgn, hits, layers)
                                    is_seen = 1
                                    if not value >= least:  # also true for NaN: no earlier seen sample
                                        least = value
                            number += is_seen | clear
                values[cell], seen[cell] = least, number
