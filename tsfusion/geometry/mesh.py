# SPDX-License-Identifier: MIT
"""Hold triangle meshes, change them and write their files."""

import dataclasses
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.core import durable_files
from tsfusion.core.errors import OutputError
from tsfusion.geometry import (
    mesh_cropping,
    mesh_encoding,
    mesh_islands,
    mesh_simplification,
    object_cards,
    point_files,
)
from tsfusion.geometry.map_answers import import_open3d
from tsfusion.geometry.mesh_arrays import MeshArrays

FORMATS = tuple(mesh_encoding.FORMATS)
GUESS_COLOR = (230, 40, 190)  # RGB, seldom seen indoors or out


@dataclass(frozen=True, eq=False, repr=False)
class Mesh(MeshArrays, object_cards.Shown):
    """Triangles in world coordinates; the outside is the side the normals point to.

    Attributes:
        vertices: (n, 3) float32, metres.
        faces: (m, 3) int32, counter-clockwise seen from outside.
        normals: (n, 3) float32, unit length.
        colors: (n, 3) uint8 RGB (sRGB); grey where no colour was seen, None if the map holds none.
        known_up: direction away from the ground; None = `up` finds it.
        held: attitudes of the sensors that saw the whole map; None = unknown.
        guessed: (m,) bool, True for faces that close holes in unseen regions; None = no such faces.
        provenance: origin of the mesh, for readers of its files; None = unknown.

    Examples:
        >>> volume = tsfusion.Volume(0.05)
        >>> added = volume.integrate(tsfusion.open_dataset("synthetic:room", count=1)[0])
        >>> mesh = volume.extract_mesh()
        >>> mesh.vertices.shape == mesh.normals.shape, bool(mesh.faces.max() < len(mesh.vertices))
        (True, True)
        >>> mesh.cropped((-1, -1, 0, 1, 1, 1)).save("part.glb").name
        'part.glb'
    """

    def _facts(self) -> dict[str, str]:
        colored = "grey" if self.colors is None else "coloured"
        return {
            "triangles": f"{len(self.faces)} triangles",
            "vertices": f"{len(self.vertices)} vertices, {colored}",
            "size": object_cards.extent(self.vertices),
        }

    def _pictures(self) -> list[object_cards.Picture | None]:
        up = self.up.direction if self.up else (0.0, 0.0, 1.0)
        return [object_cards.surface(self.vertices, self.normals, self.colors, up)]

    def save(self, path: str | os.PathLike[str]) -> Path:
        """Write PLY (binary), GLB, OBJ or STL by the file's suffix; complete or not at all.

        PLY, OBJ and STL keep the map's frame. GLB is turned so that up is +Y, as glTF 2.0 asks; with unknown
        up it keeps the map's frame. Each file contains its unit, up direction, origin and guessed triangles
        (`mesh_encoding`); STL has no colours.

        Args:
            path: the file; `.ply`, `.glb`, `.obj` or `.stl`.

        Raises:
            OutputError: for another suffix, an empty mesh, or a path that cannot be written.
        """
        path = Path(path)
        if path.suffix.lower() not in FORMATS:
            raise OutputError(f"a mesh is saved as {', '.join(FORMATS)}, got {path.name!r}")
        if not len(self.faces):
            raise OutputError(f"nothing to write to {path}: the mesh has no triangles (yet)")
        content = self.encode(path.suffix.lower())
        with durable_files.written(path) as file:
            file.write(content)
        return path

    def save_points(self, path: str | os.PathLike[str]) -> Path:
        """Write the vertices with their normals and colours as PLY, PCD, LAS or LAZ, in the map's frame.

        Args:
            path: the file; `.ply`, `.pcd`, `.las` or `.laz`.

        Raises:
            OutputError: for another suffix, an empty mesh, or a path that cannot be written.
            MissingDependency: for LAS and LAZ without laspy.
        """
        origins = self.provenance.origins if self.provenance else []
        return point_files.save(
            path, self.vertices, normals=self.normals, colors=self.colors,
            facts=mesh_encoding.facts_of(self), origin=origins[0] if len(origins) == 1 else None,
        )  # fmt: skip

    def encode(self, suffix: str) -> bytes:
        """Encode the mesh as the content of a file with `suffix`: `.ply`, `.glb`, `.obj` or `.stl`."""
        return mesh_encoding.encode(self, suffix)

    def to_open3d(self) -> Any:
        """Make an `open3d.t.geometry.TriangleMesh` in the map's frame, with `normals` and `colors` (0 to 1).

        Its `to_legacy()` is an `open3d.geometry.TriangleMesh`. Raises MissingDependency without Open3D.
        """
        o3d = import_open3d()
        mesh = o3d.t.geometry.TriangleMesh(o3d.core.Tensor(self.vertices), o3d.core.Tensor(self.faces))
        mesh.vertex.normals = o3d.core.Tensor(self.normals)
        if self.colors is not None:
            mesh.vertex.colors = o3d.core.Tensor(self.colors / np.float32(255))
        return mesh

    def without_islands(self, min_extent: float | None = None) -> "Mesh":
        """Return the mesh without its islands; the same object if it has none.

        `min_extent`: smaller pieces, by the diagonal of their box in metres, are islands; None = pieces with
        few vertices (`mesh_islands.find`).
        """
        islands = self.islands(min_extent)
        if not islands.any():
            return self
        return dataclasses.replace(self.of_faces(~islands[self.faces[:, 0]]), known_up=self.up)

    def islands(self, min_extent: float | None = None) -> NDArray[np.bool_]:
        """Return an (n,) bool mask of the vertices of islands, which `without_islands` leaves out.

        `min_extent`: metres; None = the bound of `without_islands`.
        """
        if min_extent is None:
            return self._islands
        return mesh_islands.find_smaller(self.faces, self.vertices, min_extent)

    def count_islands(self, islands: NDArray[np.bool_]) -> dict[str, int]:
        """Return the number of `islands` in a mask from `Mesh.islands`, and of their `triangles`, by name."""
        triangles = int(islands[self.faces[:, 0]].sum())
        return {"islands": mesh_islands.count(self.faces, islands), "triangles": triangles}

    def cropped(self, box: Sequence[float]) -> "Mesh":
        """Return the part of the mesh inside a `box`: x0, y0, z0, x1, y1, z1 in metres, in the mesh's frame.

        Triangles across a side of the box are cut. Raises InvalidConfig for another box.
        """
        return dataclasses.replace(mesh_cropping.cropped(self, box), known_up=self.up)

    def simplified(
        self, *, ratio: float | None = None, triangles: int | None = None, max_error: float | None = None
    ) -> "Mesh":
        """Return the mesh with fewer triangles, the same borders, and mean colours at merged vertices.

        Args:
            ratio: wanted share of the triangles, above 0 and up to 1.
            triangles: wanted number. Borders need two triangles per edge: the result has at least these.
            max_error: largest distance of a new vertex from the planes of its original triangles, metres.

        Raises:
            InvalidConfig: unless one of them is given, in its range.
            MissingDependency: without fast-simplification.
        """
        less = mesh_simplification.simplified(self, ratio=ratio, triangles=triangles, max_error=max_error)
        return dataclasses.replace(less, known_up=self.up)

    def with_guesses_marked(self) -> "Mesh":
        """Return the mesh with its guessed triangles (over holes) in `GUESS_COLOR`, on separate vertices."""
        if self.guessed is None or not self.guessed.any():
            return self
        seen, guess = self.of_faces(~self.guessed), self.of_faces(self.guessed)
        colors = [
            np.full(part.vertices.shape, shade, np.uint8) if part.colors is None else part.colors
            for part, shade in ((seen, 160), (guess, 160))
        ]
        colors[1] = np.full(guess.vertices.shape, GUESS_COLOR, np.uint8)
        return dataclasses.replace(
            self,
            vertices=np.concatenate((seen.vertices, guess.vertices)),
            faces=np.concatenate((seen.faces, guess.faces + np.int32(len(seen.vertices)))),
            normals=np.concatenate((seen.normals, guess.normals)),
            colors=np.concatenate(colors),
            guessed=np.repeat((False, True), (len(seen.faces), len(guess.faces))),
            known_up=self.up,
        )

    @property
    def nbytes(self) -> int:
        arrays = (self.vertices, self.faces, self.normals, self.colors)
        return sum(array.nbytes for array in arrays if array is not None)

    @property
    def figures(self) -> dict[str, Any]:
        """Counts of vertices, triangles, and islands with their triangles; extent along the axes; up."""
        extent = np.ptp(self.vertices, axis=0) if len(self.vertices) else np.zeros(3)
        islands = self.count_islands(self._islands)
        return {
            "vertices": len(self.vertices),
            "triangles": len(self.faces),
            "extent_m": [round(float(length), 3) for length in extent],
            "islands": islands["islands"],
            "island_triangles": islands["triangles"],
            "up": self.up,
            **({} if self.guessed is None else {"guessed_triangles": int(self.guessed.sum())}),
        }

    @property
    def summary(self) -> str:
        return summarise(self.figures)

    @cached_property
    def _islands(self) -> NDArray[np.bool_]:
        return mesh_islands.find(self.faces, len(self.vertices))


