# SPDX-License-Identifier: MIT
"""OpenVDB files of one grid of floats, whose leaves are the map's blocks of 8³ voxels.

Format 224, as OpenVDB's `io/File.cc`, `tree/RootNode.h`, `tree/InternalNode.h` and `io/Compression.h` write
it: a root, nodes of 32³ nodes of 16³ leaves. Values that are the background are inactive and not stored, and
nothing is compressed otherwise. Everything is little-endian. The grid's class is `unknown`, no level set: a
map's distances end behind each surface, where readers of level sets see a second one.
"""

import shutil
import struct
import tempfile
from collections.abc import Iterable
from itertools import groupby
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from tsfusion.core import durable_files
from tsfusion.core.errors import OutputError

_MAGIC, _FORMAT, _LIBRARY = 0x56444220, 224, (12, 0)
_ACTIVE_VALUES_ONLY = 2  # COMPRESS_ACTIVE_MASK
_ALL_OTHERS_ARE_BACKGROUND = b"\0"  # NO_MASK_OR_INACTIVE_VALS
_GRID = "Tree_float_5_4_3"
_NO_UUID = b"00000000-0000-0000-0000-000000000000"  # the same map gives the same file
_LEAVES, _NODES = 16, 32  # a side of a node of leaves, and of a node of those

Parts = Iterable[tuple[NDArray[np.int32], NDArray[np.float32]]]


def order_of(blocks: NDArray[np.int32]) -> NDArray[np.int64]:
    """Indices that put (n, 3) blocks into the order of their leaves in a file."""
    node, root = blocks // _LEAVES, blocks // (_LEAVES * _NODES)
    columns = [*blocks.T[::-1], *node.T[::-1], *root.T[::-1]]
    found: NDArray[np.int64] = np.lexsort(columns)
    return found


def write(path: Path, parts: Parts, *, name: str, voxel_size: float, background: float) -> None:
    """Write a grid; complete or not at all, in memory for one part and 80 bytes a block.

    Args:
        parts: blocks (n, 3) int32 in the order of `order_of`, and their values (n, 8, 8, 8) float32.
        name: of the grid, such as `tsdf`.
        background: value of every voxel that is not in `parts`, metres.

    Raises:
        OutputError: when there is no block, or the file cannot be written.
    """
    try:
        with tempfile.TemporaryFile(dir=path.parent) as buffers:
            kept = [(blocks, _write_leaves(buffers, values, background)) for blocks, values in parts]
            if not kept:
                raise OutputError(f"nothing to write to {path}: the map is empty")
            blocks = np.concatenate([one[0] for one in kept])
            masks = np.concatenate([one[1] for one in kept])
            grid = struct.pack("<I", _ACTIVE_VALUES_ONLY) + _metadata({"class": "unknown", "name": name})
            grid += _transform(voxel_size) + struct.pack("<if", 1, background) + _topology(blocks, masks)
            with durable_files.replacing(path) as file:
                _write_file(file, name, grid, buffers)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}") from error


def _write_leaves(file: BinaryIO, values: NDArray[np.float32], background: float) -> NDArray[np.uint8]:
    """Write the values of leaves; returns their masks (n, 64) of active voxels."""
    flat = np.ascontiguousarray(values.reshape(len(values), 512), "<f4")
    active = flat != np.float32(background)
    masks = np.packbits(active, axis=1, bitorder="little")
    header = np.concatenate([masks, np.zeros((len(flat), 1), np.uint8)], axis=1)  # and the kind of the others
    rows = np.concatenate([header, flat.view(np.uint8)], axis=1)
    keeps = np.concatenate([np.ones(header.shape, bool), np.repeat(active, 4, axis=1)], axis=1)
    file.write(rows[keeps].data)
    return masks


def _write_file(file: BinaryIO, name: str, grid: bytes, buffers: BinaryIO) -> None:
    """Write a file of one grid, given all that stands before its leaves' values, and these."""
    file.write(struct.pack("<qIII?", _MAGIC, _FORMAT, *_LIBRARY, True) + _NO_UUID)
    file.write(_metadata({"creator": "tsfusion"}) + struct.pack("<I", 1))
    file.write(_text(name) + _text(_GRID) + _text(""))
    begin = file.tell() + 24  # three offsets: of the grid, of its leaves' values, and of its end
    values = begin + len(grid)
    file.write(struct.pack("<qqq", begin, values, values + buffers.tell()) + grid)
    buffers.seek(0)
    shutil.copyfileobj(buffers, file)


def _text(text: str) -> bytes:
    return struct.pack("<I", len(text.encode())) + text.encode()


def _metadata(entries: dict[str, str]) -> bytes:
    parts = [_text(key) + _text("string") + _text(value) for key, value in entries.items()]
    return struct.pack("<I", len(parts)) + b"".join(parts)


def _transform(voxel_size: float) -> bytes:
    """Index to metres: a voxel's whole numbers are its centre."""
    rows = (voxel_size / 2, voxel_size, voxel_size, 1 / voxel_size, voxel_size**-2, 0.5 / voxel_size)
    numbers = np.repeat(np.array(rows, "<f8"), 3)
    return _text("UniformScaleTranslateMap") + numbers.tobytes()


def _topology(blocks: NDArray[np.int32], masks: NDArray[np.uint8]) -> bytes:
    """Topology of the tree: the nodes and leaves that exist."""
    node, root = blocks // _LEAVES, blocks // (_LEAVES * _NODES)
    starts = [0, *(np.flatnonzero((np.diff(node, axis=0) != 0).any(axis=1)) + 1).tolist(), len(blocks)]
    roots = [
        (key, list(each)) for key, each in groupby(range(len(starts) - 1), lambda n: root[starts[n]].tolist())
    ]
    parts = [struct.pack("<II", 0, len(roots))]
    for key, nodes in roots:
        first = [starts[n] for n in nodes]
        parts.append(struct.pack("<iii", *(8 * _LEAVES * _NODES * k for k in key)))
        parts.append(_node(node[first] % _NODES, _NODES))
        for n in nodes:
            leaves = slice(starts[n], starts[n + 1])
            parts += [_node(blocks[leaves] % _LEAVES, _LEAVES), masks[leaves].tobytes()]
    return b"".join(parts)


def _node(children: NDArray[np.int32], side: int) -> bytes:
    """A node with these (n, 3) children: their mask, that of its own active values, and these: none."""
    has_child = np.zeros(side**3, bool)
    has_child[np.ravel_multi_index(tuple(children.T), (side,) * 3)] = True
    return (
        np.packbits(has_child, bitorder="little").tobytes() + bytes(side**3 // 8) + _ALL_OTHERS_ARE_BACKGROUND
    )
