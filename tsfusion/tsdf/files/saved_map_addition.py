# SPDX-License-Identifier: MIT
"""Add any number of saved maps, file to file, with memory for one chunk of each.

A chunk is copied without decompression if its blocks lie between the blocks of all other maps. Then only its
keys and sums are read, for the hash.
"""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import MapError, MapFull, WeightOverflow
from tsfusion.core.number_ranges import distinct
from tsfusion.geometry.up_direction import SensorPosture
from tsfusion.kernels.base.sensor_noise import WEIGHT_ONE
from tsfusion.kernels.integration.integrate import WEIGHT_LIMIT
from tsfusion.tsdf.files import checkpoint, map_history
from tsfusion.tsdf.files.checkpoint import CHUNK, CUBE, CheckpointHeader, Chunk, Piece, SideThread
from tsfusion.tsdf.files.map_history import HELD
from tsfusion.tsdf.files.saved_map import begin_hash
from tsfusion.tsdf.store import clear_blocks
from tsfusion.tsdf.store.growing_array import LAYER_DTYPES
from tsfusion.tsdf.sums.map_addition import added_colors

BlockColumns = dict[str, NDArray[Any]]  # (n, 512) of each layer


def add_files(paths: Sequence[Path], target: Path) -> CheckpointHeader:
    """Write the sum of saved maps of one frame, voxel size and set of layers, as `Volume.merge` makes it.

    Args:
        paths: one or more files; the caller makes sure that no keyframe is in two of them.
        target: the file to write; may be one of `paths`.

    Raises:
        MapError: when the maps differ in voxel size or layers.
        MapFull, WeightOverflow: as `Volume.merge`; nothing is written.
        CheckpointError: when a map cannot be read, or the sum cannot be written.
    """
    headers, keys = zip(*(checkpoint.keys_of(path) for path in paths), strict=True)
    blocks = len(distinct(np.concatenate(keys)))
    header = _header(paths, headers, blocks)
    with ExitStack() as opened:
        streams = [
            _BlockStream(own, opened.enter_context(checkpoint.reading(path, is_checked=True)))
            for path, own in zip(paths, keys, strict=True)
        ]
        digest = opened.enter_context(MapDigest(header.config.voxel_size))
        pieces = _pieces(streams, header.layers, digest)
        checkpoint.write_pieces(target, header, blocks, pieces, map_hash=digest.hexdigest)
    return header


def checked_keys(path: Path) -> tuple[CheckpointHeader, NDArray[np.int64]]:
    """Return header and block keys of a checkpoint, after a check of its voxels against the map's hash.

    Raises as `checkpoint.reading`, and DamagedCheckpoint for another hash.
    """
    with checkpoint.reading(path) as (header, chunks), MapDigest(header.config.voxel_size) as digest:
        keys = np.empty(header.blocks, np.int64)
        for chunk in chunks:
            own = keys[chunk.first : chunk.first + chunk.blocks]
            chunk.fill(own)
            for name in header.layers[: header.layers.index("sums") + 1]:
                chunk.fill(rows := np.empty((chunk.blocks, CUBE), LAYER_DTYPES[name]))
            digest.add(own, rows)
        checkpoint.verify(path, header, digest.hexdigest())
    return header, keys


def _header(paths: Sequence[Path], headers: Sequence[CheckpointHeader], blocks: int) -> CheckpointHeader:
    first = headers[0]
    for other in headers[1:]:
        if (other.config.voxel_size, other.layers) != (first.config.voxel_size, first.layers):
            raise MapError("maps of different voxel sizes or layers cannot be added: fuse one of them again")
    if blocks > first.config.max_blocks:
        raise MapFull(
            f"the map may hold at most max_blocks = {first.config.max_blocks} blocks; together they have "
            f"{blocks}: choose larger voxels, or fuse parts of the journal"
        )
    clear = clear_blocks.summed([one.clear_blocks(path) for one, path in zip(headers, paths, strict=True)])
    clear_blocks.check_count(len(clear[0]), first.config.max_blocks)
    held, meta = SensorPosture(), dict[str, Any]()
    for number, one in enumerate(headers):
        own = dict(one.meta)
        held.merge(SensorPosture(own.pop(HELD, None)))
        meta = map_history.added(meta, own) if number else own
    return CheckpointHeader(
        config=first.config,
        keyframes=sum(one.keyframes for one in headers),
        map_hash="0" * len(first.map_hash),  # placeholder until the hash is known
        meta={**meta, HELD: held.numbers},
        layers=first.layers,
        clear=clear_blocks.encoded(clear),
    )


class MapDigest:
    """Hash of a map from its blocks in key order, given in pieces of any length."""

    def __init__(self, voxel_size: float) -> None:
        self._digest, self._side = begin_hash(voxel_size), SideThread()
        self._waiting: list[tuple[NDArray[np.int64], NDArray[np.int64]]] = []  # keys, sums
        self._count = 0

    def __enter__(self) -> "MapDigest":
        self._side.__enter__()
        return self

    def __exit__(self, *of: object) -> None:
        self._side.__exit__(*of)

    def add(self, keys: NDArray[np.int64], sums: NDArray[np.int64]) -> None:
        """Add the next blocks in key order to the hash; the arrays must not change afterwards."""
        while len(keys):
            now = min(CHUNK - self._count, len(keys))
            self._waiting.append((keys[:now], sums[:now]))
            self._count += now
            keys, sums = keys[now:], sums[now:]
            if self._count == CHUNK:
                self._take()

    def _take(self) -> None:
        for which in (0, 1):
            for one in self._waiting:
                self._side.do(partial(self._digest.update, one[which].data))
        self._waiting, self._count = [], 0

    def hexdigest(self) -> str:
        self._take()
        self._side.wait()
        return self._digest.hexdigest()


