# SPDX-License-Identifier: MIT
"""Mutations that keep enough of a message's form to get past its first checks: the seeds of deeper bugs."""

import random
import struct
import zlib
from collections.abc import Callable, Sequence
from hashlib import blake2b
from typing import Any

import msgspec

Mutate = Callable[[bytes, random.Random, Sequence[bytes]], bytes]

# fmt: off
_INTEGERS = [0, 1, 2, 3, 7, 8, 16, 127, 128, 255, 256, 4095, 4096, 8191, 8192, 8193, 65535, 65536, 2_000_000,
             2_000_001, (1 << 31) - 1, 1 << 31, (1 << 32) - 1, 1 << 32, (1 << 63) - 1, (1 << 64) - 1,
             -1, -2, -(1 << 31), -(1 << 63)]
_FLOATS = [0.0, -0.0, 1.0, -1.0, 1e-320, 1e-300, 1e155, 1e300, -1e300, 1e6, 1e-3,
           float("inf"), float("-inf"), float("nan")]
_WORDS = ["", "depth", "disparity", "points", "origins", "color", "confidence", "dzp+zstd", "mm+dzp+zstd",
          "jpeg", "png", "uint8", "uint16", "float32", "default", "kinect", "x" * 40, "../x", "a\0b", "é"]
# fmt: on


# --- plain bytes ---


def raw(content: bytes, rng: random.Random, corpus: Sequence[bytes]) -> bytes:
    """A few changes of bytes: flips, numbers, cuts, copies, pieces of others."""
    mutated = bytearray(content)
    for _ in range(1 << rng.randrange(4)):
        _change(mutated, rng, corpus)
    return bytes(mutated)


def _change(mutated: bytearray, rng: random.Random, corpus: Sequence[bytes]) -> None:
    at = rng.randrange(len(mutated) + 1)
    kind = rng.randrange(8)
    if kind == 0 and mutated:
        mutated[at % len(mutated)] ^= 1 << rng.randrange(8)
    elif kind == 1 and mutated:
        mutated[at % len(mutated)] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)))
    elif kind == 2:
        del mutated[at : at + (1 << rng.randrange(10))]
    elif kind == 3:
        mutated[at:at] = rng.randbytes(1 << rng.randrange(6))
    elif kind == 4:
        form = rng.choice(("<H", "<I", "<Q", ">H", ">I", ">Q"))
        number = struct.pack(form, rng.choice(_INTEGERS) % (1 << 8 * struct.calcsize(form)))
        mutated[at : at + len(number)] = number
    elif kind == 5:
        mutated[at:] = b""
    elif kind == 6:
        mutated[at:at] = mutated[at : at + (1 << rng.randrange(10))]
    else:
        other = rng.choice(corpus) if corpus else b""
        start = rng.randrange(len(other) + 1)
        mutated[at:at] = other[start : start + (1 << rng.randrange(10))]


# --- anything that msgpack can say ---


def value(old: Any, rng: random.Random) -> Any:
    """Something else in its place, often of the same type."""
    kind = rng.randrange(10)
    if isinstance(old, bool) or old is None or kind == 0:
        return rng.choice((None, True, False, 0, 1.5, "", b"", [], {}, [[]] * 3, {"": None}))
    if isinstance(old, int):
        return rng.choice((*_INTEGERS, old + 1, old - 1, old * 2, float(old)))
    if isinstance(old, float):
        return rng.choice((*_FLOATS, -old, old * (1 + 1e-3), 1))
    if isinstance(old, str):
        return rng.choice((*_WORDS, old + "x", old[:-1], old * 2))
    if isinstance(old, bytes):
        return raw(old, rng, ())
    return old


def tree(content: Any, rng: random.Random) -> Any:
    """Change one place in a tree of lists and dicts."""
    if isinstance(content, dict) and content:
        return _dict(dict(content), rng)
    if isinstance(content, list) and content:
        return _list(list(content), rng)
    return value(content, rng)


def _dict(content: dict[Any, Any], rng: random.Random) -> dict[Any, Any]:
    key = rng.choice(list(content))
    kind = rng.randrange(12)
    if kind == 0:
        del content[key]
    elif kind == 1:
        content[rng.choice(_WORDS)] = content[key]
    else:
        content[key] = tree(content[key], rng)
    return content


def _list(content: list[Any], rng: random.Random) -> list[Any]:
    at = rng.randrange(len(content))
    kind = rng.randrange(12)
    if kind == 0:
        del content[at]
    elif kind == 1:
        content.insert(at, content[rng.randrange(len(content))])
    elif kind == 2:
        rng.shuffle(content)
    else:
        content[at] = tree(content[at], rng)
    return content


def msgpack(content: bytes, rng: random.Random, corpus: Sequence[bytes]) -> bytes:
    """A change of what it says, or of its bytes."""
    if rng.random() < 0.3:
        return raw(content, rng, corpus)
    try:
        return msgspec.msgpack.encode(tree(msgspec.msgpack.decode(content), rng))
    except Exception:  # noqa: BLE001  not msgpack any more, or what it cannot say
        return raw(content, rng, corpus)


# --- keyframe messages: length and bytes of each frame ---


def join(frames: Sequence[bytes]) -> bytes:
    """Join the frames of a message into one string of bytes."""
    return b"".join(struct.pack("<I", len(frame)) + frame for frame in frames)


def split(content: bytes) -> list[bytes]:
    """The frames again; any string has some."""
    frames: list[bytes] = []
    at = 0
    while at + 4 <= len(content) and len(frames) < 64:
        (length,) = struct.unpack_from("<I", content, at)
        frames.append(content[at + 4 : at + 4 + length])
        at += 4 + length
    return frames


