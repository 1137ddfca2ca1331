# SPDX-License-Identifier: MIT
"""Convert a map to arrays of voxels, in memory (NumPy, Open3D) or in a file: `.npz`, `.zarr` or `.vdb`.

Both layouts of arrays hold `voxel_size` (metres) and, for each voxel, `tsdf` float32 (signed distance to the
surface in metres, positive in front of it, NaN where unseen), `weight` float32 (votes, in full-confidence
samples) and, in a map with colour, `color` uint8 RGB (0 where unseen). A distance field holds `distance`
float32 (metres, at most `max_distance`) instead.

Blocks: `blocks` (n, 3) int32, and `tsdf`, `weight` (n, 8, 8, 8), `color` (n, 8, 8, 8, 3). The centre of voxel
(i, j, k) of block b is at (8 · blocks[b] + (i, j, k) + 0.5) · voxel_size.

Dense: `tsdf`, `weight` (X, Y, Z), `color` (X, Y, Z, 3), and `origin` (3,) float64: the centre of voxel (i, j,
k) is at origin + ((i, j, k) + 0.5) · voxel_size.

OpenVDB: one grid, `tsdf` or `distance`. Its background value fills voxels unseen or far from surfaces.
"""

import tempfile
import zipfile
from collections.abc import Callable, Iterator
from functools import cached_property
from itertools import chain, pairwise
from pathlib import Path
from typing import IO, Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import DTypeLike, NDArray

from tsfusion.core import durable_files
from tsfusion.core.errors import InvalidConfig, OutputError, needing, refusals_as
from tsfusion.core.readable_numbers import OnProgress
from tsfusion.geometry import point_files
from tsfusion.geometry.map_answers import import_open3d
from tsfusion.geometry.mesh_arrays import generator
from tsfusion.kernels.base.sensor_noise import WEIGHT_ONE
from tsfusion.kernels.integration.integrate import MAX_DISTANCE, QUANTA_PER_VOXEL, WEIGHT_MASK
from tsfusion.tsdf.answers import distance_fields
from tsfusion.tsdf.store.block_store import BlockStore, unpack_keys
from tsfusion.tsdf.sums.map_addition import LANE, VOTES
from tsfusion.tsdf.surface.field_regularizer import values_of

MOST_DENSE = 1 << 31  # voxels
_CHUNK = 256  # blocks per step
_EARLIEST = (1980, 1, 1, 0, 0, 0)  # date of every archive member, so that the same map gives the same file
SIDE = 8  # voxels
OPEN3D_TRUNCATION = 8.0  # distance in voxels that Open3D stores as 1: its `trunc_voxel_multiplier`


class _GridField(NamedTuple):
    dtype: DTypeLike
    unseen: float
    units: str
    shape: tuple[int, ...] = ()


_FIELDS = {
    "tsdf": _GridField(np.float32, np.nan, "m"),
    "weight": _GridField(np.float32, 0, "1"),
    "color": _GridField(np.uint8, 0, "1", (3,)),
    "distance": _GridField(np.float32, np.nan, "m"),
}

_HELD = {
    "tsdf": "signed distance along rays, at most the truncation; NaN where nothing was seen",
    "distance": "Euclidean distance to the nearest surface, at most max_distance",
}
FieldName = Literal["tsdf", "distance"]
FORMATS = (".npz", ".zarr", ".vdb")


class _Voxels(NamedTuple):
    """Arrays of voxels to write, given as iterators, so that memory holds only a part."""

    plain: dict[str, NDArray[Any]]  # small arrays, such as the voxel size
    names: list[str]  # keys of `_FIELDS`
    shape: tuple[int, ...]  # without a field's own dimensions
    parts: Callable[[str], Iterator[NDArray[Any]]]  # yields the parts of a field along the first axis


