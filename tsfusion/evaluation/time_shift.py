# SPDX-License-Identifier: MIT
"""Poses of other times: the frames fit better with the poses of frames some places later or earlier."""

from collections.abc import Sequence

import numpy as np

from tsfusion.datasets.dataset import Dataset, pose_of
from tsfusion.evaluation.frame_pairs import MIN_FIT, Fits, FramePair
from tsfusion.geometry.se3 import Transform

MAX_SHIFT = 8  # frames, early or late
MIN_SHIFT_PAIRS = 2
MIN_SHIFT_GAIN = 0.05
MIN_SHIFT_SHARE = 0.7  # of the gain by small corrections


def time_shift(dataset: Dataset, pairs: Sequence[FramePair], best: Fits) -> int | None:
    """Number of frames by which later poses fit clearly better; None where no shift does.

    Args:
        best: fits of the pairs after small corrections.
    """
    gap = next((gap for gap in (4, 1) if any(p.second - p.first == gap for p in pairs)), None)
    indices = [index for index, pair in enumerate(pairs) if pair.second - pair.first == gap][::2]
    chosen, reachable = [pairs[index] for index in indices], best[indices]
    poses: dict[int, Transform | None] = {}

    def pose(index: int) -> Transform | None:
        if index not in poses:
            poses[index] = pose_of(dataset, index) if 0 <= index < len(dataset) else None
        return poses[index]

    def fits(late: int) -> Fits:
        moved = [(pose(pair.first + late), pose(pair.second + late)) for pair in chosen]
        return np.array(
            [
                np.nan if first is None or second is None else pair.fit(np.linalg.inv(second) @ first)
                for pair, (first, second) in zip(chosen, moved, strict=True)
            ]
        )

    given, found = fits(0), (0.0, 0)
    for late in sorted(range(-MAX_SHIFT, MAX_SHIFT + 1), key=abs):
        moved = fits(late)
        known = np.isfinite(moved)
        if known.sum() < MIN_SHIFT_PAIRS or moved[known].mean() < MIN_FIT:
            continue
        if (moved > given)[known].all():
            gain, missing = (float((each - given)[known].mean()) for each in (moved, reachable))
            if gain > max(MIN_SHIFT_GAIN, MIN_SHIFT_SHARE * missing):
                found = max(found, (gain, late))
    return found[1] or None


def time_text(dataset: Dataset, late: int) -> str:
    """Description of poses that are `late` frames late, and what to do."""
    shift = f"{abs(late)} frame{'s' if abs(late) > 1 else ''}"
    stamps = dataset.timestamps_ns
    if stamps is not None and len(stamps) > 1:
        shift += f" ({abs(late) * float(np.median(np.diff(stamps))) / 1e6:.0f} ms)"
    way = (
        "late: each frame fits the pose of a later one"
        if late > 0
        else "early: each frame fits an earlier pose"
    )
    return f"the poses' times are about {shift} {way}; shift their time stamps"
