# SPDX-License-Identifier: MIT
"""Cache answers of a map: planners ask for the same slice again, and cameras for the same view.

A cached slice is updated where blocks changed. A cached view shows a state slightly older than the newest.
"""

import time
from collections import OrderedDict
from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple

import msgspec

from tsfusion.core.config import Surface
from tsfusion.geometry.map_answers import View, checked_camera
from tsfusion.geometry.map_questions import MOST_CELLS, Raycast, Slice, SliceSettings, ViewSettings
from tsfusion.geometry.up_direction import Up
from tsfusion.wire.messages.questions import MapVersion

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from tsfusion.tsdf.answers.map_slices import CurrentSlice
    from tsfusion.tsdf.volume import Volume

_MOST_KEPT = 2  # slices, of some 52 bytes a cell


class KeptSlices:
    """Cache of the slices of one map that were last asked for."""

    def __init__(self, volume: "Volume") -> None:
        self._volume = volume
        self._kept: OrderedDict[Slice, CurrentSlice] = OrderedDict()

    def get(self, question: Slice) -> "CurrentSlice":
        """Return the slice that a question asks for, brought up to date with the map.

        Raises:
            InvalidConfig: the slice has too many cells.
        """
        if question.box is None:  # around the map, which grows
            return self._made(question)
        key = msgspec.structs.replace(question, kind="distance")
        found = self._kept.pop(key, None)  # an update that is given up leaves nothing
        if found is None:
            found = self._made(key)
        else:
            found.update()
        self._kept[key] = found
        if len(self._kept) > _MOST_KEPT:
            self._kept.popitem(last=False)
        return found

    def _made(self, asked: Slice) -> "CurrentSlice":
        how, up = asked.settings(SliceSettings), Up(asked.up, "given")
        return self._volume.current_slice(asked.low, asked.high, up=up, most_cells=MOST_CELLS, **how)


_WANTED_S = 2.0  # for so long after a view with `max_age`, the next view is prepared
_CUBES_AT_ONCE = 4
_REST_FACTOR = 1.0  # pause per time of work: at most half of the idle time


class _LastView(NamedTuple):
    surface: tuple[Surface | None, float | None]  # and its `min_weight`
    version: int  # of the map
    state: MapVersion
    there: "NDArray[np.int64]"  # cubes of the map
    shown: list[int]  # cubes in view


class KeptViews:
    """Camera views of one map, each of one state of the map: the newest, or that of the last view."""

    def __init__(self, volume: "Volume", state: Callable[[], MapVersion]) -> None:
        self._volume, self._state = volume, state
        self._last: _LastView | None = None
        self._left: tuple[int, list[int]] = -1, []  # version, and the cubes to mesh until the view is of it
        self._newest_s = self._wanted_s = self._next_s = 0.0  # time.monotonic()

    def note_change(self) -> None:
        """Record that the map is about to change."""
        if self._is_newest:
            self._newest_s = time.monotonic()

    def get(self, question: Raycast) -> tuple[View, MapVersion]:
        """Return the view that a question asks for, and the state of the map that it shows."""
        from tsfusion.tsdf.answers.camera_views import in_view, view_of

        camera = checked_camera(question.intrinsics, question.matrix, question.shape)
        shown = question.settings(ViewSettings)
        surface = shown.pop("surface"), shown.pop("min_weight")
        cubes, last, now = self._volume.surface.cubes(*surface), self._last, time.monotonic()
        if question.max_age > 0:
            self._wanted_s = now + _WANTED_S
        is_kept = last is not None and last.surface == surface and not self._is_newest
        if last is not None and is_kept and now - self._newest_s <= question.max_age:
            meshes = cubes.meshes.of_version(last.version, in_view(last.there, cubes.side_m, *camera))
            if meshes is not None:
                return view_of(meshes, cubes.has_color, *camera, **shown), last.state
        numbers = in_view(cubes.numbers(), cubes.side_m, *camera)
        view = view_of(cubes.meshes.of(numbers), cubes.has_color, *camera, **shown)
        return view, self._settle(surface, numbers)

    def _settle(self, surface: tuple[Surface | None, float | None], shown: list[int]) -> MapVersion:
        """Keep what a complete view of the newest state showed. Returns that state."""
        cubes, state = self._volume.surface.cubes(*surface), self._state()
        cubes.meshes.settle()
        self._last = _LastView(surface, self._volume.version, state, cubes.numbers(), shown)
        return state

    def wait(self) -> float | None:
        """Return the seconds until `prepare` is due; None if there is nothing to prepare."""
        now = time.monotonic()
        if self._last is None or self._is_newest or now >= self._wanted_s:
            return None
        return max(self._next_s - now, 0.0)

    def prepare(self) -> None:
        """Mesh some changed cubes of the last view, so that the next view takes less time."""
        began, last = time.monotonic(), self._last
        if last is None:
            return
        meshes, version = self._volume.surface.cubes(*last.surface).meshes, self._volume.version
        if self._left[0] != version:  # a mesh that does not fit into the kept ones is made once
            self._left = version, meshes.lacking(last.shown)
        left = self._left[1]
        try:
            for _ in meshes.of(left[:_CUBES_AT_ONCE]):
                pass
            del left[:_CUBES_AT_ONCE]
            if not left:
                self._settle(last.surface, last.shown)
        finally:
            now = time.monotonic()
            self._next_s = now + _REST_FACTOR * (now - began)

    @property
    def _is_newest(self) -> bool:
        return self._last is not None and self._last.version == self._volume.version
