# SPDX-License-Identifier: MIT
"""Encode arrays as bytes and back, without loss except for JPEG.

`dzp+zstd` does four steps. It takes differences to the previous element (of the bit patterns, modulo
2^width). Zigzag coding makes them unsigned. Byte planes group the bytes of equal rank. zstd level 1 packs
them. Neighbours in a depth image are alike, so the high planes are nearly empty. `mm+dzp+zstd`: float32
metres that are whole millimetres, as int32.
"""

import math
import re
import struct
import zlib
from collections.abc import Iterator
from itertools import islice
from typing import Any

import numpy as np
import zstandard
from numpy.typing import NDArray

from tsfusion.wire.records.record_header import Refused

_PNG = b"\x89PNG\r\n\x1a\n"
_PNG_HEADER = struct.Struct(">I4sIIBBBBB")  # length, kind, width, height, bits, colour, then three methods
_PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # by colour
_WORST_RATIO = 1032  # best compression of deflate
_FEW_TIMES = 4  # data that cannot unfold to more than so many times the image needs no check
_PIECE = 1 << 20  # bytes unfolded at a time
_PNG_CHUNK = struct.Struct(">I4s")
_PNG_AROUND = 12  # bytes of a chunk besides its content
# No animation (other sizes), and nothing compressed but the image: zTXt, iTXt, iCCP unfold at will.
_PNG_KINDS = frozenset(b"PLTE IDAT tRNS gAMA cHRM sRGB sBIT bKGD pHYs tIME tEXt oFFs".split())
_MAX_PNG_CHUNKS = 1 << 14  # writers of PNG start a new chunk every 8 kB or more

_JPEG = b"\xff\xd8"
_JPEG_FRAMES = frozenset((0xC0, 0xC1, 0xC2))  # baseline, extended, progressive
_JPEG_SEGMENTS = frozenset((0xC4, 0xDB, 0xDD, 0xFE, *range(0xE0, 0xF0)))  # tables, comments, application data
_MAX_JPEG_SEGMENTS = 1024  # before the frame header; a colour profile is the longest, with 255
_MAX_SCANS = 64  # a decoder goes over the whole image for each, however short it is; ten are usual
_SCAN = re.compile(rb"\xff\xda")


def image_size(frame: Any) -> tuple[int, int]:
    """Read (height, width) of a PNG or JPEG without decoding it, more strictly than decoders do.

    OpenCV's decoders believe the headers: a PNG of fifty bytes can make them take two gigabytes. A JPEG can
    state two different sizes. So this accepts only files that can be read in a single way.

    Raises:
        Refused: `payload` when the frame is no PNG or JPEG, or could cost a decoder more than an image of
            that size.
    """
    view = memoryview(frame)
    head = bytes(view[:8])
    if head == _PNG:
        return _png_size(view)
    if head[:2] == _JPEG:
        return _jpeg_size(view)
    raise Refused("payload", "neither a PNG nor a JPEG")


