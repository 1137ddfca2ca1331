# SPDX-License-Identifier: MIT
"""Points with normals and colours as PLY, PCD, LAS or LAZ files, in the map's frame.

PLY and PCD are binary and hold float32 as it is. LAS and LAZ (laspy) hold integers of `_LAS_STEP` metres,
normals as extra dimensions, and what is known about the points in a record of their own; the map's origin is
in their coordinates.
"""

import os
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from tsfusion.core import durable_files
from tsfusion.core.errors import MissingDependency, OutputError
from tsfusion.geometry.origin import Origin, System, system

FORMATS = (".ply", ".pcd", ".las", ".laz")
ONLY_POINTS = (".pcd", ".las", ".laz")  # formats that hold no triangles
_INSTALL = "to write LAS or LAZ: pip install 'laspy[lazrs]' (or '.[mesh]')"
_LAS_STEP = 1e-5  # metres; int32 then reaches 21 km
_LAS_FARTHEST = 2**31 * _LAS_STEP
_RECORD = 4711  # of our own user id


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
        facts: what the file says about them, by name.
        origin: of the map; LAS and LAZ have the system, units and coordinates that its poses came with.

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
    try:
        with durable_files.replacing(path) as file:
            if suffix == ".ply":
                _write_ply(file, rows, facts)
            elif suffix == ".pcd":
                _write_pcd(file, rows, facts)
            else:
                _write_las(file, rows, facts, origin or Origin((0, 0, 0)), compressed=suffix == ".laz")
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}") from error
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
    """PCD 0.7, as the Point Cloud Library describes it; colour as the bits of one float."""
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
    """LAS 1.4."""
    try:
        import laspy
    except ImportError as error:
        raise MissingDependency(_INSTALL) from error
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
