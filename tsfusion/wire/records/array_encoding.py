# SPDX-License-Identifier: MIT
"""Arrays to bytes and back, without loss except for JPEG.

`dzp+zstd`: difference to the previous element (of the bit patterns, modulo 2^width) → zigzag → byte
planes → zstd level 1. Neighbours in a depth image are alike, so the high planes are nearly empty.
`mm+dzp+zstd`: float32 metres that are whole millimetres, as int32.
"""

import math
from typing import Any

import numpy as np
import zstandard
from numpy.typing import NDArray

from tsfusion.wire.records import image_headers
from tsfusion.wire.records.record_header import Refused

_ZSTD_LEVEL = 1
_SAMPLE = 512
_CV_NO_MEMORY = -4  # cv::Error::StsNoMem
_MM_LIMIT = 2**31 - 1


def pack(array: NDArray[Any]) -> bytes:
    """`dzp+zstd` of an array of 1-, 2- or 4-byte elements; (n, 3) points go column by column."""
    planes = _planes(_zigzag(_bits(array)))
    return zstandard.ZstdCompressor(level=_ZSTD_LEVEL).compress(planes.data)


def unpack(frame: Any, dtype: np.dtype[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    """Undo `pack`.

    Raises:
        Refused: `payload` unless the frame holds exactly this array.
    """
    size = math.prod(shape) * dtype.itemsize
    check_zstd(frame, size)
    try:
        planes = zstandard.ZstdDecompressor().decompress(
            frame, max_output_size=max(size, 1), allow_extra_data=False
        )
    except zstandard.ZstdError as error:
        raise Refused("payload", f"not a whole zstd frame: {error}") from error
    if len(planes) != size:
        raise Refused("payload", f"an array of {size} bytes was announced, got {len(planes)}")
    return _unbits(_unzigzag(_unplanes(planes, dtype.itemsize)), dtype, shape)


def pack_mm(points: NDArray[np.float32]) -> bytes | None:
    """`mm+dzp+zstd` of (n, 3) float32 metres, or None unless that gives the same floats back to the bit."""
    if not _whole_mm(points[:_SAMPLE]) or not _whole_mm(points):
        return None
    return pack(_to_mm(points))


def unpack_mm(frame: Any, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Undo `pack_mm`."""
    return _from_mm(unpack(frame, np.dtype(np.int32), shape))


def pack_jpeg(image: NDArray[np.uint8], quality: int) -> bytes:
    """(H, W, 3) uint8 BGR as JPEG."""
    import cv2  # who sends no images does without its 16 MB

    _, encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return bytes(encoded)


def unpack_image(frame: Any, dtype: np.dtype[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    """A JPEG or PNG whose file header was checked to announce `shape` (see `image_headers.size`).

    Raises:
        Refused: `payload` unless it decodes to exactly that array, `limits` for a PNG that unfolds to more.
    """
    import cv2

    image_headers.check_unfolding(frame)
    color = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION  # the other has no orientation either
    flags = color if len(shape) == 3 else cv2.IMREAD_UNCHANGED
    try:
        image = cv2.imdecode(np.frombuffer(frame, np.uint8), flags)
    except cv2.error as error:
        if error.code == _CV_NO_MEMORY:
            raise MemoryError(f"an image {shape} {dtype}") from error
        raise Refused("payload", f"not a readable image: {error}") from error
    if image is None or image.shape != shape or image.dtype != dtype:
        got = "nothing" if image is None else f"{image.shape} {image.dtype}"
        raise Refused("payload", f"an image {shape} {dtype} was announced, got {got}")
    return np.asarray(image)


def check_zstd(frame: Any, size: int) -> None:
    """Raise Refused (`limits`) unless the zstd frame says it holds exactly `size` bytes.

    The decompressor obeys the size in the frame over any limit it is given, so this comes first.
    """
    try:
        stated = zstandard.get_frame_parameters(frame).content_size
    except zstandard.ZstdError as error:
        raise Refused("payload", f"not a zstd frame: {error}") from error
    if stated != size:
        raise Refused("limits", f"an array of {size} bytes was announced, the zstd frame states {stated}")


def _bits(array: NDArray[Any]) -> NDArray[Any]:
    flat = np.ascontiguousarray(array.T if _by_column(array.shape) else array).reshape(-1)
    return flat.view(f"u{flat.dtype.itemsize}")


def _unbits(bits: NDArray[Any], dtype: np.dtype[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    array = bits.view(dtype)
    if _by_column(shape):
        return np.ascontiguousarray(array.reshape(shape[::-1]).T)
    return array.reshape(shape)


def _by_column(shape: tuple[int, ...]) -> bool:
    return len(shape) == 2 and shape[1] == 3


def _zigzag(bits: NDArray[Any]) -> NDArray[Any]:
    difference = bits.copy()
    np.subtract(bits[1:], bits[:-1], out=difference[1:])
    signed: NDArray[Any] = difference.view(f"i{bits.dtype.itemsize}")
    folded: NDArray[Any] = (signed << 1) ^ (signed >> (8 * bits.dtype.itemsize - 1))
    return folded.view(bits.dtype)


def _unzigzag(zigzag: NDArray[Any]) -> NDArray[Any]:
    sign = np.negative(zigzag & 1)
    bits: NDArray[Any] = np.cumsum((zigzag >> 1) ^ sign, dtype=zigzag.dtype)
    return bits


def _planes(values: NDArray[Any]) -> NDArray[np.uint8]:
    """The bytes of n unsigned integers, (size, n) uint8. Shifts are several times faster than a transpose."""
    planes = np.empty((values.dtype.itemsize, len(values)), np.uint8)
    for byte, plane in enumerate(planes):
        np.right_shift(values, 8 * byte, out=plane, casting="unsafe")
    return planes


def _unplanes(planes: bytes, itemsize: int) -> NDArray[Any]:
    rows = np.frombuffer(planes, np.uint8).reshape(itemsize, -1)
    values: NDArray[Any] = rows[0].astype(f"u{itemsize}")
    for byte in range(1, itemsize):
        values |= rows[byte].astype(values.dtype) << (8 * byte)
    return values


def _to_mm(points: NDArray[np.float32]) -> NDArray[np.int32]:
    mm: NDArray[np.int32] = np.rint(points.astype(np.float64) * 1000).astype(np.int32)
    return mm


def _from_mm(mm: NDArray[np.int32]) -> NDArray[np.float32]:
    return np.divide(mm, 1000.0).astype(np.float32)


def _whole_mm(points: NDArray[np.float32]) -> bool:
    # Comparisons with NaN are false, so this also keeps NaN and infinity out of the cast.
    if not bool((np.abs(points) < _MM_LIMIT / 1000).all()):
        return False
    return bool(np.array_equal(_from_mm(_to_mm(points)).view(np.uint32), points.view(np.uint32)))
