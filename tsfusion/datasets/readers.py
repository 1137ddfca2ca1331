# SPDX-License-Identifier: MIT
"""Text tables, images and camera matrices from files; each error is one DatasetError that names the file."""

import struct
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import DatasetError, InvalidKeyframe
from tsfusion.geometry.calibration import MAX_NO_SKEW
from tsfusion.geometry.calibration_files import read_text
from tsfusion.geometry.keyframe import MAX_IMAGE_SIDE, Intrinsics, check_intrinsics

_PNG = b"\x89PNG\r\n\x1a\n"
_PIXEL_CHUNKS = (b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND")
_HEADER = 13  # bytes of IHDR


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

    Pixels come as stored, as calibrations and depth have them: an EXIF orientation is for picture viewers.
    OpenCV believes a PNG of a few bytes that claims gigabytes of pixels, and raises beyond that. libpng
    prints what it does not like: a PNG is checked here first, and freed of what is not needed for its pixels.
    """
    if content[:8].tobytes() == _PNG:
        pixels = _png_of_pixels(content.tobytes())
        if pixels is None:
            return None
        content = np.frombuffer(pixels, np.uint8)
    try:
        stored = flags | cv2.IMREAD_IGNORE_ORIENTATION
        image: NDArray[Any] | None = cv2.imdecode(content, stored) if len(content) else None
    except cv2.error:
        image = None
    return image


def _png_of_pixels(content: bytes) -> bytes | None:
    """A PNG without the chunks that do not change its pixels; None where it is damaged or far too large."""
    kept, place = [_PNG], len(_PNG)
    while place < len(content):
        length, name = struct.unpack(">I4s", content[place : place + 8].ljust(8, b"\0"))
        chunk = content[place : place + 12 + length]
        if len(chunk) < 12 + length or zlib.crc32(chunk[4:-4]) != int.from_bytes(chunk[-4:], "big"):
            return None
        if name == b"IHDR" and (length != _HEADER or max(struct.unpack(">2I", chunk[8:16])) > MAX_IMAGE_SIDE):
            return None
        if name in _PIXEL_CHUNKS:
            kept.append(chunk)
        if name == b"IEND":
            return b"".join(kept)
        place += len(chunk)
    return None


def read_color(path: Path, shape: tuple[int, ...] | None) -> NDArray[np.uint8]:
    """(H, W, 3) uint8 BGR of the depth image's `shape`; None: of any."""
    color: NDArray[np.uint8] = read_image(path, "a colour image", cv2.IMREAD_COLOR)
    if shape is not None and color.shape[:2] != shape:
        cure = turned_by_exif(path, color.shape, shape) or "register colour and depth before"
        raise DatasetError(
            f"{path} is {color.shape[1]}×{color.shape[0]}, its depth image {shape[1]}×{shape[0]}; "
            f"expected equal sizes: {cure}, or leave the colour out (--option color=false)"
        )
    return color


def turned_by_exif(path: Path, stored: Sequence[int], shape: Sequence[int]) -> str:
    """Cure of a JPEG of the size `stored` that only its EXIF orientation turns to `shape`; else empty."""
    if tuple(stored[:2]) != tuple(shape[1::-1]) or path.suffix.lower() == ".png":
        return ""
    shown = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if shown is None or shown.shape[:2] != tuple(shape[:2]):
        return ""
    return "pixels count as stored, and an EXIF orientation turns these: save the images turned"


def intrinsics_of(K: NDArray[np.float64], source: object) -> Intrinsics:
    """The intrinsics in a camera or projection matrix, checked; an error names where it came from.

    Images of a camera with skew are no pinhole camera's before they are undistorted.
    """
    if abs(K[0, 1]) > MAX_NO_SKEW:
        raise DatasetError(
            f"{source}: the matrix has a skew of {K[0, 1]:.4g} px, which is not used here: rectify the "
            "images, or give their --calibration FILE"
        )
    return checked_intrinsics(Intrinsics(*map(float, (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))), source)


def checked_intrinsics(intrinsics: Intrinsics, source: object) -> Intrinsics:
    """`intrinsics`, or an error that names where they came from."""
    try:
        check_intrinsics(intrinsics)
    except InvalidKeyframe as error:
        raise DatasetError(f"{source}: {error}") from error
    return intrinsics
