# SPDX-License-Identifier: MIT
r"""Read and write a saved map: one file, written completely or not at all, and verified when read.

    TSFMAP1\n | header | chunk … | digest      each but the first: uint32 length, then its bytes

The header is msgpack. A chunk is one zstd frame with the keys and then each layer of up to 1024 blocks, in
key order. A sum of maps also has shorter chunks. The digest is blake2b-128 of everything before it.
"""

import hashlib
import os
import struct
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO, NamedTuple

import msgspec
import numpy as np
import zstandard
from numpy.typing import NDArray

from tsfusion.core import durable_files
from tsfusion.core.config import SYMMETRIC, VolumeConfig
from tsfusion.core.errors import CheckpointError, DamagedCheckpoint, errors_as, refusals_as
from tsfusion.tsdf.files import map_history
from tsfusion.tsdf.store.growing_array import LAYER_DTYPES

if TYPE_CHECKING:
    from tsfusion.tsdf.store.clear_blocks import ClearCounts

MAGIC = b"TSFMAP1\n"
CHUNK = 1024  # blocks
CUBE = 512  # voxels a block
_MOST_WAITING = 2  # calls of a side thread: each waiting call keeps memory
_DIGEST_BYTES = 16
_PART = 1 << 20  # bytes to copy per step
_ROWS = 128  # rows to gather per step
_MAX_WINDOW_BYTES = 1 << 24  # of zstd; level 1 uses less

NamedArrays = Iterable[tuple[str, NDArray[Any]]]  # for each layer: its name, and some rows of a chunk


class CheckpointHeader(msgspec.Struct, kw_only=True):
    """First part of a checkpoint: the settings and history of the map, and the layout of the other parts."""

    config: VolumeConfig
    keyframes: int
    map_hash: str
    layers: list[str]
    meta: dict[str, Any]
    blocks: int = 0
    clear: bytes = b""  # blocks that keyframes look through (`clear_blocks.encoded`)

    def clear_blocks(self, path: Path) -> "ClearCounts":
        """Return the blocks that keyframes look through, and their counts. Raises DamagedCheckpoint."""
        from tsfusion.tsdf.store import clear_blocks  # imports Taichi

        with errors_as(DamagedCheckpoint, f"{path} is malformed", ValueError):
            return clear_blocks.decoded(self.clear, self.config.max_blocks)


class _SavedSettings(msgspec.Struct):
    config: dict[str, Any]


class Chunk(NamedTuple):
    """Up to 1024 blocks of a checkpoint that is being read.

    `fill` reads the next bytes into an array: first the keys (blocks,) int64, then, for each layer in the
    header's order, rows (blocks, 512) of its dtype. `frame` is the whole chunk as stored.
    """

    first: int
    blocks: int
    fill: Callable[[NDArray[Any]], None]
    frame: bytes


class Piece(NamedTuple):
    """Up to 1024 blocks of a checkpoint that is being written, in one of three forms.

    `rows` has the keys, then the layers in the header's order. `content` has all of that in one array.
    `frame` is the compressed form, as stored in a file (`Chunk`).
    """

    blocks: int
    rows: NamedArrays = ()
    content: NDArray[np.uint8] | None = None
    frame: bytes = b""


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
    """Write a checkpoint: the blocks `slots` of each layer (…, 512) under their keys.

    The old file at `path` stays until the new file is complete and on the disk. The partial file of a killed
    writer is overwritten.

    Args:
        map_digest: takes the keys and sums in the same pass; its result is the header's `map_hash`.
        between: called after each 1024 blocks are read.

    Raises:
        CheckpointError: when the file cannot be written.
    """
    with SideThread() as side:

        def hashed(rows: NamedArrays) -> NamedArrays:
            for name, some in rows:
                if map_digest is not None and name in ("keys", "sums"):
                    side.do(partial(map_digest.update, some.data))
                yield name, some

        def map_hash() -> str:
            side.wait()
            return "" if map_digest is None else map_digest.hexdigest()

        pieces = (
            Piece(len(chunk), hashed(_rows(keys[i : i + CHUNK], chunk, layers)))
            for i in range(0, len(keys), CHUNK)
            for chunk in (slots[i : i + CHUNK],)
        )
        if map_digest is not None:
            header.map_hash = "0" * 2 * map_digest.digest_size
        hash_at_end = None if map_digest is None else map_hash
        return write_pieces(path, header, len(keys), pieces, map_hash=hash_at_end, between=between)


def write_pieces(
    path: Path,
    header: CheckpointHeader,
    blocks: int,
    pieces: Iterable[Piece],
    *,
    map_hash: Callable[[], str] | None = None,
    between: Callable[[], None] = lambda: None,
) -> Path:
    """Write a map of `blocks` blocks from `pieces` in key order, as `write`, with one piece in memory.

    `map_hash` is called after the last piece; until then the header has a placeholder of its length.
    """
    header.blocks = blocks
    with refusals_as(CheckpointError, f"cannot write the map {path}"), durable_files.replacing(path) as file:
        file.write(MAGIC)
        _write_header(file, header)
        for payload in _payloads(header, pieces, between):
            for part in (struct.pack("<I", sum(map(len, payload))), *payload):
                file.write(part)
        if map_hash is not None:
            header.map_hash = map_hash()
            file.seek(len(MAGIC))
            _write_header(file, header)
            file.seek(0, os.SEEK_END)
        _write_digest(file)
    return path


