# SPDX-License-Identifier: MIT
"""A saved map that answers as a live one does, so that whoever asks need not know which it is."""

import time
from collections.abc import Callable
from typing import Any

from numpy.typing import ArrayLike

from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.geometry.map_answers import Samples, View
from tsfusion.tsdf.volume import Volume
from tsfusion.wire.map_client import Answered, Result
from tsfusion.wire.questions import MapState


class SavedMapAnswers:
    """A map in this process with the methods of `wire.map_client.MapClient`. `timeout` has no effect."""

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
        timeout: float | None = None,
        **how: Any,
    ) -> Answered[View]:
        """See `MapClient.raycast`."""
        return self._answered(lambda: self._volume.raycast(intrinsics, T_world_camera, shape, **how))

    def _answered(self, answer: Callable[[], Result]) -> Answered[Result]:
        began = time.monotonic()
        result = answer()
        took = time.monotonic() - began
        state = MapState(keyframes=self._volume.keyframes)
        return Answered(result=result, state=state, delay_s=took, took_s=took)
