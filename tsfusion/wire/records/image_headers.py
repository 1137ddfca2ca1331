# SPDX-License-Identifier: MIT
"""The size of a PNG or JPEG, and what a PNG unfolds to: read before decoding, more strictly than decoders do.

OpenCV's decoders believe what they read: a PNG of fifty bytes can have them take two gigabytes, and a JPEG
can have one size here and another one there. So only files are accepted that can be read in one way alone.
"""

import re
import struct
import zlib
from collections.abc import Iterator
from itertools import islice
from typing import Any

from tsfusion.wire.records.record_header import Refused

_PNG = b"\x89PNG\r\n\x1a\n"
_PNG_HEADER = struct.Struct(">I4sIIBBBBB")  # length, kind, width, height, bits, colour, then three methods
_PNG_CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}  # by colour
_WORST_RATIO = 1032  # that deflate reaches
_FEW_TIMES = 4  # what unfolds to so many times its image, at most, is not looked into
_PIECE = 1 << 20  # bytes unfolded at a time
_PNG_CHUNK = struct.Struct(">I4s")
_PNG_AROUND = 12  # bytes of a chunk besides its content
# No animation (other sizes), and nothing compressed but the image: zTXt, iTXt, iCCP unfold at will.
_PNG_KINDS = frozenset(b"PLTE IDAT tRNS gAMA cHRM sRGB sBIT bKGD pHYs tIME tEXt oFFs".split())
_MAX_PNG_CHUNKS = 1 << 14  # writers of PNG begin a new one every 8 kB or more

_JPEG = b"\xff\xd8"
_JPEG_FRAMES = frozenset((0xC0, 0xC1, 0xC2))  # baseline, extended, progressive
_JPEG_SEGMENTS = frozenset((0xC4, 0xDB, 0xDD, 0xFE, *range(0xE0, 0xF0)))  # tables, comments, application data
_MAX_JPEG_SEGMENTS = 1024  # before the frame header; a colour profile is the longest, with 255
_MAX_SCANS = 64  # each goes over the whole image, however short it is; ten are usual
_SCAN = re.compile(rb"\xff\xda")


def size(frame: Any) -> tuple[int, int]:
    """Read (height, width) of a PNG or JPEG without decoding it.

    Raises:
        Refused: `payload` when it is neither, or could cost its decoder more than an image of that size.
    """
    view = memoryview(frame)
    head = bytes(view[:8])
    if head == _PNG:
        return _png_size(view)
    if head[:2] == _JPEG:
        return _jpeg_size(view)
    raise Refused("payload", "neither a PNG nor a JPEG")


def check_unfolding(frame: Any) -> None:
    """Check that a PNG holds the pixels of its image and no more; `size` has checked the rest.

    A decoder unfolds what follows the last pixel, too: 4 MB of it take 14 seconds. This takes up to two
    thirds of the time of decoding, and none where so few bytes cannot unfold to much more.

    Raises:
        Refused: `limits` for more or fewer pixels than the image has, `payload` for what is not compressed.
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
    """Raise Refused unless these bytes unfold to exactly so many, which are not kept."""
    inflater, size = zlib.decompressobj(), 0
    try:
        for part in parts:
            rest: Any = part
            while rest and size <= expected:
                size += len(inflater.decompress(rest, min(_PIECE, expected + 1 - size)))
                rest = inflater.unconsumed_tail
            if inflater.unused_data:
                raise Refused("limits", "a PNG with more behind its pixels")
    except zlib.error as error:
        raise Refused("payload", f"a PNG whose pixels are not compressed as they must be: {error}") from error
    if size != expected:
        more = "more" if size > expected else "fewer"
        raise Refused("limits", f"a PNG that unfolds to {more} bytes than the {expected} of its image")


def _png_size(view: memoryview) -> tuple[int, int]:
    if view.nbytes < len(_PNG) + _PNG_HEADER.size:
        raise Refused("payload", "a PNG that is cut short")
    length, kind, width, height, _, _, *methods = _PNG_HEADER.unpack_from(view, len(_PNG))
    if (length, kind) != (13, b"IHDR"):
        raise Refused("payload", f"a PNG begins with its header, got {kind!r}")
    if any(methods):
        raise Refused("payload", "a PNG that is interlaced: save it again without")
    for kind, _, _ in _chunks(view):
        if kind not in _PNG_KINDS:
            raise Refused("payload", f"a PNG with a chunk {kind!r}: save it again without")
    return int(height), int(width)


def _chunks(view: memoryview) -> Iterator[tuple[bytes, int, int]]:
    """Kind, place of the content and length of each chunk between header and end.

    Raises:
        Refused: `payload` for too many, or no end.
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
    for _ in range(_MAX_JPEG_SEGMENTS):  # 32 MB of tiny ones would take seconds
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