def _write_header(file: BinaryIO, header: CheckpointHeader) -> None:
    encoded = msgspec.msgpack.encode(header)
    file.write(struct.pack("<I", len(encoded)) + encoded)


def _write_digest(file: BinaryIO) -> None:
    file.flush()
    with open(file.name, "rb") as written:
        file.write(_digest(written, file.tell()))


def copy(source: Path, target: Path, alter: Callable[[CheckpointHeader], None]) -> Path:
    """Copy a checkpoint, with a header that `alter` changes. Raises as `reading` and `write`."""
    with (
        refusals_as(CheckpointError, f"cannot copy the map {source} to {target}"),
        source.open("rb") as old,
        durable_files.replacing(target) as file,
    ):
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
    return target


def split(content: NDArray[np.uint8], layers: Iterable[str]) -> tuple[NDArray[np.int64], dict[str, Any]]:
    """Split the bytes of a chunk into keys (n,) and rows (n, 512) of each layer.

    `content` comes from `array_for`, or is a whole chunk; the arrays are views of it.
    """
    layers = list(layers)
    blocks = len(content) // _block_bytes(layers)
    rows, at = dict[str, Any](), 8 * blocks
    for name in layers:
        end = at + blocks * CUBE * np.dtype(LAYER_DTYPES[name]).itemsize
        rows[name] = content[at:end].view(LAYER_DTYPES[name]).reshape(blocks, CUBE)
        at = end
    return content[: 8 * blocks].view(np.int64), rows


def array_for(blocks: int, layers: Iterable[str]) -> NDArray[np.uint8]:
    return np.empty(blocks * _block_bytes(layers), np.uint8)


@contextmanager
def reading(path: Path, *, is_checked: bool = False) -> Iterator[tuple[CheckpointHeader, Iterator[Chunk]]]:
    """Open a checkpoint. Yields its header and chunks; the `with` block reads each chunk into its own arrays.

    Memory holds one chunk besides these. A MemoryError of the `with` block becomes a CheckpointError.

    Args:
        is_checked: the caller has just read the file, so its digest is not compared again.

    Raises:
        DamagedCheckpoint: when a byte differs from the written byte.
        CheckpointError: when the file is missing, unreadable, or of another version.
    """
    try:
        with path.open("rb") as file:
            _check_magic(file, path)
            if not is_checked:
                _check_digest(file, path)
            header = _read_header(file, path)
            yield header, _read_chunks(file, path, header)
    except OSError as error:
        missing = isinstance(error, FileNotFoundError)
        raise CheckpointError(f"cannot read the map {path}: {error.strerror}", missing=missing) from error
    except MemoryError as error:
        raise CheckpointError(f"the map {path} does not fit into this machine's memory") from error


def keys_of(path: Path, *, is_checked: bool = False) -> tuple[CheckpointHeader, NDArray[np.int64]]:
    """Return the header and the sorted block keys of a checkpoint. Arguments and errors as in `reading`."""
    with reading(path, is_checked=is_checked) as (header, chunks):
        keys = np.empty(header.blocks, np.int64)
        for chunk in chunks:
            chunk.fill(keys[chunk.first : chunk.first + chunk.blocks])
    return header, keys


def verify(path: Path, header: CheckpointHeader, map_hash: str) -> None:
    """Raise DamagedCheckpoint unless the loaded map has the hash that was saved."""
    if map_hash != header.map_hash:
        raise DamagedCheckpoint(f"{path} says its map hash is {header.map_hash}, its content has {map_hash}")


def _payloads(
    header: CheckpointHeader, pieces: Iterable[Piece], between: Callable[[], None]
) -> Iterator[list[bytes]]:
    """Yield the bytes of each piece as several parts: there may be little memory beside the map."""
    left = header.blocks
    for piece in pieces:
        left -= piece.blocks
        if piece.frame:
            yield [piece.frame]
            continue
        if piece.content is not None:  # one call is a quarter faster than several
            yield [zstandard.ZstdCompressor(level=1).compress(piece.content.data)]
            continue
        size = piece.blocks * _block_bytes(header.layers)
        compressor = zstandard.ZstdCompressor(level=1).compressobj(size=size)
        parts = [compressor.compress(rows.data) for _, rows in piece.rows]
        between()
        yield [*parts, compressor.flush()]
    assert left == 0, "the pieces are not all blocks"


