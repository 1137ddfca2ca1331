# SPDX-License-Identifier: MIT
"""Reading a segment: an MCAP file, one uncompressed chunk (with its CRC) a keyframe.

A segment that was cut off by a crash has no index at its end and normal MCAP readers refuse it. The walk
here goes from record to record and takes every whole one, also those behind a damaged one.
"""

import io
import logging
import os
import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, BinaryIO

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Chunk, Message
from mcap.stream_reader import breakup_chunk
from mcap.writer import MCAP0_MAGIC
from msgspec import Struct

from tsfusion.errors import JournalError

LAYOUT = b"""tsfusion journal record, little-endian:
session: 16 bytes; seq: u64; client: 32 bytes, the name its key is allowed under, UTF-8, zeros after it;
frame count: u8; length of each frame: u32; the frames of the wire message."""
_HEAD = struct.Struct("<16sQ32sB")
_RECORD = struct.Struct("<BQ")  # MCAP: opcode, length
_MAX_RECORD_BYTES = 1 << 30
_MAGIC_BYTES = 8

log = logging.getLogger(__name__)


class Position(Struct, frozen=True, order=True, array_like=True):
    """Where a record starts: the segment's number and the byte in it. Positions sort in journal order."""

    segment: int
    offset: int


class Record(Struct, frozen=True):
    """One journaled keyframe message."""

    position: Position
    session: bytes
    seq: int
    client: str  # that the key was allowed under which it came; empty = no keys
    logged_ns: int  # wall clock
    frames: list[memoryview]

    @property
    def nbytes(self) -> int:
        """Bytes of the message."""
        return sum(frame.nbytes for frame in self.frames)


class Scan(Struct, frozen=True):
    """A record that a scan found, without its frames."""

    position: Position
    session: bytes
    seq: int
    client: str
    nbytes: int


def segments(folder: Path) -> list[int]:
    """The numbers of a folder's segments, oldest first.

    Raises:
        JournalError: when the folder cannot be listed.
    """
    try:
        return sorted(int(path.stem) for path in folder.glob("*.mcap") if path.stem.isdecimal())
    except OSError as error:
        raise failed("list", folder, error) from error


def segment_path(folder: Path, number: int) -> Path:
    """The file of a segment."""
    return folder / f"{number:06d}.mcap"


def read(folder: Path, position: Position) -> Record:
    """One record by its position, also while its segment is being written.

    Raises:
        JournalError: when it is not there or its CRC differs.
    """
    return read_at(segment_path(folder, position.segment), position.offset)


def read_at(path: Path, offset: int) -> Record:
    """One record of a segment file.

    Raises:
        JournalError: when it is not there or its CRC differs.
    """
    try:
        with path.open("rb") as file:
            chunk = _chunk_at(file, offset, os.fstat(file.fileno()).st_size)
    except OSError as error:
        raise failed("read", path, error) from error
    record = None if chunk is None else _unpack(chunk, Position(_number(path), offset))
    if record is None:
        raise JournalError(f"{path} holds no whole keyframe at byte {offset}")
    return record


def scan(path: Path) -> tuple[list[Scan], int]:
    """Every whole record of a segment in order, and how many damaged ones lie between.

    A torn tail was never acknowledged and does not count as damage.

    Raises:
        JournalError: when the file cannot be read at all.
    """
    found, damaged = [], 0
    for record in _records(path):
        if record is None:
            damaged += 1
        else:
            found.append(Scan(record.position, record.session, record.seq, record.client, record.nbytes))
    if damaged:
        log.error("%s: %d keyframes are damaged and lost", path, damaged)
    return found, damaged


def records(path: Path) -> Iterator[Record]:
    """The whole records of one segment file.

    Raises:
        JournalError: when the file cannot be read at all.
    """
    return (record for record in _records(path) if record is not None)


def _records(path: Path) -> Iterator[Record | None]:
    try:
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            offset = _MAGIC_BYTES
            while (end := _record_end(file, offset, size)) is not None:
                chunk = _chunk_at(file, offset, size)
                if chunk is not None:
                    yield _unpack(chunk, Position(_number(path), offset))
                offset = end
            if _is_closed(file, size) and offset != size - _MAGIC_BYTES:
                yield None  # a damaged length hides what follows
    except OSError as error:
        raise failed("read", path, error) from error


def _record_end(file: BinaryIO, offset: int, size: int) -> int | None:
    file.seek(offset)
    head = file.read(_RECORD.size)
    if len(head) < _RECORD.size:
        return None
    end = offset + _RECORD.size + int(_RECORD.unpack(head)[1])
    return end if end <= size else None


def _number(path: Path) -> int:
    return int(path.stem) if path.stem.isdecimal() else 0


def _is_closed(file: BinaryIO, size: int) -> bool:
    file.seek(max(size - _MAGIC_BYTES, 0))
    return size > _MAGIC_BYTES and file.read(_MAGIC_BYTES) == MCAP0_MAGIC


def _chunk_at(file: BinaryIO, offset: int, size: int) -> bytes | None:
    """The content of the chunk record at `offset`; None when there is another record or not all of it."""
    end = _record_end(file, offset, size)
    if end is None or end - offset > _MAX_RECORD_BYTES:
        return None
    file.seek(offset)
    whole = file.read(end - offset)
    return whole[_RECORD.size :] if whole[0] == Opcode.CHUNK else None


def _unpack(chunk: bytes, position: Position) -> Record | None:
    """The keyframe message in a chunk; None when its CRC differs or it is not one of ours."""
    try:
        parsed = Chunk.read(ReadDataStream(io.BytesIO(chunk)))
        messages = [r for r in breakup_chunk(parsed, validate_crc=True) if isinstance(r, Message)]
        return _unpack_message(messages[0], position)
    except Exception as error:  # noqa: BLE001  mcap raises EndOfFile, CRCValidationError, struct.error, …
        log.debug("a damaged chunk at %s: %r", position, error)
        return None


def pack(frames: Sequence[Any], session: bytes, seq: int, client: str) -> bytes:
    """What `unpack` reads: the message of one record."""
    views = [memoryview(frame).cast("B") for frame in frames]
    lengths = struct.pack(f"<{len(views)}I", *(view.nbytes for view in views))
    return b"".join([_HEAD.pack(session, seq, client.encode(), len(views)), lengths, *views])


def _unpack_message(message: Message, position: Position) -> Record:
    body = memoryview(message.data)
    session, seq, client, count = _HEAD.unpack_from(body)
    at = _HEAD.size + 4 * count
    frames = []
    for length in struct.unpack_from(f"<{count}I", body, _HEAD.size):
        frames.append(body[at : at + length])
        at += length
    if at != body.nbytes:
        raise JournalError(f"a record of {body.nbytes} bytes at {position} says it has {at}")
    name = client.rstrip(b"\0").decode()
    return Record(position, session, seq, name, message.log_time, frames)


def failed(verb: str, path: Path, error: OSError) -> JournalError:
    """The error for something the disk refused."""
    return JournalError(f"cannot {verb} {path}: {error.strerror}")
