# SPDX-License-Identifier: MIT
"""Parts of a whole mesh: made of a saved map by workers, kept in files, put together by one of them."""

import zipfile
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from tsfusion.core.durable_files import replacing
from tsfusion.core.errors import OutputError
from tsfusion.geometry.mesh_parts import MeshPart
from tsfusion.tsdf.files import checkpoint
from tsfusion.tsdf.store.block_store import unpack_keys
from tsfusion.tsdf.surface import mesh_tiles
from tsfusion.tsdf.surface.mesh_tiles import MeshRun, Numbered
from tsfusion.tsdf.volume import Volume

LEAST_TILES = 3  # of a run: its neighbours' tiles are solved for it, too
_FARTHEST = 1 << 18  # beyond every block


def shares(blocks: int, workers: int) -> list[range]:
    """The tiles of a map's mesh in runs, one for each worker; none where a single one does it as fast."""
    tiles = mesh_tiles.tile_count(blocks)
    count = min(workers, tiles // LEAST_TILES)
    if count < 2:
        return []
    borders = np.linspace(0, tiles, count + 1).round().astype(int).tolist()
    return [range(first, stop) for first, stop in pairwise(borders)]


def make(file: Path, which: range, view: dict[str, Any]) -> MeshRun:
    """The mesh of some tiles of a saved map, of which no more is loaded than what lies across their x."""
    _, keys = checkpoint.keys_of(file, is_checked=True)
    x = unpack_keys(mesh_tiles.blocks_of_run(keys, which))[:, 0]
    low, high = (int(x.min()), -_FARTHEST, -_FARTHEST), (int(x.max()) + 1, _FARTHEST, _FARTHEST)
    return Volume.load_blocks(file, low, high, is_checked=True, **view).mesh_run(keys, which)


def write(path: Path, made: MeshRun) -> None:
    """Keep a run in a file; raises OutputError when the disk refuses."""
    part, border = made.part, made.border
    arrays: dict[str, Any] = {
        "vertices": part.vertices, "faces": part.faces, "normals": part.normals, "colors": part.colors,
        "open_at": made.open_at, "open_keys": made.open_keys, "open_edges": made.open_edges,
        "border_keys": border.keys, "border_edges": border.edges, "border_first": border.first,
        "first": np.array(made.first),
    }  # fmt: skip
    try:
        with replacing(path) as file:
            np.savez(file, **{name: one for name, one in arrays.items() if one is not None})
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}") from error


def read(path: Path) -> MeshRun:
    """A run that was kept; raises OutputError when it cannot be read."""
    try:
        with np.load(path) as found:
            colors = found["colors"] if "colors" in found.files else None
            return MeshRun(
                MeshPart(found["vertices"], found["faces"], found["normals"], colors),
                found["open_at"],
                found["open_keys"],
                found["open_edges"],
                Numbered(found["border_keys"], found["border_edges"], found["border_first"]),
                np.int64(found["first"]),
            )
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise OutputError(f"cannot read {path}: {error}") from error
