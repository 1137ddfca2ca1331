# SPDX-License-Identifier: MIT
"""Folders of a stereo camera's images: left/ and right/ with equal names."""

from pathlib import Path

from tsfusion.core.errors import DatasetError
from tsfusion.datasets.dataset import SCAN, require_folder
from tsfusion.datasets.file_names import in_time
from tsfusion.datasets.formats.image_folders import first_size, images
from tsfusion.datasets.stereo_pairs import PairedImages, find_pairs, paired
from tsfusion.geometry.keyframe import Intrinsics

EXPECTED = (
    "left/ and right/ with images of equal names; K.txt and baseline.txt (metres) if rectified, else "
    "left.yaml and right.yaml or --calibration; and poses of the left camera with --trajectory"
)


_SIDES = ("left", "right")


def recognises(path: Path) -> bool:
    """Whether the folder has `left/` and `right/`, with images."""
    return all((path / side).is_dir() and bool(images(path / side, EXPECTED)) for side in _SIDES)


class StereoFolder(PairedImages):
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
        pairs = paired(left, right, self.skipped)
        files, self.timestamps_ns = in_time([left[name] for name in pairs], [*pairs])
        nowhere = [None] * len(files)
        self._files = self._keep([pairs[file.stem] for file in files], nowhere, (root, EXPECTED), posed=False)
        size, self._with_color = first_size(files, self._image), color
        self._pairs, self.camera = find_pairs(
            root, size, intrinsics=intrinsics, calibration=calibration, baseline=baseline
        )
