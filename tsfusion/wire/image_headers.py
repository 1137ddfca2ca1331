# SPDX-License-Identifier: MIT
"""The size in the header of a PNG or JPEG, read before decoding and more strictly than decoders do.

OpenCV's decoders believe what they read: a PNG of fifty bytes can have them take two gigabytes, and a JPEG
can have one size here and another one there. So only files are accepted that can be read in one way alone.
"""

import re
import struct
from itertools import islice
from typing import Any

from tsfusion.wire.record_header import Refused

_PNG = b"\x89PNG\r\n\x1a\n"
_PNG_HEADER = struct.Struct(">I4sII")  # length, kind, width, height
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


def _png_size(view: memoryview) -> tuple[int, int]:
    at = len(_PNG)
    if view.nbytes < at + _PNG_HEADER.size:
        raise Refused("payload", "a PNG that is cut short")
    length, kind, width, height = _PNG_HEADER.unpack_from(view, at)
    if (length, kind) != (13, b"IHDR"):
        raise Refused("payload", f"a PNG begins with its header, got {kind!r}")
    for _ in range(_MAX_PNG_CHUNKS):
        at += length + _PNG_AROUND
        if at + _PNG_AROUND > view.nbytes:
            raise Refused("payload", "a PNG that is cut short")
        length, kind = _PNG_CHUNK.unpack_from(view, at)
        if kind == b"IEND":
            return height, width
        if kind not in _PNG_KINDS:
            raise Refused("payload", f"a PNG with a chunk {kind!r}: save it again without")
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
