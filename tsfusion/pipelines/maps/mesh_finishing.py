# SPDX-License-Identifier: MIT
"""Finish a mesh for sharing: crop it, remove small pieces, simplify it, and write it to files."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tsfusion.core.errors import InvalidConfig, OutputError
from tsfusion.geometry import mesh_cropping, mesh_islands, mesh_simplification, point_files
from tsfusion.geometry.mesh import FORMATS, GUESS_COLOR, Mesh
from tsfusion.pipelines.maps import mesh_preview

if TYPE_CHECKING:
    from tsfusion.tsdf.volume import Volume

_MARGIN = 128  # voxels around a box that its surface depends on
# Memory of a step beside the map, in map sizes: the most that lab/bench/mesh_sharing.py --memory found
_FILLING, _SIMPLIFYING, _TEXTURING = 3.0, 6.0, 4.0
Box = tuple[float, float, float, float, float, float]
PICTURE = ".png"
SURFACES = (*FORMATS, *point_files.ONLY_POINTS)
_EXACT = (".ply", ".obj", *point_files.ONLY_POINTS)  # the whole map


@dataclasses.dataclass(frozen=True, kw_only=True)
class Finishing:
    """Steps that finish a mesh, in this order. A step that is None is left out.

    Attributes:
        crop: x0, y0, z0, x1, y1, z1 in metres.
        min_component: metres. Pieces whose bounding box has a shorter diagonal are removed.
        simplify: arguments of `Mesh.simplified`.
        mark_guesses: guessed triangles get a colour of their own.
    """

    crop: Box | None = None
    min_component: float | None = None
    simplify: dict[str, float] | None = None
    mark_guesses: bool = False

    @property
    def is_nothing(self) -> bool:
        """True if a mesh stays as it is."""
        return self == Finishing()

    def apply(self, mesh: Mesh) -> tuple[Mesh, dict[str, Any]]:
        """Return the finished mesh, and the numbers of `islands` removed and of their `triangles`.

        Raises:
            OutputError: when nothing is left.
        """
        left_out = {"islands": 0, "triangles": 0}
        if self.crop is not None and len(mesh.faces):
            mesh = _not_empty(mesh.cropped(self.crop), "nothing of the mesh lies in this box")
        if self.min_component is not None and len(mesh.faces):
            whole, islands = mesh, mesh.islands(self.min_component)
            mesh = mesh.without_islands(self.min_component)
            _not_empty(mesh, f"no piece of the mesh is {self.min_component:g} m across")
            left_out = whole.count_islands(islands)
        if self.simplify is not None:
            mesh = mesh.simplified(**self.simplify)  # type: ignore[arg-type]
        return mesh.with_guesses_marked() if self.mark_guesses else mesh, left_out

    def legend(self, mesh: Mesh) -> list[dict[str, str]]:
        """Return the legend of the colour of guessed triangles, or an empty list without any."""
        if not self.mark_guesses or mesh.guessed is None:
            return []
        return [{"color": "#{:02x}{:02x}{:02x}".format(*GUESS_COLOR), "name": "guessed: nobody saw this"}]


def checked(
    *,
    crop: Box | None,
    min_component: float | None,
    fill_holes: int | None,
    simplify: str | None,
    mark_guesses: bool,
) -> Finishing:
    """Check what a user asked for, and return the steps.

    Raises:
        InvalidConfig: for an invalid value, before any slow work.
        MissingDependency: without the library that simplifies.
    """
    if crop is not None:
        mesh_cropping.checked_box(crop)
    if min_component is not None:
        mesh_islands.checked_extent(min_component)
    if fill_holes is not None:
        from tsfusion.tsdf.surface import hole_filling  # Taichi: a mesh of a server needs none

        hole_filling.checked(fill_holes)
    if mark_guesses and fill_holes is None:
        raise InvalidConfig("--mark-guesses paints what --fill-holes guesses: give that, too")
    target = simplification(simplify)
    if target is not None:
        mesh_simplification.library()
    return Finishing(crop=crop, min_component=min_component, simplify=target, mark_guesses=mark_guesses)


def check_memory(map_bytes: int, most_bytes: int, *, fill_holes: bool, simplify: bool, texture: bool) -> None:
    """Refuse steps that would need too much memory, before they start.

    Args:
        most_bytes: limit for the map and the steps together.

    Raises:
        InvalidConfig: when they would take more.
    """
    steps = {
        "--simplify": simplify * _SIMPLIFYING,
        "--texture": texture * _TEXTURING,
        "--fill-holes": fill_holes * _FILLING,
    }
    flag, times = max(steps.items(), key=lambda step: step[1])
    needed = (1 + times) * map_bytes
    if times and needed > most_bytes:
        raise InvalidConfig(
            f"{flag} needs all of the mesh, and may take {needed / 1e9:.3g} GB for a map of "
            f"{map_bytes / 1e9:.3g} GB, where {most_bytes / 1e9:.3g} GB may be taken: give a --crop, a "
            "smaller one, or more --memory"
        )


def fitting(volume: "Volume", crop: Box | None, most_bytes: int, **steps: bool) -> "Volume":
    """Return the map, or only its part around the box if the steps would otherwise need too much memory.

    Args:
        most_bytes: limit for the map. The map and the steps together may take twice as much.
        steps: arguments of `check_memory`.

    Raises:
        InvalidConfig: when even the part needs too much. OutputError: see `part_around`.
    """
    try:
        check_memory(volume.stats().bytes, 2 * most_bytes, **steps)
    except InvalidConfig:
        if crop is None:
            raise
        volume = part_around(volume, crop, most_bytes)
        check_memory(volume.stats().bytes, 2 * most_bytes, **steps)
    return volume


def part_around(volume: "Volume", box: Box, most_bytes: int) -> "Volume":
    """Return the part of a large map that the mesh in a box depends on.

    Raises:
        OutputError: when this part is too large for memory.
    """
    margin = _MARGIN * volume.config.voxel_size
    around = [*(low - margin for low in box[:3]), *(high + margin for high in box[3:])]
    try:
        return volume.crop(around, most_bytes=most_bytes)
    except MemoryError as error:
        raise OutputError(f"the map in this box is too large for memory, too: {error}") from error


def simplification(text: str | None) -> dict[str, float] | None:
    """Return arguments of `Mesh.simplified`: `0.25` or `25%` (ratio), `50000` (triangles), `5mm` (error).

    Raises:
        InvalidConfig: for anything else.
    """
    if text is None:
        return None
    units = {
        "mm": ("max_error", 1e-3),
        "cm": ("max_error", 1e-2),
        "%": ("ratio", 1e-2),
        "m": ("max_error", 1.0),
    }
    unit = next((unit for unit in units if text.endswith(unit)), "")
    try:
        number = float(text.removesuffix(unit))
    except ValueError:
        number = -1.0
    if unit and number > 0:
        name, scale = units[unit]
        return {name: number * scale}
    if 0 < number < 1:
        return {"ratio": number}
    if number >= 1 and number == int(number):
        return {"triangles": int(number)}
    raise InvalidConfig(
        "a mesh is simplified to a share (0.25 or 25%), a number of triangles (50000) or an error (5mm), "
        f"got {text!r}"
    )


def _not_empty(mesh: Mesh, why: str) -> Mesh:
    if not len(mesh.faces):
        raise OutputError(f"nothing to write: {why}")
    return mesh


def write(mesh: Mesh, files: Sequence[Path], *, keep_islands: bool | None = None) -> dict[str, Any]:
    """Write a surface, its points (PCD, LAS, LAZ) or a picture (PNG) by each file's suffix.

    Args:
        keep_islands: None: PLY, OBJ and point files keep islands; GLB, STL and pictures do not.

    Returns:
        Number of `islands` left out, their `triangles`, and the names of the `files` without them.

    Raises:
        OutputError: for an empty mesh or a path that cannot be written.
    """
    tidy, without = mesh.without_islands(), list[str]()
    for file in files:
        suffix = file.suffix.lower()
        keeps = suffix in _EXACT if keep_islands is None else keep_islands
        chosen = mesh if keeps else tidy
        if chosen is not mesh:
            without.append(file.name)
        if suffix == PICTURE:
            mesh_preview.render(chosen, file)
        elif suffix in point_files.ONLY_POINTS:
            chosen.save_points(file)
        else:
            chosen.save(file)
    if not without:
        return {"islands": 0, "triangles": 0, "files": []}
    figures = mesh.figures
    return {"islands": figures["islands"], "triangles": figures["island_triangles"], "files": without}
