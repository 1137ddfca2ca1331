# SPDX-License-Identifier: MIT
"""A map's blocks and surface as arrays: of NumPy, and of Open3D."""

import sys

import numpy as np
import pytest

from tsfusion import MissingDependency, Volume
from tsfusion.tsdf.store.block_store import unpack_keys

VOXEL = 0.02


def plane(volume: Volume, z: float, half: float = 0.3) -> Volume:
    """Add a wall at z, half red, that was seen from below."""
    u, v = (x.ravel() for x in np.mgrid[-half:half:0.01, -half:half:0.01])
    points = np.stack([u, v, np.full_like(u, z)], 1).astype(np.float32)
    color = np.where(u[:, None] > 0, np.uint8([20, 40, 200]), np.uint8(100)).astype(np.uint8)
    origins = points - np.float32((0, 0, 0.5))
    volume.integrate(points=points, origins=origins, color=color, T_world_camera=np.eye(4))
    return volume


@pytest.fixture(scope="module")
def volume() -> Volume:
    return plane(Volume(VOXEL, sensor="scanner", threads=2), 0.1)


def test_blocks_show_what_is_stored(volume: Volume) -> None:
    blocks, store = volume.blocks(), volume._store
    assert len(blocks) == store.count > 0
    assert np.array_equal(blocks.coordinates, unpack_keys(store.keys))
    for name in ("sums", "color_rgn", "color_b"):
        shown, layer = getattr(blocks, name), getattr(store, name)
        assert shown.shape == (store.count, 8, 8, 8)
        assert shown.ctypes.data == layer.ctypes.data
        assert np.array_equal(shown.reshape(len(shown), -1), layer[: store.count])
        with pytest.raises(ValueError, match="read-only"):
            shown[:] = 0
    assert blocks.correction is None


def test_decoded_blocks_say_how_far_the_wall_is(volume: Volume) -> None:
    blocks = volume.blocks()
    distance, weight, color = blocks.distance(), blocks.weight(), blocks.color()
    seen = np.isfinite(distance)
    assert np.array_equal(seen, weight > 0)
    voxels = 8 * blocks.coordinates[:, None, None, None] + np.stack(np.mgrid[:8, :8, :8], axis=-1)
    centres = (voxels + 0.5) * VOXEL
    assert distance[seen] == pytest.approx(0.1 - centres[seen][:, 2], abs=2e-3)
    assert color is not None
    right = (color != 0).any(axis=-1) & (centres[..., 0] > VOXEL)
    assert (color[right] == [200, 40, 20]).all()
    assert right.any()


def test_blocks_stay_while_the_map_grows() -> None:
    grown = plane(Volume(VOXEL, sensor="scanner", threads=2), 0.1)
    blocks = grown.blocks()
    sums, keys = blocks.sums.copy(), grown._store.keys.copy()
    far = np.arange(3_000, dtype=np.float32)[:, None] * np.float32((0.3, 0, 0)) + np.float32((5, 0, 0))
    grown.integrate(points=far, origins=far - np.float32((0, 0, 1)), T_world_camera=np.eye(4))
    assert grown._store.count > 3 * len(blocks)
    del grown
    assert np.array_equal(blocks.sums, sums)
    assert np.array_equal(blocks.coordinates, unpack_keys(keys))
    assert np.isfinite(blocks.distance()).any()


def test_an_empty_map_has_no_blocks_and_no_points() -> None:
    empty = Volume(VOXEL, threads=2, color=False)
    blocks, cloud = empty.blocks(), empty.point_cloud()
    assert len(blocks) == len(blocks.coordinates) == len(blocks.distance()) == len(cloud.points) == 0
    assert blocks.color() is None
    assert cloud.colors is None


def test_a_point_cloud_lies_on_the_surface(volume: Volume) -> None:
    cloud = volume.point_cloud()
    assert len(cloud.points) == len(cloud.normals) == len(cloud.weights) > 500
    assert cloud.points[:, 2] == pytest.approx(0.1, abs=1e-3)
    assert cloud.normals @ (0, 0, -1) == pytest.approx(1, abs=1e-3)
    assert (cloud.weights >= volume.model.min_weight).all()
    assert cloud.weights.max() <= volume.blocks().weight().max()
    assert cloud.colors is not None
    assert (cloud.colors[cloud.points[:, 0] > 0.05] == [200, 40, 20]).all()


def test_without_open3d_the_error_names_it(volume: Volume, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    for one in (volume, volume.point_cloud(), volume.extract_mesh()):
        with pytest.raises(MissingDependency, match="pip install open3d"):
            one.to_open3d()


def test_open3d_meshes_the_same_surface(volume: Volume) -> None:
    pytest.importorskip("open3d")
    mesh = volume.extract_mesh(surface="raw")
    theirs = volume.to_open3d().extract_triangle_mesh(weight_threshold=volume.model.min_weight)
    positions = np.sort(theirs.vertex.positions.numpy() + VOXEL / 2, axis=0)
    assert np.allclose(positions, np.sort(mesh.vertices, axis=0), atol=1e-5)
    cloud = volume.point_cloud().to_open3d()
    assert np.array_equal(cloud.point.positions.numpy(), volume.point_cloud().points)
    assert cloud.point.colors.numpy().max() == pytest.approx(200 / 255)
    assert len(Volume(VOXEL, threads=2).to_open3d().hashmap().key_tensor()) >= 0
