# SPDX-License-Identifier: MIT
"""Read and write frame 0 of a record: three bytes for its kind, one of major version, a header as msgpack.

A session's records are keyframes (`TSF`) and corrections of keyframes (`TSC`), in one series of numbers. A
new version byte stops old readers. New optional fields need no new version: old readers skip them.
"""

import sys
import zlib
from typing import Annotated, Any, ClassVar, Literal, TypeAlias

import msgspec
from msgspec import Meta, Struct

from tsfusion.core.config import DEFAULT_MAP, SERVER_SESSION, MapName
from tsfusion.core.errors import DecodeError
from tsfusion.geometry.keyframe import MAX_SENSOR_NAME, Intrinsics

_MARK = b"\xa5check\xc4\x04"  # msgpack: the key "check", and the head of a value of four bytes
_CRC_BYTES = 4
_MOST_WORN = 4  # wrong bits of 64 with which a mark still counts: 1 in 10¹³ random byte strings is so near
_FIXMAP, _MOST_IN_FIXMAP, _MAP16 = 0x80, 15, 0xDE  # of the msgpack format


def seal(message: bytes) -> bytes:
    """Return a message with a seal: its CRC-32, as the last entry of its msgpack map (under 65535 entries).

    TCP's own checksum misses one damaged segment in 65536, and a relay may damage bytes between two
    connections. Keys authenticate every byte. Without keys and seal, a changed number or pose would stay
    unnoticed. Readers that do not know the entry skip it. A message without a seal is valid, too.
    """
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
    """True if a message (any bytes-like object) carries a seal that does not match.

    A seal with a changed mark counts as damaged, too: otherwise its CRC would not be checked.
    """
    view = memoryview(message)
    sealed, crc = view[:-_CRC_BYTES], view[-_CRC_BYTES:]
    mark = bytes(sealed[-len(_MARK) :])
    if mark != _MARK:
        worn = int.from_bytes(mark, "big") ^ int.from_bytes(_MARK, "big")
        return worn.bit_count() <= _MOST_WORN
    return zlib.crc32(sealed).to_bytes(_CRC_BYTES, "big") != crc


MAGIC_BYTES = 3
VERSION = 1  # of both kinds
MAX_HEADER_BYTES = 4096

ArrayName = Literal["depth", "disparity", "points", "origins", "color", "confidence"]
ArrayCodec = Literal["dzp+zstd", "mm+dzp+zstd", "jpeg", "png"]
Length = Annotated[int, Meta(ge=0, le=2_000_000)]
Natural = Annotated[int, Meta(ge=0, le=(1 << 63) - 1)]
Crc32 = Annotated[int, Meta(ge=0, le=(1 << 32) - 1)]
SessionId = Annotated[bytes, Meta(min_length=16, max_length=16)]
WORLD_NAME = "[A-Za-z0-9_-]{1,64}"
WorldName = Annotated[str, Meta(pattern=rf"\A({WORLD_NAME})?\Z")]
RecordNumber = Annotated[int, Meta(ge=1, le=(1 << 63) - 1)]
TransformRows = Annotated[tuple[float, ...], Meta(min_length=12, max_length=12)]


class Refused(DecodeError):
    """Error of a message that is no valid record; `reason` is the short name under which it is counted."""

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


class Damaged(Refused):
    """Error of a message whose bytes changed on the way. The sender's copy may be good."""


class Buffer(Struct, frozen=True, kw_only=True):
    """Description of one array of the keyframe, which one frame carries (buffers[i] by frame i + 1)."""

    name: ArrayName
    codec: ArrayCodec
    dtype: Literal["uint8", "uint16", "float32"]  # of the decoded array
    shape: Annotated[tuple[Length, ...], Meta(min_length=1, max_length=3)]
    bytes: Annotated[int, Meta(ge=0)]  # length of the frame
    crc32: Crc32  # of the frame


