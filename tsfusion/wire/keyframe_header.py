# SPDX-License-Identifier: MIT
"""Frame 0 of a keyframe message: `TSF`, one byte of major version, then this struct as msgpack.

The version byte changes when an old reader must not try; new optional fields are minor changes that an
old reader skips.
"""

from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct

from tsfusion.core.config import MapName
from tsfusion.core.errors import DecodeError
from tsfusion.geometry.keyframe import MAX_SENSOR_NAME, Intrinsics

MAGIC = b"TSF"
VERSION = 1
MAX_HEADER_BYTES = 4096

ArrayName = Literal["depth", "disparity", "points", "origins", "color", "confidence"]
ArrayCodec = Literal["dzp+zstd", "mm+dzp+zstd", "jpeg", "png"]
Length = Annotated[int, Meta(ge=0, le=2_000_000)]
Natural = Annotated[int, Meta(ge=0, le=(1 << 63) - 1)]


class Refused(DecodeError):
    """A message that is not a keyframe; `reason` is the word under which it is counted."""

    def __init__(self, reason: str, message: str) -> None:
        super().__init__(message)
        self.reason = reason


class Buffer(Struct, frozen=True, kw_only=True):
    """One array of the keyframe and the frame that carries it (buffers[i] is frame i + 1)."""

    name: ArrayName
    codec: ArrayCodec
    dtype: Literal["uint8", "uint16", "float32"]  # of the decoded array
    shape: Annotated[tuple[Length, ...], Meta(min_length=1, max_length=3)]
    bytes: Annotated[int, Meta(ge=0)]  # length of the frame
    crc32: Annotated[int, Meta(ge=0, le=(1 << 32) - 1)]  # of the frame


class KeyframeHeader(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """All of a keyframe except its arrays.

    Attributes:
        session: 16 random bytes, one value a spool.
        seq: number of the keyframe in its session, rising by one.
        previous: the seq before this one among those the sender still offers, 0 = none: what lies
            between the two was dropped on purpose.
        map: the map it is for.
        sent_ns: the sender's monotonic clock when this copy was handed to the socket.
        pose: the upper three rows of `T_world_camera`, row by row.
        scale: `depth_scale` or `disparity_scale`.
    """

    session: Annotated[bytes, Meta(min_length=16, max_length=16)]
    seq: Annotated[int, Meta(ge=1, le=(1 << 63) - 1)]
    previous: Natural
    pose: Annotated[tuple[float, ...], Meta(min_length=12, max_length=12)]
    buffers: Annotated[tuple[Buffer, ...], Meta(min_length=1, max_length=4)]
    map: MapName = "default"
    sent_ns: Natural = 0
    scale: float | None = None
    intrinsics: Intrinsics | None = None
    baseline_fx: float | None = None
    sensor: Annotated[str, Meta(max_length=MAX_SENSOR_NAME)] | None = None
    timestamp_ns: Natural = 0
    captured_ns: Natural = 0


_PREFIX = MAGIC + bytes([VERSION])
_DECODER = msgspec.msgpack.Decoder(KeyframeHeader)


def pack(header: KeyframeHeader) -> bytes:
    """Encode frame 0."""
    return _PREFIX + msgspec.msgpack.encode(header)


def unpack(frame: Any) -> KeyframeHeader:
    """Read frame 0 (any bytes-like object).

    Raises:
        Refused: `header` (too long, or not this struct), `magic` or `version`.
    """
    view = memoryview(frame)
    if view.nbytes > MAX_HEADER_BYTES:
        raise Refused("header", f"the header must be at most {MAX_HEADER_BYTES} bytes, got {view.nbytes}")
    if bytes(view[:3]) != MAGIC:
        raise Refused("magic", f"a keyframe starts with {MAGIC!r}, got {bytes(view[:3])!r}")
    if bytes(view[3:4]) != _PREFIX[3:]:
        raise Refused("version", f"this is wire format {VERSION}, got {bytes(view[3:4]).hex() or 'nothing'}")
    try:
        return _DECODER.decode(view[4:])
    except Exception as error:  # msgspec also raises UnicodeDecodeError and RecursionError
        raise Refused("header", f"the header is malformed: {error}") from error


def stamp(frame: Any, *, previous: int, sent_ns: int) -> bytes:
    """Frame 0 again with the send time and the seq of the keyframe sent before this one."""
    return pack(msgspec.structs.replace(unpack(frame), previous=previous, sent_ns=sent_ns))
