# SPDX-License-Identifier: MIT
"""Files of a mesh: surfaces and pictures, with or without its islands."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tsfusion.geometry import point_files
from tsfusion.geometry.mesh import FORMATS, Mesh
from tsfusion.pipelines import mesh_preview

PICTURE = ".png"
SURFACES = (*FORMATS, *point_files.ONLY_POINTS)
_EXACT = (".ply", ".obj", *point_files.ONLY_POINTS)  # the whole map


def write(mesh: Mesh, files: Sequence[Path], *, keep_islands: bool | None = None) -> dict[str, Any]:
    """Write a surface, its points (PCD, LAS, LAZ) or a picture (PNG) by each file's suffix.

    Args:
        keep_islands: None = PLY, OBJ and points keep them; GLB, STL and pictures do not.

    Returns:
        Number of `islands` left out, their `triangles`, and the names of the `files` without them.

    Raises:
        OutputError: for an empty mesh or a place that cannot be written.
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