class _BlockStream:
    def __init__(self, keys: NDArray[np.int64], opened: tuple[CheckpointHeader, Iterator[Chunk]]) -> None:
        self._keys, self._layers, self._chunks = keys, opened[0].layers, opened[1]
        self._chunk: Chunk | None = None  # chunk of the next block
        self._rows: BlockColumns = {}  # rows of that chunk, after they are read
        self._taken = 0

    @property
    def is_over(self) -> bool:
        return self._taken == len(self._keys)

    @property
    def next_key(self) -> int:
        return int(self._keys[self._taken])

    @property
    def last_key(self) -> int:
        chunk = self._current()
        return int(self._keys[chunk.first + chunk.blocks - 1])

    @property
    def is_at_chunk(self) -> bool:
        return self._current().first == self._taken

    def _current(self) -> Chunk:
        if self._chunk is None or self._chunk.first + self._chunk.blocks == self._taken:
            self._chunk, self._rows = next(self._chunks), {}
        return self._chunk

    def pass_on(self, digest: MapDigest) -> Piece:
        chunk = self._current()
        keys, sums = np.empty(chunk.blocks, np.int64), np.empty((chunk.blocks, CUBE), np.int64)
        chunk.fill(keys)
        chunk.fill(sums)  # the first layer
        digest.add(keys, sums)
        self._taken += chunk.blocks
        return Piece(chunk.blocks, frame=chunk.frame)

    def keys_up_to(self, last: int) -> NDArray[np.int64]:
        rest = self._keys[self._taken :]
        return rest[: np.searchsorted(rest, last, side="right")]

    def take(self, last: int) -> Iterator[tuple[NDArray[np.int64], BlockColumns]]:
        """Yield keys and rows of the next blocks of a file, up to key `last`, one chunk per step."""
        left = len(self.keys_up_to(last))
        while left:
            chunk = self._current()
            if not self._rows:
                self._read(chunk)
            first = self._taken - chunk.first
            now = min(left, chunk.blocks - first)
            keys = self._keys[self._taken : self._taken + now]
            self._taken, left = self._taken + now, left - now
            yield keys, {name: rows[first : first + now] for name, rows in self._rows.items()}

    def _read(self, chunk: Chunk) -> None:
        content = checkpoint.array_for(chunk.blocks, self._layers)
        chunk.fill(content)
        _, self._rows = checkpoint.split(content, self._layers)


def _pieces(streams: Sequence[_BlockStream], layers: Sequence[str], digest: MapDigest) -> Iterator[Piece]:
    while left := sorted((one for one in streams if not one.is_over), key=lambda one: one.next_key):
        first, last = left[0], left[0].last_key
        if first.is_at_chunk and all(one.next_key > last for one in left[1:]):
            yield first.pass_on(digest)
            continue
        keys = distinct(np.concatenate([one.keys_up_to(last) for one in left]))
        for i in range(0, len(keys), CHUNK):
            yield _sum(keys[i : i + CHUNK], left, layers, digest)


def _sum(
    keys: NDArray[np.int64], streams: Sequence[_BlockStream], layers: Sequence[str], digest: MapDigest
) -> Piece:
    """Return the sums over all maps of the blocks `keys`, which are the next blocks of the streams."""
    content = checkpoint.array_for(len(keys), layers)
    own, sums = checkpoint.split(content, layers)
    own[:] = keys
    is_there = np.zeros(len(keys), bool)
    for stream in streams:
        for theirs, rows in stream.take(int(keys[-1])):
            at = np.searchsorted(keys, theirs)
            again = is_there[at]
            if again.any():
                _add(sums, {name: one[again] for name, one in rows.items()}, at[again])
                _put(sums, {name: one[~again] for name, one in rows.items()}, at[~again])
            else:
                _put(sums, rows, at)
            is_there[at] = True
    digest.add(keys, sums["sums"])
    return Piece(len(keys), content=content)


def _put(sums: BlockColumns, rows: BlockColumns, at: NDArray[np.int64]) -> None:
    """Copy the rows of one map's blocks to rows `at` of `sums`, which no map has filled yet."""
    if not len(at):
        return
    run = slice(int(at[0]), int(at[-1]) + 1)  # mostly the indices are consecutive
    where: Any = run if run.stop - run.start == len(at) else at
    for name, one in rows.items():
        sums[name][where] = one


def _add(sums: BlockColumns, rows: BlockColumns, at: NDArray[np.int64]) -> None:
    both = sums["sums"][at]
    both += rows["sums"]
    if (is_full := both & WEIGHT_LIMIT).any():  # the limit is a bit; a lane overflows at twice the limit
        full = int(is_full.any(axis=1).sum())
        raise WeightOverflow(
            f"{full} blocks hold voxels that would have more votes than their integers hold "
            f"({WEIGHT_LIMIT / WEIGHT_ONE:.0f} full samples)"
        )
    sums["sums"][at] = both
    if "color_rgn" in sums:
        here = sums["color_rgn"][at], sums["color_b"][at]
        there = rows["color_rgn"], rows["color_b"]
        sums["color_rgn"][at], sums["color_b"][at] = added_colors(here, there)
    if "hits" in sums:
        sums["hits"][at] += rows["hits"]
    if "correction" in sums:  # smoothed values are no sums
        sums["correction"][at] = 0
