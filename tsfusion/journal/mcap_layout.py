# SPDX-License-Identifier: MIT
"""Pack and parse the bytes of a segment: an MCAP file with one uncompressed chunk and CRC per keyframe.

    opening | chunk "segment" | index | (chunk "keyframe" | index) … | end of data | summary | footer | magic

The first chunk holds the segment's identity, random bytes that every record repeats. After damage, a reader
accepts only records with this identity: a keyframe may contain any bytes its sender likes, other records too.
A keyframe's chunk repeats all its lengths several times, so a damaged length shows.
A mark replaces each erased record (`journal.erasing`).
"""

import struct
import time
import zlib
from collections.abc import Sequence
from functools import cache
from io import BytesIO
from typing import IO, Any, NamedTuple

from mcap.opcode import Opcode
from msgspec import Struct

from tsfusion.core.errors import JournalError
from tsfusion.wire.records.record_header import is_correction, world_of

TOPIC = "/keyframes"
ENCODING = "x-tsfusion"
IDENTITY_BYTES = 8
CLIENT_BYTES = 32
_SESSION_BYTES = 16
# The opening of a segment has the same length as in journals of earlier versions
_LAYOUT = b"""journal record, little-endian:
segment: 8 bytes, the identity of the segment; session: 16 bytes; seq: u64;
client: 32 bytes, the name its key is allowed under, UTF-8, zeros after it;
frame count: u8; length of each frame: u32; the frames of the wire message"""
_SEGMENT_LAYOUT = b"journal segment: TSFSEG1 and a zero then the identity of the segment, 8 bytes"
_SEGMENT_MAGIC = b"TSFSEG1\0"
_KEYFRAMES, _SEGMENT = 1, 2  # channels
KEYFRAMES_CHANNEL = _KEYFRAMES
_ERASED_OPCODE = 0xE5  # of those that MCAP leaves to programs
_ERASED_MAGIC = b"TSFGONE\0"

_CHUNK = struct.Struct("<BQQQQIIQ")  # opcode, length, first and last time, size, CRC, compression, stored
_MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log and publish time
_IDENTITY = struct.Struct(f"<8s{IDENTITY_BYTES}s")
_RECORD = struct.Struct(f"<{IDENTITY_BYTES}s{_SESSION_BYTES}sQ{CLIENT_BYTES}sB")
_HEAD = struct.Struct(_CHUNK.format + _MESSAGE.format[1:] + _RECORD.format[1:])
_ERASED = struct.Struct(f"<BQ8s{IDENTITY_BYTES}s{_SESSION_BYTES}sQ{CLIENT_BYTES}s")  # then its CRC
_CRC = struct.Struct("<I")
_INDEX = struct.Struct("<BQHIQQ")  # opcode, length, channel, bytes that follow, time, offset in the chunk
_LENGTH_BYTES = 9  # opcode and length, which no length counts
_MAX_CHUNK_BYTES = 1 << 30

LIBRARY = b"tsfusion"
MAGIC = b"\x89MCAP0\r\n"
OPENING = MAGIC + struct.pack("<BQII", Opcode.HEADER, 8 + len(LIBRARY), 0, len(LIBRARY)) + LIBRARY
END_OF_DATA = struct.pack("<BQI", Opcode.DATA_END, 4, 0)
HEAD_BYTES = _HEAD.size
INDEX_BYTES = _INDEX.size
ERASED_BYTES = _ERASED.size + _CRC.size  # the bytes of an erased record that are not zeros
INDEX_START = struct.pack("<BQHI", Opcode.MESSAGE_INDEX, INDEX_BYTES - _LENGTH_BYTES, _KEYFRAMES, 16)


class Position(Struct, frozen=True, order=True, array_like=True):
    """Start of a record: the segment's number and the byte in it. Positions sort in journal order."""

    segment: int
    offset: int


