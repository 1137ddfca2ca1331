# SPDX-License-Identifier: MIT
"""A saved map that answers as a live one does, so that whoever asks need not know which it is."""

import time
from collections.abc import Callable, Sequence
from typing import Any

from numpy.typing import ArrayLike

from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.geometry.map_answers import Samples, View
from tsfusion.geometry.map_grids import DistanceField, DistanceSlice, OccupancySlice
from tsfusion.tsdf.volume import Volume
from tsfusion.wire.asking.map_client import Answered, Result
from tsfusion.wire.messages.questions import MapVersion


class SavedMapAnswers:
    """A map in this process with the methods of `MapClient`. `timeout` and `max_age` have
    no effect."""

    def __init__(self, volume: Volume) -> None:
        self._volume = volume

    def sample(self, points: ArrayLike, *, timeout: float | None = None, **how: Any) -> Answered[Samples]:
        """See `MapClient.sample`."""
        return self._answered(lambda: self._volume.sample(points, **how))

    def raycast(
        self,
        intrinsics: Intrinsics | ArrayLike,
        T_world_camera: ArrayLike,
        shape: tuple[int, int],
        *,
        max_age: float = 0.0,
        timeout: float | None = None,
        **how: Any,
    ) -> Answered[View]:
        """See `MapClient.raycast`."""
        return self._answered(lambda: self._volume.raycast(intrinsics, T_world_camera, shape, **how))

    def occupancy_slice(
        self, low: float, high: float, *, timeout: float | None = None, **how: Any
    ) -> Answered[OccupancySlice]:
        """See `MapClient.occupancy_slice`."""
        return self._answered(lambda: self._volume.occupancy_slice(low, high, **how))

    def distance_slice(
        self, low: float, high: float, *, timeout: float | None = None, **how: Any
    ) -> Answered[DistanceSlice]:
        """See `MapClient.distance_slice`."""
        return self._answered(lambda: self._volume.distance_slice(low, high, **how))

    def distance_field(
        self, box: Sequence[float], *, timeout: float | None = None, **how: Any
    ) -> Answered[DistanceField]:
        """See `MapClient.distance_field`."""
        return self._answered(lambda: self._volume.distance_field(box, **how))

    def _answered(self, answer: Callable[[], Result]) -> Answered[Result]:
        began = time.monotonic()
        result = answer()
        took = time.monotonic() - began
        state = MapVersion(keyframes=self._volume.keyframes)
        return Answered(result=result, state=state, delay_s=took, took_s=took)
