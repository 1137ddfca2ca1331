# SPDX-License-Identifier: MIT
"""A map as arrays of voxels in an `.npz` file, for NumPy and everything that reads it.

Both kinds hold `voxel_size` (metres) and, for each voxel, `tsdf` float32 (signed distance to the surface in
metres, positive in front of it, NaN where nothing was seen), `weight` float32 (votes, in full-confidence
samples) and, where the map has colour, `color` uint8 RGB (0 where none was seen).

Blocks: `blocks` (n, 3) int32, and `tsdf`, `weight` (n, 8, 8, 8), `color` (n, 8, 8, 8, 3). The centre of voxel
(i, j, k) of block b is at (8 · blocks[b] + (i, j, k) + 0.5) · voxel_size.

Dense: `tsdf`, `weight` (X, Y, Z), `color` (X, Y, Z, 3), and `origin` (3,) float64: the centre of voxel
(i, j, k) is at origin + ((i, j, k) + 0.5) · voxel_size.
"""

import zipfile
from collections.abc import Callable, Iterator
from itertools import chain, pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from tsfusion.core import durable_files
from tsfusion.core.errors import OutputError
from tsfusion.kernels.integrate import QUANTA_PER_VOXEL, WEIGHT_MASK
from tsfusion.kernels.sensor_noise import WEIGHT_ONE
from tsfusion.tsdf.block_store import BlockStore, unpack_keys
from tsfusion.tsdf.surface_values import values_of

MOST_DENSE = 1 << 31  # voxels
_CHUNK = 256  # blocks at a time
_LANE = (1 << 24) - 1  # of Σ R and Σ G
_VOTES = (1 << 16) - 1
_EARLIEST = (1980, 1, 1, 0, 0, 0)  # as the date of every part: the same map gives the same file


class _Field(NamedTuple):
    """What is written of each voxel."""

    dtype: DTypeLike
    unseen: float
    shape: tuple[int, ...] = ()


_FIELDS = {
    "tsdf": _Field(np.float32, np.nan),
    "weight": _Field(np.float32, 0),
    "color": _Field(np.uint8, 0, (3,)),
}

Watch = Callable[[int, int], None]  # bytes of the arrays written, of all


def write(store: BlockStore, path: Path, *, dense: bool, watch: Watch = lambda _done, _all: None) -> None:
    """Write the voxels of a map; complete or not at all, in little memory.

    Args:
        dense: one box around the whole map, instead of its blocks.

    Raises:
        OutputError: when it cannot be written, a map is empty, or the box has more than `MOST_DENSE` voxels.
    """
    used = store.used()
    if not len(used):
        raise OutputError(f"nothing to write to {path}: the map is empty")
    blocks = unpack_keys(store.keys[used])
    low, high = blocks.min(axis=0), blocks.max(axis=0) + 1
    shape = tuple(int(length) for length in 8 * (high - low)) if dense else (len(used), 8, 8, 8)
    if dense and np.prod(shape, dtype=np.float64) > MOST_DENSE:
        raise OutputError(
            f"a dense box of {' × '.join(map(str, shape))} voxels is too large (at most {MOST_DENSE}): "
            "crop the map first, or write its blocks"
        )
    plain: dict[str, Any] = {"voxel_size": np.float64(store.voxel_size)}
    plain |= {"origin": 8 * low * store.voxel_size} if dense else {"blocks": blocks}
    fields = {name: field for name, field in _FIELDS.items() if store.color or name != "color"}
    each = [np.dtype((field.dtype, field.shape)).itemsize for field in fields.values()]
    try:
        with durable_files.replacing(path) as file, zipfile.ZipFile(file, "w") as archive:
            for name, value in plain.items():
                _write_array(archive, name, np.shape(value), iter([np.asarray(value)]))
            progress = _Progress(watch, int(np.prod(shape)) * sum(each))
            for name, field in fields.items():
                parts = _slabs(store, used, blocks, name) if dense else _blocks(store, used, name)
                _write_array(archive, name, shape + field.shape, map(progress, parts))
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}") from error


class _Progress:
    """Tells how many bytes have passed."""

    def __init__(self, watch: Watch, total: int) -> None:
        self._watch, self._total, self._done = watch, total, 0

    def __call__(self, part: NDArray[Any]) -> NDArray[Any]:
        self._done += part.nbytes
        self._watch(self._done, self._total)
        return part


def _write_array(
    archive: zipfile.ZipFile, name: str, shape: tuple[int, ...], parts: Iterator[NDArray[Any]]
) -> None:
    """Write an array of this shape whose parts, in order, are those given."""
    entry = zipfile.ZipInfo(f"{name}.npy", _EARLIEST)
    entry.compress_type = zipfile.ZIP_DEFLATED
    with archive.open(entry, "w", force_zip64=True) as file:
        first = next(parts)
        header = {"descr": np.lib.format.dtype_to_descr(first.dtype), "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_2_0(file, header)
        for part in chain([first], parts):
            file.write(np.ascontiguousarray(part).data)


def _blocks(store: BlockStore, used: NDArray[np.int64], name: str) -> Iterator[NDArray[Any]]:
    """Parts (m, 8, 8, 8, …) of a field."""
    for i in range(0, len(used), _CHUNK):
        yield decoded(store, used[i : i + _CHUNK], name)


def _slabs(
    store: BlockStore, used: NDArray[np.int64], blocks: NDArray[np.int32], name: str
) -> Iterator[NDArray[Any]]:
    """Parts (8, Y, Z, …) of a field: one for each block along x."""
    field, low = _FIELDS[name], blocks.min(axis=0)
    x, y, z = (blocks - low).T
    wide, high = int(y.max()) + 1, int(z.max()) + 1
    ends = np.searchsorted(x, np.arange(int(x.max()) + 2))
    for first, end in pairwise(ends.tolist()):
        slab = np.full((8, wide, 8, high, 8, *field.shape), field.unseen, field.dtype)
        for i in range(first, end, _CHUNK):
            part = slice(i, min(i + _CHUNK, end))
            slab[:, y[part], :, z[part]] = decoded(store, used[part], name)
        yield slab


def decoded(store: BlockStore, slots: NDArray[np.int64], name: str) -> NDArray[Any]:
    """(m, 8, 8, 8, …) of a field in blocks: `tsdf`, `weight` or `color`."""
    shape = (len(slots), 8, 8, 8, *_FIELDS[name].shape)
    if name == "tsdf":
        quanta = values_of(store.keys[slots], store, 0.0)
        return np.reshape(quanta * np.float32(store.voxel_size / QUANTA_PER_VOXEL), shape)
    if name == "weight":
        weights = (store.sums[slots] & WEIGHT_MASK).astype(np.float32) / np.float32(WEIGHT_ONE)
        return np.reshape(weights, shape)
    rgn = store.color_rgn[slots]
    votes = np.maximum(rgn & _VOTES, 1)
    sums = (rgn >> 40, rgn >> 16 & _LANE, store.color_b[slots])
    return np.reshape(np.stack([np.rint(one / votes) for one in sums], axis=-1).astype(np.uint8), shape)