class Record(Struct, frozen=True):
    """One journaled message: a keyframe or a correction."""

    position: Position
    session: bytes
    seq: int
    client: str  # name that the sender's key is allowed under; empty = no keys
    logged_ns: int  # wall clock
    frames: list[memoryview]

    @property
    def nbytes(self) -> int:
        """Bytes of the message."""
        return sum(frame.nbytes for frame in self.frames)

    @property
    def is_correction(self) -> bool:
        """True for a correction; read from the first bytes of the message."""
        return bool(self.frames) and is_correction(self.frames[0])

    @property
    def world(self) -> str:
        """The world (coordinate frame) in the header; empty without one or with an unreadable header."""
        return world_of(self.frames[0]) if self.frames else ""


class ChunkHead(NamedTuple):
    """The first bytes of a keyframe's chunk, up to its table of frames."""

    opcode: int
    length: int
    first_ns: int
    last_ns: int
    size: int
    crc32: int
    compression: int
    stored: int
    message_opcode: int
    message_length: int
    channel: int
    sequence: int
    logged_ns: int
    published_ns: int
    segment: bytes
    session: bytes
    seq: int
    client: bytes
    frame_count: int

    @property
    def nbytes(self) -> int:
        """Bytes of the whole chunk."""
        return _LENGTH_BYTES + self.length

    @property
    def is_sound(self) -> bool:
        """True if these fields can be the head of a keyframe's chunk: all its lengths agree."""
        table = _RECORD.size + 4 * self.frame_count
        return (
            self.opcode == Opcode.CHUNK
            and self.length == _CHUNK.size - _LENGTH_BYTES + self.stored
            and self.size == self.stored == _LENGTH_BYTES + self.message_length
            and self.message_length >= _MESSAGE.size - _LENGTH_BYTES + table
            and (self.compression, self.message_opcode, self.channel) == (0, Opcode.MESSAGE, _KEYFRAMES)
            and self.nbytes <= _MAX_CHUNK_BYTES
        )

    @property
    def message_index(self) -> bytes:
        """The bytes of the index that the writer puts after the chunk."""
        return _index(_KEYFRAMES, self.logged_ns, 0)


def _index(channel: int, logged_ns: int, offset: int) -> bytes:
    return _INDEX.pack(Opcode.MESSAGE_INDEX, _INDEX.size - _LENGTH_BYTES, channel, 16, logged_ns, offset)


def wall_clock_ns() -> int:
    """Return the wall clock time in nanoseconds, for people; 0 if the clock shows a time before 1970."""
    return max(time.time_ns(), 0)  # MCAP has no earlier times


def begin_segment(stream: IO[bytes], identity: bytes, now_ns: int) -> Any:
    """Write the first bytes of a segment; return the MCAP writer for `write_record`."""
    from mcap.writer import CompressionType, Writer  # a tenth of a client's import time

    writer = Writer(stream, chunk_size=1, compression=CompressionType.NONE)
    writer.start(library=LIBRARY.decode())
    schema = writer.register_schema("tsfusion.keyframe", ENCODING, _LAYOUT)
    writer.register_channel(TOPIC, ENCODING, schema)
    schema = writer.register_schema("tsfusion.segment", ENCODING, _SEGMENT_LAYOUT)
    writer.register_channel("/segment", ENCODING, schema)
    writer.add_message(_SEGMENT, now_ns, _IDENTITY.pack(_SEGMENT_MAGIC, identity), now_ns)
    return writer


def write_record(writer: Any, payload: bytes, seq: int, now_ns: int) -> None:
    """Write one record, whose `payload` is made by `pack_record`."""
    writer.add_message(_KEYFRAMES, now_ns, payload, now_ns, sequence=seq % 2**32)


def pack_record(frames: Sequence[Any], identity: bytes, session: bytes, seq: int, client: str) -> bytes:
    """Return the bytes of one record: its message's frames, session, number and client.

    Raises:
        JournalError: the client's name is too long; a shortened name could be another client's.
    """
    name = client.encode()
    if len(name) > CLIENT_BYTES:
        raise JournalError(f"a client's name must be at most {CLIENT_BYTES} bytes, got {client!r}")
    views = [memoryview(frame).cast("B") for frame in frames]
    lengths = struct.pack(f"<{len(views)}I", *(view.nbytes for view in views))
    return b"".join([_RECORD.pack(identity, session, seq, name, len(views)), lengths, *views])