def message(content: bytes, rng: random.Random, corpus: Sequence[bytes]) -> bytes:
    """A change of a message's header, of an array, or of its frames; mostly with true lengths and CRCs."""
    frames = split(content)
    kind = rng.randrange(10)
    if len(frames) < 2 or kind == 0:
        return raw(content, rng, corpus)
    if kind < 5:
        prefix = frames[0][:4] if rng.random() < 0.98 else rng.randbytes(4)
        frames[0] = prefix + msgpack(frames[0][4:], rng, corpus)
    elif kind < 8:
        at = rng.randrange(1, len(frames))
        frames[at] = raw(frames[at], rng, corpus)
    elif kind == 8:
        frames = _shuffled(frames, rng)
    else:
        other = split(rng.choice(corpus)) if corpus else []
        frames[rng.randrange(1, len(frames))] = rng.choice(other) if other else b""
    if rng.random() < 0.8:
        frames = repaired(frames)
    return join(frames)


def _shuffled(frames: list[bytes], rng: random.Random) -> list[bytes]:
    at = rng.randrange(1, len(frames))
    kind = rng.randrange(3)
    if kind == 0:
        del frames[at]
    elif kind == 1:
        frames.insert(at, frames[at])
    else:
        frames[at] = frames[rng.randrange(len(frames))]
    return frames


def repaired(frames: list[bytes]) -> list[bytes]:
    """Correct the lengths and CRCs in the header, so that the checks behind them are reached."""
    try:
        header = msgspec.msgpack.decode(frames[0][4:])
        if frames[0][:3] == b"TSC":
            header["count"] = max(len(frames[1]) - 8 * header.get("removed", 0), 0) // 104
            header["crc32"] = zlib.crc32(frames[1])
            return [frames[0][:4] + msgspec.msgpack.encode(header), *frames[1:]]
        for buffer, frame in zip(header["buffers"], frames[1:], strict=False):
            buffer["bytes"], buffer["crc32"] = len(frame), zlib.crc32(frame)
        return [frames[0][:4] + msgspec.msgpack.encode(header), *frames[1:]]
    except Exception:  # noqa: BLE001  there is nothing to repair
        return frames


# --- MCAP files: magic, records of opcode, length and body, magic ---

_RECORD = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQII")  # times, size, CRC, length of the compression's name
_MAGIC_BYTES = 8


def mcap(content: bytes, rng: random.Random, corpus: Sequence[bytes]) -> bytes:
    """A change of a record, its length, or the order of records; mostly with true CRCs."""
    if rng.random() < 0.3:
        return raw(content, rng, corpus)
    records, rest = _records(content)
    if not records:
        return raw(content, rng, corpus)
    at = rng.randrange(len(records))
    opcode, body = records[at]
    kind = rng.randrange(8)
    if kind < 4:
        changed = raw(body, rng, corpus)
        records[at] = (opcode, _sealed(opcode, changed) if rng.random() < 0.7 else changed)
    elif kind == 4:
        records[at] = (rng.randrange(256), body)
    elif kind == 5:
        del records[at]
    elif kind == 6:
        records.insert(rng.randrange(len(records)), records[at])
    else:
        return _with_length(content, records, at, rng)
    return content[:_MAGIC_BYTES] + b"".join(_RECORD.pack(op, len(b)) + b for op, b in records) + rest


def _records(content: bytes) -> tuple[list[tuple[int, bytes]], bytes]:
    found, at = [], _MAGIC_BYTES
    while at + _RECORD.size <= len(content):
        opcode, length = _RECORD.unpack_from(content, at)
        if at + _RECORD.size + length > len(content):
            break
        found.append((opcode, content[at + _RECORD.size : at + _RECORD.size + length]))
        at += _RECORD.size + length
    return found, content[at:]


def _with_length(content: bytes, records: list[tuple[int, bytes]], at: int, rng: random.Random) -> bytes:
    place = _MAGIC_BYTES + sum(_RECORD.size + len(body) for _, body in records[:at]) + 1
    length = rng.choice((*_INTEGERS, len(records[at][1]) + rng.randrange(-9, 10))) % (1 << 64)
    return content[:place] + struct.pack("<Q", length) + content[place + 8 :]


def _sealed(opcode: int, body: bytes) -> bytes:
    """A chunk with the size and the CRC of what is in it."""
    inner = _CHUNK_HEAD.size + 8
    if opcode != 6 or len(body) < inner:
        return body
    first, last, _, _, _ = _CHUNK_HEAD.unpack_from(body)
    stored = body[inner:]
    head = _CHUNK_HEAD.pack(first, last, len(stored), zlib.crc32(stored), 0)
    return head + struct.pack("<Q", len(stored)) + stored


# --- saved maps: magic, header and chunks with their lengths, digest ---


def checkpoint(content: bytes, rng: random.Random, corpus: Sequence[bytes]) -> bytes:
    """A change of the header, a chunk or anything, mostly with a true digest."""
    parts, at = [], 8
    while at + 4 <= len(content) - 16:
        (length,) = struct.unpack_from("<I", content, at)
        parts.append(content[at + 4 : at + 4 + length])
        at += 4 + length
    if not parts or rng.random() < 0.2:
        return raw(content, rng, corpus)
    place = rng.randrange(len(parts))
    if rng.random() < 0.5:
        place, changed = 0, msgpack(parts[0], rng, corpus)
    else:
        changed = raw(parts[place], rng, corpus)
    parts[place] = changed
    body = content[:8] + b"".join(struct.pack("<I", len(part)) + part for part in parts)
    return body + (blake2b(body, digest_size=16).digest() if rng.random() < 0.9 else content[-16:])
