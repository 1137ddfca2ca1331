# SPDX-License-Identifier: MIT
"""Divide a map's mesh: into runs of tiles that workers join, and into GLB tiles with an index.

The index is 3D Tiles 1.1 (OGC 22-025r4): a tree of boxes, whose leaves name GLB files. Up is +Y in glTF and
+Z in 3D Tiles. So viewers turn the contents of a GLB: (x, y, z) → (x, −z, y).
"""

import json
import zipfile
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.durable_files import written
from tsfusion.core.errors import InvalidConfig, OutputError
from tsfusion.geometry.mesh_parts import MeshPart
from tsfusion.tsdf.files import checkpoint
from tsfusion.tsdf.store.block_store import distinct_blocks, unpack_keys
from tsfusion.tsdf.surface import mesh_tiles
from tsfusion.tsdf.surface.mesh_tiles import MeshRun, Numbered
from tsfusion.tsdf.volume import Volume

USUAL_BLOCKS = 16_384  # of a tile
_BLOCK_BYTES = 24 << 10  # of a block being meshed: its sums, values, the field's solution, triangles
_WORKING_BYTES = 64 << 20  # that meshing needs for a tile of any size
_HALO = 4  # blocks around a tile, at most
_LEAST_SIDE, _MOST_SIDE = 4, 1 << 14  # blocks

BlockBox = tuple[tuple[int, int, int], tuple[int, int, int]]
LEAST_TILES = 3  # of a run, because its neighbours' tiles are solved for it, too
_FARTHEST = 1 << 18  # beyond every block


