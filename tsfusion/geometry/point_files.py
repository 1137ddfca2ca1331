# SPDX-License-Identifier: MIT
"""Write points with normals and colours as PLY, PCD, LAS or LAZ files, and grids as OpenVDB files.

All are in the map's frame. PLY and PCD are binary and hold float32 unchanged. LAS and LAZ (laspy) hold
integers of `_LAS_STEP` metres, normals as extra dimensions, and facts about the points in a record of their
own. Their coordinates include the map's origin.

OpenVDB is format 224, as `io/File.cc`, `tree/RootNode.h`, `tree/InternalNode.h` and `io/Compression.h` write
it: a root, nodes of 32³ nodes of 16³ leaves; a leaf is a block of 8³ voxels. Voxels with the background value
are inactive and not stored, and nothing is compressed otherwise. Everything is little-endian. The grid's
class is `unknown`, not level set: a map's distances end behind each surface, where readers of level sets
would see a second surface.
"""

import os
import shutil
import struct
import tempfile
from collections.abc import Iterable
from itertools import groupby
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from tsfusion.core import durable_files
from tsfusion.core.errors import MissingDependency, OutputError, needing, refusals_as
from tsfusion.geometry.origin import Origin, System, system

FORMATS = (".ply", ".pcd", ".las", ".laz")
ONLY_POINTS = (".pcd", ".las", ".laz")  # formats that hold no triangles
_INSTALL = "to write LAS or LAZ: pip install 'laspy[lazrs]' (or '.[mesh]')"
_LAS_STEP = 1e-5  # metres; int32 then reaches 21 km
_LAS_FARTHEST = 2**31 * _LAS_STEP
_RECORD = 4711  # id of the record with facts
_MAGIC, _FORMAT, _LIBRARY = 0x56444220, 224, (12, 0)
_ACTIVE_VALUES_ONLY = 2  # COMPRESS_ACTIVE_MASK
_ALL_OTHERS_ARE_BACKGROUND = b"\0"  # NO_MASK_OR_INACTIVE_VALS
_GRID = "Tree_float_5_4_3"
_NO_UUID = b"00000000-0000-0000-0000-000000000000"  # the same map gives the same file
_LEAVES, _NODES = 16, 32  # leaves along a node's side; such nodes along a larger node's side
Parts = Iterable[tuple[NDArray[np.int32], NDArray[np.float32]]]


def save(
    path: str | os.PathLike[str],
    points: NDArray[np.float32],
    *,
    normals: NDArray[np.float32] | None = None,
    colors: NDArray[np.uint8] | None = None,
    facts: dict[str, str] | None = None,
    origin: Origin | None = None,
) -> Path:
    """Write points by the file's suffix; complete or not at all.

    Args:
        points: (n, 3) float32, metres.
        normals: (n, 3) float32.
        colors: (n, 3) uint8 RGB.
        facts: text that the file contains about the points, by name.
        origin: origin of the map; LAS and LAZ use the system, units and coordinates of the given poses.

    Raises:
        OutputError: for another suffix, no points, or a path that cannot be written.
        MissingDependency: for LAS and LAZ without laspy.
    """
    path, suffix = Path(path), Path(path).suffix.lower()
    if suffix not in FORMATS:
        raise OutputError(f"points are saved as {', '.join(FORMATS)}, got {path.name!r}")
    if not len(points):
        raise OutputError(f"nothing to write to {path}: there are no points (yet)")
    rows, facts = _rows(points, normals, colors), facts or {}
    with durable_files.written(path) as file:
        if suffix == ".ply":
            _write_ply(file, rows, facts)
        elif suffix == ".pcd":
            _write_pcd(file, rows, facts)
        else:
            _write_las(file, rows, facts, origin or Origin((0, 0, 0)), compressed=suffix == ".laz")
    return path


