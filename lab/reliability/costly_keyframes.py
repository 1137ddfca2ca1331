# SPDX-License-Identifier: MIT
"""Keyframes that a server accepts, and that cost it more than others do."""

import os
import struct
import zlib
from functools import cache

import numpy as np
from hostile_messages import Frames, with_depth, with_header
from keyframes_and_servers import pose

from lab.reliability.attack_target import Target
from tsfusion import Keyframe
from tsfusion.wire.records import codec


def rays(count: int, extent: float, *, seed: int = 0) -> Keyframe:
    """Points in all directions from as many origins in a cube of `extent` metres a side."""
    rng = np.random.default_rng(seed)
    origins = rng.uniform(-extent / 2, extent / 2, (count, 3)).astype(np.float32)
    ends = origins + rng.normal(0.0, 20.0, (count, 3)).astype(np.float32)
    return Keyframe(points=ends, origins=origins, T_world_camera=pose(), sensor="lidar")


@cache
def crossings(count: int = 1_600_000) -> Frames:
    """One keyframe of almost 32 MB whose rays have nothing in common."""
    return codec.encode(rays(count, 100.0), session=os.urandom(16), seq=1, jpeg_quality=90)


@cache
def filling(seed: int, count: int = 40_000) -> Frames:
    """A small keyframe, each of whose rays needs blocks that no other one needs."""
    return codec.encode(rays(count, 2000.0, seed=seed), session=os.urandom(16), seq=1, jpeg_quality=90)


def _chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


@cache
def surplus_idat(nbytes: int = 4 << 30) -> Frames:
    """A depth image of 64 × 48 pixels, followed by zeros that unfold to so many bytes."""
    image = zlib.compressobj(9)
    piece = 64 << 20
    begin = image.compress(bytes(48 * (1 + 2 * 64))) + image.flush(zlib.Z_FULL_FLUSH)
    more = image.compress(bytes(piece)) + image.flush(zlib.Z_FULL_FLUSH)  # stands alone: it can be repeated
    ihdr = struct.pack(">IIBBBBB", 64, 48, 16, 0, 0, 0, 0)
    chunks = [_chunk(b"IHDR", ihdr), _chunk(b"IDAT", begin)]
    chunks += [_chunk(b"IDAT", more)] * (nbytes // piece)
    chunks += [_chunk(b"IDAT", image.flush()), _chunk(b"IEND", b"")]
    return with_depth(b"\x89PNG\r\n\x1a\n" + b"".join(chunks), (48, 64), "png")


def fresh(frames: Frames) -> Frames:
    """The same keyframe as the first of a session of its own."""
    return with_header(frames, session=os.urandom(16), seq=1, previous=0)


def following(target: Target, frames: Frames, sent: int) -> Frames:
    """The same keyframe as the next one: of another session each, where these are all one client's.

    Without keys each session gets its turn, and who opens many gets many: docs/delivery.md.
    """
    if target.public:
        return fresh(frames)
    session = str(target.end).encode().ljust(16)[:16]
    return with_header(frames, session=session, seq=sent + 1, previous=0)  # others may have been refused
