# SPDX-License-Identifier: MIT
"""Blocks are found by their keys, and by nothing else."""

import numpy as np
from ray_maps import CASES, RayMap

from tsfusion.kernels.base import block_hash, runtime
from tsfusion.tsdf.store.growing_array import GrowingArray


def test_the_map_hash_finds_what_was_inserted_and_nothing_else() -> None:
    runtime.start(2)
    keys = np.unique(np.random.default_rng(4).integers(1, 1 << 62, 3000))
    table, slots = np.zeros(8192, np.int64), np.zeros(8192, np.int32)
    block_hash.insert_blocks(keys, 0, 1000, 0, table, slots)
    block_hash.insert_blocks(keys, 1000, 1000, 1000, table, slots)
    found = np.empty(len(keys), np.int32)
    block_hash.find_blocks(keys, table, slots, found)
    assert (found == np.where(np.arange(len(keys)) < 2000, np.arange(len(keys)), -1)).all()


def test_dropped_blocks_are_not_found_and_the_rest_are() -> None:
    here = RayMap()
    here.apply(CASES["many"])
    keys, kept = here.store.keys.copy(), here.store.count - 5
    here.store.sums[kept:] = 0
    here.store.drop(kept)
    found = here.store.slots_of(keys)
    assert (found == np.where(np.arange(len(keys)) < kept, np.arange(len(keys)), -1)).all()


def test_layers_grow_by_whole_huge_pages_and_keep_what_they_hold() -> None:
    rows = GrowingArray((512,), np.int64, 100)
    rows.array[:] = np.arange(100)[:, None]
    for needed in (1000, 5001, 9777):
        rows.reserve(needed)
        assert rows.capacity >= needed
        assert rows.array.nbytes % (1 << 21) == 0  # else they would be split where memory moves
        assert (rows.array[:100] == np.arange(100)[:, None]).all()
        assert not rows.array[100:needed].any()
