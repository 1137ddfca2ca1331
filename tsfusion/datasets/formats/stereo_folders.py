# SPDX-License-Identifier: MIT
"""Folders of a stereo camera's images: left/ and right/ with equal names."""

from pathlib import Path
from typing import Any

import cv2
from numpy.typing import NDArray

from tsfusion.core.errors import DatasetError, InvalidConfig
from tsfusion.datasets.dataset import NO_HALF, SCAN, Frames, require_folder, require_frames
from tsfusion.datasets.file_names import in_time
from tsfusion.datasets.formats.image_folders import first_size, images
from tsfusion.datasets.readers import read_image
from tsfusion.datasets.stereo_pairs import find_pairs, pair_of
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.keyframe import Intrinsics

EXPECTED = (
    "left/ and right/ with images of equal names; K.txt and baseline.txt (metres) if rectified, else "
    "left.yaml and right.yaml or --calibration; and poses of the left camera with --trajectory"
)


_SIDES = ("left", "right")


def recognises(path: Path) -> bool:
    """Whether the folder has `left/` and `right/`, with images."""
    return all((path / side).is_dir() and bool(images(path / side, EXPECTED)) for side in _SIDES)


class StereoFolder(Frames):
    """Pairs of images by name, rectified where they are not, in the axes of the rectified left camera.

    Names that are decimal seconds or nanoseconds are times. Images without their other half are left out and
    counted.

    Args:
        intrinsics, baseline: of rectified images; pixels, metres; default `K.txt` and `baseline.txt`.
        calibration: of raw images; default one of `stereo_pairs.FILE_PAIRS` in the folder.
        posed: False, as there are no poses here; `open_dataset(path, trajectory=FILE)` gives some.

    Raises:
        DatasetError: no such folder, no pairs, no camera.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        intrinsics: Intrinsics | None = None,
        calibration: str | Path | None = None,
        baseline: float | None = None,
        sensor: str = "stereo",
        color: bool = True,
        posed: bool = True,
    ) -> None:
        root = require_folder(path, "stereo folders")
        self.name, self.sensor, self.skipped = f"stereo folders {root.name}", sensor, {}
        if posed:
            raise DatasetError(f"{root} has no poses; expected --trajectory FILE; {SCAN}")
        left, right = ({file.stem: file for file in images(root / side, EXPECTED)} for side in _SIDES)
        names = [name for name in left if name in right]
        if alone := len(left) + len(right) - 2 * len(names):
            self.skipped[NO_HALF] = alone
        require_frames(len(names), root, EXPECTED, self.skipped)
        files, self.timestamps_ns = in_time([left[name] for name in names], names)
        self._poses = [None] * len(files)
        self._files = [(file, right[file.stem]) for file in files]
        self._pairs, self.camera = find_pairs(
            root, first_size(files, _image), intrinsics=intrinsics, calibration=calibration, baseline=baseline
        )
        self._with_color = color

    def __len__(self) -> int:
        return len(self._files)

    def _frame(self, index: int) -> Frame:
        left, right = map(_image, self._files[index])
        try:
            measured = pair_of(left, right, self._pairs)
        except (InvalidConfig, cv2.error) as error:
            raise DatasetError(f"{self._files[index][0]} or its right image: {error}") from error
        if not self._with_color:
            measured["color"] = None
        return self._posed_frame(index, **measured)


def _image(file: Path) -> NDArray[Any]:
    return read_image(file, "an image", cv2.IMREAD_ANYCOLOR)
