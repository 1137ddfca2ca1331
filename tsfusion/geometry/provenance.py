# SPDX-License-Identifier: MIT
"""Notes of a surface file about itself, for readers who get it without its map."""

from dataclasses import dataclass

from tsfusion.geometry.origin import Origin

GENERATOR = "tsfusion"


@dataclass(frozen=True, kw_only=True)
class Provenance:
    """Origin of a surface; None = it is not known.

    Attributes:
        source: name of the map, or of its file or folder: not where that lies, as files are sent around.
        keyframes: number that the map was made from.
        map_hash: `map_hash()` of the map.
        world: coordinate frames of its scans; empty = poses were given from elsewhere.
        voxel_size: metres.
    """

    source: str | None = None
    keyframes: int | None = None
    map_hash: str | None = None
    world: str | None = None
    voxel_size: float | None = None

    @property
    def origins(self) -> list[Origin]:
        """Origins of its worlds, in the frame of the poses that their scans came with."""
        return [one for world in (self.world or "").split() if (one := Origin.of_world(world))]

    @property
    def facts(self) -> dict[str, str]:
        """Known facts, by name, as text of one line each."""
        facts = {
            "source": self.source,
            "keyframes": self.keyframes,
            "map_hash": self.map_hash,
            "world": self.world or None,
            "origin_m": " and ".join(map(str, self.origins)) or None,
            "voxel_size_m": self.voxel_size,
        }
        return {name: " ".join(str(value).split()) for name, value in facts.items() if value is not None}


def generator() -> str:
    """Name and version of this program."""
    from tsfusion import __version__

    return f"{GENERATOR} {__version__}"
