# SPDX-License-Identifier: MIT
"""Write maps to checkpoints, load and verify them; hash their content, and describe their origin."""

import hashlib
import os
import struct
from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from tsfusion.core.config import LIMIT_SETTINGS, RUN_SETTINGS, VIEW_SETTINGS, VolumeConfig, override
from tsfusion.core.errors import CheckpointError, DamagedCheckpoint, InvalidConfig, OutputError
from tsfusion.geometry.mesh import FORMATS as MESHES
from tsfusion.geometry.mesh_arrays import Provenance
from tsfusion.kernels.integration import integrate
from tsfusion.tsdf.files import checkpoint, map_history, voxel_arrays
from tsfusion.tsdf.files.checkpoint import SideThread
from tsfusion.tsdf.store import clear_blocks
from tsfusion.tsdf.store.block_store import BlockStore, unpack_keys
from tsfusion.tsdf.store.growing_array import LAYER_DTYPES


def begin_hash(voxel_size: float) -> "hashlib.blake2b":
    """Return a new digest for a map's keys and sums, which the caller feeds, 1024 used blocks per step."""
    digest = hashlib.blake2b(digest_size=16)
    digest.update(struct.pack("<di", voxel_size, integrate.QUANTA_PER_VOXEL))
    return digest


def sums_hash(store: BlockStore) -> str:
    """Return the hash of a map's exact sums: `Volume.map_hash`."""
    return _hash_of(store, ("sums",), begin_hash(store.voxel_size))


def color_hash(store: BlockStore) -> str:
    """Return the hash of a map's exact colour sums."""
    layers = ("color_rgn", "color_b") if store.color else ()
    return _hash_of(store, layers, hashlib.blake2b(digest_size=16))


def _hash_of(store: BlockStore, layers: Iterable[str], digest: "hashlib.blake2b") -> str:
    for layer in layers:
        for keys, rows in store.in_order(layer):
            digest.update(keys.data)
            digest.update(rows.data)
    return digest.hexdigest()


def have_same_content(store: BlockStore, other: BlockStore) -> bool:
    """Return True if two maps have the same sums and colours."""
    return store.count == other.count and all(
        hash_of(store) == hash_of(other) for hash_of in (sums_hash, color_hash)
    )


def provenance(
    meta: Mapping[str, Any], keyframes: int, map_hash: str, config: VolumeConfig, source: str | None = None
) -> Provenance:
    """Return facts on a map to write into a file of its surface; `source` is the path of the map's input."""
    return Provenance(
        source=None if source is None else Path(source).resolve().name,
        keyframes=keyframes,
        map_hash=map_hash,
        world=" ".join(sorted(filter(None, map_history.worlds(meta)))),
        voxel_size=config.voxel_size,
    )


def write(path: Path, store: BlockStore, config: VolumeConfig, keyframes: int, meta: dict[str, Any]) -> Path:
    """Write a checkpoint of a map; `Volume.save` gives the arguments and errors."""
    suffix = path.suffix.lower()
    if suffix in (*MESHES, *voxel_arrays.FORMATS):
        how = "extract_mesh().save" if suffix in MESHES else "save_voxels"
        raise OutputError(f"a map is saved as .tsf, got {os.fspath(path)!r}: use {how}, or another name")
    layers = store.layers()
    header = checkpoint.CheckpointHeader(
        config=msgspec.structs.replace(config, arch="cpu"),  # the machine decides on the device
        keyframes=keyframes,
        map_hash="",
        meta=meta,
        layers=list(layers),
        clear=clear_blocks.encoded(store.clear.counts()),
    )
    used, digest = store.used(), begin_hash(config.voxel_size)
    return checkpoint.write(
        path, header, store.keys[used], used, layers, map_digest=digest, between=store.rest
    )


def fill(
    store: BlockStore, path: Path, header: checkpoint.CheckpointHeader, chunks: Iterable[checkpoint.Chunk]
) -> None:
    """Load the blocks of a checkpoint into an empty store, and compare their hash with the saved hash.

    Raises CheckpointError for other layers than the store's, for impossible blocks, or for another hash.
    """
    layers = store.layers()
    if not layers.keys() - {"hits"} <= {*header.layers} <= layers.keys():  # old maps lack `hits`
        raise CheckpointError(f"{path} is of another version: it has layers {header.layers}")
    checked, digest = 0, begin_hash(header.config.voxel_size)
    with SideThread() as side:
        for chunk in chunks:
            keys = np.empty(chunk.blocks, np.int64)
            chunk.fill(keys)
            store.insert(keys)
            for name in header.layers:
                chunk.fill(layers[name][chunk.first : store.count])
            store.note_written(np.arange(chunk.first, store.count))
            store.keep_within_memory()
            # the hash takes 1024 blocks per step, independent of the file's chunks
            while store.count - checked >= checkpoint.CHUNK or checked < store.count == header.blocks:
                end = min(checked + checkpoint.CHUNK, store.count)
                side.do(partial(_check_in, path, store, slice(checked, end), digest))
                checked = end
        side.wait()
    store.clear.replace(header.clear_blocks(path))
    checkpoint.verify(path, header, digest.hexdigest())


def fill_box(
    store: BlockStore,
    header: checkpoint.CheckpointHeader,
    chunks: Iterable[checkpoint.Chunk],
    low: NDArray[np.int64],
    high: NDArray[np.int64],
) -> None:
    """Load the blocks low ≤ (x, y, z) < high of a checkpoint into an empty store.

    A chunk without such blocks is decompressed only up to its keys.
    """
    for chunk in chunks:
        keys = np.empty(chunk.blocks, np.int64)
        chunk.fill(keys)
        blocks = unpack_keys(keys)
        inside = ((blocks >= low) & (blocks < high)).all(axis=1)
        if not inside.any():
            continue
        first = store.count
        store.insert(keys[inside])
        for name in header.layers:
            rows = np.empty((chunk.blocks, checkpoint.CUBE), LAYER_DTYPES[name])
            chunk.fill(rows)
            store.layers()[name][first : store.count] = rows[inside]
        store.note_written(np.arange(first, store.count))
    store.measure_bounds()


def _check_in(path: Path, store: BlockStore, blocks: slice, digest: "hashlib.blake2b") -> None:
    """Add the blocks just read to the hash, and compute their weight bounds. Raises for unsorted keys."""
    keys, sums = store.keys[blocks], store.sums[blocks]
    store.bounds[blocks] = (sums & integrate.WEIGHT_MASK).max(axis=1)
    before = store.keys[max(blocks.start - 1, 0) : blocks.stop]
    if (np.diff(before) <= 0).any() or not store.bounds[blocks].all():
        raise DamagedCheckpoint(f"{path} is malformed: its blocks are empty or out of order")
    digest.update(keys.data)
    digest.update(sums.data)


def loaded_config(
    header: checkpoint.CheckpointHeader, threads: int | None, changed: Mapping[str, Any]
) -> VolumeConfig:
    saved = header.config
    fixed = {name for name in changed if name not in (*VIEW_SETTINGS, *LIMIT_SETTINGS, *RUN_SETTINGS)}
    if saved.model().regularizer != "off" and changed.get("smoothness") not in (None, saved.smoothness):
        fixed.add("smoothness")  # smoothing along rays is already part of the map
    if fixed:
        raise InvalidConfig(f"a saved map cannot change {', '.join(sorted(fixed))}; fuse it anew")
    config = override(msgspec.structs.replace(saved, threads=threads, arch="cpu"), **changed)
    return override(config, max_blocks=max(config.max_blocks, header.blocks))
