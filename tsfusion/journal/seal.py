# SPDX-License-Identifier: MIT
"""The end of a closed segment: summary, footer, magic. Readers here can do without; damage to it is told."""

import struct
import zlib
from typing import Literal

from mcap.opcode import Opcode
from msgspec import Struct

from tsfusion.journal.layout import END_OF_DATA, MAGIC
from tsfusion.journal.source import Source

_FOOTER = struct.Struct("<BQQQI")  # opcode, length, start of the summary, start of its offsets, CRC
_RECORD = struct.Struct("<BQ")
_COUNT = struct.Struct("<Q")
_MAX_SUMMARY_BYTES = 1 << 28


class Seal(Struct, frozen=True):
    """What the end of a segment says.

    `open`: it was never closed, or the cut went through its end. `broken`: closed, and damaged since.
    """

    state: Literal["whole", "broken", "open"]
    data_end: int | None = None  # where the last record ends
    keyframes: int | None = None  # that the segment held when it was closed


def read(source: Source) -> Seal:
    """Look at the end of a segment."""
    closing = (
        source.read(source.size - len(MAGIC), len(MAGIC)) == MAGIC if source.size > len(MAGIC) else False
    )
    at = source.size - len(MAGIC) - _FOOTER.size
    summary = _summary(source, at) if at > 0 else None
    if summary is None:
        return Seal("broken" if closing else "open")
    start, content = summary
    keyframes = _keyframes(content)
    return Seal("whole" if closing else "broken", start - len(END_OF_DATA), keyframes)


def _summary(source: Source, footer_at: int) -> tuple[int, bytes] | None:
    """Where the summary starts, and its bytes; None unless its CRC agrees."""
    footer = source.read(footer_at, _FOOTER.size)
    opcode, length, start, _, crc32 = _FOOTER.unpack(footer)
    if (opcode, length) != (Opcode.FOOTER, _FOOTER.size - _RECORD.size):
        return None
    if not len(END_OF_DATA) + len(MAGIC) < start <= footer_at or footer_at - start > _MAX_SUMMARY_BYTES:
        return None
    content = source.read(start, footer_at - start)
    return (start, content) if zlib.crc32(footer[:-4], zlib.crc32(content)) == crc32 else None


def _keyframes(summary: bytes) -> int | None:
    """The keyframes that the statistics count: all messages but the segment's own first one."""
    at = 0
    while at + _RECORD.size + _COUNT.size <= len(summary):
        opcode, length = _RECORD.unpack_from(summary, at)
        if opcode == Opcode.STATISTICS:
            return int(_COUNT.unpack_from(summary, at + _RECORD.size)[0]) - 1
        at += _RECORD.size + length
    return None