def write(
    store: BlockStore,
    path: Path,
    *,
    dense: bool,
    field: FieldName = "tsdf",
    max_distance: float = 0.5,
    min_weight: float = 0.0,
    watch: OnProgress = lambda _done, _all: None,
) -> None:
    """Write the voxels of a map, completely or not at all, in little memory.

    Args:
        dense: one box around the whole map, instead of its blocks.
        field: signed distances as fused, with weights and colours, or the distance field.
        max_distance, min_weight: settings of the distance field, as for `Volume.distance_blocks`.

    Raises:
        InvalidConfig: for another suffix or field.
        OutputError: for a write error, an empty map, or a box of more than `MOST_DENSE` voxels.
        MissingDependency: zarr is not installed.
    """
    suffix = path.suffix.lower()
    if suffix not in FORMATS or field not in get_args(FieldName) or (dense and suffix == ".vdb"):
        raise InvalidConfig(
            f"voxels are written to {', '.join(FORMATS)}, never dense to .vdb, and the field is one of "
            f"{', '.join(get_args(FieldName))}; got {path}, {field!r}"
        )
    if not store.count or not len(used := store.used()):
        raise OutputError(f"nothing to write to {path}: the map is empty")
    near = distance_fields.in_blocks(store, max_distance, min_weight) if field == "distance" else iter(())
    if suffix == ".vdb":
        _write_vdb(path, store, used, near if field == "distance" else None, max_distance)
        return
    writer = _write_zarr if suffix == ".zarr" else _write_npz
    with refusals_as(OutputError, f"cannot write {path}"), tempfile.TemporaryFile(dir=path.parent) as spool:
        if field == "tsdf":
            voxels = _fused(store, used, dense=dense)
        elif dense:
            voxels = _dense_distances(store, max_distance, min_weight)
        else:
            voxels = _spooled_distances(store, near, max_distance, spool)
        each = [np.dtype((_FIELDS[n].dtype, _FIELDS[n].shape)).itemsize for n in voxels.names]
        writer(path, voxels, _Counted(watch, int(np.prod(voxels.shape)) * sum(each)))


def _fused(store: BlockStore, used: NDArray[np.int64], *, dense: bool) -> _Voxels:
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
    names = ["tsdf", "weight", "color"] if store.color else ["tsdf", "weight"]
    if dense:
        return _Voxels(plain, names, shape, lambda name: _slabs(store, used, blocks, name))
    return _Voxels(plain, names, shape, lambda name: _blocks(store, used, name))


