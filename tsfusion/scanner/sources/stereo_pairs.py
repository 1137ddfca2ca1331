# SPDX-License-Identifier: MIT
"""Rectification of raw stereo images, and the frames made of them."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import DatasetError, InvalidConfig, SourceError
from tsfusion.geometry.calibration import Rectifier, Size
from tsfusion.geometry.calibration_files import read_rig
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.keyframe import Intrinsics

# A folder as a calibration: the files of the left and the right camera, or of intrinsics and extrinsics.
FILE_PAIRS = (
    ("cam0/sensor.yaml", "cam1/sensor.yaml"),
    ("mav0/cam0/sensor.yaml", "mav0/cam1/sensor.yaml"),
    ("left.yaml", "right.yaml"),
    ("intrinsics.yml", "extrinsics.yml"),
)


class PairRectifier(Protocol):
    """Rectifies pairs of images, as `calibration.Rectifier` does."""

    @property
    def intrinsics(self) -> Intrinsics: ...

    @property
    def baseline_fx(self) -> float: ...

    @property
    def size(self) -> Size: ...

    def pair(self, left: NDArray[Any], right: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Rectify both images."""


@dataclass(frozen=True)
class AlreadyRectified:
    """`PairRectifier` for images that are rectified already."""

    intrinsics: Intrinsics
    baseline_m: float
    size: Size

    @property
    def baseline_fx(self) -> float:
        """Baseline times focal length, metre · pixels."""
        return self.baseline_m * self.intrinsics.fx

    def pair(self, left: NDArray[Any], right: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Return both images as they are."""
        return left, right


def read_rectifier(calibration: str | Path, *, size: Size | None) -> Rectifier:
    """Read a calibration from a file, or from a folder with a pair of files (`FILE_PAIRS`).

    Args:
        size: (height, width) of one image, for files without one.

    Raises:
        SourceError: it cannot be read; the message says what was expected.
    """
    path = Path(calibration).expanduser()
    files = [path]
    if path.is_dir():
        found = [names for names in FILE_PAIRS if all((path / name).is_file() for name in names)]
        if not found:
            expected = "; ".join(" and ".join(names) for names in FILE_PAIRS)
            raise SourceError(f"{path} holds no calibration of a stereo camera; expected one of {expected}")
        files = [path / name for name in found[0]]
    try:
        try:
            rig = read_rig(*files)
        except DatasetError:
            if size is None:
                raise
            rig = read_rig(*files, size=size)
        return Rectifier(rig)
    except (DatasetError, InvalidConfig) as error:
        raise SourceError(f"calibration: {error}") from error


def frame_of(
    left: NDArray[Any],
    right: NDArray[Any],
    pairs: PairRectifier,
    *,
    sensor: str,
    timestamp_ns: int,
    captured_ns: int,
) -> Frame:
    """Make a rectified frame of raw images, (H, W) grey or (H, W, 3) BGR uint8; colour is the left one's."""
    left, right = pairs.pair(left, right)
    return Frame(
        sensor=sensor,
        left=_grey(left),
        right=_grey(right),
        color=left if left.ndim == 3 else np.repeat(left[:, :, None], 3, axis=2),
        intrinsics=pairs.intrinsics,
        baseline_fx=pairs.baseline_fx,
        timestamp_ns=timestamp_ns,
        captured_ns=captured_ns,
    )


def _grey(image: NDArray[Any]) -> NDArray[np.uint8]:
    if image.ndim == 2:
        return image
    grey: NDArray[np.uint8] = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)
    return grey
