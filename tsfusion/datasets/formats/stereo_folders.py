# SPDX-License-Identifier: MIT
"""Read folders of a stereo camera's images: left/ and right/ with equal file names."""

from pathlib import Path
from typing import Any

from tsfusion.datasets.dataset import SCAN, FramePoses, NoPoses, Times
from tsfusion.datasets.file_names import in_time
from tsfusion.datasets.folder_frames import FolderFrames
from tsfusion.datasets.formats.image_folders import first_size, images
from tsfusion.datasets.stereo_pairs import PairedImages, find_pairs, paired
from tsfusion.geometry.keyframe import Intrinsics

EXPECTED = (
    "left/ and right/ with images of equal names; K.txt and baseline.txt (metres) if rectified, else "
    "left.yaml and right.yaml or --calibration; and poses of the left camera with --trajectory"
)


_SIDES = ("left", "right")


class StereoFolder(PairedImages, FolderFrames):
    """Pairs of images with equal names, in the axes of the rectified left camera; raw images are rectified.

    Names that are decimal seconds or nanoseconds are times. Images without a partner are left out and
    counted.

    Args:
        intrinsics, baseline: pixels, metres, for rectified images; default `K.txt` and `baseline.txt`.
        calibration: for raw images; default one of `stereo_pairs.FILE_PAIRS` in the folder.
        options: those of `FolderFrames`. The folder has no poses: give `trajectory`, or `posed` False.

    Raises:
        DatasetError: there is no such folder, there are no pairs, or there is no camera.
    """

    layout, expected, sensor = "stereo folders", EXPECTED, "stereo"
    signs = (("left",), ("right",))

    @classmethod
    def recognises(cls, path: Path) -> bool:
        """Return True for a folder with images in `left/` and in `right/`."""
        return super().recognises(path) and all(images(path, side, EXPECTED) for side in _SIDES)

    def __init__(
        self,
        path: str | Path,
        *,
        intrinsics: Intrinsics | None = None,
        calibration: str | Path | None = None,
        baseline: float | None = None,
        color: bool = True,
        **options: Any,
    ) -> None:
        super().__init__(path, **options)
        size, self._with_color = first_size([left for left, _ in self._files], self._image), color
        self._pairs, self.camera = find_pairs(
            self._root, size, intrinsics=intrinsics, calibration=calibration, baseline=baseline
        )

    def _list(self, root: Path) -> tuple[list[tuple[Path, Path]], Times]:
        left, right = ({file.stem: file for file in images(root, side, EXPECTED)} for side in _SIDES)
        pairs = paired(left, right, self.skipped)
        files, times = in_time([left[name] for name in pairs], [*pairs])
        return [pairs[file.stem] for file in files], times

    def _recorded_poses(self, root: Path, files: object) -> FramePoses:
        raise NoPoses(f"{root} has no poses; expected --trajectory FILE; {SCAN}")
