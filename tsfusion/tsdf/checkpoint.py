# SPDX-License-Identifier: MIT
"""A saved map: one file, written whole or not at all, verified when read.

    TSFMAP1\\n | header | chunk … | digest      each but the first: uint32 length, then its bytes

The header is msgpack; a chunk is one zstd frame with the keys and then each layer of up to 1024 blocks,
blocks in key order; the digest is blake2b-128 of everything before it.
"""

import hashlib
import os
import struct
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import msgspec
import numpy as np
import zstandard
from numpy.typing import NDArray

from tsfusion.core import durable_files
from tsfusion.core.config import VolumeConfig
from tsfusion.core.errors import CheckpointError, DamagedCheckpoint
from tsfusion.core.side_thread import SideThread

MAGIC = b"TSFMAP1\n"
CHUNK = 1024  # blocks
CUBE = 512  # voxels a block
_DIGEST_BYTES = 16
_PART = 1 << 20  # bytes that are copied at a time
_ROWS = 128  # that are gathered at a time
_MAX_WINDOW_BYTES = 1 << 24  # of zstd; level 1 uses less
LAYER_DTYPES = {"sums": np.int64, "color_rgn": np.int64, "color_b": np.int32, "correction": np.float32}


class CheckpointHeader(msgspec.Struct, kw_only=True):
    """First part of a checkpoint: the settings and history of the map, and what follows."""

    config: VolumeConfig
    keyframes: int
    map_hash: str
    layers: list[str]
    meta: dict[str, Any]
    blocks: int = 0


class Chunk(NamedTuple):
    """Up to 1024 blocks of a checkpoint that is being read.

    `fill` reads the next bytes into an array: first the keys (blocks,) int64, then for each layer of the
    header, in its order, rows (blocks, 512) of the layer's dtype.
    """

    first: int
    blocks: int
    fill: Callable[[NDArray[Any]], None]


def write(
    path: Path,
    header: CheckpointHeader,
    keys: NDArray[np.int64],
    slots: NDArray[np.int64],
    layers: dict[str, NDArray[Any]],
    *,
    map_digest: "hashlib.blake2b | None" = None,
    between: Callable[[], None] = lambda: None,
) -> Path:
    """Write blocks `slots` of each layer (…, 512) under their keys.

    What was at `path` stays as it was until the new file is whole and on the disk. A part that a killed
    writer left is overwritten.

    Args:
        map_digest: takes the keys and sums, so that they are read once; what it comes to is the header's
            `map_hash`.
        between: called after each 1024 blocks are read.

    Raises:
        CheckpointError: when the file cannot be written.
    """
    header.blocks = len(keys)
    if map_digest is not None:
        header.map_hash = "0" * 2 * map_digest.digest_size
    try:
        with durable_files.replacing(path) as file:
            file.write(MAGIC)
            _write_header(file, header)
            for payload in _payloads(keys, slots, layers, map_digest, between):
                for part in (struct.pack("<I", sum(map(len, payload))), *payload):
                    file.write(part)
            if map_digest is not None:
                header.map_hash = map_digest.hexdigest()
                file.seek(len(MAGIC))
                _write_header(file, header)
                file.seek(0, os.SEEK_END)
            _write_digest(file)
    except OSError as error:
        raise CheckpointError(f"cannot write the map {path}: {error.strerror}") from error
    return path


def _write_header(file: BinaryIO, header: CheckpointHeader) -> None:
    encoded = msgspec.msgpack.encode(header)
    file.write(struct.pack("<I", len(encoded)) + encoded)


def _write_digest(file: BinaryIO) -> None:
    """Append the digest of a file that is written."""
    file.flush()
    with open(file.name, "rb") as written:
        file.write(_digest(written, file.tell()))


def copy(source: Path, target: Path, alter: Callable[[CheckpointHeader], None]) -> Path:
    """Write a checkpoint whose header is another one; the blocks are copied as they are.

    Raises:
        DamagedCheckpoint, CheckpointError: as `reading` and `write`.
    """
    try:
        with source.open("rb") as old, durable_files.replacing(target) as file:
            _check_magic(old, source)
            _check_digest(old, source)
            header = _read_header(old, source)
            alter(header)
            file.write(MAGIC)
            _write_header(file, header)
            left = os.fstat(old.fileno()).st_size - old.tell() - _DIGEST_BYTES
            for at in range(0, left, _PART):
                file.write(old.read(min(_PART, left - at)))
            _write_digest(file)
    except OSError as error:
        raise CheckpointError(f"cannot copy the map {source} to {target}: {error.strerror}") from error
    return target


