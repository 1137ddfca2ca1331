# SPDX-License-Identifier: MIT
"""Read the calibration of stereo cameras, rectify their images, and make frames of them."""

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import DatasetError, InvalidConfig, errors_as
from tsfusion.datasets.cameras import RecordedCamera, UnknownCamera, find_camera
from tsfusion.datasets.dataset import NO_HALF, Frames
from tsfusion.datasets.readers import read_image, read_numbers
from tsfusion.geometry.calibration import Rectifier, Size
from tsfusion.geometry.calibration_files import read_rig
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.keyframe import MAX_BASELINE_M, Intrinsics
from tsfusion.geometry.se3 import Transform

_FrameKey = TypeVar("_FrameKey", int, str)
log = logging.getLogger(__name__)

# A folder as a calibration: the files of the left and the right camera, or of intrinsics and extrinsics.
FILE_PAIRS = (
    ("cam0/sensor.yaml", "cam1/sensor.yaml"),
    ("mav0/cam0/sensor.yaml", "mav0/cam1/sensor.yaml"),
    ("left.yaml", "right.yaml"),
    ("intrinsics.yml", "extrinsics.yml"),
)


@dataclass(frozen=True)
class AlreadyRectified:
    """A `Rectifier` of images that are already rectified, which it returns unchanged."""

    intrinsics: Intrinsics
    baseline_fx: float  # metre · pixels
    size: Size
    T_left_rectified: ClassVar[Transform] = np.eye(4)

    def pair(self, left: NDArray[Any], right: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return both images unchanged.

        Raises:
            InvalidConfig: the images have another size.
        """
        for shown in (left.shape[:2], right.shape[:2]):
            if shown != self.size:
                raise InvalidConfig(f"the camera has images of {self.size[::-1]} pixels, got {shown[::-1]}")
        return left, right


PairRectifier = Rectifier | AlreadyRectified


def read_rectifier(calibration: str | Path, *, size: Size | None) -> Rectifier:
    """Read a calibration from a file, or from a folder with a pair of files (`FILE_PAIRS`).

    Args:
        size: (height, width) of one image, for files without a size.

    Raises:
        DatasetError: the calibration cannot be read. The message says what was expected.
    """
    path = Path(calibration).expanduser()
    files = [path]
    if path.is_dir():
        found = [names for names in FILE_PAIRS if all((path / name).is_file() for name in names)]
        if not found:
            expected = "; ".join(" and ".join(names) for names in FILE_PAIRS)
            raise DatasetError(f"{path} holds no calibration of a stereo camera; expected one of {expected}")
        files = [path / name for name in found[0]]
    with errors_as(DatasetError, "calibration", DatasetError, InvalidConfig):
        try:
            rig = read_rig(*files)
        except DatasetError:
            if size is None:
                raise
            rig = read_rig(*files, size=size)
        return Rectifier(rig)


def find_pairs(
    root: Path,
    size: Size,
    *,
    intrinsics: Intrinsics | None = None,
    calibration: str | Path | None = None,
    baseline: float | None = None,
    places: Sequence[Path] = (),
) -> tuple[PairRectifier, RecordedCamera]:
    """Find the stereo camera of a recording. Return the rectifier, and the left camera after rectification.

    Args:
        root: the recording's folder.
        size: (height, width) of the images.
        intrinsics, baseline: pixels, metres, for rectified images; default from files of the folder.
        calibration: for raw images; default a pair of files in the folder (`FILE_PAIRS`).
        places: folders with camera files, as for `find_camera`.

    Raises:
        UnknownCamera: the camera is not known from any source.
        DatasetError: a camera file cannot be used.
    """
    there = any(all((root / name).is_file() for name in names) for names in FILE_PAIRS)
    if calibration is not None or there:
        rectifier = read_rectifier(calibration or root, size=size)
        source = "rectified by its calibration"
        return rectifier, RecordedCamera(rectifier.intrinsics, rectifier.size, source)
    camera = find_camera(root, size, intrinsics=intrinsics, places=places)
    baseline = baseline or baseline_of(root)
    if baseline is None:
        raise UnknownCamera(f"{root} has no baseline.txt (metres) of the rectified pairs")
    if camera.undistorter is not None:
        raise DatasetError(f"{root}: pairs need a stereo camera's --calibration, got {camera}")
    return AlreadyRectified(camera.intrinsics, baseline * camera.intrinsics.fx, size), camera


def baseline_of(root: Path) -> float | None:
    """Read the baseline, metres, from `baseline.txt`, or return None without the file.

    Raises:
        DatasetError: the file does not hold one number > 0.
    """
    path = root / "baseline.txt"
    if not path.is_file():
        return None
    baseline = float(read_numbers(path, "the baseline in metres", columns=1)[0, 0])
    if not 0 < baseline <= MAX_BASELINE_M:
        unit = ": are these millimetres?" * (baseline > 0)
        raise DatasetError(f"{path} must hold the baseline in metres, > 0, got {baseline:g}{unit}")
    return baseline


def pair_of(left: NDArray[Any], right: NDArray[Any], pairs: PairRectifier) -> dict[str, Any]:
    """Return the fields of a rectified `Frame` from a raw pair, (H, W) grey or (H, W, 3) BGR uint8."""
    left, right = pairs.pair(left, right)
    return {
        "left": _grey(left),
        "right": _grey(right),
        "color": left if left.ndim == 3 else np.repeat(left[:, :, None], 3, axis=2),
        "intrinsics": pairs.intrinsics,
        "baseline_fx": pairs.baseline_fx,
    }


def paired(
    left: dict[_FrameKey, Path], right: dict[_FrameKey, Path], skipped: dict[str, int]
) -> dict[_FrameKey, tuple[Path, Path]]:
    """Pair the images of both cameras by name or number. Count images without a partner."""
    alone = [(left | right)[key] for key in left.keys() ^ right.keys()]
    if alone:
        skipped[NO_HALF] = len(alone)
        first, more = min(alone), f", with {len(alone) - 1} more" * (len(alone) > 1)
        log.warning("%s is left out%s: the other camera has no image of this name", first, more)
    return {key: (file, right[key]) for key, file in left.items() if key in right}


class PairedImages(Frames):
    """Frames of a left and a right image each, rectified if they are not yet."""

    _files: list[Any]  # left and right image of each frame
    _pairs: PairRectifier
    _with_color: bool

    def _frame(self, index: int) -> Frame:
        files = self._files[index]
        left, right = map(self._image, files)
        with errors_as(DatasetError, f"{files[0]} or its right image", InvalidConfig, cv2.error):
            measured = pair_of(left, right, self._pairs)
        measured["color"] = self._color(index, measured["color"]) if self._with_color else None
        return self._posed_frame(index, **measured)

    def _color(self, index: int, left: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Return (H, W, 3) uint8 BGR of the left camera. `left`: its rectified image, grey or in colour."""
        return left

    def _image(self, file: Path) -> NDArray[Any]:
        """Return (H, W) or (H, W, 3) uint8, as stored."""
        return read_image(file, "an image", cv2.IMREAD_ANYCOLOR)


def _grey(image: NDArray[Any]) -> NDArray[np.uint8]:
    if image.ndim == 2:
        return image
    grey: NDArray[np.uint8] = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return grey
