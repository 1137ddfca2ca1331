# SPDX-License-Identifier: MIT
"""Text tables, images and camera matrices from files; each error is one DatasetError that names the file."""

import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import DatasetError, InvalidKeyframe
from tsfusion.geometry.calibration_files import read_text
from tsfusion.geometry.keyframe import MAX_IMAGE_SIDE, Intrinsics, check_intrinsics


def read_lines(path: Path, content: str) -> list[tuple[int, str]]:
    """(line number, text) of every line that is neither blank nor a `#` comment.

    Copes with CRLF and a byte order mark.
    """
    lines = read_text(path, content).splitlines()
    numbered = ((number, line.strip()) for number, line in enumerate(lines, 1))
    return [(number, line) for number, line in numbered if line and not line.startswith("#")]


def read_numbers(path: Path, content: str, *, columns: int | None = None) -> NDArray[np.float64]:
    """A text table: (rows, columns) float64, finite; with `columns` None all rows must be equally long."""
    lines = read_lines(path, content)
    if not lines:
        raise DatasetError(f"{path} is empty; expected {content}")
    columns = columns or len(lines[0][1].split())
    return np.array([numbers(path, number, line.split(), columns, content) for number, line in lines])


def numbers(path: Path, line: int, words: list[str], count: int, content: str) -> list[float]:
    """`words` as exactly `count` finite numbers."""
    try:
        values = [float(word) for word in words]
    except ValueError as error:
        raise DatasetError(f"{path}:{line}: {error}; expected {content}") from error
    if len(values) != count:
        raise DatasetError(f"{path}:{line}: {len(values)} numbers, expected {count}: {content}")
    if not np.isfinite(values).all():
        raise DatasetError(f"{path}:{line}: not finite: {' '.join(words)}; expected {content}")
    return values


def read_image(path: Path, what: str, flags: int = cv2.IMREAD_UNCHANGED) -> NDArray[Any]:
    """Any image as stored: (H, W) or (H, W, 3) BGR; or as OpenCV's `flags` say."""
    if not path.is_file():
        raise DatasetError(f"{path} is missing; expected {what}")
    try:
        image = decode_image(np.fromfile(path, np.uint8), flags)
    except OSError as error:
        raise DatasetError(f"cannot read {path}: {error.strerror}") from error
    if image is None:
        raise DatasetError(f"{path} cannot be decoded; expected {what}")
    return image


def decode_image(content: NDArray[np.uint8], flags: int) -> NDArray[Any] | None:
    """Decode an image file's bytes as OpenCV's `flags` say; None where that fails, or it is far too large.

    OpenCV believes a PNG of a few bytes that claims gigabytes of pixels, and raises beyond that.
    """
    head = content[:24].tobytes()
    if head[1:4] == b"PNG" and any(
        side > MAX_IMAGE_SIDE for side in struct.unpack(">2I", head[16:].ljust(8))
    ):
        return None
    try:
        image: NDArray[Any] | None = cv2.imdecode(content, flags) if len(content) else None
    except cv2.error:
        image = None
    return image


def read_depth(path: Path, *, invalid: int | None = None) -> NDArray[np.uint16]:
    """(H, W) uint16 depth; pixels equal to `invalid` become 0."""
    depth = read_image(path, "a 16-bit depth image")
    if depth.dtype != np.uint16 or depth.ndim != 2:
        raise DatasetError(
            f"{path} must hold one 16-bit channel, got shape {depth.shape} of {depth.dtype} "
            "(was it saved again as 8 bits?)"
        )
    if invalid is not None:
        depth[depth == invalid] = 0
    return depth


def read_color(path: Path, shape: tuple[int, ...] | None) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 BGR of the depth image's `shape`; None: of any."""
    color: NDArray[np.uint8] = read_image(path, "a colour image", cv2.IMREAD_COLOR)
    if shape is not None and color.shape[:2] != shape:
        raise DatasetError(
            f"{path} is {color.shape[1]}×{color.shape[0]}, its depth image {shape[1]}×{shape[0]}; "
            "expected equal sizes"
        )
    return color


def read_intrinsics(path: Path) -> Intrinsics:
    """A 3×3 camera matrix in a text file."""
    K = read_numbers(path, "a 3×3 camera matrix", columns=3)
    if K.shape != (3, 3) or K[1, 0] or abs(K[2] - (0, 0, 1)).max() > 1e-9:
        raise DatasetError(f"{path} must hold a 3×3 camera matrix ending in 0 0 1, got {K.tolist()}")
    return intrinsics_of(K, path)


def intrinsics_of(K: NDArray[np.float64], source: object) -> Intrinsics:
    """The intrinsics in a camera or projection matrix, checked; an error names where it came from."""
    return checked_intrinsics(Intrinsics(*map(float, (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))), source)


def checked_intrinsics(intrinsics: Intrinsics, source: object) -> Intrinsics:
    """`intrinsics`, or an error that names where they came from."""
    try:
        check_intrinsics(intrinsics)
    except InvalidKeyframe as error:
        raise DatasetError(f"{source}: {error}") from error
    return intrinsics
