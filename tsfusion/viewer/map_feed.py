# SPDX-License-Identifier: MIT
"""Source of what a page shows: a running server, a saved map or a recording of one."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tsfusion.wire.asking.map_events import MapEvent


@dataclass(frozen=True)
class TimeLine:
    """The times that a feed can show.

    Attributes:
        keyframes: how many there are: places 0 (nothing) to `keyframes` (all).
        seconds: when the last came after the first; None = not known.
    """

    keyframes: int
    seconds: float | None = None


class MapFeed(Protocol):
    """Source of what a page shows, event by event. For one thread, but for `weights`."""

    @property
    def title(self) -> str:
        """Name of what is watched, for a person."""
        ...

    @property
    def time_line(self) -> TimeLine | None:
        """The times that `seek` takes; None = only now can be shown."""
        ...

    def maps(self) -> list[str]:
        """Names of the maps that `choose` takes."""
        ...

    def choose(self, map_name: str) -> None:
        """Show another map: `Cleared` comes next."""
        ...

    def seek(self, keyframes: int) -> None:
        """Show the map as it was after so many keyframes; what is different comes as events."""
        ...

    def events(self, timeout: float) -> list[MapEvent]:
        """Events since the last call; waits at most `timeout` seconds for the first event."""
        ...

    def weights(self, points: NDArray[np.float32]) -> NDArray[np.float32] | None:
        """(n,) weight of the map at (n, 3) points; None = nobody knows now."""
        ...

    def close(self) -> None:
        """Let go of everything."""
        ...
