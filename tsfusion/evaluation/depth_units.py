# SPDX-License-Identifier: MIT
"""Depth in a unit that no camera can mean: metres read as millimetres, millimetres read as metres."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tsfusion.datasets.cameras import DepthUnit
from tsfusion.evaluation.depth_views import DepthView
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.sample_ranges import FARTHEST_M, NEAREST_M
from tsfusion.geometry.stereo_matching import EXCHANGED, exchanged

FARTHEST_OTHERS_M = 1000.0  # median range of stereo and LiDAR above which none measures
FEW_LEVELS = 24  # different values of an image that holds whole metres
MIN_SHARE = 0.8  # of the frames
# What an indoor camera sees, metres: of a room something is farther, and most is nearer.
ROOM_M, INDOOR_M = 1.0, 6.0
COARSE_UNIT_M = 5e-4  # finer units may be millimetres, coarser ones may be finer in truth


@dataclass(frozen=True)
class UnitEvidence:
    """Evidence in one frame's depth for its unit.

    Attributes:
        typical_m: median depth, of a scan median range; 0 = nothing measured.
        farthest_m: median beyond which it cannot be.
        nearest_m: median below which it cannot be.
        levels: number of different values of an integer image; 0 for others.
        integer: whether depth is in integers of some unit.
        scale: metres an integer.
        far_m: metres within which nearly all integer depth of an indoor camera lies; 0 for others.
        exchanged: whether a stereo pair's images are each other's.
    """

    typical_m: float
    farthest_m: float = FARTHEST_OTHERS_M
    nearest_m: float = 0.0
    levels: int = 0
    integer: bool = False
    scale: float = 1.0
    far_m: float = 0.0
    exchanged: bool = False


def unit_evidence(frame: Frame, view: DepthView | None) -> UnitEvidence:
    """Evidence for its unit in a frame's depth, of which `view` is made."""
    if frame.left is not None and frame.right is not None and exchanged(frame.left, frame.right):
        return UnitEvidence(1.0, exchanged=True)
    if frame.depth is None:
        return UnitEvidence(0.0 if view is None else view.range_m)
    depth = frame.depth[::4, ::4]
    measured = depth[np.isfinite(depth) & (depth > 0)]
    integer = frame.depth.dtype == np.uint16
    scale, is_indoor = frame.depth_scale if integer else 1.0, frame.sensor in ("kinect", "tof")
    return UnitEvidence(
        float(np.median(measured)) * scale if len(measured) else 0.0,
        FARTHEST_M,
        0.0 if frame.sensor == "scanner" else NEAREST_M,
        len(np.unique(measured)) if integer else 0,
        integer,
        scale,
        float(np.percentile(measured, 95)) * scale if integer and len(measured) and is_indoor else 0.0,
    )


def unusable_depth(frames: Sequence[UnitEvidence]) -> str | None:
    """One sentence on depth in an impossible unit; None where it is possible."""
    seen = [each for each in frames if each.typical_m > 0]
    near = [each for each in seen if each.typical_m < each.nearest_m]
    far = [each for each in seen if each.typical_m > each.farthest_m]
    if seen and sum(each.exchanged for each in seen) >= MIN_SHARE * len(seen):
        return f"depth is unusable: {EXCHANGED}"
    if near and len(near) >= MIN_SHARE * len(seen):
        return _near_text(near[0])
    if far and len(far) >= MIN_SHARE * len(seen):
        return _far_text(far[0])
    return None


def doubtful_depth(frames: Sequence[UnitEvidence], unit: DepthUnit | None) -> str | None:
    """One sentence on a unit of depth that nobody stated and rooms or sensors contradict; None where it fits.

    Args:
        unit: that of the recording; None = it has none of its own.
    """
    seen = [each for each in frames if each.far_m > 0]
    if unit is None or unit.is_stated or not seen:
        return None
    far = float(np.median([each.far_m for each in seen]))
    typical = float(np.median([each.typical_m for each in seen]))
    fine = unit.metres < COARSE_UNIT_M
    if far > ROOM_M if fine else typical < INDOOR_M:
        return None
    found = f"all depth is within {far:.2g} m" if fine else f"depth is {typical:.2g} m on average"
    other = "0.001 for millimetres" if fine else "0.0002 for 5000 units a metre"
    return (
        f"{found}, which no room is, and nothing states its unit ({unit}): give --option "
        f"depth_scale={other}, or depth_scale={unit.metres:.5g} if it is true"
    )


def _near_text(unit: UnitEvidence) -> str:
    found = f"depth is unusable: it reads as {1000 * unit.typical_m:.2g} mm on average"
    if 0 < unit.levels <= FEW_LEVELS:
        return (
            f"{found}, in {unit.levels} different values: the images hold whole metres; write depth as "
            "16-bit integers of millimetres, or as float metres"
        )
    if unit.integer:
        return f"{found}: its unit is not {unit.scale:.4g} m; check the depth scale (--option depth_scale=…)"
    return f"{found}: floats are expected in metres; multiply them (by 1000 if they are in kilometres)"


def _far_text(unit: UnitEvidence) -> str:
    found = f"depth is unusable: it reads as {unit.typical_m:.3g} m on average"
    if unit.farthest_m != FARTHEST_M:
        return f"{found}: millimetres were taken for metres (of the points, or the baseline): divide by 1000"
    if unit.integer:
        return f"{found}: its unit is not {unit.scale:.4g} m; for millimetres, --option depth_scale=0.001"
    return f"{found}: floats are expected in metres, these are millimetres: divide them by 1000"
