# SPDX-License-Identifier: MIT
"""Messages that look like keyframes and are none, or are more than they seem."""

import math
import os
import struct
import zlib
from collections.abc import Iterator
from typing import Any

import msgspec
import numpy as np
import zstandard
from keyframes_and_servers import wall

from tsfusion.wire.records import codec, corrections
from tsfusion.wire.records.record_header import Buffer, pack, unpack

Frames = list[bytes]


def good() -> Frames:
    """A keyframe of a session of its own."""
    return codec.encode(wall(), session=os.urandom(16), seq=1, jpeg_quality=90)


def with_header(frames: Frames, **changes: Any) -> Frames:
    return [pack(msgspec.structs.replace(unpack(frames[0]), **changes)), *frames[1:]]


def with_depth(payload: bytes, shape: tuple[int, int], kind: str = "dzp+zstd") -> Frames:
    """A keyframe of nothing but a depth image that is what the payload says."""
    frames = good()
    depth = Buffer(
        name="depth", codec=kind, dtype="uint16", shape=shape, bytes=len(payload), crc32=zlib.crc32(payload)
    )
    return with_header([frames[0], payload], buffers=(depth,))


def png_header(width: int, height: int) -> bytes:
    """The beginning of a PNG, and no more of it."""
    body = b"IHDR" + struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + body + struct.pack(">I", zlib.crc32(body))


def stated(size: int, content: bytes) -> bytes:
    """A zstd frame that says it holds `size` bytes, whatever it holds."""
    compressed = zstandard.ZstdCompressor(write_content_size=False).compress(content)
    body = compressed[4 + 2 :]  # behind magic, descriptor and window
    return compressed[:4] + b"\xc0" + compressed[5:6] + struct.pack("<Q", size) + body


def bombs() -> Iterator[Frames]:
    """Small messages that say, or are, a lot."""
    side = 8192
    zeros = zstandard.ZstdCompressor().compress(bytes(2 * side * side))
    yield with_depth(zeros, (side, side))
    yield with_depth(zeros, (48, 64))
    yield with_depth(zstandard.ZstdCompressor().compress(bytes(2 << 22)), (2048, 2048))
    yield with_depth(stated(2 * side * side, bytes(100)), (side, side))
    yield with_depth(stated(2 * 48 * 64, bytes(32 << 20)), (48, 64))
    yield with_depth(stated(1 << 60, b"x"), (48, 64))
    yield with_depth(png_header(131_072, 131_072), (48, 64), "png")
    yield with_depth(png_header(8192, 8192), (8192, 8192), "png")
    yield with_depth(png_header(0, 0), (48, 64), "png")
    yield with_depth(b"\xff\xd8" + b"\xff\xe0\x00\x02" * 200_000, (48, 64), "png")
    yield with_depth(b"\x28\xb5\x2f\xfd", (48, 64))
    yield with_depth(png_header(64, 48) + struct.pack(">I", (1 << 31) - 1) + b"IDAT", (48, 64), "png")
    text = b"k\0\0" + zlib.compress(bytes(7_000_000))
    chunk = struct.pack(">I", len(text)) + b"zTXt" + text + struct.pack(">I", zlib.crc32(b"zTXt" + text))
    yield with_depth(png_header(64, 48) + 100 * chunk, (48, 64), "png")


def bad_values() -> Iterator[Frames]:
    """NaN, infinity, mirrors and cameras that do not exist."""
    for value in (math.nan, math.inf, -math.inf, 1e300, 1e-300):
        pose = list(np.eye(4)[:3].ravel().tolist())
        for at in (0, 3, 5):
            yield with_header(good(), pose=tuple(pose[:at] + [value] + pose[at + 1 :]))
        frames = good()
        header = unpack(frames[0])
        yield with_header(frames, intrinsics=msgspec.structs.replace(header.intrinsics, fx=value))
        yield with_header(frames, scale=value)
    yield with_header(good(), pose=tuple(np.diag([1.0, 1.0, -1.0, 1.0])[:3].ravel().tolist()))
    yield with_header(good(), intrinsics=None)


