# SPDX-License-Identifier: MIT
"""Measure the distance of points to a known surface: a mesh, points, a synthetic world or a run's."""

import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import DatasetError, OutputError, TsfusionError
from tsfusion.datasets import Synthetic, open_dataset
from tsfusion.evaluation.mesh_distance import MeshDistance, tree_of
from tsfusion.geometry.mesh_encoding import TURNED_BY_NODE
from tsfusion.pipelines.report import run_record

Measure = Callable[[NDArray[np.float32]], NDArray[np.float32]]

MESHES = (".ply", ".glb", ".obj", ".stl")
_WORLD = "synthetic"
_AGREES = 1e-5  # metres between a world's distance and what a run wrote down, in float32
_REACH = 2.0  # voxels: a point farther from every vertex of a run's mesh has no error
_TRIED = 1000  # vertices


def error_measure(truth: str | os.PathLike[str]) -> Measure:
    """Return a function that takes (n, 3) points and returns (n,) unsigned distances to the truth, metres.

    Args:
        truth: a mesh in the map's frame (PLY, GLB, OBJ, STL), measured to the nearest triangle (exact nearby:
            `evaluation.mesh_distance`); a PLY of points alone, measured to the nearest point;
            `synthetic:NAME`, the surface of a synthetic world; or the folder of a run whose dataset knows its
            surface.

    Raises:
        DatasetError: when `truth` has no known surface, or cannot be read.
        MissingDependency: without scipy.
    """
    kind, _, name = str(truth).partition(":")
    if kind == _WORLD and name:
        return _of_world(name)
    path = Path(truth)
    if path.is_dir():
        return _of_run(path)
    if path.suffix.lower() not in MESHES:
        raise DatasetError(
            f"a truth is a mesh or points ({', '.join(MESHES)}), a run's folder or {_WORLD}:room, got {truth}"
        )
    vertices, faces = _read(path)
    if len(faces):
        measure = MeshDistance(vertices, faces)
        return lambda points: measure(points).astype(np.float32)
    tree = tree_of(vertices)
    return lambda points: tree.query(points)[0].astype(np.float32)


def _of_world(name: str) -> Measure:
    world = open_dataset(f"{_WORLD}:{name}", count=1)
    if not isinstance(world, Synthetic):
        raise DatasetError(f"{_WORLD}:{name} is too large to measure errors by; give a mesh of it")
    return lambda points: np.abs(world.distance(points.astype(np.float64))).astype(np.float32)


def _of_run(folder: Path) -> Measure:
    """Return the distance function of a run: to its synthetic world, if unchanged since, or to its mesh."""
    try:
        record = run_record.read(folder)
        errors = np.load(folder / "error.npy", allow_pickle=False)
        voxel_size = float(record.config.get("volume", record.config)["voxel_size"])
    except (OSError, ValueError, KeyError, TypeError, OutputError) as error:
        raise DatasetError(
            f"{folder} holds no error that was measured (error.npy of a run whose dataset knows its surface)"
        ) from error
    vertices, _ = _read(folder / "mesh.ply")
    if errors.shape != (len(vertices),):
        raise DatasetError(f"{folder}/error.npy is not of the mesh beside it: run it again")
    kind, _, name = record.source.partition(" ")
    if kind == _WORLD:
        with suppress(DatasetError):  # the world has changed, or its package is not installed
            measure, some = _of_world(name), slice(None, None, 1 + len(vertices) // _TRIED)
            if np.allclose(measure(vertices[some].astype(np.float32)), errors[some], rtol=0.0, atol=_AGREES):
                return measure
    tree = tree_of(vertices)

    def nearest(points: NDArray[np.float32]) -> NDArray[np.float32]:
        distance, index = tree.query(points)
        return np.where(distance <= _REACH * voxel_size, errors[index], np.nan).astype(np.float32)

    return nearest


def _read(path: Path) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return (n, 3) vertices and (m, 3) faces of a file; (0, 3) faces if it holds points alone."""
    import trimesh

    try:
        loaded: Any = trimesh.load(path, process=False)
        if isinstance(loaded, trimesh.Scene):
            loaded = _merged(path, loaded)
        vertices = np.asarray(loaded.vertices, np.float64).reshape(-1, 3)
        faces = np.asarray(getattr(loaded, "faces", np.zeros((0, 3))), np.int64).reshape(-1, 3)
    except TsfusionError:
        raise
    except Exception as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise DatasetError(f"cannot read {path}: {reason}") from error
    if not len(vertices) or not np.isfinite(vertices).all():
        raise DatasetError(f"{path} has no points" if not len(vertices) else f"{path} has points at infinity")
    return vertices, faces


def _merged(path: Path, scene: Any) -> Any:
    """Join the objects of a mesh file's scene. A GLB of tsfusion stays in the map's frame, not turned."""
    import trimesh

    notes = [str(one.metadata.get("up", "")) for one in scene.geometry.values()]
    if any(note.endswith("here +y") for note in notes):  # as written before nodes turned them
        raise DatasetError(
            f"{path} is turned so that up is +y, and is not in the map's frame: give the .ply instead"
        )
    if any(note.endswith(TURNED_BY_NODE) for note in notes):
        return trimesh.util.concatenate(list(scene.geometry.values()))
    return scene.to_mesh()
