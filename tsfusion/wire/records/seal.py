# SPDX-License-Identifier: MIT
"""Seal of a message: its CRC-32, as one more entry at the end of its msgpack map.

TCP's own checksum misses one damaged segment in 65536, and a relay may damage what it carries between two
connections. Keys authenticate every byte; without keys, a number or a pose would be changed unnoticed.
Readers that do not know the entry skip it; a message may be without one.
"""

import zlib
from typing import Any

_MARK = b"\xa5check\xc4\x04"  # the key, and the head of a value of four bytes
_CRC_BYTES = 4
_MOST_WORN = 4  # bits of its 64 by which a mark may differ and be one: of random bytes 1 in 10¹³ come so near
_FIXMAP, _MOST_IN_FIXMAP, _MAP16 = 0x80, 15, 0xDE  # of the msgpack format


def seal(message: bytes) -> bytes:
    """A message, a msgpack map of less than 65535 entries, with its seal."""
    if message[0] == _MAP16:
        count, entries = int.from_bytes(message[1:3], "big"), message[3:]
    else:
        count, entries = message[0] - _FIXMAP, message[1:]
    count += 1
    head = (
        bytes([_FIXMAP + count]) if count <= _MOST_IN_FIXMAP else bytes([_MAP16, *count.to_bytes(2, "big")])
    )
    sealed = head + entries + _MARK
    return sealed + zlib.crc32(sealed).to_bytes(_CRC_BYTES, "big")


def is_damaged(message: Any) -> bool:
    """True if a message (any bytes-like object) carries a seal that does not fit it.

    A seal whose mark is changed counts, too: without it nobody would look whether the rest is as it was sent.
    """
    view = memoryview(message)
    sealed, crc = view[:-_CRC_BYTES], view[-_CRC_BYTES:]
    mark = bytes(sealed[-len(_MARK) :])
    if mark != _MARK:
        worn = int.from_bytes(mark, "big") ^ int.from_bytes(_MARK, "big")
        return worn.bit_count() <= _MOST_WORN
    return zlib.crc32(sealed).to_bytes(_CRC_BYTES, "big") != crc
