# SPDX-License-Identifier: MIT
"""Text tables, images and camera matrices from files; each error is one DatasetError that names the file."""

import struct
import zlib
from collections.abc import Sequence
from contextlib import suppress
from os import SEEK_CUR, SEEK_END
from pathlib import Path, PureWindowsPath
from typing import Any, BinaryIO

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.core import read_limits
from tsfusion.core.errors import DatasetError, InvalidKeyframe
from tsfusion.geometry.calibration import MAX_NO_SKEW
from tsfusion.geometry.calibration_files import read_text
from tsfusion.geometry.keyframe import MAX_IMAGE_SIDE, Intrinsics, check_intrinsics
from tsfusion.wire.records import image_headers
from tsfusion.wire.records.record_header import Refused

_PNG = b"\x89PNG\r\n\x1a\n"
_PIXEL_CHUNKS = (b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND")
_HEADER = 13  # bytes of IHDR
_PIXEL, _FEW = 9, 1 << 20  # bytes of a pixel that is not compressed, and of all that is no pixel


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


def listed_file(root: Path, name: str) -> Path:
    """A file that a list names, from `root`; with Windows' separators too."""
    return root / name if (root / name).exists() else root / PureWindowsPath(name).as_posix()


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
        with path.open("rb") as file:
            image = decode_image(file, flags)
    except OSError as error:
        raise DatasetError(f"cannot read {path}: {error.strerror}") from error
    if image is None:
        side = MAX_IMAGE_SIDE
        raise DatasetError(f"{path} cannot be decoded; expected {what} of at most {side}×{side} pixels")
    return image


def decode_image(file: BinaryIO, flags: int) -> NDArray[Any] | None:
    """Decode an image file as OpenCV's `flags` say; None where that fails, or it is far too large.

    Pixels come as stored, as calibrations and depth have them: an EXIF orientation is for picture viewers.
    OpenCV believes an image of a few bytes that claims gigabytes of pixels (but for PNG and JPEG, the command
    bounds that). libpng prints what it does not like: a PNG is checked here first, and what
    its pixels do not need is not even read.
    """
    is_png = file.read(len(_PNG)) == _PNG
    content = _png_of_pixels(file) if is_png else _whole(file)
    if not content:
        return None
    try:
        stored = flags | cv2.IMREAD_IGNORE_ORIENTATION
        image: NDArray[Any] | None = cv2.imdecode(np.frombuffer(content, np.uint8), stored)
    except cv2.error:
        image = None
    return image


def _whole(file: BinaryIO) -> bytes | None:
    """The bytes of an image that is no PNG; None where it is far too large."""
    nbytes = file.seek(0, SEEK_END)
    file.seek(0)
    content = file.read() if nbytes <= read_limits.MAX_FILE_BYTES else b""
    with suppress(Refused):  # neither a JPEG, nor one that can be read in one way alone
        if max(image_headers.size(content)) > MAX_IMAGE_SIDE:
            return None
    return content


def _png_of_pixels(file: BinaryIO) -> bytes | None:
    """A PNG without the chunks that do not change its pixels; None where it is damaged or far too large."""
    kept, left = [_PNG], _FEW
    while len(head := file.read(8)) == 8:
        length, name = struct.unpack(">I4s", head)
        if name not in _PIXEL_CHUNKS:
            if not name.isalpha():
                break
            file.seek(length + 4, SEEK_CUR)
            continue
        chunk = head + file.read(length + 4) if length <= left else b""
        if len(chunk) < 12 + length or zlib.crc32(chunk[4:-4]) != int.from_bytes(chunk[-4:], "big"):
            break
        if name == b"IHDR":
            width, height = struct.unpack(">2I", chunk[8:16]) if length == _HEADER else (0, 0)
            if not 0 < max(width, height) <= MAX_IMAGE_SIDE:
                break
            left += width * height * _PIXEL
        kept.append(chunk)
        left -= length
        if name == b"IEND":
            return b"".join(kept)
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
