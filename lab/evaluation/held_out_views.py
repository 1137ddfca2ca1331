# SPDX-License-Identifier: MIT
"""Test of a scan's mesh on frames that were not fused, at the poses of the same scan."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from lab.evaluation.view_prediction import compare_views
from tsfusion.core.config import SENSORS
from tsfusion.datasets.dataset import NOMINAL_NS, Dataset, frame_of
from tsfusion.datasets.trajectory_files import read_tum
from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.trajectory import rigid

_STEP = 3  # every third of the frames that can be compared


def compare_scans(dataset: Dataset, folders: Sequence[Path], *, voxel_size: float) -> list[dict[str, Any]]:
    """Result folders of `tsfusion scan` of one dataset, such as with poses of its own and with the true ones.

    The frames compared have a pose in every folder and were fused in none. Each mesh is in the world of its
    own trajectory: the figures show how well mesh and trajectory explain the depth together.

    Returns:
        `compare_views` of each folder.
    """
    given = dataset.timestamps_ns
    times = [(i + 1) * NOMINAL_NS if given is None else int(given[i]) for i in range(len(dataset))]
    stamps = {stamp: index for index, stamp in enumerate(times)}
    tracked = [_poses(_trajectory_of_mesh(folder)) for folder in folders]
    fused = set().union(*(_poses(folder / "keyframes.txt") for folder in folders))
    common = sorted(set(stamps).intersection(*tracked) - fused)[::_STEP]
    found = []
    for folder, poses in zip(folders, tracked, strict=True):
        keyframes = [frame_of(dataset, stamps[stamp]).keyframe(poses[stamp]) for stamp in common]
        found.append(
            compare_views(
                _mesh(folder / "mesh.ply"),
                keyframes,
                max_range=SENSORS[dataset.sensor].max_range,
                voxel_size=voxel_size,
            )
        )
    return found


def _trajectory_of_mesh(folder: Path) -> Path:
    """The trajectory that the mesh of a scan goes with: closed loops have moved the map, too."""
    corrected = folder / "trajectory-corrected.txt"
    return corrected if corrected.exists() else folder / "trajectory.txt"


def _poses(path: Path) -> dict[int, NDArray[np.float64]]:
    found = read_tum(path)
    return {
        int(stamp): rigid(q, t)
        for stamp, q, t in zip(found.timestamps_ns, found.quaternions, found.translations, strict=True)
    }


def _mesh(path: Path) -> Mesh:
    loaded = trimesh.load(path, process=False)
    return Mesh(
        vertices=np.asarray(loaded.vertices, np.float32),
        faces=np.asarray(loaded.faces, np.int32),
        normals=np.asarray(loaded.vertex_normals, np.float32),
        colors=None,
    )