def _rows(
    points: NDArray[np.float32], normals: NDArray[np.float32] | None, colors: NDArray[np.uint8] | None
) -> NDArray[Any]:
    fields: list[Any] = [("point", "<f4", 3)]
    fields += [("normal", "<f4", 3)] * (normals is not None) + [("color", "u1", 3)] * (colors is not None)
    rows = np.empty(len(points), fields)
    for name, column in (("point", points), ("normal", normals), ("color", colors)):
        if column is not None:
            rows[name] = column
    return rows


def _write_ply(file: BinaryIO, rows: NDArray[Any], facts: dict[str, str]) -> None:
    names = {"point": "float x y z", "normal": "float nx ny nz", "color": "uchar red green blue"}
    kinds = [names[name].split() for name in rows.dtype.names or ()]
    lines = [
        "ply", "format binary_little_endian 1.0", *(f"comment {name} {fact}" for name, fact in facts.items()),
        f"element vertex {len(rows)}", *(f"property {kind} {name}" for kind, *each in kinds for name in each),
        "end_header",
    ]  # fmt: skip
    file.write("".join(f"{line}\n" for line in lines).encode())
    file.write(rows.data)


def _write_pcd(file: BinaryIO, rows: NDArray[Any], facts: dict[str, str]) -> None:
    """Write PCD 0.7 of the Point Cloud Library; a colour is packed into the bits of one float."""
    kinds: list[Any] = [("point", "<f4", 3)]
    names = ["x", "y", "z"]
    if "normal" in (rows.dtype.names or ()):
        kinds, names = [*kinds, ("normal", "<f4", 3)], [*names, "normal_x", "normal_y", "normal_z"]
    if has_color := "color" in (rows.dtype.names or ()):
        kinds, names = [*kinds, ("rgb", "<u4")], [*names, "rgb"]
    packed = np.empty(len(rows), kinds)
    for name in packed.dtype.names or ():
        if name != "rgb":
            packed[name] = rows[name]
    if has_color:
        packed["rgb"] = rows["color"].astype(np.uint32) @ np.array([1 << 16, 1 << 8, 1], np.uint32)
    lines = [
        "# .PCD v0.7 - Point Cloud Data file format", *(f"# {name} {fact}" for name, fact in facts.items()),
        "VERSION 0.7", f"FIELDS {' '.join(names)}", "SIZE" + " 4" * len(names), "TYPE" + " F" * len(names),
        "COUNT" + " 1" * len(names), f"WIDTH {len(rows)}", "HEIGHT 1", "VIEWPOINT 0 0 0 1 0 0 0",
        f"POINTS {len(rows)}", "DATA binary",
    ]  # fmt: skip
    file.write("".join(f"{line}\n" for line in lines).encode("ascii", "replace"))
    file.write(packed.data)


def _write_las(
    file: BinaryIO, rows: NDArray[Any], facts: dict[str, str], origin: Origin, *, compressed: bool
) -> None:
    with needing(_INSTALL):
        import laspy
    if compressed and not laspy.LazBackend.detect_available():
        raise MissingDependency(_INSTALL)
    recorded = system(origin.crs) if origin.crs else System()
    points = (rows["point"].astype(np.float64) + origin.position) / recorded.metres
    middle = np.round((points.min(axis=0) + points.max(axis=0)) / 2)
    if np.abs(points - middle).max() >= _LAS_FARTHEST:
        raise OutputError(
            f"LAS holds points within {_LAS_FARTHEST / 1000:.0f} km of their middle; use PLY or PCD"
        )
    names = rows.dtype.names or ()
    header = laspy.LasHeader(version="1.4", point_format=7 if "color" in names else 6)
    header.scales, header.offsets = np.full(3, _LAS_STEP), middle
    header.global_encoding.wkt = True  # as formats from 6 on must have it, also without a system
    header.generating_software = facts.get("generator", "")[:32]
    if recorded.projection is not None:
        header.add_crs(recorded.projection)
    text = "".join(f"{name} {fact}\n" for name, fact in facts.items())
    header.vlrs.append(laspy.VLR("tsfusion", _RECORD, "about these points", text.encode()[:65535]))
    if "normal" in names:
        header.add_extra_dims([laspy.ExtraBytesParams(f"normal_{axis}", np.float32) for axis in "xyz"])
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = points.T
    if "color" in names:
        cloud.red, cloud.green, cloud.blue = rows["color"].T.astype(np.uint16) * 257
    if "normal" in names:
        for axis, column in zip("xyz", rows["normal"].T, strict=True):
            cloud[f"normal_{axis}"] = column
    cloud.write(file, do_compress=compressed)


