# SPDX-License-Identifier: MIT
"""Cache answers of a map: planners ask for the same slice again, and cameras for the same view.

A cached slice is updated where blocks changed. A cached view shows a state slightly older than the newest.
"""

import time
from collections import OrderedDict
from collections.abc import Callable
from typing import TYPE_CHECKING

import msgspec
import numpy as np
from numpy.typing import NDArray

from tsfusion.core.config import Surface
from tsfusion.geometry.map_answers import View, checked_camera
from tsfusion.geometry.map_questions import MOST_CELLS, Raycast, Slice, SliceSettings, ViewSettings
from tsfusion.geometry.up_direction import Up
from tsfusion.wire.messages.questions import MapVersion

if TYPE_CHECKING:
    from tsfusion.tsdf.answers.map_slices import CurrentSlice
    from tsfusion.tsdf.surface.surface_tiles import SurfaceTiles
    from tsfusion.tsdf.volume import Volume

_MOST_KEPT = 2  # slices, of some 52 bytes a cell


class KeptSlices:
    """Cache of the slices of one map that were last asked for."""

    def __init__(self, volume: "Volume") -> None:
        self._volume = volume
        self._kept: OrderedDict[Slice, CurrentSlice] = OrderedDict()
        self._changed: dict[Slice, list[NDArray[np.int32]]] = {}

    def note_taken(self, blocks: NDArray[np.int32]) -> None:
        """Mark blocks (n, 3) as changed that `Volume.take_dirty` gave to another reader."""
        for changed in self._changed.values():
            changed.append(blocks)

    def get(self, question: Slice) -> "CurrentSlice":
        """Return the slice that a question asks for, brought up to date with the map.

        Raises:
            InvalidConfig: the slice has too many cells.
        """
        from tsfusion.tsdf.store.block_store import distinct_blocks

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
        how, up = asked.settings(SliceSettings), Up(asked.up, "given")
        return self._volume.current_slice(asked.low, asked.high, up=up, most_cells=MOST_CELLS, **how)


_WANTED_S = 2.0  # for so long after a view with `max_age`, the next view is prepared
_CUBES_AT_ONCE = 4
_REST_FACTOR = 1.0  # pause per time of work: at most half of the idle time


class KeptViews:
    """Cache for camera views of one map, each of a single state of the map."""

    def __init__(self, volume: "Volume", state: Callable[[], MapVersion]) -> None:
        self._volume, self._state = volume, state
        self._how: tuple[Surface | None, float | None] = None, None  # cached surface and its `min_weight`
        self._kept: tuple[int, MapVersion] | None = None  # version and state of the cached surface
        self._newest_s = self._wanted_s = self._next_s = 0.0  # time.monotonic()

    def note_change(self) -> None:
        """Record that the map is about to change."""
        if self._is_newest:
            self._newest_s = time.monotonic()

    def get(self, question: Raycast) -> tuple[View, MapVersion]:
        """Return the view that a question asks for, and the state of the map that it shows."""
        camera = checked_camera(question.intrinsics, question.matrix, question.shape)
        shown = question.settings(ViewSettings)
        how = shown.pop("surface"), shown.pop("min_weight")
        from tsfusion.tsdf.answers import camera_views

        now = time.monotonic()
        if question.max_age > 0:
            self._wanted_s = now + _WANTED_S
        if self._kept is not None and how == self._how and not self._is_newest:
            version, state = self._kept
            is_kept = now - self._newest_s <= question.max_age and self._tiles().settled == version
            view = camera_views.cast_settled(self._tiles(), *camera, **shown) if is_kept else None
            if view is not None:
                return view, state
        view = camera_views.cast(self._volume.surface.kept(*how), *camera, **shown)
        self._how, self._kept = how, (self._volume.version, self._state())
        return view, self._kept[1]

    def wait(self) -> float | None:
        """Return the seconds until `prepare` is due; None if there is nothing to prepare."""
        now = time.monotonic()
        if self._kept is None or self._is_newest or now >= self._wanted_s:
            return None
        return max(self._next_s - now, 0.0)

    def prepare(self) -> None:
        """Mesh some changed cells of the last view's scene, so that the next view takes less time."""
        began = time.monotonic()
        if (tiles := self._tiles()).settled is None:
            self._kept = None  # no cache until the next view
            return
        try:
            if tiles.settle_some(_CUBES_AT_ONCE):
                self._kept = self._volume.version, self._state()
        finally:
            now = time.monotonic()
            self._next_s = now + _REST_FACTOR * (now - began)

    def _tiles(self) -> "SurfaceTiles":
        return self._volume.surface.kept(*self._how)

    @property
    def _is_newest(self) -> bool:
        return self._kept is not None and self._kept[0] == self._volume.version
