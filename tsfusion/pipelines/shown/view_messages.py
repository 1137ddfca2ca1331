# SPDX-License-Identifier: MIT
"""Messages between a page's feed and the process that reads its map (no Taichi here)."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import TsfusionError
from tsfusion.viewer.map_feed import TimeLine
from tsfusion.wire.asking.map_events import MapEvent


@dataclass(frozen=True)
class Open:
    """Show a map. `number`: that all that follows about it has; `name`: in a state folder."""

    number: int
    path: Path
    name: str | None


@dataclass(frozen=True)
class Seek:
    """Show it after so many keyframes."""

    keyframes: int


@dataclass(frozen=True, eq=False)
class Weigh:
    """Ask for the weights at (n, 3) points."""

    number: int
    points: NDArray[np.float32]


@dataclass(frozen=True)
class Took:
    """So many bytes of triangles were taken."""

    nbytes: int


@dataclass(frozen=True)
class Opened:
    """A map is shown; `name` = which."""

    number: int
    name: str
    time_line: TimeLine | None


@dataclass(frozen=True)
class ViewFailed:
    """A map cannot be shown."""

    number: int
    error: TsfusionError


@dataclass(frozen=True, eq=False)
class Told:
    """Events of a map."""

    number: int
    events: list[MapEvent]
    nbytes: int


@dataclass(frozen=True, eq=False)
class Weighed:
    """The answer to `Weigh`."""

    number: int
    weights: NDArray[np.float32] | None
