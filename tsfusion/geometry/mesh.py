# SPDX-License-Identifier: MIT
"""Triangle meshes, and their files."""

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.core import durable_files, process
from tsfusion.core.errors import OutputError

FORMATS = (".ply", ".glb", ".obj")


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles in world coordinates; the outside is the side the normals point to.

    Attributes:
        vertices: (n, 3) float32, metres.
        faces: (m, 3) int32, counter-clockwise seen from outside.
        normals: (n, 3) float32, unit length.
        colors: (n, 3) uint8 RGB (sRGB); grey where no colour was seen, None if the map holds none.
    """

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]
    normals: NDArray[np.float32]
    colors: NDArray[np.uint8] | None = None

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write PLY (binary), GLB or OBJ by the file's suffix; complete or not at all.

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
        with process.uninterrupted():  # trimesh ignores exceptions while it is imported
            import trimesh

        colors = self.colors
        if colors is not None and suffix == ".glb":
            colors = _SRGB_TO_LINEAR[colors]  # glTF vertex colours are linear light
        mesh = trimesh.Trimesh(
            self.vertices, self.faces, vertex_normals=self.normals, vertex_colors=colors, process=False
        )
        options: dict[str, Any] = {
            ".ply": {"vertex_normal": True},
            ".glb": {"include_normals": True},
            ".obj": {"include_normals": True},
        }[suffix]
        content = mesh.export(file_type=suffix[1:], **options)
        return content.encode() if isinstance(content, str) else bytes(content)


def _srgb_to_linear() -> NDArray[np.uint8]:
    s = np.arange(256) / 255
    linear = np.where(s <= 0.04045, s / 12.92, ((s + 0.055) / 1.055) ** 2.4)
    return np.round(linear * 255).astype(np.uint8)


_SRGB_TO_LINEAR = _srgb_to_linear()