def check_unfolding(frame: Any) -> None:
    """Check that a PNG decompresses to the pixels of its image and no more. Call it after `image_size`.

    A decoder also unpacks data after the last pixel: 4 MB of it take 14 seconds. This check takes up to two
    thirds of the time of decoding. It is skipped where the file is too small to grow to much more.

    Raises:
        Refused: `limits` for more or fewer pixels than the image has, `payload` for data that is not
            compressed.
    """
    view = memoryview(frame)
    if bytes(view[:8]) != _PNG:
        return
    _, _, width, height, bits, color, *_ = _PNG_HEADER.unpack_from(view, len(_PNG))
    expected = height * (1 + (width * bits * _PNG_CHANNELS.get(color, 4) + 7) // 8)
    parts = [view[at : at + length] for kind, at, length in _chunks(view) if kind == b"IDAT"]
    if sum(part.nbytes for part in parts) * _WORST_RATIO > _FEW_TIMES * expected:
        _check_inflated(parts, expected)


def _check_inflated(parts: list[memoryview], expected: int) -> None:
    """Raise Refused unless these parts decompress to exactly `expected` bytes. The bytes are not kept."""
    inflater, size = zlib.decompressobj(), 0
    try:
        for part in parts:
            rest: Any = part
            while rest and size <= expected:
                size += len(inflater.decompress(rest, min(_PIECE, expected + 1 - size)))
                rest = inflater.unconsumed_tail
            if inflater.unused_data:
                raise Refused("limits", "a PNG with data after its pixels")
    except zlib.error as error:
        raise Refused("payload", f"a PNG whose pixels are not compressed as they must be: {error}") from error
    if size != expected:
        more = "more" if size > expected else "fewer"
        raise Refused("limits", f"a PNG that decompresses to {more} bytes than the {expected} of its image")


def _png_size(view: memoryview) -> tuple[int, int]:
    if view.nbytes < len(_PNG) + _PNG_HEADER.size:
        raise Refused("payload", "a PNG that is cut short")
    length, kind, width, height, _, _, *methods = _PNG_HEADER.unpack_from(view, len(_PNG))
    if (length, kind) != (13, b"IHDR"):
        raise Refused("payload", f"a PNG begins with its header, got {kind!r}")
    if any(methods):
        raise Refused("payload", "an interlaced PNG: save it without interlacing")
    for kind, _, _ in _chunks(view):
        if kind not in _PNG_KINDS:
            raise Refused("payload", f"a PNG with a chunk {kind!r}: save it again without")
    return int(height), int(width)


def _chunks(view: memoryview) -> Iterator[tuple[bytes, int, int]]:
    """Yield kind, offset of the content, and length of each chunk of a PNG between its header and its end.

    Raises:
        Refused: `payload` for too many chunks, or no end.
    """
    at, length = len(_PNG), 13
    for _ in range(_MAX_PNG_CHUNKS):
        at += length + _PNG_AROUND
        if at + _PNG_AROUND > view.nbytes:
            raise Refused("payload", "a PNG that is cut short")
        length, kind = _PNG_CHUNK.unpack_from(view, at)
        if kind == b"IEND":
            return
        yield kind, at + _PNG_CHUNK.size, length
    raise Refused("payload", "a PNG of too many chunks")


def _jpeg_size(view: memoryview) -> tuple[int, int]:
    if sum(1 for _ in islice(_SCAN.finditer(view), _MAX_SCANS + 1)) > _MAX_SCANS:
        raise Refused("payload", f"a JPEG of more than {_MAX_SCANS} scans")
    at = len(_JPEG)
    for _ in range(_MAX_JPEG_SEGMENTS):  # 32 MB of tiny segments would take seconds
        if at + 9 > view.nbytes or view[at] != 0xFF:
            break
        marker, length = view[at + 1], int.from_bytes(view[at + 2 : at + 4], "big")
        if marker in _JPEG_FRAMES:
            height, width = struct.unpack(">HH", view[at + 5 : at + 9])
            return height, width
        if marker not in _JPEG_SEGMENTS:
            raise Refused("payload", f"a JPEG with marker {marker:02x} before its frame header")
        if length < 2:
            break
        at += 2 + length
    raise Refused("payload", "a JPEG without a frame header")


_ZSTD_LEVEL = 1
_SAMPLE = 512
_CV_NO_MEMORY = -4  # cv::Error::StsNoMem
_MM_LIMIT = 2**31 - 1


def pack(array: NDArray[Any]) -> bytes:
    """Encode an array of 1-, 2- or 4-byte elements as `dzp+zstd`; (n, 3) points go column by column."""
    planes = _planes(_zigzag(_bits(array)))
    return zstandard.ZstdCompressor(level=_ZSTD_LEVEL).compress(planes.data)


def unpack(frame: Any, dtype: np.dtype[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    """Decode bytes of `dzp+zstd` to an array.

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
    """Encode (n, 3) float32 metres as `mm+dzp+zstd`; None if decoding would not give the same bits."""
    if not _whole_mm(points[:_SAMPLE]) or not _whole_mm(points):
        return None
    return pack(_to_mm(points))


def unpack_mm(frame: Any, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Decode bytes of `mm+dzp+zstd` to (n, 3) float32 metres."""
    return _from_mm(unpack(frame, np.dtype(np.int32), shape))


def pack_jpeg(image: NDArray[np.uint8], quality: int) -> bytes:
    """Encode a (H, W, 3) uint8 BGR image as JPEG."""
    import cv2  # imported late: a sender without images saves its 16 MB

    _, encoded = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return bytes(encoded)


def unpack_image(frame: Any, dtype: np.dtype[Any], shape: tuple[int, ...]) -> NDArray[Any]:
    """Decode a JPEG or PNG after `image_size` found `shape` in its header.

    Raises:
        Refused: `payload` unless it decodes to exactly that array, `limits` for a PNG with more data.
    """
    import cv2

    check_unfolding(frame)
    color = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION  # IMREAD_UNCHANGED ignores it, too
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
    """Raise Refused (`limits`) unless the zstd frame states exactly `size` bytes.

    The decompressor trusts the size in the frame more than its own limit, so this check comes first.
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
    """Return the bytes of n unsigned integers as byte planes, (size, n) uint8. A transpose is far slower."""
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
