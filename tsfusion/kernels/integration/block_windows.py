# SPDX-License-Identifier: MIT
"""Windows of 8³ blocks that a ray walks through: where it is in one, and where its blocks lie in the layers.

A ray crosses about ten voxels and two or three blocks. To look a block up wherever a ray enters one would
cost more than the voxels: a jump that no processor predicts, and the hash. In a window, each voxel reads the
place of its block from a small table.
"""

import taichi as ti

from tsfusion.kernels.base.voxel_traversal import pack

WINDOWS = 64  # that a unit keeps: those it used last, one for each place that the low bits of the key name
WINDOW_BLOCKS = 512
WINDOW_BITS = 6  # of a voxel's coordinate in its window
WINDOW_SCRATCH = WINDOWS * (1 + WINDOW_BLOCKS)  # int64 of a unit: keys, places of blocks in the layers
UNKNOWN = 8 - (1 << 31)  # instead of a place


@ti.func
def open_window(window, scratch: ti.template(), base):
    """Where the places of a window's blocks are in the unit's scratch, which begins at `base`.

    They are unknown if it did not have this window.
    """
    number = (window[0] & 3) << 4 | (window[1] & 3) << 2 | (window[2] & 3)
    blocks = base + WINDOWS + number * WINDOW_BLOCKS
    key = pack(window[0], window[1], window[2])
    if scratch[base + number] != key:
        scratch[base + number] = key
        for i in range(blocks, blocks + WINDOW_BLOCKS):
            scratch[i] = UNKNOWN
    return blocks
