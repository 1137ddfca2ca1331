# SPDX-License-Identifier: MIT
"""Hold a mesh that is too large for memory in files on the disk, part by part, and save it from there."""

import tempfile
import weakref
from collections.abc import Iterable, Iterator
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsfusion.core import durable_files
from tsfusion.core.errors import OutputError, refusals_as
from tsfusion.geometry import mesh_islands, up_direction
from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.mesh_arrays import Provenance
from tsfusion.geometry.up_direction import SensorPosture, Up

FORMATS = (".ply", ".glb")
_FACE = np.dtype([("count", "u1"), ("corners", "<i4", 3)])


class MeshPart(NamedTuple):
    """A part of a mesh; `faces` (m, 3) int32 number vertices from the whole mesh's end, the last is 1.

    Faces may use vertices of parts that come later in the mesh.
    """

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]
    normals: NDArray[np.float32]
    colors: NDArray[np.uint8] | None


def joined(parts: list[MeshPart]) -> Mesh:
    """Return the whole mesh from its parts, given from the last part of the mesh to the first."""
    nothing = np.zeros((0, 3), np.float32)
    vertices, faces, normals = (
        np.concatenate([part[which] for part in reversed(parts)]) if parts else nothing for which in range(3)
    )
    colors = [part.colors for part in reversed(parts) if part.colors is not None]
    return Mesh(
        vertices,
        np.asarray(len(vertices) - faces, np.int32),
        normals,
        np.concatenate(colors) if colors else None,
    )


