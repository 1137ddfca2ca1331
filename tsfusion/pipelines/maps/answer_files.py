# SPDX-License-Identifier: MIT
"""Read query points from files, and write a map's answers to files."""

import csv
import io
import re
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.core import durable_files
from tsfusion.core.errors import DatasetError
from tsfusion.geometry.map_answers import Samples, View

POINTS = (".csv", ".txt", ".xyz", ".npy", ".ply")
SAMPLES = (".csv", ".npy", ".npz")
VIEWS = (".png", ".npz")
COLUMNS = ("x", "y", "z", "distance", "weight", "gradient_x", "gradient_y", "gradient_z")


def read(source: str) -> NDArray[np.float64]:
    """Return the (n, 3) float64 points of a file: columns of numbers, an array, or the vertices of a PLY.

    Args:
        source: path of a file, or `-` to read columns of numbers from the standard input.

    Raises:
        DatasetError: when the file cannot be read, has no points, or has a point that is not finite.
    """
    name = "standard input" if source == "-" else source
    try:
        points = _parsed(source, name)
    except OSError as error:
        raise DatasetError(f"cannot read {name}: {error.strerror}") from error
    except (ValueError, KeyError, IndexError, EOFError) as error:
        raise DatasetError(f"{name} has no points: {' '.join(str(error).split())}") from error
    if points.ndim != 2 or points.shape[1] != 3 or not len(points) or points.dtype.kind not in "fiu":
        raise DatasetError(f"{name} must hold points (n, 3), got {points.dtype} of shape {points.shape}")
    bad = np.flatnonzero(~np.isfinite(points).all(axis=1))
    if len(bad):
        raise DatasetError(f"{name}: point {bad[0] + 1} is not finite: {points[bad[0]].tolist()}")
    return points.astype(np.float64)


def _parsed(source: str, name: str) -> NDArray[Any]:
    suffix = Path(source).suffix.lower()
    if source == "-":
        return _columns(sys.stdin.read(), name)
    if suffix == ".npy":
        return np.asarray(np.load(source, allow_pickle=False))
    if suffix == ".ply":
        import trimesh

        with open(source, "rb") as file:
            found = trimesh.load(file, file_type="ply", process=False)  # which would merge vertices
            return np.asarray(getattr(found, "vertices", np.zeros((0, 3))))
    if suffix not in POINTS:
        raise DatasetError(f"{source} must end in {', '.join(POINTS)}")
    return _columns(Path(source).read_text(encoding="utf-8-sig"), source)


def _columns(text: str, source: str) -> NDArray[np.float64]:
    """Return (n, 3) numbers of a text whose columns are separated by commas, semicolons or spaces.

    A first line without a number is a title. If it names x, y and z, they are read, else the first three.
    """
    rows: list[list[float]] = []
    places: list[int] | None = None
    for number, line in enumerate(text.splitlines(), 1):
        content = line.partition("#")[0].strip().rstrip(",;")
        if not content.strip(",; \t"):
            continue
        words = re.split(r"\s*;\s*" if ";" in content else r"\s*,\s*|\s+", content)
        if places is None:
            named = [word.strip("\"'").lower() for word in words]
            places = [named.index(axis) for axis in "xyz"] if {*"xyz"} <= {*named} else [0, 1, 2]
            if not any(map(_is_number, words)):
                continue
        try:
            rows.append([float(words[place]) for place in places])
        except (ValueError, IndexError) as error:
            raise DatasetError(f"{source}:{number}: expected x, y, z, got {line.strip()!r}") from error
    return np.array(rows, np.float64).reshape(-1, 3)


def _is_number(word: str) -> bool:
    return word.lstrip("+-.")[:1].isdigit()


def csv_text(points: NDArray[np.float64], found: Samples) -> str:
    """Return a CSV table with a title line. Numbers are as short as they read back equal; unseen is `nan`."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    columns = (*points.T, found.distance, found.weight, *found.gradient.T)
    writer.writerows(zip(*columns, strict=True))
    return text.getvalue()


def write_samples(path: Path, points: NDArray[np.float64], found: Samples) -> None:
    """Write a table (.csv), only the distances (.npy), or all arrays by name (.npz). No partial file is left.

    Raises:
        OutputError: when it cannot be written.
    """
    suffix = path.suffix.lower()
    with durable_files.written(path) as file:
        if suffix == ".csv":
            file.write(csv_text(points, found).encode())
        elif suffix == ".npy":
            np.save(file, found.distance)
        else:
            np.savez_compressed(file, points=points, **vars(found))


def write_view(path: Path, found: View) -> None:
    """Write a picture (.png), or the arrays by name (.npz). No partial file is left.

    Raises:
        OutputError: when it cannot be written.
    """
    if path.suffix.lower() == ".png":
        content = cv2.imencode(".png", cv2.cvtColor(picture(found), cv2.COLOR_RGB2BGR))[1].tobytes()
        with durable_files.written(path) as file:
            file.write(content)
        return
    arrays = {name: array for name, array in vars(found).items() if array is not None}
    with durable_files.written(path) as file:
        np.savez_compressed(file, **arrays)


def picture(view: View) -> NDArray[np.uint8]:
    """Return the (H, W, 3) RGB picture of a view. A pixel that hit nothing is white.

    Without colours the shape is shaded in grey. A view of depth alone is one grey.
    """
    hit = (view.depth > 0)[..., np.newaxis]
    if view.colors is not None:
        shown = view.colors
    else:
        normals = np.zeros((*view.depth.shape, 3)) if view.normals is None else view.normals
        light = np.abs(normals @ np.array([0.4, -0.5, 0.77]))  # along no axis: no wall is black
        shown = np.repeat((60 + 190 * light.clip(0, 1)).astype(np.uint8)[..., np.newaxis], 3, axis=2)
    return np.where(hit, shown, np.uint8(255))
