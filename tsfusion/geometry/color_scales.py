# SPDX-License-Identifier: MIT
"""Choose colours for numbers and names, also for colour-blind people, and round ends for scales."""

import colorsys
import math
from functools import cache

import numpy as np
from numpy.typing import NDArray

# Okabe and Ito's, without black: RGB
_PALETTE = (0x0072B2, 0xE69F00, 0x009E73, 0xCC79A7, 0x56B4E9, 0xD55E00, 0xF0E442)
_GOLDEN = 0.618034  # of a turn of hue between further colours
_STEPS = (1, 2, 3, 4, 5, 8, 10)


@cache
def ramp() -> NDArray[np.uint8]:
    """Return (256, 3) uint8 RGB of the colour map viridis: dark is low, bright is high."""
    import cv2

    bgr = cv2.applyColorMap(np.arange(256, dtype=np.uint8).reshape(-1, 1), cv2.COLORMAP_VIRIDIS)
    return np.ascontiguousarray(bgr.reshape(-1, 3)[:, ::-1])


def of_number(index: int) -> tuple[int, int, int]:
    """Return the RGB colour for the item of this index."""
    if index < len(_PALETTE):
        packed = _PALETTE[index]
        return packed >> 16, packed >> 8 & 255, packed & 255
    red, green, blue = colorsys.hsv_to_rgb(index * _GOLDEN % 1, 0.65, 0.9)
    return round(255 * red), round(255 * green), round(255 * blue)


def as_hex(rgb: tuple[int, int, int]) -> str:
    """Return a colour as #rrggbb."""
    return "#{:02x}{:02x}{:02x}".format(*rgb)


def rounded_up(most: float) -> float:
    """Return the next number that is 1, 2, 3, 4, 5 or 8 times a power of ten, at least 0.001."""
    most = max(most, 1e-3)
    power = 10.0 ** math.floor(math.log10(most))
    return next(step for step in _STEPS if step * power >= most) * power
