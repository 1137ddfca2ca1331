# SPDX-License-Identifier: MIT
"""Real recordings with their poses or frames changed."""

import dataclasses
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.datasets import Dataset, open_dataset
from tsfusion.datasets.dataset import Frames, frame_of
from tsfusion.evaluation.pose_check import PoseCheckReport, check
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.se3 import Transform

FOLDERS = {
    "7scenes": "7scenes/redkitchen",
    "hololens": "hololens/000",
    "redwood": "redwood_livingroom1",
    "open3d": "open3d_rgbd",
    "3dmatch": "3dmatch",
    "icl": "icl_nuim_tum",
}


class Corrupted(Frames):
    """Another dataset with its poses changed, its frames changed, or poses of `late` frames before."""

    def __init__(
        self,
        dataset: Dataset,
        pose: Callable[[Transform], NDArray[np.float64]] = np.asarray,
        frame: Callable[[Frame], dict[str, object]] = lambda _: {},
        late: int = 0,
    ) -> None:
        self.name, self.sensor, self.skipped = dataset.name, dataset.sensor, {}
        self.timestamps_ns = dataset.timestamps_ns
        self._frame_of = cache(lambda index: frame_of(dataset, index))
        self._pose, self._change, self._late, self._count = pose, frame, late, len(dataset)

    def __len__(self) -> int:
        return self._count - abs(self._late)

    def _frame(self, index: int) -> Frame:
        seen = self._frame_of(index + max(0, self._late))
        posed = self._frame_of(index + max(0, -self._late))
        fields = {field.name: getattr(seen, field.name) for field in dataclasses.fields(seen) if field.init}
        T = None if posed.T_world_camera is None else self._pose(posed.T_world_camera)
        changed = {"T_world_camera": T, **self._change(seen)}
        return Frame(**{**fields, **changed})


@cache
def opened(place: Path, **options: Any) -> Dataset:
    """The dataset, each frame read once for all tests."""
    return Corrupted(open_dataset(place, **options))


@cache
def genuine(place: Path) -> PoseCheckReport:
    """The check of a dataset as it is, done once for all tests."""
    return check(opened(place))
