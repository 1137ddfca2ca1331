# SPDX-License-Identifier: MIT
"""Origins of maps whose poses are in a national grid or UTM.

Voxels and float32 vertices reach some kilometres around zero; eastings and northings are hundreds of
kilometres away. So the reader of a recording subtracts whole metres from all positions. The name of the map's
world has them: it goes with each record into the journal, the map and the meshes, and maps of two origins are
of two worlds.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import InvalidConfig, MissingDependency

AUTO = "auto"
FAR = 1e4  # metres from zero, beyond which poses that begin there are taken to be in a grid
_STEP = 1000  # metres: an origin that was found is a multiple of it, so that drives of a place have one
FARTHEST = 1e8  # metres from zero; the Earth is smaller
_CRS = re.compile(r"EPSG:[0-9]{4,6}|[A-Z_]+\[.*", re.DOTALL)
_WORLD = re.compile(r"(?:EPSG([0-9]{4,6})|origin)((?:_-?[0-9]{1,9}){3})")


class System(NamedTuple):
    crs: str = ""  # its code, such as `EPSG:25832`; empty = nobody said, or it has none
    metres: tuple[float, float, float] = (1.0, 1.0, 1.0)  # of a unit along x, y and z
    projection: Any = None  # a `pyproj.CRS`


@lru_cache(maxsize=64)
def system(text: str) -> System:
    """System of a code or WKT. Raises InvalidConfig for none or degrees, MissingDependency without pyproj."""
    if not _CRS.fullmatch(text):
        raise InvalidConfig(f"crs must be EPSG: and a number, such as EPSG:25832, got {text!r}")
    try:
        import pyproj

        read = pyproj.CRS.from_user_input(text)
    except ImportError as error:
        raise MissingDependency("for a coordinate reference system: pip install '.[crs]'") from error
    except pyproj.exceptions.CRSError as error:
        raise InvalidConfig(f"pyproj knows no coordinate reference system {text[:60]}") from error
    if read.is_geographic:
        cure = "project points and poses first, such as to UTM (`pdal translate`, `gdaltransform`)"
        raise InvalidConfig(f"positions in {read.name} are degrees: {cure}")
    units = [axis.unit_conversion_factor or 1.0 for axis in read.axis_info] or [1.0]
    code = read.to_epsg() or (read.sub_crs_list or [read])[0].to_epsg()
    return System(f"EPSG:{code}" if code else "", (units[0], units[0], units[2 if units[2:] else 0]), read)


@dataclass(frozen=True)
class Origin:
    """Position of a map's zero in the frame of the poses that a recording came with.

    Attributes:
        position: whole metres along the axes of that frame, also where its system counts feet.
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
        """World name of keyframes whose positions count from here."""
        return "_".join([self.crs.replace(":", "") or "origin", *map(str, self.position)])

    @staticmethod
    def of_world(world: str) -> "Origin | None":
        """Origin in the name of a world; None = the world has none."""
        found = _WORLD.fullmatch(world)
        if found is None:
            return None
        x, y, z = (int(word) for word in found[2].split("_")[1:])
        return Origin((x, y, z), f"EPSG:{found[1]}" if found[1] else "")

    def __str__(self) -> str:
        return " ".join([*map(str, self.position), *filter(None, [self.crs])])


def found(positions: Sequence[NDArray[np.float64]], wanted: object = None, crs: str = "") -> Origin | None:
    """Origin of a recording; None = its positions stay as they are.

    Args:
        positions: (3,) metres each, in the recording's order.
        wanted: `auto` or None = near the first position, if that is farther than `FAR` from zero; `X,Y,Z` or
            three numbers = that place in whole metres.
        crs: code of their coordinate reference system.

    Raises InvalidConfig for anything else.
    """
    if wanted is not None and not (isinstance(wanted, str) and wanted == AUTO):
        return Origin(_parsed(wanted), crs)
    if not len(positions) or (np.abs(positions[0]).max() <= FAR and not crs):
        return None
    x, y, z = (int(_STEP * round(float(one) / _STEP)) for one in positions[0])
    return Origin((x, y, z), crs)


def world_of(recording: Any) -> str:
    """Name of the world of a recording's given poses, by its `origin`; empty = it has none."""
    there: Origin | None = getattr(recording, "origin", None)
    return "" if there is None else there.world


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