def concatenated(meshes: Sequence[Mesh]) -> Mesh:
    """Return one mesh of several, vertices and faces in their order; with colours if all have them."""
    if len(meshes) == 1:
        return meshes[0]
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)], dtype=np.int32)
    colors = [mesh.colors for mesh in meshes if mesh.colors is not None]
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=False)]),
        np.concatenate([mesh.normals for mesh in meshes]),
        np.concatenate(colors) if len(colors) == len(meshes) else None,
    )


def summarise(figures: dict[str, Any]) -> str:
    """Return the `figures` of a mesh as one line of text."""
    extent = " × ".join(f"{length:.2f}" for length in figures["extent_m"])
    if figures["islands"] is None:
        pieces = "islands not looked for"
    else:
        share = 100 * figures["island_triangles"] / max(figures["triangles"], 1)
        word = "island" if figures["islands"] == 1 else "islands"
        pieces = f"{_grouped(figures['islands'])} {word} ({share:.1f} %)"
    vertices, triangles = _grouped(figures["vertices"]), _grouped(figures["triangles"])
    if figures.get("guessed_triangles"):
        triangles += f" triangles ({_grouped(figures['guessed_triangles'])} guessed)"
    else:
        triangles += " triangles"
    up = mesh_encoding.described(figures["up"])
    return f"{vertices} vertices, {triangles}, {extent} m, {pieces}, up {up}"


def _grouped(number: int) -> str:
    return f"{number:,}".replace(",", "\u202f")
