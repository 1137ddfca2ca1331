# SPDX-License-Identifier: MIT
"""Load the blocks and settings of a checkpoint into a map, and check them."""

import hashlib
from collections.abc import Iterable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from tsfusion.core.config import LIMIT_SETTINGS, RUN_SETTINGS, VIEW_SETTINGS, VolumeConfig, override
from tsfusion.core.errors import CheckpointError, DamagedCheckpoint, InvalidConfig
from tsfusion.core.process import SideThread
from tsfusion.kernels.integration import integrate
from tsfusion.tsdf.files import checkpoint
from tsfusion.tsdf.store.block_store import BlockStore, unpack_keys
from tsfusion.tsdf.store.growing_array import LAYER_DTYPES


def fill(
    store: BlockStore,
    path: Path,
    header: checkpoint.CheckpointHeader,
    chunks: Iterable[checkpoint.Chunk],
    digest: "hashlib.blake2b",
) -> None:
    """Load the blocks of a checkpoint into an empty store, and their keys and sums into a digest.

    Raises CheckpointError for other layers than the store's, or for impossible blocks.
    """
    layers = store.layers()
    if not layers.keys() - {"hits"} <= {*header.layers} <= layers.keys():  # old maps lack `hits`
        raise CheckpointError(f"{path} is of another version: it has layers {header.layers}")
    checked = 0
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
    """Hash the blocks just read, and measure their bounds."""
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
