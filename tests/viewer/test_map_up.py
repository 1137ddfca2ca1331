# SPDX-License-Identifier: MIT
"""Up in a page: by how sensors were held, whatever comes first, the surface or the sensor."""

import numpy as np
import pytest

from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.up_direction import SensorPosture
from tsfusion.viewer.map.map_tiles import MapTiles
from tsfusion.viewer.map.map_views import MapUp
from tsfusion.wire.asking.followed_map import PathsFound, ScannerSeen, SurfaceUpdate


def floor(axis: int, height: float) -> SurfaceUpdate:
    """A floor of 4 × 4 m that is seen from the side to which `axis` points."""
    n = 41
    steps = np.linspace(-2, 2, n, dtype=np.float32)
    a, b = (one.ravel() for one in np.meshgrid(steps, steps, indexing="ij"))
    vertices = np.insert(np.column_stack((a, b)), axis, height, axis=1).astype(np.float32)
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    quads = np.stack([corner, corner + 1, corner + n, corner + n, corner + 1, corner + n + 1], axis=1)
    faces = quads.reshape(-1, 3).astype(np.int32)
    normals = np.tile(np.eye(3, dtype=np.float32)[axis], (len(vertices), 1))
    mesh = Mesh(vertices, faces, normals)
    return SurfaceUpdate(
        np.zeros((1, 3), np.int32), np.array([0, len(faces)], np.int32), mesh, np.ones(1, bool)
    )


def upright(axis: int) -> np.ndarray:
    """The pose of a camera that is held upright where the map's axis points up."""
    T = np.eye(4)
    T[:3, 1] = -np.eye(3)[axis]  # a camera's y points down
    T[:3, 2] = np.eye(3)[(axis + 1) % 3]
    T[:3, 0] = np.cross(T[:3, 1], T[:3, 2])
    return T


def test_a_scanner_that_is_seen_after_its_surface_counts() -> None:
    tiles, up = MapTiles(), MapUp()
    tiles.apply([floor(0, -1.5)], 0.0)  # without a camera nobody takes x for up
    up.look(tiles)
    camera = Intrinsics(500.0, 500.0, 320.0, 240.0)
    up.note_scanner(ScannerSeen(b"one", 0, upright(0), camera, (480, 640)))
    up.look(tiles)
    assert up.direction @ (1, 0, 0) > 0.99


@pytest.mark.parametrize("axis", [1, 2])
def test_paths_say_which_way_is_up(axis: int) -> None:
    tiles = MapTiles()
    tiles.apply([floor(axis, -1.5)], 0.0)
    held = SensorPosture()
    for _ in range(3):
        held.add(upright(axis), "kinect")

    up = MapUp()
    up.look(tiles)
    up.note_paths(PathsFound({}, held))
    up.look(tiles)
    assert up.direction @ np.eye(3)[axis] > 0.99

    up.note_paths(PathsFound({}, SensorPosture()))  # nobody knows: what was known stays
    up.look(tiles)
    assert up.direction @ np.eye(3)[axis] > 0.99
