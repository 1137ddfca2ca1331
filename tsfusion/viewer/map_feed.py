# SPDX-License-Identifier: MIT
"""Define the source of a page's map: a running server, a saved map or a recording of one."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from tsfusion.wire.asking.followed_map import MapEvent


@dataclass(frozen=True)
class TimeLine:
    """The states of a map over time that a feed can show.

    Attributes:
        keyframes: number of keyframes: `seek` takes 0 (empty map) to `keyframes` (whole map).
        seconds: duration from the first to the last keyframe; None = unknown.
    """

    keyframes: int
    seconds: float | None = None


class MapFeed(Protocol):
    """Source of a page's events. For one thread, except for `weights`."""

    @property
    def title(self) -> str:
        """Name of the shown map, for a person."""
        ...

    @property
    def time_line(self) -> TimeLine | None:
        """States that `seek` can show; None = only the present."""
        ...

    def maps(self) -> list[str]:
        """Return the names of the maps that `choose` takes."""
        ...

    def choose(self, map_name: str) -> None:
        """Show another map; the feed's next event is `Cleared`."""
        ...

    def seek(self, keyframes: int) -> None:
        """Show the map after so many keyframes; the differences come as events."""
        ...

    def events(self, timeout: float) -> list[MapEvent]:
        """Return the events since the last call; wait at most `timeout` seconds for the first one."""
        ...

    def weights(self, points: NDArray[np.float32]) -> NDArray[np.float32] | None:
        """Return the (n,) weights of the map at (n, 3) points; None if they are unknown now."""
        ...

    def close(self) -> None:
        """Release all resources."""
        ...
