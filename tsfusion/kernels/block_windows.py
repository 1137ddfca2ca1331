# SPDX-License-Identifier: MIT
"""Windows of 8³ blocks that a ray walks through: where it is in one, and where its blocks lie in the layers.

A ray crosses about ten voxels and two or three blocks. To look a block up wherever a ray enters one would
cost more than the voxels: a jump that no processor predicts, and the hash. In a window, each voxel reads the
place of its block from a small table.
"""

import taichi as ti

from tsfusion.kernels.voxel_traversal import pack

WINDOWS = 64  # that a unit keeps: those it used last, one for each place that the low bits of the key name
WINDOW_BLOCKS = 512
WINDOW_BITS = 6  # of a voxel's coordinate in its window
MOST_IN_WINDOW = 3 << WINDOW_BITS  # voxels of a ray
WINDOW_SCRATCH = WINDOWS * (1 + WINDOW_BLOCKS)  # int64 of a unit: keys, places of blocks in the layers
UNKNOWN = 8 - (1 << 31)  # instead of a place

# Where a ray is in its window, one int64: x, y and z in the low half, ten bits each, of which bit 6 is set
# once a step has left the window; in the upper half the distance to the surface, 2⁻¹⁶ quantum.
STEPS = (1 << 20, 1 << 10, 1)  # what a step towards +x, +y, +z adds
LEFT_WINDOW = (1 << 26) + (1 << 16) + (1 << 6)
LOW_BITS = 7 * (STEPS[0] + STEPS[1] + STEPS[2])


@ti.func
def gather_bits(spread):
    """64 x + 8 y + z of the low three bits of three fields of ten."""
    # the products that meet in these nine bits are x, 2⁷ y and 2¹⁴ z
    return (((spread & LOW_BITS) * ((1 << 14) + (1 << 7) + 1)) >> 14) & (WINDOW_BLOCKS - 1)


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
