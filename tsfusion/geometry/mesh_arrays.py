# SPDX-License-Identifier: MIT
"""The arrays of a triangle mesh, for functions that make a mesh of another one."""

import dataclasses
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from tsfusion.core import process
from tsfusion.geometry import up_direction
from tsfusion.geometry.provenance import Provenance
from tsfusion.geometry.up_direction import HeldSensor, Up

AnyMesh = TypeVar("AnyMesh", bound="MeshArrays")


@dataclass(frozen=True, eq=False, repr=False)
class MeshArrays:
    """Arrays of a `Mesh`, which says what they are."""

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]
    normals: NDArray[np.float32]
    colors: NDArray[np.uint8] | None = None
    known_up: Up | None = field(default=None, kw_only=True)
    held: HeldSensor | None = field(default=None, kw_only=True, repr=False)
    guessed: NDArray[np.bool_] | None = field(default=None, kw_only=True)
    provenance: Provenance | None = field(default=None, kw_only=True)

    @cached_property
    def up(self) -> Up | None:
        """Direction away from the ground, as given or found; None = not known."""
        if self.known_up is not None or self.held is None:
            return self.known_up
        return up_direction.find(self, self.held)

    def of_faces(self: AnyMesh, kept: NDArray[np.bool_] | NDArray[np.integer]) -> AnyMesh:
        """A mesh of some of the faces and the vertices that they use, in the same order.

        Args:
            kept: (m,) bool for each face, or the numbers of faces.
        """
        chosen = np.flatnonzero(kept) if kept.dtype == np.bool_ else kept
        faces = np.take(self.faces, chosen, axis=0)
        first, last = (int(faces.min()), int(faces.max())) if len(faces) else (0, -1)
        is_used = np.zeros(last + 1 - first, bool)  # of a part of the mesh these are few of all vertices
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