class KeyframeHeader(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Header of a keyframe, frame 0: all its fields but the arrays.

    Attributes:
        session: 16 random bytes, one value for each spool.
        seq: number of the record in its session, rising by one.
        previous: seq of the record before this one, among those that the sender still offers; 0 without one.
            The sender dropped the records between the two on purpose.
        map: name of the map that it is for.
        world: name of the coordinate frame of its pose, drawn by the localizer; empty for poses given from
            outside.
        same_frame: True if the sender declares that this frame is the map's, whatever worlds the map has.
        sent_ns: the sender's monotonic clock when this copy went to the socket.
        pose: the upper three rows of `T_world_camera`, row by row.
        scale: `depth_scale` or `disparity_scale`.
    """

    kind: ClassVar[str] = "keyframe"

    session: SessionId
    seq: RecordNumber
    previous: Natural
    pose: TransformRows
    buffers: Annotated[tuple[Buffer, ...], Meta(min_length=1, max_length=4)]
    map: MapName = "default"
    world: WorldName = ""
    same_frame: bool = False
    sent_ns: Natural = 0
    scale: float | None = None
    intrinsics: Intrinsics | None = None
    baseline_fx: float | None = None
    sensor: Annotated[str, Meta(max_length=MAX_SENSOR_NAME)] | None = None
    timestamp_ns: Natural = 0
    captured_ns: Natural = 0


class CorrectionHeader(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Header of a correction, frame 0; the numbers and poses follow in its body.

    Attributes:
        session, seq, previous, map, world, same_frame, sent_ns: as for a keyframe.
        count: number of keyframes that get another pose.
        removed: number of keyframes to take out of the map.
        crc32: CRC-32 of the body.
        T_map_odometry: upper three rows, row by row, of the transform to multiply from the left to poses
            after the last keyframe. None keeps the present one.
        target: session whose keyframes it removes for good, written only by a server. None: its own session.
    """

    kind: ClassVar[str] = "correction"

    session: SessionId
    seq: RecordNumber
    previous: Natural
    count: Natural
    crc32: Crc32
    map: MapName = "default"
    world: WorldName = ""
    same_frame: bool = False
    sent_ns: Natural = 0
    removed: Natural = 0
    T_map_odometry: TransformRows | None = None
    target: SessionId | None = None


RecordHeader: TypeAlias = KeyframeHeader | CorrectionHeader
_MAGIC: dict[type[RecordHeader], bytes] = {KeyframeHeader: b"TSF", CorrectionHeader: b"TSC"}
_DECODERS: dict[bytes, Any] = {
    magic: msgspec.msgpack.Decoder(header_type) for header_type, magic in _MAGIC.items()
}


def pack(header: RecordHeader) -> bytes:
    """Encode a header as frame 0, without a seal."""
    return _MAGIC[type(header)] + bytes([VERSION]) + msgspec.msgpack.encode(header)


def packed(
    kind: type[RecordHeader],
    *,
    session: bytes,
    seq: int,
    previous: int | None = None,
    map_name: str = DEFAULT_MAP,
    world: str = "",
    same_frame: bool = False,
    **content: Any,
) -> bytes:
    """Return frame 0 of a record with this content. `sent_ns` is 0 until `with_fields` sets it."""
    previous = seq - 1 if previous is None else previous
    address: dict[str, Any] = {"session": session, "seq": seq, "previous": previous, "map": map_name}
    return pack(kind(**address, world=world, same_frame=same_frame, **content))


def unpack(frame: Any) -> RecordHeader:
    """Read frame 0 (any bytes-like object) of a keyframe or a correction.

    Raises:
        Refused: `header` (too long, or malformed), `magic`, `version` or `crc`.
    """
    view = memoryview(frame)
    if view.nbytes > MAX_HEADER_BYTES:
        raise Refused("header", f"the header must be at most {MAX_HEADER_BYTES} bytes, got {view.nbytes}")
    magic, version = bytes(view[:MAGIC_BYTES]), bytes(view[MAGIC_BYTES : MAGIC_BYTES + 1])
    if magic not in _DECODERS:
        raise Refused("magic", f"a record starts with {' or '.join(map(str, _DECODERS))}, got {magic!r}")
    if version != bytes([VERSION]):
        raise Refused("version", f"this is record format {VERSION}, got {version.hex() or 'nothing'}")
    content = view[MAGIC_BYTES + 1 :]
    if is_damaged(content):
        raise Damaged("crc", "the header was damaged on its way (CRC-32 differs)")
    try:
        return _DECODERS[magic].decode(content)  # type: ignore[no-any-return]
    except Exception as error:  # msgspec also raises UnicodeDecodeError and RecursionError
        raise Refused("header", f"the header is malformed: {error}") from error


def unpack_keyframe(frame: Any) -> KeyframeHeader:
    """Read frame 0 of a keyframe. Raise Refused as `unpack`, and (`magic`) for a correction."""
    header = unpack(frame)
    if not isinstance(header, KeyframeHeader):
        raise Refused("magic", f"a keyframe is expected, got a {header.kind}")
    return header


def is_servers_own(header: RecordHeader) -> bool:
    """True if only a server has the right to write such a record: one that forgets keyframes."""
    has_target = isinstance(header, CorrectionHeader) and header.target is not None
    return has_target or header.session == SERVER_SESSION


def is_correction(frame: Any) -> bool:
    """True if frame 0 begins as that of a correction. The rest is not checked."""
    return bytes(memoryview(frame)[:MAGIC_BYTES]) == _MAGIC[CorrectionHeader]


def world_of(frame: Any) -> str:
    """Return the world (coordinate frame) that frame 0 names, or "" for a malformed header."""
    try:
        return sys.intern(unpack(frame).world)
    except Refused:
        return ""


def with_fields(frame: Any, **fields: Any) -> bytes:
    """Return frame 0 with changed fields, and a new seal: for fields such as `sent_ns`, known late."""
    stamped = pack(msgspec.structs.replace(unpack(frame), **fields))
    return stamped[: MAGIC_BYTES + 1] + seal(stamped[MAGIC_BYTES + 1 :])
