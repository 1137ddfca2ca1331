# SPDX-License-Identifier: MIT
"""Depth in a unit that no camera can mean: metres read as millimetres, millimetres read as metres."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tsfusion.evaluation.depth_views import DepthView
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.sample_ranges import FARTHEST_M, NEAREST_M

FARTHEST_OTHERS_M = 1000.0  # median range of stereo and LiDAR above which none measures
FEW_LEVELS = 24  # different values of an image that holds whole metres
MIN_SHARE = 0.8  # of the frames


@dataclass(frozen=True)
class DepthUnit:
    """Evidence in one frame's depth for its unit.

    Attributes:
        typical_m: median depth, of a scan median range; 0 = nothing measured.
        farthest_m: median beyond which it cannot be.
        nearest_m: median below which it cannot be.
        levels: number of different values of an integer image; 0 for others.
        integer: whether depth is in integers of some unit.
        scale: metres an integer.
    """

    typical_m: float
    farthest_m: float = FARTHEST_OTHERS_M
    nearest_m: float = 0.0
    levels: int = 0
    integer: bool = False
    scale: float = 1.0


def depth_unit(frame: Frame, view: DepthView | None) -> DepthUnit:
    """Evidence for its unit in a frame's depth, of which `view` is made."""
    if frame.depth is None:
        return DepthUnit(0.0 if view is None else view.range_m)
    depth = frame.depth[::4, ::4]
    measured = depth[np.isfinite(depth) & (depth > 0)]
    integer = frame.depth.dtype == np.uint16
    scale = frame.depth_scale if integer else 1.0
    return DepthUnit(
        float(np.median(measured)) * scale if len(measured) else 0.0,
        FARTHEST_M,
        0.0 if frame.sensor == "scanner" else NEAREST_M,
        len(np.unique(measured)) if integer else 0,
        integer,
        scale,
    )


def unusable_depth(frames: Sequence[DepthUnit]) -> str | None:
    """One sentence on depth in an impossible unit; None where it is possible."""
    seen = [each for each in frames if each.typical_m > 0]
    near = [each for each in seen if each.typical_m < each.nearest_m]
    far = [each for each in seen if each.typical_m > each.farthest_m]
    if near and len(near) >= MIN_SHARE * len(seen):
        return _near_text(near[0])
    if far and len(far) >= MIN_SHARE * len(seen):
        return _far_text(far[0])
    return None


def _near_text(unit: DepthUnit) -> str:
    found = f"depth is unusable: it reads as {1000 * unit.typical_m:.2g} mm on average"
    if 0 < unit.levels <= FEW_LEVELS:
        return (
            f"{found}, in {unit.levels} different values: the images hold whole metres; write depth as "
            "16-bit integers of millimetres, or as float metres"
        )
    if unit.integer:
        return f"{found}: its unit is not {unit.scale:.4g} m; check the depth scale (--option depth_scale=…)"
    return f"{found}: floats are expected in metres; multiply them (by 1000 if they are in kilometres)"


def _far_text(unit: DepthUnit) -> str:
    found = f"depth is unusable: it reads as {unit.typical_m:.3g} m on average"
    if unit.farthest_m != FARTHEST_M:
        return f"{found}: millimetres were taken for metres (of the points, or the baseline): divide by 1000"
    if unit.integer:
        return f"{found}: its unit is not {unit.scale:.4g} m; for millimetres, --option depth_scale=0.001"
    return f"{found}: floats are expected in metres, these are millimetres: divide them by 1000"
