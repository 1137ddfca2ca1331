# SPDX-License-Identifier: MIT
"""Hold the arrays of a triangle mesh and its origin, for functions that make files and other meshes."""

import dataclasses
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from tsfusion.core import process
from tsfusion.geometry import up_direction
from tsfusion.geometry.origin import Origin
from tsfusion.geometry.up_direction import SensorPosture, Up

GENERATOR = "tsfusion"
AnyMesh = TypeVar("AnyMesh", bound="MeshArrays")


@dataclass(frozen=True, kw_only=True)
class Provenance:
    """Origin of a surface; None = unknown.

    Attributes:
        source: name of the map, or of its file or folder without the path, because files are sent around.
        keyframes: number of keyframes in the map.
        map_hash: `map_hash()` of the map.
        world: worlds (coordinate frames) of its scans; empty = poses were given from elsewhere.
        voxel_size: metres.
    """

    source: str | None = None
    keyframes: int | None = None
    map_hash: str | None = None
    world: str | None = None
    voxel_size: float | None = None

    @property
    def origins(self) -> list[Origin]:
        """Origins (offsets of map coordinates) in the names of its worlds, in the frame of given poses."""
        return [one for world in (self.world or "").split() if (one := Origin.of_world(world))]

    @property
    def facts(self) -> dict[str, str]:
        """Known facts about the origin, by name, as text of one line each."""
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
    from tsfusion import __version__

    return f"{GENERATOR} {__version__}"


@dataclass(frozen=True, eq=False, repr=False)
class MeshArrays:
    """Arrays of a `Mesh`, whose docstring describes them."""

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]
    normals: NDArray[np.float32]
    colors: NDArray[np.uint8] | None = None
    known_up: Up | None = field(default=None, kw_only=True)
    held: SensorPosture | None = field(default=None, kw_only=True, repr=False)
    guessed: NDArray[np.bool_] | None = field(default=None, kw_only=True)
    provenance: Provenance | None = field(default=None, kw_only=True)

    @cached_property
    def up(self) -> Up | None:
        """Direction away from the ground, as given or found; None = unknown."""
        if self.known_up is not None or self.held is None:
            return self.known_up
        return up_direction.find(self, self.held)

    def of_faces(self: AnyMesh, kept: NDArray[np.bool_] | NDArray[np.integer]) -> AnyMesh:
        """Return the mesh of some faces and the vertices that they use, in the same order.

        `kept`: (m,) bool for each face, or the numbers of faces.
        """
        chosen = np.flatnonzero(kept) if kept.dtype == np.bool_ else kept
        faces = np.take(self.faces, chosen, axis=0)
        first, last = (int(faces.min()), int(faces.max())) if len(faces) else (0, -1)
        is_used = np.zeros(last + 1 - first, bool)  # a part of the mesh uses few of all vertices
        is_used[faces - first] = True
        used, number = first + np.flatnonzero(is_used), np.cumsum(is_used, dtype=np.int32) - np.int32(1)
        return dataclasses.replace(
            self,
            vertices=np.take(self.vertices, used, axis=0),
            faces=np.take(number, faces - first),
            normals=np.take(self.normals, used, axis=0),
            colors=None if self.colors is None else np.take(self.colors, used, axis=0),
            guessed=None if self.guessed is None else self.guessed[chosen],
        )

    def to_trimesh(self) -> Any:
        """Make a `trimesh.Trimesh` in the map's frame, with normals and colours; nothing is merged."""
        with process.uninterrupted():  # trimesh ignores exceptions while it is imported
            import trimesh

        return trimesh.Trimesh(
            self.vertices, self.faces, vertex_normals=self.normals, vertex_colors=self.colors, process=False
        )
