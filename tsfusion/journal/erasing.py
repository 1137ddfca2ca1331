# SPDX-License-Identifier: MIT
"""Erase records from a closed segment file: zeros replace their bytes, and all other records keep their
offsets.

One MCAP record of a private opcode replaces an erased record, its chunk and its index. It is equally long,
and MCAP readers skip it. It names the erased record, so the server does not take that record again from its
client.

    opcode, length | mark | segment's identity | session | seq | client | CRC | zeros

Erasing first removes the index at the end of the segment, and last writes a new one. A crash in between
leaves a segment without an index, as a killed server does. The next run then continues.
"""

import ctypes
import os
import struct
import zlib
from collections.abc import Collection, Iterator
from contextlib import suppress
from io import FileIO
from pathlib import Path
from typing import NamedTuple

from mcap.opcode import Opcode

from tsfusion.core.errors import JournalError
from tsfusion.journal import mcap_layout, record_scan
from tsfusion.journal.segments import SegmentFile, journal_errors

_PIECE_BYTES = 4 << 20
_PUNCH_HOLE = 0x01 | 0x02  # FALLOC_FL_KEEP_SIZE | FALLOC_FL_PUNCH_HOLE
_ZEROS = bytes(1 << 20)


def erase(path: Path, offsets: Collection[int]) -> Iterator[int]:
    """Erase the records at these byte offsets of a closed segment, a piece at a time.

    Yields:
        The number of records erased so far; after the last step the changes are on the disk.

    Raises:
        JournalError: an offset has neither a record nor an erased record, or the disk refuses.
    """
    with journal_errors("erase records of", path), path.open("r+b", buffering=0) as file:
        with SegmentFile(path) as source:
            places = [_place(source, offset) for offset in sorted(offsets)]
            end = record_scan.read_segment_end(source)
            summary = _summary(source, end, {one.offset for one in places})
        if summary is not None:
            file.truncate(summary[0])
            os.fdatasync(file.fileno())
        for one in places:
            _write(file, one.mark, one.offset)
        os.fdatasync(file.fileno())  # from now on, readers see these records as erased
        yield from _clear(file, places)
        if summary is not None:
            _write(file, summary[1], summary[0])
        os.fsync(file.fileno())


class _RecordPlace(NamedTuple):
    offset: int
    nbytes: int
    mark: bytes  # first bytes of the erased record


def _place(source: SegmentFile, offset: int) -> _RecordPlace:
    raw = source.read(offset, mcap_layout.HEAD_BYTES)
    if (erased := mcap_layout.parse_erased(raw)) is not None:
        return _RecordPlace(offset, erased.nbytes, raw[: mcap_layout.ERASED_BYTES])
    head = mcap_layout.parse_head(raw)
    if head is None or offset + head.nbytes > source.size:
        raise JournalError(f"{source.path} holds no whole record at byte {offset}: it is not erased")
    index = head.message_index
    has_index = source.read(offset + head.nbytes, len(index)) == index
    nbytes = head.nbytes + (len(index) if has_index else 0)
    return _RecordPlace(offset, nbytes, mcap_layout.erased_mark(head, nbytes))


def _write(file: FileIO, content: bytes, at: int) -> None:
    view = memoryview(content)
    while view:
        written = os.pwrite(file.fileno(), view, at)
        at, view = at + written, view[written:]


def _clear(file: FileIO, places: list[_RecordPlace]) -> Iterator[int]:
    """Overwrite records with zeros, except the marks at their starts that name the erased records."""
    unsynced = 0
    for number, one in enumerate(places, 1):
        at, end = one.offset + len(one.mark), one.offset + one.nbytes
        while at < end:
            piece = _ZEROS[: end - at]
            _write(file, piece, at)
            at += len(piece)
            unsynced += len(piece)
            if unsynced >= _PIECE_BYTES:
                os.fdatasync(file.fileno())
                unsynced = 0
                yield number - 1
    os.fdatasync(file.fileno())
    for one in places:
        _give_back(file, one.offset + len(one.mark), one.nbytes - len(one.mark))
    yield len(places)


def _give_back(file: FileIO, at: int, nbytes: int) -> None:
    """Release the disk space of zeros where the system can (Linux); the bytes still read as zeros."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).fallocate(file.fileno(), _PUNCH_HOLE, ctypes.c_int64(at), ctypes.c_int64(nbytes))


# --- the index at the end ---

_RECORD = struct.Struct("<BQ")  # opcode, length
_CHUNK_INDEX_START = struct.Struct("<QQQ")  # first and last time, offset of the chunk
_STATISTICS = struct.Struct("<QHIIIIQQI")  # messages, …, chunks, first and last time, bytes of the counts
_CHANNEL_COUNT = struct.Struct("<HQ")
_GROUP = struct.Struct("<BQQ")  # opcode, start, length
_FOOTER = struct.Struct("<BQQQI")


def _summary(source: SegmentFile, end: record_scan.SegmentEnd, erased: set[int]) -> tuple[int, bytes] | None:
    """Return where a segment's end-of-data mark begins, and this mark with a new index; None without one."""
    if end.data_end is None:
        return None
    start = end.data_end + len(mcap_layout.END_OF_DATA)
    content = source.read(start, source.size - start)
    groups: dict[int, list[bytes]] = {}
    at = 0
    while at + _RECORD.size <= len(content):
        opcode, length = _RECORD.unpack_from(content, at)
        record = content[at : at + _RECORD.size + length]
        at += len(record)
        if opcode == Opcode.FOOTER:
            break
        if opcode == Opcode.CHUNK_INDEX:
            _, _, chunk = _CHUNK_INDEX_START.unpack_from(record, _RECORD.size)
            if chunk in erased:
                continue
        if opcode != Opcode.SUMMARY_OFFSET:
            groups.setdefault(opcode, []).append(record)
    chunks = len(groups.get(Opcode.CHUNK_INDEX, ()))
    groups[Opcode.STATISTICS] = [_recount(record, chunks) for record in groups.get(Opcode.STATISTICS, ())]
    return end.data_end, mcap_layout.END_OF_DATA + _packed(groups, start) + mcap_layout.MAGIC


def _recount(statistics: bytes, chunks: int) -> bytes:
    """Return the statistics record of a segment with this number of chunks, one message each."""
    fields = list(_STATISTICS.unpack_from(statistics, _RECORD.size))
    gone, fields[0], fields[5] = fields[0] - chunks, chunks, chunks
    counts = statistics[_RECORD.size + _STATISTICS.size :]
    channels = [list(one) for one in _CHANNEL_COUNT.iter_unpack(counts)]
    for one in channels:
        one[1] -= gone if one[0] == mcap_layout.KEYFRAMES_CHANNEL else 0
    packed = b"".join(_CHANNEL_COUNT.pack(*one) for one in channels)
    return statistics[: _RECORD.size] + _STATISTICS.pack(*fields) + packed


def _packed(groups: dict[int, list[bytes]], start: int) -> bytes:
    """Return the bytes of an index that stands at offset `start`: groups of records, offsets and footer."""
    records, offsets, at = b"", b"", start
    for opcode, group in groups.items():
        if group:
            joined = b"".join(group)
            fields = _GROUP.pack(opcode, at, len(joined))
            offsets += _RECORD.pack(Opcode.SUMMARY_OFFSET, len(fields)) + fields
            records += joined
            at += len(joined)
    footer = _FOOTER.pack(Opcode.FOOTER, _FOOTER.size - _RECORD.size, start, at, 0)[:-4]
    crc32 = zlib.crc32(footer, zlib.crc32(records + offsets))
    return records + offsets + footer + struct.pack("<I", crc32)
