# SPDX-License-Identifier: MIT
"""Compute the ranges of a keyframe's samples, and advise about impossible ranges."""

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry.keyframe import Keyframe

NO_SAMPLES = "no_samples"  # the reason under which a keyframe without a usable sample is counted
# Metres. A median depth outside of these is in another unit: no camera measures nearer, and the sensor
# models end there.
NEAREST_M, FARTHEST_M = 0.01, 100.0


def sample_ranges(keyframe: Keyframe) -> NDArray[np.float64]:
    """Return (n,) metres of the samples with a return: depth along the axis, or a ray's length."""
    measured = keyframe.measurement
    with np.errstate(invalid="ignore", divide="ignore", over="ignore"):
        if keyframe.points is not None:
            origins = 0.0 if keyframe.origins is None else keyframe.origins
            ranges = np.linalg.norm((measured - origins).astype(np.float64), axis=-1)
        elif keyframe.disparity is not None:
            pixels = measured * keyframe.disparity_scale
            ranges = np.where(pixels > 0, (keyframe.baseline_fx or 0.0) / pixels, 0.0)
        else:
            scale = keyframe.depth_scale if measured.dtype == np.uint16 else 1.0
            ranges = measured.astype(np.float64) * scale
        found: NDArray[np.float64] = ranges[np.isfinite(ranges) & (ranges > 0)]
        return found


def wrong_unit(keyframe: Keyframe) -> str:
    """Return advice if a keyframe's depth seems to be in a wrong unit; empty if it may be in metres.

    The median decides: no sensor measures so near or so far in metres.
    """
    ranges = sample_ranges(keyframe)
    if not len(ranges):
        return ""
    median = float(np.median(ranges))
    if NEAREST_M <= median <= FARTHEST_M:
        return ""
    if keyframe.kind == "disparity":
        return f"a median depth of {median:.3g} m: check baseline_fx and disparity_scale"
    if keyframe.kind == "points":
        return f"a median range of {median:.3g} m: points must be in metres"
    if median < NEAREST_M:
        return f"a median depth of {median:.3g} m: check depth_scale (metres a unit), or give float32 metres"
    return (
        f"a median depth of {median:.4g} m looks like millimetres: give uint16 with depth_scale=0.001, or "
        "float32 metres"
    )


def why_no_samples(keyframe: Keyframe, min_range: float, max_range: float, reach: float) -> str:
    """Return the reason why a map can use none of a keyframe's samples, and the cure, for a person.

    Args:
        min_range, max_range: of the sensor's model, metres.
        reach: reach of the map from its origin along each axis, metres.
    """
    ranges = sample_ranges(keyframe)
    count = int(np.prod(keyframe.shape))
    what = "points" if keyframe.kind == "points" else "pixels"
    start = f"the keyframe has no usable sample: of {count} {what} "
    if not len(ranges):
        return start + f"none has a return; is the sensor covered, or is this no {keyframe.kind}?"
    if not np.any((ranges >= min_range) & (ranges <= max_range)):
        where = f"none is from {min_range:g} to {max_range:g} m away (median {np.median(ranges):.4g} m)"
        return start + f"{where}; {wrong_unit(keyframe) or 'use another --sensor or --max-range'}"
    if keyframe.confidence is not None and not keyframe.confidence.any():
        return start + "every one has confidence 0; 255 is full confidence"
    away = float(np.abs(keyframe.T_world_camera[:3, 3]).max())
    if away + float(ranges.max()) > reach:
        return start + (
            f"none is within the map's reach: the sensor is {away / 1000:.4g} km from the map's origin along "
            f"an axis, and voxels of this size reach {reach / 1000:.4g} km; subtract an offset from all poses"
        )
    return start + "the few within range stand alone, as noise does; outlier_filter = false keeps them"
