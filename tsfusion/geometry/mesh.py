# SPDX-License-Identifier: MIT
"""Triangle meshes, and their files."""

import dataclasses
import os
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.core import durable_files, process
from tsfusion.core.errors import OutputError
from tsfusion.geometry import mesh_islands, up_direction
from tsfusion.geometry.map_answers import import_open3d
from tsfusion.geometry.up_direction import HeldSensor, Up

FORMATS = (".ply", ".glb", ".obj")
_COMMENTS = {".ply": (b"comment ", b"format binary_little_endian 1.0\n"), ".obj": (b"# ", b"")}


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles in world coordinates; the outside is the side the normals point to.

    Attributes:
        vertices: (n, 3) float32, metres.
        faces: (m, 3) int32, counter-clockwise seen from outside.
        normals: (n, 3) float32, unit length.
        colors: (n, 3) uint8 RGB (sRGB); grey where no colour was seen, None if the map holds none.
        known_up: away from the ground; None = `up` finds it.
        held: how the sensors that saw a whole map were held; None = nobody knows.
    """

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]
    normals: NDArray[np.float32]
    colors: NDArray[np.uint8] | None = None
    known_up: Up | None = field(default=None, kw_only=True)
    held: HeldSensor | None = field(default=None, kw_only=True, repr=False)

    @cached_property
    def up(self) -> Up | None:
        """Direction away from the ground, as given or found; None = not known."""
        if self.known_up is not None or self.held is None:
            return self.known_up
        return up_direction.find(self, self.held)

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write PLY (binary), GLB or OBJ by the file's suffix; complete or not at all.

        PLY and OBJ keep the map's frame and name its up direction in a comment. GLB is turned so that up is
        +Y, as glTF 2.0 asks for; where up is not known it keeps the map's frame.

        Raises:
            OutputError: for another suffix, an empty mesh, or a path that cannot be written.
        """
        path = Path(path)
        if path.suffix.lower() not in FORMATS:
            raise OutputError(f"a mesh is saved as {', '.join(FORMATS)}, got {path.name!r}")
        if not len(self.faces):
            raise OutputError(f"nothing to write to {path}: the mesh has no triangles (yet)")
        content = self.encode(path.suffix.lower())
        try:
            with durable_files.replacing(path) as file:
                file.write(content)
        except OSError as error:
            raise OutputError(f"cannot write {path}: {error.strerror}") from error
        return path

    def encode(self, suffix: str) -> bytes:
        """Encode the mesh as the content of a `.ply`, `.glb` or `.obj` file."""
        if suffix == ".glb":
            return bytes(self._as_gltf().export(file_type="glb", include_normals=True))
        normals = {".ply": "vertex_normal", ".obj": "include_normals"}[suffix]
        content = self.to_trimesh().export(file_type=suffix[1:], **{normals: True})
        content = content.encode() if isinstance(content, str) else bytes(content)
        comment, before = _COMMENTS[suffix]
        head, before, rest = content.partition(before) if before else (b"", b"", content)
        lines = (b"frame of the map, right-handed; unit metre", f"up {_described(self.up)}".encode())
        return head + before + b"".join(comment + line + b"\n" for line in lines) + rest

    def to_trimesh(self) -> Any:
        """Make a `trimesh.Trimesh` in the map's frame, with normals and colours; nothing is merged."""
        with process.uninterrupted():  # trimesh ignores exceptions while it is imported
            import trimesh

        return trimesh.Trimesh(
            self.vertices, self.faces, vertex_normals=self.normals, vertex_colors=self.colors, process=False
        )

    def to_open3d(self) -> Any:
        """Make an `open3d.geometry.TriangleMesh` in the map's frame, with normals and colours.

        Raises:
            MissingDependency: without Open3D.
        """
        open3d = import_open3d()
        vectors = open3d.utility
        mesh = open3d.geometry.TriangleMesh(
            vectors.Vector3dVector(self.vertices), vectors.Vector3iVector(self.faces)
        )
        mesh.vertex_normals = vectors.Vector3dVector(self.normals)
        if self.colors is not None:
            mesh.vertex_colors = vectors.Vector3dVector(self.colors / 255)
        return mesh

    def without_islands(self) -> "Mesh":
        """The mesh without its islands (`mesh_islands.find`); itself where it has none."""
        kept = ~self._islands
        if kept.all():
            return self
        number = np.cumsum(kept, dtype=np.int32) - 1
        return dataclasses.replace(
            self,
            vertices=self.vertices[kept],
            faces=number[self.faces[kept[self.faces[:, 0]]]],
            normals=self.normals[kept],
            colors=None if self.colors is None else self.colors[kept],
            known_up=self.up,
        )

    @property
    def figures(self) -> dict[str, Any]:
        """Counts of vertices, triangles, and islands with their triangles; extent along the axes; up."""
        extent = np.ptp(self.vertices, axis=0) if len(self.vertices) else np.zeros(3)
        return {
            "vertices": len(self.vertices),
            "triangles": len(self.faces),
            "extent_m": [round(float(length), 3) for length in extent],
            "islands": mesh_islands.count(self.faces, self._islands),
            "island_triangles": int(self._islands[self.faces[:, 0]].sum()),
            "up": self.up,
        }

    @property
    def summary(self) -> str:
        """One line: vertices, triangles, extent in metres, islands, and up."""
        return summarise(self.figures)

    @cached_property
    def _islands(self) -> NDArray[np.bool_]:
        return mesh_islands.find(self.faces, len(self.vertices))

    def _as_gltf(self) -> Any:
        """Make the `trimesh.Trimesh` that goes into a GLB file: +Y up, vertex colours as linear light."""
        turn = np.eye(3) if self.up is None else self.up.to_y()
        turned = dataclasses.replace(
            self,
            vertices=(self.vertices @ turn.T).astype(np.float32),
            normals=(self.normals @ turn.T).astype(np.float32),
            colors=None if self.colors is None else _SRGB_TO_LINEAR[self.colors],
        ).to_trimesh()
        turned.metadata["up"] = f"map's {_described(self.up)}" + (", here +y" if self.up else "")
        return turned


def summarise(figures: dict[str, Any]) -> str:
    """A mesh's `figures` as one line."""
    extent = " × ".join(f"{length:.2f}" for length in figures["extent_m"])
    if figures["islands"] is None:
        pieces = "islands not looked for"
    else:
        share = 100 * figures["island_triangles"] / max(figures["triangles"], 1)
        word = "island" if figures["islands"] == 1 else "islands"
        pieces = f"{_grouped(figures['islands'])} {word} ({share:.1f} %)"
    vertices, triangles = _grouped(figures["vertices"]), _grouped(figures["triangles"])
    return f"{vertices} vertices, {triangles} triangles, {extent} m, {pieces}, up {_described(figures['up'])}"


def _grouped(number: int) -> str:
    return f"{number:,}".replace(",", "\u202f")


def _described(up: Up | None) -> str:
    return "unknown" if up is None else str(up)


def _srgb_to_linear() -> NDArray[np.uint8]:
    s = np.arange(256) / 255
    linear = np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)
    return np.round(linear * 255).astype(np.uint8)


_SRGB_TO_LINEAR = _srgb_to_linear()
