# SPDX-License-Identifier: MIT
"""Source of a page's map: a running server, a saved map or a recording of one."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tsfusion.wire.asking.map_events import MapEvent


@dataclass(frozen=True)
class TimeLine:
    """Times that a feed can show.

    Attributes:
        keyframes: their number: places 0 (nothing) to `keyframes` (all).
        seconds: from the first to the last; None = not known.
    """

    keyframes: int
    seconds: float | None = None


class MapFeed(Protocol):
    """Source of a page's events. For one thread, except for `weights`."""

    @property
    def title(self) -> str:
        """Name of the watched map, for a person."""
        ...

    @property
    def time_line(self) -> TimeLine | None:
        """Times that `seek` takes; None = only the present can be shown."""
        ...

    def maps(self) -> list[str]:
        """Names of the maps that `choose` takes."""
        ...

    def choose(self, map_name: str) -> None:
        """Show another map: `Cleared` comes next."""
        ...

    def seek(self, keyframes: int) -> None:
        """Show the map as it was after so many keyframes; the differences come as events."""
        ...

    def events(self, timeout: float) -> list[MapEvent]:
        """Events since the last call; waits at most `timeout` seconds for the first event."""
        ...

    def weights(self, points: NDArray[np.float32]) -> NDArray[np.float32] | None:
        """(n,) weight of the map at (n, 3) points; None = unknown now."""
        ...

    def close(self) -> None:
        """Release all resources."""
        ...
