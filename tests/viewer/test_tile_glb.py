# SPDX-License-Identifier: MIT
"""Tiles as GLB: places to a fraction of a voxel, no cracks, and the colours that were asked for."""

from pathlib import Path

import numpy as np
import pytest
from drawn_scenes import decoded
from gltf_validation import problems

from tsfusion.viewer.map import tile_glb

VOXEL = 0.02


def encoded(vertices: np.ndarray, colors: np.ndarray, corner: np.ndarray, voxel_size: float = VOXEL) -> bytes:
    faces = np.arange(len(vertices) // 3 * 3, dtype=np.int32).reshape(-1, 3)
    return tile_glb.encode(vertices.astype(np.float32), faces, colors.astype(np.uint8), corner, voxel_size)


@pytest.mark.parametrize("count", [3, 999, 70_002])
def test_positions_and_faces_come_back(count: int) -> None:
    random = np.random.default_rng(count)
    vertices = random.uniform(-1, 1, (count, 3))
    model = decoded(encoded(vertices, random.integers(0, 256, (count, 3)), np.full(3, -1.0)))
    assert np.abs(model.vertices - vertices).max() <= VOXEL / tile_glb.SHARES / 2 + 1e-6
    assert np.array_equal(model.faces.ravel(), np.arange(count // 3 * 3))


def test_neighbours_meet_without_a_crack() -> None:
    """Vertices that two tiles share have one place in both, to the last bit."""
    edge = 64 * VOXEL
    shared = np.random.default_rng(0).uniform(edge - 0.3, edge, (300, 3))
    grey = np.full(shared.shape, 128)
    left = decoded(encoded(shared, grey, np.zeros(3))).vertices
    right = decoded(encoded(shared, grey, np.full(3, edge - 64 * VOXEL / 2))).vertices
    assert np.abs(left - right).max() < 1e-12


def test_khronos_finds_a_tile_too_bright_on_purpose_and_nothing_else(tmp_path: Path) -> None:
    vertices = np.random.default_rng(2).uniform(0, 1, (300, 3))
    (tmp_path / "tile.glb").write_bytes(encoded(vertices, np.full((300, 3), 200), np.zeros(3)))
    found = {(one["code"], one["pointer"].rpartition("/")[0]) for one in problems(tmp_path / "tile.glb")}
    assert found <= {("VALUE_NOT_IN_RANGE", "/materials/0/pbrMetallicRoughness/baseColorFactor")}


def test_a_tile_with_strays_gets_a_coarser_grid() -> None:
    vertices = np.array([[0.0, 0, 0], [40.0, 0, 0], [0, 7.123, 0]])
    model = decoded(encoded(vertices, np.zeros((3, 3)), np.zeros(3)))
    assert np.abs(model.vertices - vertices).max() < VOXEL / 8


def test_the_screen_shows_the_colours_asked_for() -> None:
    """Of walls, wood, skin, grass, shadows; and greys up to nearly white."""
    random = np.random.default_rng(1)
    grey = random.integers(0, 245, (2000, 1))
    colors = np.clip(grey + random.integers(-30, 31, (2000, 3)), 0, 245)
    model = decoded(encoded(np.zeros((2000, 3)), colors, np.zeros(3)))
    error = np.abs(model.colors - colors).max(axis=1)
    assert np.percentile(error, 98) < 1.0
    assert error.max() < 30  # deep shadows of a pure hue


def test_white_stays_nearly_white_and_black_black() -> None:
    model = decoded(encoded(np.zeros((3, 3)), np.array([[255] * 3, [0] * 3, [128] * 3]), np.zeros(3)))
    assert model.colors[0].min() > 248
    assert model.colors[1].max() < 1
    assert np.abs(model.colors[2] - 128).max() < 0.5