class MeshParts:
    """A mesh on the disk.

    Args:
        parts: the last part of the mesh first.
        folder: folder for temporary files without names.
        held: attitudes of the sensors that saw the map.
        known_up: direction away from the ground; None = it is found.

    Attributes:
        provenance: origin of the mesh, which its files contain.
        left_out: number of removed `islands` and of their `triangles`.

    Raises:
        OutputError: the folder's disk has no room.
    """

    def __init__(
        self, parts: Iterable[MeshPart], folder: Path, *, held: SensorPosture, known_up: Up | None = None
    ) -> None:
        self._held, self._known_up, self._folder = held, known_up, folder
        self.provenance: Provenance | None = None
        self.left_out = {"islands": 0, "triangles": 0}
        self._counts: list[tuple[int, int]] = []  # vertices and faces of each part, in order of arrival
        self._low, self._high = np.full(3, np.inf), np.full(3, -np.inf)
        self._vertex = np.dtype([])
        with refusals_as(OutputError, f"cannot write the mesh to {folder}"):
            self._vertices, self._faces = (self._file(folder) for _ in range(2))
            for part in parts:
                self._take(part)
            self._vertices.flush()
            self._faces.flush()
        self.vertices, self.faces = (sum(part[which] for part in self._counts) for which in (0, 1))

    def _file(self, folder: Path) -> BinaryIO:
        file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115  it is closed with this object
        weakref.finalize(self, file.close)
        return file

    def _take(self, part: MeshPart) -> None:
        self._vertex = _vertex_type(part.colors is not None)
        rows = np.empty(len(part.vertices), self._vertex)
        rows["position"], rows["normal"] = part.vertices, part.normals
        if part.colors is not None:
            rows["color"][:, :3], rows["color"][:, 3] = part.colors, 255
        self._vertices.write(rows.data)
        self._faces.write(np.ascontiguousarray(part.faces, "<i4").data)
        self._counts.append((len(part.vertices), len(part.faces)))
        if len(part.vertices):
            self._low = np.minimum(self._low, part.vertices.min(axis=0))
            self._high = np.maximum(self._high, part.vertices.max(axis=0))

    @cached_property
    def up(self) -> Up | None:
        """Direction away from the ground, as given or found; None = unknown."""
        if self._known_up is not None:
            return self._known_up
        step, skipped = max(1, self.faces // up_direction.SAMPLE), 0
        found = [np.empty(0, self._vertex)]
        for part in self._in_order():
            found.append(self._rows(part[skipped::step].ravel()))
            skipped = (skipped - len(part)) % step
        rows = np.concatenate(found)
        faces = np.arange(len(rows), dtype=np.int32).reshape(-1, 3)
        return up_direction.find(Mesh(rows["position"], faces, rows["normal"]), self._held)

    def without_islands(self, min_extent: float) -> "MeshParts":
        """Return a mesh on the disk without pieces smaller than `min_extent` metres, as `Mesh` does.

        Raises OutputError without room on the folder's disk.
        """
        file = self._file(self._folder)
        with refusals_as(OutputError, f"cannot write the mesh to {self._folder}"):
            file.truncate(4 * (self.vertices + 1))
            number = np.memmap(file, np.int32, "r+")
            islands = mesh_islands.find_in_parts(self._arrived(), number, min_extent)
            kept = mesh_islands.without(self._arrived(), number, islands)
            parts = MeshParts(kept, self._folder, held=self._held, known_up=self.up)
        parts.provenance = self.provenance
        parts.left_out = {"islands": islands.count, "triangles": self.faces - parts.faces}
        return parts

    def _arrived(self) -> Iterator[MeshPart]:
        vertex_at = face_at = 0
        for vertices, faces in self._counts:
            size = vertices * self._vertex.itemsize
            rows = np.frombuffer(_read(self._vertices, vertex_at, size), self._vertex)
            corners = np.frombuffer(_read(self._faces, face_at, 12 * faces), "<i4").reshape(-1, 3)
            colors = rows["color"][:, :3] if self._has_color else None
            yield MeshPart(rows["position"], corners, rows["normal"], colors)
            vertex_at, face_at = vertex_at + size, face_at + 12 * faces

    @property
    def figures(self) -> dict[str, Any]:
        """Figures as `Mesh.figures` gives them, without a search for islands."""
        extent = self._high - self._low if self.vertices else np.zeros(3)
        return {
            "vertices": self.vertices,
            "triangles": self.faces,
            "extent_m": [round(float(length), 3) for length in extent],
            "islands": None,
            "island_triangles": None,
            "up": self.up,
        }

    def save(self, path: Path) -> list[Path]:
        """Write one PLY, the same as `Mesh.save`, or a GLB for each part (`NAME-0001.glb` and on); return the
        files.

        Raises OutputError for another suffix, an empty mesh, or a path that cannot be written.
        """
        check(path)
        if not self.faces:
            raise OutputError(f"nothing to write to {path}: the mesh has no triangles (yet)")
        if path.suffix.lower() == ".ply":
            return [self._save_ply(path)]
        return self._save_tiles(path)

    def _save_tiles(self, path: Path) -> list[Path]:
        meshes = (self._mesh(faces) for faces in self._in_order() if len(faces))
        files = [mesh.save(_tile(path, number)) for number, mesh in enumerate(meshes, 1)]
        number = len(files) + 1
        while (left := _tile(path, number)).is_file():  # left by an earlier, larger mesh
            left.unlink()
            number += 1
        return files

    def _save_ply(self, path: Path) -> Path:
        with durable_files.written(path) as file:
            file.write(self._header())
            for count, offset in self._pieces(0, self._vertex.itemsize):
                file.write(_read(self._vertices, offset, count * self._vertex.itemsize))
            for faces in self._in_order():
                rows = np.empty(len(faces), _FACE)
                rows["count"], rows["corners"] = 3, faces
                file.write(rows.data)
        return path

    def _header(self) -> bytes:
        """Return the header of the mesh's PLY file: that of a one-triangle mesh with other counts."""
        corners, grey = np.eye(3, dtype=np.float32), np.zeros((3, 3), np.uint8)
        faces = np.arange(3, dtype=np.int32)[None]
        one = Mesh(corners, faces, corners, grey if self._has_color else None, known_up=self.up)
        one = replace(one, provenance=self.provenance)
        head, end, _ = one.encode(".ply").partition(b"end_header\n")
        head = head.replace(b"element vertex 3\n", b"element vertex %d\n" % self.vertices)
        return head.replace(b"element face 1\n", b"element face %d\n" % self.faces) + end

    def _pieces(self, which: int, item_bytes: int) -> Iterator[tuple[int, int]]:
        """Yield item count and file offset of each part, in mesh order. `which`: 0 vertices, 1 faces."""
        offset = sum(counts[which] for counts in self._counts) * item_bytes
        for counts in reversed(self._counts):
            offset -= counts[which] * item_bytes
            yield counts[which], offset

    def _in_order(self) -> Iterator[NDArray[np.int32]]:
        """Yield the faces of each part in the order of the mesh, with vertex numbers of the whole mesh."""
        for count, offset in self._pieces(1, 12):
            from_end = np.frombuffer(_read(self._faces, offset, 12 * count), "<i4").reshape(-1, 3)
            yield np.asarray(self.vertices - from_end, np.int32)

    def _mesh(self, faces: NDArray[np.int32]) -> Mesh:
        used, corners = np.unique(faces, return_inverse=True)
        rows = self._rows(used)
        colors = rows["color"][:, :3].copy() if self._has_color else None
        triangles: NDArray[np.int32] = corners.reshape(-1, 3).astype(np.int32)
        mesh = Mesh(rows["position"].copy(), triangles, rows["normal"].copy(), colors, known_up=self.up)
        return replace(mesh, provenance=self.provenance)

    def _rows(self, numbers: NDArray[np.int32]) -> NDArray[Any]:
        """Return vertices by number from the file, which stores the mesh's last part first."""
        if not len(numbers):
            return np.empty(0, self._vertex)
        counts = np.array([count for count, _ in reversed(self._counts)])
        first = np.cumsum(counts) - counts
        part = np.searchsorted(first, numbers, side="right") - 1
        lies = numbers - first[part] + self.vertices - first[part] - counts[part]
        return np.asarray(np.memmap(self._vertices, self._vertex, "r")[lies])

    @property
    def _has_color(self) -> bool:
        return "color" in (self._vertex.names or ())


def _tile(path: Path, number: int) -> Path:
    return path.with_stem(f"{path.stem}-{number:04}")


def check(path: Path) -> None:
    """Raise OutputError for a file type in which a mesh cannot be written part by part."""
    if path.suffix.lower() not in FORMATS:
        raise OutputError(
            f"a mesh that is too large for memory is saved as {' or '.join(FORMATS)}, got {path.name!r}"
        )


def _vertex_type(has_color: bool) -> np.dtype[Any]:
    fields: list[Any] = [("position", "<f4", 3), ("normal", "<f4", 3)]
    return np.dtype(fields + [("color", "u1", 4)] * has_color)


def _read(file: BinaryIO, offset: int, size: int) -> bytes:
    file.seek(offset)
    return file.read(size)