def lies() -> Iterator[Frames]:
    """Lengths, counts, names and checksums that are not true."""
    frames = good()
    header = unpack(frames[0])
    changes: list[dict[str, Any]] = [
        *({"bytes": 0}, {"bytes": 1 << 40}, {"crc32": 0}, {"dtype": "float32"}, {"name": "points"}),
        *({"shape": (2_000_000, 2_000_000)}, {"shape": (0, 0)}, {"shape": (1, 1, 3)}),
    ]
    for change in changes:
        first, *others = header.buffers
        yield with_header(frames, buffers=(msgspec.structs.replace(first, **change), *others))
    yield with_header(frames, buffers=header.buffers * 2)
    yield with_header(frames, seq=(1 << 63) - 1, previous=(1 << 63) - 2)
    yield with_header(frames, map="../../etc")
    yield [frames[0]] * 5
    yield [frames[0]] + [b""] * 1000
    yield [frames[0][:4] + b"\xdf\xff\xff\xff\xff", *frames[1:]]
    yield [frames[0][:4] + b"\x91" * 4000, *frames[1:]]
    yield [b"TSF\x01" + bytes(8000), *frames[1:]]
    yield [frames[0], os.urandom(1 << 20), frames[2]]
    yield [b""]


def hostile_corrections(session: bytes, seq: int = 3, previous: int = 2) -> list[tuple[str, str, Frames]]:
    """A name, the reason it is refused for, and the frames of a correction of keyframes 1 and 2."""
    correction = corrections.checked({1: np.eye(4), 2: np.eye(4)})
    frames = corrections.encode(correction, session=session, seq=seq, previous=previous)
    fields, body = msgspec.msgpack.decode(frames[0][4:]), frames[1]

    def changed(content: bytes = body, **changes: Any) -> Frames:
        """With a true checksum."""
        header = {**fields, "crc32": zlib.crc32(content), **changes}
        return [b"TSC\x01" + msgspec.msgpack.encode(header), content]

    def valued(at: int, value: float) -> Frames:
        return changed(body[: 16 + 8 * at] + struct.pack("<d", value) + body[24 + 8 * at :])

    def numbered(*numbers: int) -> Frames:
        return changed(struct.pack("<2q", *numbers) + body[16:])

    def removing(*numbers: int) -> Frames:
        return changed(body + struct.pack(f"<{len(numbers)}q", *numbers), removed=len(numbers))

    identity = np.eye(4)[:3].ravel().tolist()
    found = [
        ("cut short", "size", changed(body[:-1])),
        ("too long", "size", changed(body + b"x")),
        ("no poses", "size", changed(b"")),
        ("more announced", "size", changed(count=corrections.MAX_KEYFRAMES)),
        ("too many", "limits", changed(count=corrections.MAX_KEYFRAMES, removed=1)),
        ("huge count", "limits", changed(count=1 << 62)),
        ("negative count", "header", changed(count=-1)),
        ("negative removed", "header", changed(removed=-1)),
        ("damaged", "crc", changed(crc32=1)),
        ("a path as map", "header", changed(map="../../etc")),
        ("short session", "header", changed(session=b"short")),
        ("short T", "header", changed(T_map_odometry=identity[:11])),
        ("NaN in T", "values", changed(T_map_odometry=[*identity[:11], math.nan])),
        ("mirror in T", "values", changed(T_map_odometry=[-1.0, *identity[1:]])),
        ("number 0", "values", numbered(0, 1)),
        ("negative number", "values", numbered(-5, 1)),
        ("falling numbers", "values", numbered(2, 1)),
        ("one number twice", "values", numbered(1, 1)),
        ("removed 0", "values", removing(0)),
        ("removed twice", "values", removing(5, 5)),
        ("corrected and removed", "values", removing(2)),
        ("mirror", "values", valued(0, -1.0)),
        ("sheared", "values", valued(1, 0.01)),
        ("far", "values", valued(3, 1e7)),
        ("no body", "frames", frames[:1]),
        ("two bodies", "frames", [*frames, body]),
        ("as a keyframe", "header", [b"TSF" + frames[0][3:], body]),
        ("version 2", "version", [b"TSC\x02" + frames[0][4:], body]),
        ("not a header", "header", [b"TSC\x01\xc1", body]),
        ("deep", "header", [b"TSC\x01" + b"\x91" * 4000, body]),
    ]
    for value in (math.nan, math.inf, -math.inf, 1e300, -1e300):
        found += [(f"{value}", "values", valued(at, value)) for at in (0, 3, 23)]
    return found
