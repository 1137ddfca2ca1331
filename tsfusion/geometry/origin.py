# SPDX-License-Identifier: MIT
"""Shift the poses of a recording in a national grid or UTM to an origin near the map.

Voxels and float32 vertices reach some kilometres around zero, but eastings and northings are hundreds of
kilometres long. So the reader of a recording subtracts whole metres from all positions. The name of the map's
world (coordinate frame) contains these metres. Each record carries this name into the journal, the map and
the meshes, so maps of two origins have two worlds.
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
FAR = 1e4  # metres from zero; a recording that starts farther away is taken to be in a grid
_STEP = 1000  # metres: found origins are multiples, so that drives through one area share an origin
FARTHEST = 1e8  # metres from zero; the Earth is smaller
_CRS = re.compile(r"EPSG:[0-9]{4,6}|[A-Z_]+\[.*", re.DOTALL)
_WORLD = re.compile(r"(?:EPSG([0-9]{4,6})|origin)((?:_-?[0-9]{1,9}){3})")


class System(NamedTuple):
    crs: str = ""  # code such as `EPSG:25832`; empty = not stated, or none exists
    metres: tuple[float, float, float] = (1.0, 1.0, 1.0)  # metres of one unit along x, y and z
    projection: Any = None  # a `pyproj.CRS`


@lru_cache(maxsize=64)
def system(text: str) -> System:
    """Return a coordinate reference system by EPSG code or WKT text, in metres or feet, not degrees."""
    if not _CRS.fullmatch(text):
        raise InvalidConfig(f"crs must be EPSG: and a number, such as EPSG:25832, got {text!r}")
    try:
        import pyproj

        read = pyproj.CRS.from_user_input(text)
    except ImportError as error:
        raise MissingDependency("a coordinate reference system needs pyproj: pip install '.[crs]'") from error
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
    """Position of the map's zero in the coordinate frame of a recording's given poses.

    Attributes:
        position: whole metres along the axes of that frame, even if its system uses feet.
        crs: its coordinate reference system, such as `EPSG:25832`; empty = not stated.

    Examples:
        >>> origin = Origin((447800, 5411400, 300), "EPSG:25832")
        >>> origin.world, Origin.of_world(origin.world) == origin
        ('EPSG25832_447800_5411400_300', True)
    """

    position: tuple[int, int, int]
    crs: str = ""

    @property
    def world(self) -> str:
        """Name of the world (coordinate frame) whose positions count from this origin."""
        return "_".join([self.crs.replace(":", "") or "origin", *map(str, self.position)])

    @staticmethod
    def of_world(world: str) -> "Origin | None":
        """Return the origin in the name of a world, or None without one."""
        found = _WORLD.fullmatch(world)
        if found is None:
            return None
        x, y, z = (int(word) for word in found[2].split("_")[1:])
        return Origin((x, y, z), f"EPSG:{found[1]}" if found[1] else "")

    def __str__(self) -> str:
        return " ".join([*map(str, self.position), *filter(None, [self.crs])])


def found(positions: Sequence[NDArray[np.float64]], wanted: object = None, crs: str = "") -> Origin | None:
    """Return the origin to subtract from a recording's positions, or None if they stay unchanged.

    Args:
        positions: (3,) metres each, in the recording's order.
        wanted: `auto` or None = near the first position, if that is farther than `FAR` from zero; `X,Y,Z` or
            three numbers = this position in whole metres.
        crs: code of the positions' coordinate reference system.

    Raises InvalidConfig for anything else.
    """
    if wanted is not None and not (isinstance(wanted, str) and wanted == AUTO):
        return Origin(_parsed(wanted), crs)
    if not len(positions) or (np.abs(positions[0]).max() <= FAR and not crs):
        return None
    x, y, z = (int(_STEP * round(float(one) / _STEP)) for one in positions[0])
    return Origin((x, y, z), crs)


def world_of(recording: Any) -> str:
    """Return the world name of a recording's given poses, by its `origin`; empty without an origin."""
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