def _rows(
    keys: NDArray[np.int64], slots: NDArray[np.int64], layers: dict[str, NDArray[Any]]
) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield names and arrays of a chunk: the keys, then the layers, `_ROWS` rows per step."""
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
    encoded = _read_exactly(file, length, path)
    try:
        header = msgspec.msgpack.decode(encoded, type=CheckpointHeader)
        if "min_behind" not in msgspec.msgpack.decode(encoded, type=_SavedSettings).config:
            # Older rays reach equally far before and behind their ends; rays added later must, too
            header.config = msgspec.structs.replace(header.config, min_behind=SYMMETRIC)
    except msgspec.ValidationError as error:  # the digest agrees, so the writer wrote exactly this
        raise CheckpointError(f"{path} is of another version: {error}") from error
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise DamagedCheckpoint(f"{path} is malformed: {error}") from error
    if not {"sums"} <= set(header.layers) <= set(LAYER_DTYPES):
        raise CheckpointError(f"{path} is of another version: it has layers {header.layers}")
    if not 0 <= header.blocks <= header.config.max_blocks or header.keyframes < 0:
        claim = f"{header.blocks} blocks of {header.keyframes} keyframes"
        raise DamagedCheckpoint(f"{path} is malformed: it claims {claim}")
    try:
        map_history.check_readable(header.meta)
    except (TypeError, ValueError, LookupError, AttributeError) as error:
        raise DamagedCheckpoint(f"{path} is malformed: its list of keyframes cannot be read") from error
    return header


def _block_bytes(layers: Iterable[str]) -> int:
    return 8 + sum(CUBE * np.dtype(LAYER_DTYPES[name]).itemsize for name in layers)


def _read_chunks(file: BinaryIO, path: Path, header: CheckpointHeader) -> Iterator[Chunk]:
    decompressor = zstandard.ZstdDecompressor(max_window_size=_MAX_WINDOW_BYTES)
    each, first, blocks = _block_bytes(header.layers), 0, header.blocks
    while first < blocks:
        (length,) = struct.unpack("<I", _read_exactly(file, 4, path))
        frame = _read_exactly(file, length, path)
        with errors_as(DamagedCheckpoint, f"{path} is damaged", zstandard.ZstdError):
            size = zstandard.get_frame_parameters(frame).content_size
            if size % each or not 0 < size <= each * min(CHUNK, blocks - first):
                raise DamagedCheckpoint(f"{path} is damaged: a chunk has another size than expected")
            with decompressor.stream_reader(frame) as stream:
                yield Chunk(first, size // each, partial(_fill, stream, path), frame)
        first += size // each


def _fill(stream: zstandard.ZstdDecompressionReader, path: Path, rows: NDArray[Any]) -> None:
    """Read the next bytes of a chunk into the contiguous array `rows`."""
    with errors_as(DamagedCheckpoint, f"{path} is damaged", zstandard.ZstdError):
        read = stream.readinto(rows.data)
    if read != rows.nbytes:
        raise DamagedCheckpoint(f"{path} is damaged: a chunk ends {rows.nbytes - read} bytes early")


def _check_digest(file: BinaryIO, path: Path) -> None:
    """Raise DamagedCheckpoint unless the file's digest is right. The position in `file` stays the same.

    The check comes before any allocation, because a header with one flipped bit may ask for all memory.
    """
    here = file.tell()
    size = file.seek(0, os.SEEK_END) - _DIGEST_BYTES
    if size < 0 or _digest(file, size) != file.read():
        raise DamagedCheckpoint(f"{path} is cut short or altered: its digest does not match")
    file.seek(here)


def _digest(file: BinaryIO, size: int) -> bytes:
    """Return the digest of the first `size` bytes of a file, and leave the position after these bytes."""
    file.seek(0)
    digest = hashlib.blake2b(digest_size=_DIGEST_BYTES)
    for at in range(0, size, _PART):
        digest.update(file.read(min(_PART, size - at)))
    return digest.digest()


def _read_exactly(file: BinaryIO, size: int, path: Path) -> bytes:
    if size > os.fstat(file.fileno()).st_size or len(content := file.read(size)) != size:
        raise DamagedCheckpoint(f"{path} is cut short")
    return content


class SideThread:
    """A thread for calls in order, used as a context; if no thread can start, calls run at once."""

    def __init__(self) -> None:
        self._pool: ThreadPoolExecutor | None = ThreadPoolExecutor(1)
        self._waiting: deque[Future[None]] = deque()

    def __enter__(self) -> "SideThread":
        return self

    def __exit__(self, *_: object) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def do(self, call: Callable[[], None]) -> None:
        """Queue a call; wait while the queue is full. Raises an error of an earlier call."""
        if self._pool is not None:
            try:
                self._waiting.append(self._pool.submit(call))
            except RuntimeError:  # no thread, for want of memory
                self._pool = None
        if self._pool is None:
            call()
        while len(self._waiting) > _MOST_WAITING:
            self._waiting.popleft().result()

    def wait(self) -> None:
        """Wait until every call is done. Raises an error of one of the calls."""
        while self._waiting:
            self._waiting.popleft().result()
