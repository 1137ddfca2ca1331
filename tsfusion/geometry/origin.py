# SPDX-License-Identifier: MIT
"""Origins of maps whose poses are in a national grid or UTM.

Voxels and float32 vertices reach some kilometres around zero; eastings and northings are hundreds of
kilometres away. So whole metres are taken off all positions of a recording, once, where it is read. The name
of the map's world says which: it goes with each record into the journal, the map and the meshes, and maps of
two origins are of two worlds.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import InvalidConfig

AUTO = "auto"
FAR = 1e4  # metres from zero, beyond which poses that begin there are taken to be in a grid
_STEP = 100  # metres: an origin that was found is a multiple of it
FARTHEST = 1e8  # metres from zero; the Earth is smaller
_CRS = re.compile(r"EPSG:([0-9]{4,6})")
_WORLD = re.compile(r"(?:EPSG([0-9]{4,6})|origin)((?:_-?[0-9]{1,9}){3})")


@dataclass(frozen=True)
class Origin:
    """Position of a map's zero in the frame of the poses that a recording came with.

    Attributes:
        position: whole metres along the axes of that frame.
        crs: its coordinate reference system, such as `EPSG:25832`; empty = nobody said.

    Examples:
        >>> origin = Origin((447800, 5411400, 300), "EPSG:25832")
        >>> origin.world, Origin.of_world(origin.world) == origin
        ('EPSG25832_447800_5411400_300', True)
    """

    position: tuple[int, int, int]
    crs: str = ""

    @property
    def world(self) -> str:
        """Name of the world of keyframes whose positions count from here."""
        return "_".join([self.crs.replace(":", "") or "origin", *map(str, self.position)])

    @staticmethod
    def of_world(world: str) -> "Origin | None":
        """The origin in the name of a world; None = the world has none."""
        found = _WORLD.fullmatch(world)
        if found is None:
            return None
        x, y, z = (int(word) for word in found[2].split("_")[1:])
        return Origin((x, y, z), f"EPSG:{found[1]}" if found[1] else "")

    def __str__(self) -> str:
        return " ".join([*map(str, self.position), *filter(None, [self.crs])])


def found(
    positions: Sequence[NDArray[np.float64]], wanted: object = None, crs: str | None = None
) -> Origin | None:
    """The origin of a recording; None = its positions stay as they are.

    Args:
        positions: (3,) metres each, in the recording's order.
        wanted: `auto` or None = near the first position where that is farther than `FAR` from zero; `X,Y,Z`
            or three numbers = that place in whole metres.
        crs: coordinate reference system of the positions, such as `EPSG:25832`.

    Raises:
        InvalidConfig: for anything else.
    """
    if crs is not None and (not isinstance(crs, str) or not _CRS.fullmatch(crs)):
        raise InvalidConfig(f"crs must be EPSG: and a number, such as EPSG:25832, got {crs!r}")
    if wanted is not None and not (isinstance(wanted, str) and wanted == AUTO):
        return Origin(_parsed(wanted), crs or "")
    if not len(positions) or (np.abs(positions[0]).max() <= FAR and not crs):
        return None
    x, y, z = (int(_STEP * round(float(one) / _STEP)) for one in positions[0])
    return Origin((x, y, z), crs or "")


def world_of(recording: Any) -> str:
    """Name of the world of a recording's given poses, by its `origin`; empty = it has none."""
    there: Origin | None = getattr(recording, "origin", None)
    return "" if there is None else there.world


def position_of(world: str) -> tuple[int, int, int] | None:
    """Metres of the origin in the name of a world; None = it has none."""
    there = Origin.of_world(world)
    return None if there is None else there.position


def _parsed(wanted: object) -> tuple[int, int, int]:
    words = wanted.replace(",", " ").split() if isinstance(wanted, str) else wanted
    try:
        numbers = [float(word) for word in words]  # type: ignore[attr-defined]
        x, y, z = (int(number) for number in numbers)
        if [x, y, z] != numbers or max(abs(x), abs(y), abs(z)) > FARTHEST:
            raise ValueError
    except (TypeError, ValueError, OverflowError) as error:
        raise InvalidConfig(
            f"origin must be {AUTO} or X,Y,Z in whole metres, such as 447800,5411400,300, got {wanted!r}"
        ) from error
    return x, y, z