def _dense_distances(store: BlockStore, max_distance: float, min_weight: float) -> _Voxels:
    found = distance_fields.in_box(store, None, min_weight=min_weight, max_distance=max_distance)
    plain = {"voxel_size": np.float64(store.voxel_size), "origin": found.origin}
    plain["max_distance"] = np.float64(max_distance)
    slabs = np.array_split(found.distance, found.distance.shape[0] // 8)
    return _Voxels(plain, ["distance"], found.distance.shape, lambda _: iter(slabs))


def _spooled_distances(
    store: BlockStore, near: Iterator[distance_fields.FieldBlocks], max_distance: float, spool: IO[bytes]
) -> _Voxels:
    """Return the distances near a map's surfaces, kept in a file until the number of blocks is known."""
    blocks = []
    for one in near:
        spool.write(one.distance.data)
        blocks.append(one.blocks)
    plain = {"voxel_size": np.float64(store.voxel_size), "max_distance": np.float64(max_distance)}
    if not blocks:
        raise OutputError("nothing to write: the map has no surface with so much weight; lower min_weight")
    plain["blocks"] = np.concatenate(blocks)
    count = len(plain["blocks"])

    def parts(_: str) -> Iterator[NDArray[Any]]:
        spool.seek(0)
        for i in range(0, count, _CHUNK):
            part = min(_CHUNK, count - i)
            yield np.frombuffer(spool.read(part * 2048), np.float32).reshape(part, 8, 8, 8)

    return _Voxels(plain, ["distance"], (count, 8, 8, 8), parts)


def _write_npz(path: Path, voxels: _Voxels, progress: "_Counted") -> None:
    with durable_files.replacing(path) as file, zipfile.ZipFile(file, "w") as archive:
        for name, value in voxels.plain.items():
            _write_array(archive, name, np.shape(value), iter([np.asarray(value)]))
        for name in voxels.names:
            shape = voxels.shape + _FIELDS[name].shape
            _write_array(archive, name, shape, map(progress, voxels.parts(name)))


def _write_zarr(path: Path, voxels: _Voxels, progress: "_Counted") -> None:
    """Write a zarr folder in which each array has chunks of `_CHUNK` blocks, or of 8 layers along x."""
    with needing(
        f"writing {path} needs zarr and Python 3.11 or later: pip install '.[zarr]' in your clone of tsfusion"
    ):
        import zarr
    if path.is_dir() and any(path.iterdir()) and not (path / "zarr.json").exists():
        raise OutputError(f"cannot write {path}: it is a folder of something else; choose another name")
    with durable_files.replacing_folder(path) as folder:
        about: dict[str, Any] = {"generator": generator(), "unit": "metre", "field": _HELD[voxels.names[0]]}
        about["voxel_size"] = float(voxels.plain["voxel_size"])
        group = zarr.open_group(folder, mode="w", attributes=about)
        for name, value in voxels.plain.items():
            names = ("block", "axis") if np.ndim(value) == 2 else ("axis",)[: np.ndim(value)]
            group.create_array(name, data=np.asarray(value), dimension_names=names)
        places = ("x", "y", "z") if "origin" in voxels.plain else ("block", "i", "j", "k")
        for name in voxels.names:
            field = _FIELDS[name]
            first = min(8 if "origin" in voxels.plain else _CHUNK, voxels.shape[0])
            array = group.create_array(
                name, shape=voxels.shape + field.shape, chunks=(first, *voxels.shape[1:], *field.shape),
                dtype=np.dtype(field.dtype), fill_value=field.unseen,
                dimension_names=(*places, "channel")[: len(voxels.shape + field.shape)],
                attributes={"units": field.units},
            )  # fmt: skip
            at = 0
            for part in map(progress, voxels.parts(name)):
                array[at : at + len(part)] = part.reshape(len(part), *voxels.shape[1:], *field.shape)
                at += len(part)


def _write_vdb(
    path: Path,
    store: BlockStore,
    used: NDArray[np.int64],
    near: Iterator[distance_fields.FieldBlocks] | None,
    max_distance: float,
) -> None:
    size = store.voxel_size
    if near is not None:
        point_files.write(path, near, name="distance", voxel_size=size, background=max_distance)
        return
    beyond = size * (MAX_DISTANCE + 1) / QUANTA_PER_VOXEL  # larger than every fused distance
    used = used[point_files.order_of(unpack_keys(store.keys[used]))]
    parts = (
        (unpack_keys(store.keys[part]), np.nan_to_num(decoded(store, part, "tsdf"), nan=beyond))
        for part in (used[i : i + _CHUNK] for i in range(0, len(used), _CHUNK))
    )
    point_files.write(path, parts, name="tsdf", voxel_size=size, background=beyond)


class _Counted:
    def __init__(self, watch: OnProgress, total: int) -> None:
        self._watch, self._total, self._done = watch, total, 0

    def __call__(self, part: NDArray[Any]) -> NDArray[Any]:
        self._done += part.nbytes
        self._watch(self._done, self._total)
        return part


def _write_array(
    archive: zipfile.ZipFile, name: str, shape: tuple[int, ...], parts: Iterator[NDArray[Any]]
) -> None:
    entry = zipfile.ZipInfo(f"{name}.npy", _EARLIEST)
    entry.compress_type = zipfile.ZIP_DEFLATED
    with archive.open(entry, "w", force_zip64=True) as file:
        first = next(parts)
        header = {"descr": np.lib.format.dtype_to_descr(first.dtype), "fortran_order": False, "shape": shape}
        np.lib.format.write_array_header_2_0(file, header)
        for part in chain([first], parts):
            file.write(np.ascontiguousarray(part).data)


def _blocks(store: BlockStore, used: NDArray[np.int64], name: str) -> Iterator[NDArray[Any]]:
    """Yield a map's field `name` in parts (m, 8, 8, 8, …) of some blocks each."""
    for i in range(0, len(used), _CHUNK):
        yield decoded(store, used[i : i + _CHUNK], name)


def _slabs(
    store: BlockStore, used: NDArray[np.int64], blocks: NDArray[np.int32], name: str
) -> Iterator[NDArray[Any]]:
    """Yield a map's field `name` in dense parts (8, Y, Z, …), one for each block along x."""
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
    """Return the field `tsdf`, `weight` or `color` of the blocks in `slots`, decoded, (m, 8, 8, 8, …)."""
    shape = (len(slots), 8, 8, 8, *_FIELDS[name].shape)
    if name == "tsdf":
        quanta = values_of(store.keys[slots], store, 0.0)
        return np.reshape(quanta * np.float32(store.voxel_size / QUANTA_PER_VOXEL), shape)
    if name == "weight":
        weights = (store.sums[slots] & WEIGHT_MASK).astype(np.float32) / np.float32(WEIGHT_ONE)
        return np.reshape(weights, shape)
    rgn = store.color_rgn[slots]
    votes = np.maximum(rgn & VOTES, 1)
    sums = (rgn >> 40, rgn >> 16 & LANE, store.color_b[slots])
    return np.reshape(np.stack([np.rint(one / votes) for one in sums], axis=-1).astype(np.uint8), shape)


class Blocks:
    """The n current blocks of a map, 8³ voxels each: [block, x, y, z].

    The centre of voxel (i, j, k) of block b is at (8 · coordinates[b] + (i, j, k) + 0.5) · voxel_size. The
    arrays of stored sums are read-only views, (n, 8, 8, 8), that stay valid after any change of the map. They
    show later changes of these blocks until the map's memory grows.

    Args:
        store: the blocks of a map; `Volume.blocks()` passes them.

    Attributes:
        coordinates: (n, 3) int32, in units of 8 voxels.
        voxel_size: metres.
        sums: int64, (Σ w·m) · 2²⁷ + Σ w: m in sixtieths of a voxel, w in sixteenths of a full sample.
        color_rgn: int64, (Σ R) · 2⁴⁰ + (Σ G) · 2¹⁶ + n of n votes; None if the map holds no colour.
        color_b: int32, Σ B.
        correction: float32, added to Σ w·m by smoothing along rays; None in a map without such smoothing.

    Examples:
        >>> volume = tsfusion.Volume(0.05)
        >>> added = volume.integrate(tsfusion.open_dataset("synthetic:room", count=1)[0])
        >>> blocks = volume.blocks()
        >>> blocks.sums.shape == blocks.distance().shape == (len(blocks), 8, 8, 8)
        True
    """

    def __init__(self, store: BlockStore) -> None:
        self._store, self._keys = store, store.keys.copy()
        self.voxel_size = store.voxel_size
        self.sums, self.color_rgn, self.color_b, self.correction = (
            None if (rows := store.shown(name)) is None else rows.reshape(-1, SIDE, SIDE, SIDE)
            for name in ("sums", "color_rgn", "color_b", "correction")
        )

    def __len__(self) -> int:
        return len(self._keys)

    @cached_property
    def coordinates(self) -> NDArray[np.int32]:
        return unpack_keys(self._keys)

    def distance(self) -> NDArray[np.float32]:
        """Return signed distances along rays, (n, 8, 8, 8) metres, NaN where unseen: a copy of the state."""
        found: NDArray[np.float32] = self._decoded("tsdf")
        return found

    def weight(self) -> NDArray[np.float32]:
        """Return the votes in full-confidence samples, (n, 8, 8, 8): a copy of the current state."""
        found: NDArray[np.float32] = self._decoded("weight")
        return found

    def color(self) -> NDArray[np.uint8] | None:
        """Return RGB, (n, 8, 8, 8, 3), 0 where unseen: a copy of the state, or None without colour."""
        return self._decoded("color") if self._store.color else None

    def _decoded(self, name: str) -> Any:
        slots = self._store.slots_of(self._keys).astype(np.int64)
        return decoded(self._store, slots, name)


def to_voxel_block_grid(store: BlockStore) -> Any:
    """Make an Open3D `VoxelBlockGrid` of the raw values. Raises MissingDependency without Open3D."""
    o3d = import_open3d()
    used = store.used()
    names = ["tsdf", "weight", *(["color"] if store.color else [])]
    grid = o3d.t.geometry.VoxelBlockGrid(
        names, [o3d.core.float32] * len(names), [(1,), (1,), (3,)][: len(names)], store.voxel_size, SIDE,
        max(len(used), 1),
    )  # fmt: skip
    if not len(used):
        return grid
    rows, _ = grid.hashmap().activate(o3d.core.Tensor(unpack_keys(store.keys[used])))
    rows = rows.numpy()
    for name in names:
        values = decoded(store, used, name).astype(np.float32).reshape(len(used), SIDE, SIDE, SIDE, -1)
        if name == "tsdf":
            values = np.nan_to_num(values / (OPEN3D_TRUNCATION * store.voxel_size), nan=1.0).clip(-1, 1)
        grid.attribute(name).numpy()[rows] = values.transpose(0, 3, 2, 1, 4)  # x runs fastest in Open3D
    return grid
