# SPDX-License-Identifier: MIT
"""Tiles of a map have the triangles of the whole, and an index by which viewers find them."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from keyframes_and_servers import pose, wall

from tsfusion import Volume, VolumeConfig
from tsfusion.cluster import tiling
from tsfusion.core.errors import InvalidConfig
from tsfusion.geometry.mesh_parts import joined
from tsfusion.tsdf.surface import field_regularizer, mesh_tiles

CONFIG = VolumeConfig(voxel_size=0.02, threads=1)


@pytest.fixture(scope="module")
def volume() -> Volume:
    made = Volume(CONFIG)
    for i in range(6):
        made.integrate(wall(i, T_world_camera=pose(0.3 * i, 0.1 * i)))
    return made


def corners(mesh: Any) -> np.ndarray:
    """(m, 27) of each triangle: positions, normals and colours of its corners, sorted."""
    columns = np.concatenate([mesh.vertices, mesh.normals, mesh.colors.astype(np.float32)], axis=1)
    rows = columns[mesh.faces].reshape(len(mesh.faces), 27)
    return rows[np.lexsort(rows.T)]


@pytest.mark.parametrize("surface", ["raw", "field", "normal"])
def test_tiles_are_the_whole_mesh(volume: Volume, tmp_path: Path, surface: Any) -> None:
    """Bit for bit raw; a part's field is that of the same blocks in the whole map, bit for bit."""
    file = volume.save(tmp_path / "map.tsf")
    boxes = tiling.boxes(file, 0.48, tiling.USUAL_BLOCKS)
    assert len(boxes) > 6
    tiles, cells = [], 0
    for low, high in boxes:
        part = Volume.load_blocks(file, low, high, surface=surface)
        blocks = part.blocks_within(low, high)
        assert part.stats().blocks < volume.stats().blocks
        cells += len(blocks)
        tiles.append(part.extract_mesh(blocks=blocks))
        of_whole = volume.extract_mesh(blocks=blocks, surface=surface)
        np.testing.assert_array_equal(corners(tiles[-1]), corners(of_whole))
    assert cells == volume.stats().blocks
    whole = volume.extract_mesh(surface=surface)
    assert sum(len(tile.faces) for tile in tiles) == pytest.approx(len(whole.faces), rel=1e-3)
    if surface == "raw":
        together = np.concatenate([corners(tile) for tile in tiles])
        np.testing.assert_array_equal(together[np.lexsort(together.T)], corners(whole))
    else:  # the field of some blocks is that of the whole map but for its halo (docs/method.md)
        from scipy.spatial import cKDTree

        apart, _ = cKDTree(whole.vertices).query(np.concatenate([tile.vertices for tile in tiles]))
        assert apart.max() < 0.01 * CONFIG.voxel_size


@pytest.mark.parametrize("surface", ["raw", "field", "normal"])
def test_runs_of_a_mesh_are_the_whole_one_bit_for_bit(
    volume: Volume, tmp_path: Path, surface: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(field_regularizer, "BATCH", 64)  # blocks a tile
    assert tiling.shares(5 * 64, 8) == []
    assert tiling.shares(6 * 64, 8) == [range(3), range(3, 6)]
    monkeypatch.setattr(tiling, "LEAST_TILES", 1)
    file = volume.save(tmp_path / "map.tsf")
    whole = volume.extract_mesh(surface=surface)
    blocks = volume.stats().blocks
    assert tiling.shares(64, 8) == []
    for workers in (2, 5, 1000):
        shares = tiling.shares(blocks, workers)
        assert [one for share in shares for one in share] == list(range(-(-blocks // 64)))
        files = [tmp_path / f"{workers}-{number}.npz" for number in range(len(shares))]
        for path, share in zip(files, shares, strict=True):
            tiling.write_run(path, tiling.make_run(file, share, {"surface": surface}))
        runs = [tiling.read_run(path) for path in files]
        assert sum(len(one.open_at) for one in runs) > 0
        made = joined(list(mesh_tiles.together(reversed(runs))))
        for name in ("vertices", "faces", "normals", "colors"):
            np.testing.assert_array_equal(getattr(made, name), getattr(whole, name))


def test_tiles_are_as_large_as_a_worker_can_hold(volume: Volume, tmp_path: Path) -> None:
    file = volume.save(tmp_path / "map.tsf")
    assert len(tiling.boxes(file, None, 1 << 20)) <= 8  # the cubes around the origin
    few = tiling.boxes(file, None, 100)
    assert len(few) > 8
    for low, high in few:
        assert len(volume.blocks_within(low, high)) <= 100
    assert tiling.most_blocks(None, 0) == tiling.USUAL_BLOCKS
    assert 1 < tiling.most_blocks(700 << 20, 350 << 20) < tiling.USUAL_BLOCKS
    assert tiling.most_blocks(1 << 20, 350 << 20) == 1
    with pytest.raises(InvalidConfig, match=r"an edge of 0\.16 m or more, got 0\.01 m"):
        tiling.boxes(file, 0.01, 100)


def test_the_index_holds_each_tile_once(tmp_path: Path) -> None:
    random = np.random.default_rng(3)
    low = random.uniform(-50, 50, (40, 3))
    tiles = [{"low": one.tolist(), "high": (one + 2).tolist()} for one in low]
    tiles += [tiles[0]] * 12  # at one place
    tileset = json.loads(tiling.write_tileset(tmp_path, tiles).read_text())
    assert tileset["asset"]["version"] == "1.1"
    found: list[str] = []

    def visit(node: dict[str, Any], outer: tuple[np.ndarray, np.ndarray] | None, error: float) -> None:
        box = np.array(node["boundingVolume"]["box"])
        center, half = box[:3], np.abs(box[3:].reshape(3, 3)).sum(axis=0)
        if outer is not None:
            assert (center - half >= outer[0] - 1e-9).all()
            assert (center + half <= outer[1] + 1e-9).all()
        assert node["geometricError"] <= error
        if "content" in node:
            found.append(node["content"]["uri"])
            x, y, z = tiles[int(found[-1][:5])]["low"]
            np.testing.assert_allclose(center - half, (x, -z - 2, y), atol=1e-9)
        for child in node.get("children", ()):
            visit(child, (center - half, center + half), node["geometricError"])

    visit(tileset["root"], None, tileset["geometricError"])
    assert sorted(found) == [f"{number:05}.glb" for number in range(len(tiles))]


def test_a_tile_as_viewers_turn_it_fills_its_box(volume: Volume, tmp_path: Path) -> None:
    from tsfusion.cluster.job_runner import _tile_figures

    mesh = volume.extract_mesh()
    mesh.save(tmp_path / "00000.glb")
    tileset = json.loads(tiling.write_tileset(tmp_path, [_tile_figures(mesh)]).read_text())
    box = np.array(tileset["root"]["boundingVolume"]["box"])
    bounds = trimesh.load(tmp_path / "00000.glb").bounds  # glTF's axes
    turned = np.stack([bounds[:, 0], -bounds[::-1, 2], bounds[:, 1]], axis=1)
    np.testing.assert_allclose(turned.mean(axis=0), box[:3], atol=1e-4)
    np.testing.assert_allclose((turned[1] - turned[0]) / 2, np.diag(box[3:].reshape(3, 3)), atol=1e-4)
