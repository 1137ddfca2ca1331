# SPDX-License-Identifier: MIT
"""A saved map: one file, written whole or not at all, verified when read.

    TSFMAP1\\n | header | chunk … | digest      each but the first: uint32 length, then its bytes

The header is msgpack; a chunk is one zstd frame with the keys and then each layer of up to 1024 blocks,
blocks in key order; the digest is blake2b-128 of everything before it.
"""

import hashlib
import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any, BinaryIO

import msgspec
import numpy as np
import zstandard
from numpy.typing import NDArray

from tsfusion.core import durable_files
from tsfusion.core.config import VolumeConfig
from tsfusion.core.errors import CheckpointError, DamagedCheckpoint

MAGIC = b"TSFMAP1\n"
CHUNK = 1024  # blocks
CUBE = 512  # voxels a block
LAYER_DTYPES = {"sums": np.int64, "color_rgn": np.int64, "color_b": np.int32, "correction": np.float32}


class CheckpointHeader(msgspec.Struct, kw_only=True):
    """First part of a checkpoint: the settings and history of the map, and what follows."""

    config: VolumeConfig
    keyframes: int
    map_hash: str
    layers: list[str]
    meta: dict[str, Any]
    blocks: int = 0


def write(
    path: Path,
    header: CheckpointHeader,
    keys: NDArray[np.int64],
    slots: NDArray[np.int64],
    layers: dict[str, NDArray[Any]],
) -> Path:
    """Write blocks `slots` of each layer (…, 512) under their keys.

    What was at `path` stays as it was until the new file is whole and on the disk. A part that a killed
    writer left is overwritten.

    Raises:
        CheckpointError: when the file cannot be written.
    """
    header.blocks = len(keys)
    digest = hashlib.blake2b(MAGIC, digest_size=16)
    try:
        with durable_files.replacing(path) as file:
            file.write(MAGIC)
            for payload in _payloads(header, keys, slots, layers):
                for part in (struct.pack("<I", len(payload)), payload):
                    digest.update(part)
                    file.write(part)
            file.write(digest.digest())
    except OSError as error:
        raise CheckpointError(f"cannot write the map {path}: {error.strerror}") from error
    return path


def read(path: Path) -> tuple[CheckpointHeader, NDArray[np.int64], dict[str, NDArray[Any]]]:
    """Header, keys and layers of a checkpoint.

    Raises:
        DamagedCheckpoint: when a byte differs from what was written.
        CheckpointError: when the file is missing, cannot be read now, or is of another version.
    """
    try:
        with path.open("rb") as file:
            _check_magic(file, path)
            _check_digest(file, path)
            header = _read_header(file, path)
            keys = np.empty(header.blocks, np.int64)
            layers = {name: np.empty((header.blocks, CUBE), LAYER_DTYPES[name]) for name in header.layers}
            for first, chunk in _read_chunks(file, path, header):
                count, at = min(CHUNK, header.blocks - first), 0
                for target in (keys, *layers.values()):
                    part = target[first : first + count]
                    part[...] = np.frombuffer(chunk, part.dtype, part.size, at).reshape(part.shape)
                    at += part.nbytes
    except OSError as error:
        missing = isinstance(error, FileNotFoundError)
        raise CheckpointError(f"cannot read the map {path}: {error.strerror}", missing=missing) from error
    except MemoryError as error:
        raise CheckpointError(f"the map {path} does not fit into this machine's memory") from error
    return header, keys, layers


def verify(path: Path, header: CheckpointHeader, map_hash: str) -> None:
    """Raise DamagedCheckpoint unless the loaded map has the hash that was saved."""
    if map_hash != header.map_hash:
        raise DamagedCheckpoint(f"{path} says its map hash is {header.map_hash}, but it loads as {map_hash}")


def _payloads(
    header: CheckpointHeader,
    keys: NDArray[np.int64],
    slots: NDArray[np.int64],
    layers: dict[str, NDArray[Any]],
) -> Iterator[bytes]:
    compressor = zstandard.ZstdCompressor(level=1)
    yield msgspec.msgpack.encode(header)
    for i in range(0, len(keys), CHUNK):
        chunk = slots[i : i + CHUNK]
        raw = keys[i : i + CHUNK].tobytes() + b"".join(layer[chunk].tobytes() for layer in layers.values())
        yield compressor.compress(raw)


def _check_magic(file: BinaryIO, path: Path) -> None:
    magic = file.read(len(MAGIC))
    if magic == MAGIC:
        return
    is_of_another_version = len(magic) == len(MAGIC) and magic.startswith(MAGIC[:-2])
    kind = CheckpointError if is_of_another_version else DamagedCheckpoint
    raise kind(
        f"{path} is not a tsfusion map of version 1 (it starts with {magic!r}); "
        "expected the map.tsf of a server"
    )


def _read_header(file: BinaryIO, path: Path) -> CheckpointHeader:
    (length,) = struct.unpack("<I", _read_exactly(file, 4, path))
    try:
        header = msgspec.msgpack.decode(_read_exactly(file, length, path), type=CheckpointHeader)
    except msgspec.ValidationError as error:  # the digest agrees: it is as its writer meant it
        raise CheckpointError(f"{path} is of another version: {error}") from error
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise DamagedCheckpoint(f"{path} is malformed: {error}") from error
    if not set(header.layers) <= set(LAYER_DTYPES):
        raise CheckpointError(f"{path} is of another version: it has layers {header.layers}")
    if not 0 <= header.blocks <= header.config.max_blocks:
        raise DamagedCheckpoint(f"{path} is malformed: it claims {header.blocks} blocks")
    return header


def _read_chunks(file: BinaryIO, path: Path, header: CheckpointHeader) -> Iterator[tuple[int, bytes]]:
    per_block = 8 + sum(CUBE * np.dtype(LAYER_DTYPES[name]).itemsize for name in header.layers)
    for first in range(0, header.blocks, CHUNK):
        size = min(CHUNK, header.blocks - first) * per_block
        (length,) = struct.unpack("<I", _read_exactly(file, 4, path))
        frame = _read_exactly(file, length, path)
        try:
            if zstandard.get_frame_parameters(frame).content_size != size:
                raise DamagedCheckpoint(f"{path} is damaged: a chunk is not of the {size} bytes expected")
            yield first, zstandard.ZstdDecompressor().decompress(frame)
        except zstandard.ZstdError as error:
            raise DamagedCheckpoint(f"{path} is damaged: {error}") from error


def _check_digest(file: BinaryIO, path: Path) -> None:
    """Compare the digest of the whole file; leaves the position in `file` as it was.

    This comes before any allocation: a header with one flipped bit may ask for all memory there is.
    """
    here = file.tell()
    remaining = file.seek(0, os.SEEK_END) - 16
    file.seek(0)
    digest = hashlib.blake2b(digest_size=16)
    while remaining > 0:
        part = file.read(min(1 << 20, remaining))
        digest.update(part)
        remaining -= len(part)
    if file.read() != digest.digest():
        raise DamagedCheckpoint(f"{path} is cut short or altered: its digest does not match")
    file.seek(here)


def _read_exactly(file: BinaryIO, size: int, path: Path) -> bytes:
    """Read `size` bytes, or raise DamagedCheckpoint where the file ends before."""
    if size > os.fstat(file.fileno()).st_size or len(content := file.read(size)) != size:
        raise DamagedCheckpoint(f"{path} is cut short")
    return content