@contextmanager
def reading(path: Path) -> Iterator[tuple[CheckpointHeader, Iterator[Chunk]]]:
    """Header and chunks of a checkpoint, for the block to put straight into their place.

    No more than a chunk is held beside that place. A MemoryError of the block is one of the checkpoint.

    Raises:
        DamagedCheckpoint: when a byte differs from what was written.
        CheckpointError: when the file is missing, cannot be read now, or is of another version.
    """
    try:
        with path.open("rb") as file:
            _check_magic(file, path)
            _check_digest(file, path)
            header = _read_header(file, path)
            yield header, _read_chunks(file, path, header)
    except OSError as error:
        missing = isinstance(error, FileNotFoundError)
        raise CheckpointError(f"cannot read the map {path}: {error.strerror}", missing=missing) from error
    except MemoryError as error:
        raise CheckpointError(f"the map {path} does not fit into this machine's memory") from error


def verify(path: Path, header: CheckpointHeader, map_hash: str) -> None:
    """Raise DamagedCheckpoint unless the loaded map has the hash that was saved."""
    if map_hash != header.map_hash:
        raise DamagedCheckpoint(f"{path} says its map hash is {header.map_hash}, but it loads as {map_hash}")


def _payloads(
    keys: NDArray[np.int64],
    slots: NDArray[np.int64],
    layers: dict[str, NDArray[Any]],
    map_digest: "hashlib.blake2b | None",
    between: Callable[[], None],
) -> Iterator[list[bytes]]:
    """Each chunk, in parts: the map may have left little memory. A second thread hashes meanwhile."""
    with SideThread() as side:
        for i in range(0, len(keys), CHUNK):
            chunk = slots[i : i + CHUNK]
            size = len(chunk) * _block_bytes(layers)
            compressor = zstandard.ZstdCompressor(level=1).compressobj(size=size)
            parts = []
            for name, rows in _rows(keys[i : i + CHUNK], chunk, layers):
                if map_digest is not None and name in ("keys", "sums"):
                    side.do(partial(map_digest.update, rows.data))
                parts.append(compressor.compress(rows.data))
            between()
            yield [*parts, compressor.flush()]
        side.wait()


def _rows(
    keys: NDArray[np.int64], slots: NDArray[np.int64], layers: dict[str, NDArray[Any]]
) -> Iterator[tuple[str, NDArray[Any]]]:
    """The keys of a chunk, and its rows, some at a time."""
    yield "keys", keys
    for name, layer in layers.items():
        for j in range(0, len(slots), _ROWS):
            yield name, layer[slots[j : j + _ROWS]]


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


def _block_bytes(layers: Iterable[str]) -> int:
    """Bytes of a block: its key and its row in each layer."""
    return 8 + sum(CUBE * np.dtype(LAYER_DTYPES[name]).itemsize for name in layers)


def _read_chunks(file: BinaryIO, path: Path, header: CheckpointHeader) -> Iterator[Chunk]:
    decompressor = zstandard.ZstdDecompressor(max_window_size=_MAX_WINDOW_BYTES)
    for first in range(0, header.blocks, CHUNK):
        count = min(CHUNK, header.blocks - first)
        size = count * _block_bytes(header.layers)
        (length,) = struct.unpack("<I", _read_exactly(file, 4, path))
        frame = _read_exactly(file, length, path)
        try:
            if zstandard.get_frame_parameters(frame).content_size != size:
                raise DamagedCheckpoint(f"{path} is damaged: a chunk is not of the {size} bytes expected")
            with decompressor.stream_reader(frame) as stream:
                yield Chunk(first, count, partial(_fill, stream, path))
        except zstandard.ZstdError as error:
            raise DamagedCheckpoint(f"{path} is damaged: {error}") from error


def _fill(stream: zstandard.ZstdDecompressionReader, path: Path, rows: NDArray[Any]) -> None:
    """Read the next bytes of a chunk into `rows`, which are contiguous."""
    try:
        read = stream.readinto(rows.data)
    except zstandard.ZstdError as error:
        raise DamagedCheckpoint(f"{path} is damaged: {error}") from error
    if read != rows.nbytes:
        raise DamagedCheckpoint(f"{path} is damaged: a chunk ends {rows.nbytes - read} bytes early")


def _check_digest(file: BinaryIO, path: Path) -> None:
    """Compare the digest of the whole file; leaves the position in `file` as it was.

    This comes before any allocation: a header with one flipped bit may ask for all memory there is.
    """
    here = file.tell()
    size = file.seek(0, os.SEEK_END) - _DIGEST_BYTES
    if size < 0 or _digest(file, size) != file.read():
        raise DamagedCheckpoint(f"{path} is cut short or altered: its digest does not match")
    file.seek(here)


def _digest(file: BinaryIO, size: int) -> bytes:
    """The digest of the first bytes of a file, whose position is behind them then."""
    file.seek(0)
    digest = hashlib.blake2b(digest_size=_DIGEST_BYTES)
    for at in range(0, size, _PART):
        digest.update(file.read(min(_PART, size - at)))
    return digest.digest()


def _read_exactly(file: BinaryIO, size: int, path: Path) -> bytes:
    """Read `size` bytes, or raise DamagedCheckpoint where the file ends before."""
    if size > os.fstat(file.fileno()).st_size or len(content := file.read(size)) != size:
        raise DamagedCheckpoint(f"{path} is cut short")
    return content
