# SPDX-License-Identifier: MIT
"""Slices that were asked for, kept up to date as blocks change: a planner asks for the same one again."""

from collections import OrderedDict
from typing import TYPE_CHECKING

import msgspec
import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry.up_direction import Up
from tsfusion.wire.questions import MOST_CELLS, Slice

if TYPE_CHECKING:
    from tsfusion.tsdf.map_slices import CurrentSlice
    from tsfusion.tsdf.volume import Volume

_MOST_KEPT = 2  # slices, of some 52 bytes a cell


class KeptSlices:
    """The slices of one map that were asked for last."""

    def __init__(self, volume: "Volume") -> None:
        self._volume = volume
        self._kept: OrderedDict[Slice, CurrentSlice] = OrderedDict()
        self._changed: dict[Slice, list[NDArray[np.int32]]] = {}

    def note_taken(self, blocks: NDArray[np.int32]) -> None:
        """Note changed blocks (n, 3) that `Volume.take_dirty` will not show again."""
        for changed in self._changed.values():
            changed.append(blocks)

    def get(self, question: Slice) -> "CurrentSlice":
        """The slice as the map is now.

        Raises:
            InvalidConfig: for too many cells.
        """
        from tsfusion.tsdf.block_store import distinct_blocks

        if question.box is None:  # around the map, which grows
            return self._made(question)
        key = msgspec.structs.replace(question, kind="distance")
        found, changed = self._kept.pop(key, None), self._changed.pop(key, [])
        if found is None:
            found = self._made(key)
        else:
            blocks = np.concatenate([*changed, self._volume.changed_blocks()])
            found.update(distinct_blocks(blocks))
        self._kept[key], self._changed[key] = found, []
        if len(self._kept) > _MOST_KEPT:
            del self._changed[self._kept.popitem(last=False)[0]]
        return found

    def _made(self, asked: Slice) -> "CurrentSlice":
        return self._volume.current_slice(
            asked.low,
            asked.high,
            box=asked.box,
            up=Up(asked.up, "given"),
            resolution=asked.resolution,
            max_distance=asked.max_distance,
            min_weight=asked.min_weight,
            most_cells=MOST_CELLS,
        )