def order_of(blocks: NDArray[np.int32]) -> NDArray[np.int64]:
    """Return the indices that sort (n, 3) blocks into the order of an OpenVDB file's leaves."""
    node, root = blocks // _LEAVES, blocks // (_LEAVES * _NODES)
    columns = [*blocks.T[::-1], *node.T[::-1], *root.T[::-1]]
    found: NDArray[np.int64] = np.lexsort(columns)
    return found


def write(path: Path, parts: Parts, *, name: str, voxel_size: float, background: float) -> None:
    """Write an OpenVDB grid, complete or not at all; needs memory for one part and 80 bytes a block.

    Args:
        parts: blocks (n, 3) int32 in the order of `order_of`, and their values (n, 8, 8, 8) float32.
        name: name of the grid, such as `tsdf`.
        background: value of every voxel outside `parts`, metres.

    Raises:
        OutputError: there is no block, or the file cannot be written.
    """
    with refusals_as(OutputError, f"cannot write {path}"), tempfile.TemporaryFile(dir=path.parent) as buffers:
        kept = [(blocks, _write_leaves(buffers, values, background)) for blocks, values in parts]
        if not kept:
            raise OutputError(f"nothing to write to {path}: the map is empty")
        blocks = np.concatenate([one[0] for one in kept])
        masks = np.concatenate([one[1] for one in kept])
        grid = struct.pack("<I", _ACTIVE_VALUES_ONLY) + _metadata({"class": "unknown", "name": name})
        grid += _transform(voxel_size) + struct.pack("<if", 1, background) + _topology(blocks, masks)
        with durable_files.replacing(path) as file:
            _write_file(file, name, grid, buffers)


def _write_leaves(file: BinaryIO, values: NDArray[np.float32], background: float) -> NDArray[np.uint8]:
    """Write OpenVDB leaves' values (n, 8, 8, 8); return their bit masks (n, 64) of active voxels."""
    flat = np.ascontiguousarray(values.reshape(len(values), 512), "<f4")
    active = flat != np.float32(background)
    masks = np.packbits(active, axis=1, bitorder="little")
    header = np.concatenate([masks, np.zeros((len(flat), 1), np.uint8)], axis=1)  # and the kind of the others
    rows = np.concatenate([header, flat.view(np.uint8)], axis=1)
    keeps = np.concatenate([np.ones(header.shape, bool), np.repeat(active, 4, axis=1)], axis=1)
    file.write(rows[keeps].data)
    return masks


def _write_file(file: BinaryIO, name: str, grid: bytes, buffers: BinaryIO) -> None:
    """Write an OpenVDB file: `grid` holds all bytes before the leaves' values, `buffers` the values."""
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
    """Return OpenVDB's transform from index to metres: whole numbers are the centres of voxels."""
    rows = (voxel_size / 2, voxel_size, voxel_size, 1 / voxel_size, voxel_size**-2, 0.5 / voxel_size)
    numbers = np.repeat(np.array(rows, "<f8"), 3)
    return _text("UniformScaleTranslateMap") + numbers.tobytes()


def _topology(blocks: NDArray[np.int32], masks: NDArray[np.uint8]) -> bytes:
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
    """Return an OpenVDB node: a mask of its (n, 3) children, and an empty mask of its own active values."""
    has_child = np.zeros(side**3, bool)
    has_child[np.ravel_multi_index(tuple(children.T), (side,) * 3)] = True
    return (
        np.packbits(has_child, bitorder="little").tobytes() + bytes(side**3 // 8) + _ALL_OTHERS_ARE_BACKGROUND
    )