def parse_head(raw: bytes) -> ChunkHead | None:
    """Return the head of a keyframe's chunk, or None if the bytes are not such a head."""
    if len(raw) < HEAD_BYTES:
        return None
    parsed = ChunkHead(*_HEAD.unpack_from(raw))
    return parsed if parsed.is_sound else None


def parse_record(raw: bytes, position: Position) -> Record | None:
    """Return the record in a chunk, or None unless it is complete and its CRC agrees."""
    parsed = parse_head(raw)
    if parsed is None or len(raw) != parsed.nbytes:
        return None
    body = memoryview(raw)
    if zlib.crc32(body[_CHUNK.size :]) != parsed.crc32:
        return None
    lengths = struct.unpack_from(f"<{parsed.frame_count}I", raw, HEAD_BYTES)
    at = HEAD_BYTES + 4 * parsed.frame_count
    if at + sum(lengths) != len(raw):
        return None
    frames = []
    for length in lengths:
        frames.append(body[at : at + length])
        at += length
    try:
        client = parsed.client.rstrip(b"\0").decode()
    except UnicodeDecodeError:
        return None
    return Record(position, parsed.session, parsed.seq, client, parsed.logged_ns, frames)


class ErasedHead(NamedTuple):
    """The first bytes of the filler that replaces an erased record, as fields."""

    segment: bytes
    session: bytes
    seq: int
    client: str
    nbytes: int


def erased_mark(head: ChunkHead, nbytes: int) -> bytes:
    """Return the first bytes of the filler for an erased record; `nbytes` is the filler's whole length."""
    fields = (head.segment, head.session, head.seq, head.client)
    mark = _ERASED.pack(_ERASED_OPCODE, nbytes - _LENGTH_BYTES, _ERASED_MAGIC, *fields)
    return mark + _CRC.pack(zlib.crc32(mark))


def parse_erased(raw: bytes) -> ErasedHead | None:
    """Return the head of an erased record, or None if the bytes are not such a head."""
    if len(raw) < ERASED_BYTES or raw[0] != _ERASED_OPCODE:
        return None
    _, length, magic, segment, session, seq, client = _ERASED.unpack_from(raw)
    (crc32,) = _CRC.unpack_from(raw, _ERASED.size)
    if magic != _ERASED_MAGIC or zlib.crc32(raw[: _ERASED.size]) != crc32:
        return None
    name = client.rstrip(b"\0").decode(errors="replace")
    return ErasedHead(segment, session, seq, name, _LENGTH_BYTES + length)


class SegmentChunk(NamedTuple):
    """The first chunk of a segment, which names the file's layout and identity."""

    layout: bytes
    identity: bytes
    end: int
    message_index: bytes  # the writer puts it after the chunk

    @property
    def is_ours(self) -> bool:
        """True if this version can read the segment."""
        return self.layout == _SEGMENT_MAGIC


def parse_segment_chunk(raw: bytes) -> SegmentChunk | None:
    """Return the segment's own chunk from the first bytes of a file, or None if it is missing or damaged."""
    at = len(OPENING)
    if len(raw) < at + _CHUNK.size:
        return None
    opcode, length, first_ns, last_ns, size, crc32, compression, stored = _CHUNK.unpack_from(raw, at)
    end = at + _LENGTH_BYTES + length
    inner, message = at + _CHUNK.size, end - _MESSAGE.size - _IDENTITY.size
    if (opcode, compression, size, end) != (Opcode.CHUNK, 0, stored, inner + stored):
        return None
    if not inner <= message or end > len(raw) or zlib.crc32(raw[inner:end]) != crc32:
        return None
    _, _, channel, _, logged_ns, _ = _MESSAGE.unpack_from(raw, message)
    magic, identity = _IDENTITY.unpack_from(raw, message + _MESSAGE.size)
    if (channel, magic[:6]) != (_SEGMENT, _SEGMENT_MAGIC[:6]) or not first_ns == last_ns == logged_ns:
        return None
    return SegmentChunk(magic, identity, end, _index(channel, logged_ns, message - inner))


@cache
def segment_start_bytes() -> int:
    """Return the number of bytes of a segment before its first keyframe."""
    stream = BytesIO()
    begin_segment(stream, bytes(IDENTITY_BYTES), 0)
    return len(stream.getvalue())