def most_blocks(worker_memory: int | None, base_rss: int) -> int:
    """Return how many blocks fit into a worker that meshes a tile, with the blocks around the tile.

    Args:
        base_rss: bytes of memory that a worker has before.
    """
    if worker_memory is None:
        return USUAL_BLOCKS
    return max(1, min(USUAL_BLOCKS, (worker_memory - base_rss - _WORKING_BYTES) // _BLOCK_BYTES))


def boxes(file: Path, tile_size: float | None, most: int) -> list[BlockBox]:
    """Return the cubes that hold a map's blocks, as block coordinates: first, and last + 1.

    Args:
        file: the map.
        tile_size: metres, edge of a cube. None = the largest cubes with at most `most` blocks, halo included.

    Raises:
        InvalidConfig: for a `tile_size` below one block.
    """
    header, keys = checkpoint.keys_of(file)
    blocks = unpack_keys(keys).astype(np.int64)
    side = _side(blocks, most) if tile_size is None else round(tile_size / (8 * header.config.voxel_size))
    if side < 1:
        raise InvalidConfig(
            f"a tile must have an edge of {8 * header.config.voxel_size:g} m or more, got {tile_size:g} m"
        )
    cubes = distinct_blocks((blocks // side).astype(np.int32)) * side
    return [((x, y, z), (x + side, y + side, z + side)) for x, y, z in cubes.tolist()]


def _side(blocks: NDArray[np.int64], most: int) -> int:
    """Return the largest edge, in blocks, of cubes that hold at most `most` blocks with those around them."""
    side = _MOST_SIDE
    while side > _LEAST_SIDE:
        _, counts = np.unique(blocks // side, axis=0, return_counts=True)
        around = ((side + 2 * _HALO) / side) ** 2  # a surface goes on beyond the cube on four sides
        if counts.max() * min(around, len(blocks) / counts.max()) <= most:
            break
        side //= 2
    return side


def write_tileset(folder: Path, tiles: list[dict[str, Any]]) -> Path:
    """Write `tileset.json` for the files 00000.glb, 00001.glb, … of a folder.

    Args:
        tiles: `low` and `high` corners of each file's vertices, metres, in the file's axes.

    Raises:
        OSError: when the file cannot be written.
    """
    corners = np.array([(tile["low"], tile["high"]) for tile in tiles])  # (n, 2, 3)
    corners = np.stack([corners[..., 0], -corners[..., 2], corners[..., 1]], axis=-1)
    corners = np.stack([corners.min(axis=1), corners.max(axis=1)], axis=1)
    root = _node(np.arange(len(tiles)), corners)
    size = float(np.linalg.norm(corners[:, 1].max(axis=0) - corners[:, 0].min(axis=0)))
    tileset = {"asset": {"version": "1.1"}, "geometricError": size, "root": {**root, "refine": "ADD"}}
    path = folder / "tileset.json"
    with written(path) as file:
        file.write(json.dumps(tileset, indent=1).encode() + b"\n")
    return path


def _node(which: NDArray[np.int64], corners: NDArray[np.float64]) -> dict[str, Any]:
    """Return a node of the 3D Tiles tree for the files with numbers `which`: one file, or child nodes.

    Args:
        corners: (n, 2, 3) lowest and highest corner of each file's box.
    """
    low, high = corners[which, 0].min(axis=0), corners[which, 1].max(axis=0)
    node: dict[str, Any] = {"boundingVolume": {"box": _box(low, high)}}
    if len(which) == 1:
        return {**node, "geometricError": 0.0, "content": {"uri": f"{which[0]:05}.glb"}}
    centers = corners[which].mean(axis=1)
    octant = (centers > (centers.min(axis=0) + centers.max(axis=0)) / 2) @ (4, 2, 1)
    groups = [which[octant == number] for number in np.unique(octant)]
    if len(groups) == 1:  # all boxes have the same centre
        groups = np.array_split(which, min(8, len(which)))
    error = float(np.linalg.norm(high - low)) / 2
    return {**node, "geometricError": error, "children": [_node(group, corners) for group in groups]}


def _box(low: NDArray[np.float64], high: NDArray[np.float64]) -> list[float]:
    """Return a box as 3D Tiles has it: centre and three half axes, 12 numbers."""
    half = np.maximum((high - low) / 2, 1e-3)
    return [*((low + high) / 2).tolist(), *np.diag(half).ravel().tolist()]


def shares(blocks: int, workers: int) -> list[range]:
    """Divide the tiles of a map's mesh into runs, one for each worker; empty if one worker is as fast."""
    tiles = mesh_tiles.tile_count(blocks)
    count = min(workers, tiles // LEAST_TILES)
    if count < 2:
        return []
    borders = np.linspace(0, tiles, count + 1).round().astype(int).tolist()
    return [range(first, stop) for first, stop in pairwise(borders)]


def make_run(file: Path, which: range, view: dict[str, Any]) -> MeshRun:
    """Mesh some tiles of a saved map. Only the blocks in their range of x are loaded."""
    _, keys = checkpoint.keys_of(file, is_checked=True)
    x = unpack_keys(mesh_tiles.blocks_of_run(keys, which))[:, 0]
    low, high = (int(x.min()), -_FARTHEST, -_FARTHEST), (int(x.max()) + 1, _FARTHEST, _FARTHEST)
    return Volume.load_blocks(file, low, high, is_checked=True, **view).surface.mesh_run(keys, which)


def write_run(path: Path, made: MeshRun) -> None:
    """Write the mesh of a run of tiles to a file. Raise OutputError if that fails."""
    part, border = made.part, made.border
    arrays: dict[str, Any] = {
        "vertices": part.vertices, "faces": part.faces, "normals": part.normals, "colors": part.colors,
        "open_at": made.open_at, "open_keys": made.open_keys, "open_edges": made.open_edges,
        "border_keys": border.keys, "border_edges": border.edges, "border_first": border.first,
        "first": np.array(made.first),
    }  # fmt: skip
    with written(path) as file:
        np.savez(file, **{name: one for name, one in arrays.items() if one is not None})


def read_run(path: Path) -> MeshRun:
    """Read the mesh of a run of tiles from a file. Raise OutputError if that fails."""
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
