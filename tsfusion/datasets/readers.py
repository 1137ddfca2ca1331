# SPDX-License-Identifier: MIT
"""Read text tables, images, depth and camera matrices from files. Errors name the file."""

import json
import struct
import zipfile
import zlib
from collections.abc import Sequence
from contextlib import suppress
from io import BytesIO
from os import SEEK_CUR, SEEK_END
from pathlib import Path, PureWindowsPath
from typing import Any, BinaryIO

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.core import limits
from tsfusion.core.errors import DatasetError, InvalidKeyframe, errors_as, needing, refusals_as
from tsfusion.geometry.calibration import MAX_NO_SKEW
from tsfusion.geometry.calibration_files import read_text
from tsfusion.geometry.keyframe import MAX_IMAGE_SIDE, Intrinsics, check_intrinsics
from tsfusion.geometry.sample_ranges import FARTHEST_M, NEAREST_M
from tsfusion.wire.records import array_encoding
from tsfusion.wire.records.record_header import Refused

_PNG = b"\x89PNG\r\n\x1a\n"
_PIXEL_CHUNKS = (b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND")
_HEADER = 13  # bytes of IHDR
_PIXEL, _FEW = 9, 1 << 20  # bytes of an uncompressed pixel; bytes of everything else
PHONE_SCALE = 4  # colour so much larger, of the same shape, is a phone's, which registers its depth to it
DEPTH_SUFFIXES = (".png", ".tif", ".tiff", ".pgm", ".exr", ".npy")
_AS_OBJECTS = 8  # bytes of memory for each byte of JSON
_EVERY = 4  # every 4th pixel is used to check the unit, every 4th row for the order of bytes
_FEWEST_STEPS = 200  # between neighbours, needed to check the order of bytes
_SMOOTHER = 8  # times; depth in the right order of bytes is 10 to 100 times smoother


def read_lines(path: Path, content: str) -> list[tuple[int, str]]:
    """Return (line number, text) of each line that is neither blank nor a `#` comment.

    CRLF and a byte order mark are allowed.
    """
    lines = read_text(path, content).splitlines()
    numbered = ((number, line.strip()) for number, line in enumerate(lines, 1))
    return [(number, line) for number, line in numbered if line and not line.startswith("#")]


def read_numbers(path: Path, content: str, *, columns: int | None = None) -> NDArray[np.float64]:
    """Read a text table, separated by spaces or commas: (rows, columns) float64, finite.

    With `columns` None rows must be equally long.
    """
    lines = read_lines(path, content)
    if not lines:
        raise DatasetError(f"{path} is empty; expected {content}")
    rows = [(number, line.replace(",", " ").split()) for number, line in lines]
    columns = columns or len(rows[0][1])
    return np.array([numbers(path, number, words, columns, content) for number, words in rows])


def read_json(file: Any, expected: str = "JSON of a whole recording") -> dict[str, Any]:
    """Read named values from a JSON file in a folder or in a zip. Raises DatasetError."""
    content = read_content(file)
    limits.check(file, _AS_OBJECTS * len(content))
    try:
        said = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise DatasetError(f"{file} cannot be read ({error}); expected {expected}") from error
    if not isinstance(said, dict):
        raise DatasetError(f"{file} holds no named values; expected {expected}")
    return said


def read_content(file: Any) -> bytes:
    """Return the bytes of a file in a folder or in a zip. Raises DatasetError."""
    try:
        is_packed = isinstance(file, zipfile.Path)
        limits.check(file, file.root.getinfo(file.at).file_size if is_packed else file.stat().st_size)
        with file.open("rb") as opened:
            content: bytes = opened.read()
    except KeyError as error:
        raise DatasetError(f"{file} is missing") from error
    except (OSError, EOFError, RuntimeError, ValueError, zlib.error, zipfile.BadZipFile) as error:
        raise DatasetError(f"cannot read {file}: {getattr(error, 'strerror', None) or error}") from error
    return content


def listed_file(root: Path, name: str) -> Path:
    """Return a file named by a list, below `root`. Windows' separators are allowed."""
    return root / name if (root / name).exists() else root / PureWindowsPath(name).as_posix()


def numbers(path: Path, line: int, words: list[str], count: int, content: str) -> list[float]:
    try:
        values = [float(word) for word in words]
    except ValueError as error:
        raise DatasetError(f"{path}:{line}: {error}; expected {content}") from error
    if len(values) != count:
        raise DatasetError(f"{path}:{line}: {len(values)} numbers, expected {count}: {content}")
    if not np.isfinite(values).all():
        raise DatasetError(f"{path}:{line}: not finite: {' '.join(words)}; expected {content}")
    return values


def read_image(path: Any, what: str, flags: int = cv2.IMREAD_UNCHANGED) -> NDArray[Any]:
    """Read an image in a folder or in a zip: as stored, (H, W) or (H, W, 3) BGR, or by OpenCV's `flags`."""
    if not path.is_file():
        raise DatasetError(f"{path} is missing; expected {what}")
    with (
        refusals_as(DatasetError, f"cannot read {path}"),
        path.open("rb") if isinstance(path, Path) else BytesIO(read_content(path)) as file,
    ):
        image = decode_image(file, flags)
    if image is None:
        side = MAX_IMAGE_SIDE
        raise DatasetError(f"{path} cannot be decoded; expected {what} of at most {side}×{side} pixels")
    return image


def decode_image(file: BinaryIO, flags: int) -> NDArray[Any] | None:
    """Decode an image file by OpenCV's `flags`. Return None if it is damaged or far too large.

    Pixels come as stored, because calibrations and depth refer to stored pixels: an EXIF orientation is
    ignored. OpenCV trusts an image of a few bytes that claims gigabytes of pixels. For PNG and JPEG the size
    is checked here; for others the command sets a limit. libpng prints its complaints. So a PNG is checked
    first, and chunks that its pixels do not need are not read.
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
    """Return all bytes of an image that is no PNG, or None if the image is far too large."""
    nbytes = file.seek(0, SEEK_END)
    file.seek(0)
    content = file.read() if nbytes <= limits.MAX_FILE_BYTES else b""
    with suppress(Refused):  # no JPEG, or an ambiguous one
        if max(array_encoding.image_size(content)) > MAX_IMAGE_SIDE:
            return None
    return content


def _png_of_pixels(file: BinaryIO) -> bytes | None:
    """Return a PNG with only the chunks that change pixels, or None if it is damaged or far too large."""
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
    """Read (H, W, 3) uint8 BGR. It must have the depth image's `shape`, unless that is None.

    Colour of a phone, `PHONE_SCALE` times as large as its depth or larger, is made as small as the depth.
    """
    color: NDArray[np.uint8] = read_image(path, "a colour image", cv2.IMREAD_COLOR)
    if shape is not None and color.shape[:2] != shape:
        rows, columns = shape[:2]
        if color.shape[0] >= PHONE_SCALE * rows and color.shape[0] * columns == color.shape[1] * rows:
            return np.asarray(cv2.resize(color, (columns, rows), interpolation=cv2.INTER_AREA), np.uint8)
        cure = turned_by_exif(path, color.shape, shape) or "register colour and depth before"
        raise DatasetError(
            f"{path} is {color.shape[1]}×{color.shape[0]}, its depth image {shape[1]}×{shape[0]}; "
            f"expected equal sizes: {cure}, or leave the colour out (--option color=false)"
        )
    return color


def turned_by_exif(path: Path, stored: Sequence[int], shape: Sequence[int]) -> str:
    """Return advice if only its EXIF orientation turns a JPEG of the size `stored` to `shape`; else ""."""
    if tuple(stored[:2]) != tuple(shape[1::-1]) or path.suffix.lower() == ".png":
        return ""
    shown = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if shown is None or shown.shape[:2] != tuple(shape[:2]):
        return ""
    return "pixels count as stored, and an EXIF orientation turns these: save the images turned"


def intrinsics_of(K: NDArray[np.float64], source: object) -> Intrinsics:
    """Return the checked intrinsics of a camera or projection matrix. `source`: its name in an error.

    A matrix with skew is refused: such images must be undistorted first.
    """
    if abs(K[0, 1]) > MAX_NO_SKEW:
        raise DatasetError(
            f"{source}: the matrix has a skew of {K[0, 1]:.4g} px, which is not used here: rectify the "
            "images, or give their --calibration FILE"
        )
    return checked_intrinsics(Intrinsics(*map(float, (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))), source)


def checked_intrinsics(intrinsics: Intrinsics, source: object) -> Intrinsics:
    """Return valid intrinsics, or raise an error that names the `source`."""
    with errors_as(DatasetError, source, InvalidKeyframe):
        check_intrinsics(intrinsics)
    return intrinsics


def read_depth(path: Path, *, invalid: int | None = None) -> NDArray[Any]:
    """Read (H, W) depth: uint16 in the recording's units, with 0 for `invalid`, or float32 as stored.

    Raises:
        DatasetError: there is no such file, or it is not one channel of 16 bits or floats.
        MissingDependency: the OpenEXR package is not installed, for EXR.
    """
    depth = _stored(path)
    depth = depth.astype(depth.dtype.newbyteorder("="), copy=False)
    if (
        depth.ndim == 3
        and (depth.shape[2] == 1 or depth.dtype.kind == "f")
        and (depth == depth[:, :, :1]).all()
    ):
        depth = depth[:, :, 0]  # grey, as floats are often written
    if depth.dtype.kind in "iu" and depth.dtype.itemsize > 2 and (depth == depth.astype(np.uint16)).all():
        depth = depth.astype(np.uint16)
    if depth.ndim != 2 or depth.dtype not in (np.uint16, np.float16, np.float32, np.float64):
        raise DatasetError(f"{path} must hold one 16-bit channel or floats, got {_described(depth)}")
    if depth.dtype != np.uint16:
        with np.errstate(over="ignore"):
            return np.ascontiguousarray(depth, dtype=np.float32)
    if invalid is not None:
        depth[depth == invalid] = 0
    return np.ascontiguousarray(depth, dtype=np.uint16)


def check_metres(depth: NDArray[np.float32], source: object) -> None:
    """Raise DatasetError if floats are clearly not metres: their median is above 100 m, or below 1 cm."""
    some = depth[::_EVERY, ::_EVERY]
    valid = some[np.isfinite(some) & (some > 0)]
    middle = float(np.median(valid)) if valid.size else 1.0
    if NEAREST_M <= middle <= FARTHEST_M:
        return
    unit, scale = ("millimetres", "0.001") if middle > FARTHEST_M else ("divided once too often", "1")
    raise DatasetError(
        f"{source}: depth is expected in metres, but the median of its floats is {middle:.5g}: {unit}? "
        f"then give --option depth_scale={scale} (in Python depth_scale={scale})"
    )


def check_byte_order(depth: NDArray[Any], source: object) -> None:
    """Raise DatasetError if (H, W) uint16 depth is far smoother after an exchange of its bytes."""
    if depth.dtype != np.uint16 or not (depth & 0xFF).any():  # floats, or multiples of 256
        return
    rows = depth[::_EVERY]
    both = (rows[:, 1:] > 0) & (rows[:, :-1] > 0)
    if np.count_nonzero(both) < _FEWEST_STEPS:
        return
    steps, exchanged = (
        np.abs(np.diff(image.astype(np.int32), axis=1))[both].mean() for image in (rows, rows.byteswap())
    )
    if steps > _SMOOTHER * exchanged:
        raise DatasetError(
            f"{source}: the two bytes of each depth value are exchanged (neighbours differ by {steps:.0f}, "
            f"after exchanging them by {exchanged:.0f}): write the depth anew in the PNG's own byte order, "
            "big-endian (numpy's `byteswap()` mends what was read)"
        )


def read_npy(path: Path) -> NDArray[Any]:
    """Read the array of a `.npy` file. Raises DatasetError."""
    try:  # NumPy compares the array's size with the file's
        found = np.lib.format.open_memmap(path, mode="r")
        limits.check(path, found.nbytes)
        return np.array(found)
    except FileNotFoundError as error:
        raise DatasetError(f"{path} is missing; expected an (H, W) array of depth") from error
    except (OSError, ValueError, EOFError) as error:
        raise DatasetError(f"{path} cannot be read; expected an (H, W) array of depth ({error})") from error


def _stored(path: Path) -> NDArray[Any]:
    suffix = path.suffix.lower()
    if suffix == ".npy":
        return read_npy(path)
    return _read_exr(path) if suffix == ".exr" else read_image(path, "a depth image")


def _read_exr(path: Path) -> NDArray[Any]:
    """Read an EXR image's only channel, (H, W), or several of one size, (H, W, channels), without alpha."""
    if not path.is_file():
        raise DatasetError(f"{path} is missing; expected a depth image")
    with needing(f"{path}: EXR needs OpenEXR: pip install '.[exr]'"):
        import OpenEXR
    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            for part in file.parts:
                low, high = part.header["dataWindow"]
                pixels = np.prod(np.subtract(high, low, dtype=float) + 1)
                limits.check(path, 4 * len(part.header["channels"]) * pixels)
        with OpenEXR.File(str(path), separate_channels=True) as file:
            channels = [channel.pixels for name, channel in file.channels().items() if name != "A"]
        return channels[0] if len(channels) == 1 else np.dstack(channels)
    except (RuntimeError, ValueError, IndexError, OSError) as error:
        raise DatasetError(f"{path} cannot be decoded; expected a depth image ({error})") from error


def _described(image: NDArray[Any]) -> str:
    """Return a description of an image, for an error that it is no depth."""
    shape = f"shape {image.shape} of {image.dtype}"
    if image.ndim == 3 and image.dtype == np.uint8:
        return f"{shape}: a colour image"
    return f"{shape} (was it saved again as 8 bits?)" if image.dtype == np.uint8 else shape
