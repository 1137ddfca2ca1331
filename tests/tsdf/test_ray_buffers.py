# SPDX-License-Identifier: MIT
"""Rays of images and of points, against their NumPy twins."""

import kernel_twins
import numpy as np
import pytest
from formula_scenes import plane_keyframe
from numpy.typing import NDArray
from ray_maps import QUANTA, RayMap, rays_of

from tsfusion import Intrinsics, Keyframe
from tsfusion.core.config import SENSORS, VolumeConfig
from tsfusion.kernels.base import runtime
from tsfusion.tsdf.integration.ray_buffers import STRIPS, RayBuffers, model_parameters


@pytest.fixture(scope="module", autouse=True)
def taichi() -> None:
    runtime.start(2)


def image_keyframe(seed: int, kind: str) -> Keyframe:
    """A slanted plane with a step, noise, holes and lone pixels; some tiles are flat."""
    random = np.random.default_rng(seed)
    pose = np.eye(4)
    pose[:3, :3] = np.linalg.qr(random.normal(size=(3, 3)))[0]
    pose[:3, :3] *= np.linalg.det(pose[:3, :3])
    pose[:3, 3] = random.uniform(-2, 2, 3)
    camera = Intrinsics(60.0, -58.0, 19.5, 14.5)
    v, u = np.mgrid[:30, :41]
    metres = 1.0 + 0.02 * u + 0.01 * v + 0.5 * (v > 20) + 0.01 * random.normal(size=(30, 41))
    metres[random.random((30, 41)) < 0.1] = 0.0
    alone = (random.random((30, 41)) < 0.1) & (v > 12)
    metres[alone] = random.uniform(0.5, 4.0, alone.sum())
    if kind == "disparity":
        image = np.where(metres > 0, 30.0 / np.maximum(metres, 0.01) * 16, 0).clip(0, 65535).astype(np.uint16)
        return Keyframe(disparity=image, baseline_fx=30.0, intrinsics=camera, T_world_camera=pose)
    if kind == "float":
        depth = metres.astype(np.float32)
        depth[0, :5] = (np.nan, np.inf, -1.0, 0.0, 2.0)
        return Keyframe(depth=depth, intrinsics=camera, T_world_camera=pose)
    return Keyframe(depth=(metres * 1000).astype(np.uint16), intrinsics=camera, T_world_camera=pose)


def depth_of(keyframe: Keyframe, parameters: NDArray[np.float64]) -> NDArray[np.float64]:
    """(H, W) metres, 0 where there is no usable return."""
    raw = np.nan_to_num(keyframe.measurement.astype(np.float64), nan=0.0, posinf=0.0)
    if keyframe.kind == "disparity":
        z = keyframe.baseline_fx * 16 / np.maximum(raw, 1e-9)
    else:
        z = raw * (keyframe.depth_scale if keyframe.measurement.dtype == np.uint16 else 1.0)
    return np.where((raw > 0) & (z >= parameters[7]) & (z <= parameters[8]), z, 0.0)


def expected_rays(
    keyframe: Keyframe, parameters: NDArray[np.float64], voxel_size: float, bundled: bool, filtered: bool
) -> tuple[list[NDArray[np.int32]], int]:
    """Rays by tile, cell and layer, and how many samples went into them."""
    K, T = keyframe.intrinsics, keyframe.T_world_camera
    metres = depth_of(keyframe, parameters)
    pitch = max(1 / abs(K.fx), 1 / abs(K.fy)) / voxel_size
    rays, used = [], 0

    def tolerance(z: float) -> float:
        return voxel_size + 4 * (parameters[0] + parameters[1] * (z - parameters[2]) ** 2)

    for top, left in np.ndindex(-(-metres.shape[0] // 12), -(-metres.shape[1] // 12)):
        tile = metres[12 * top : 12 * top + 12, 12 * left : 12 * left + 12]
        if not tile.any():
            continue
        wide, high = kernel_twins.cell_shape(tile, pitch) if bundled else (1, 1)
        sigma = (tolerance(float(tile[tile > 0].mean())) - voxel_size) / 4
        plane = kernel_twins.tile_plane(tile, sigma, voxel_size) if bundled else None
        for y, x in np.ndindex(-(-tile.shape[0] // high), -(-tile.shape[1] // wide)):
            cell = tile[y * high : (y + 1) * high, x * wide : (x + 1) * wide]
            for layer in kernel_twins.layers(cell, tolerance):
                v, u = np.argwhere(layer).mean(axis=0) + (y * high, x * wide)
                z = cell[layer].mean()
                if filtered and layer.sum() == 1:
                    v0, u0 = int(v) + 12 * top, int(u) + 12 * left
                    around = metres[max(v0 - 1, 0) : v0 + 2, max(u0 - 1, 0) : u0 + 2]
                    if ((around > 0) & (np.abs(around - z) <= tolerance(z))).sum() < 2:
                        continue
                v, u = v + 12 * top, u + 12 * left
                ray = T[:3, :3] @ ((u - K.cx) / K.fx, (v - K.cy) / K.fy, 1)
                normal = None
                if plane is not None:
                    right, down = T[:3, 0] / K.fx * z + ray * plane[0], T[:3, 1] / K.fy * z + ray * plane[1]
                    normal = np.cross(right, down)
                weight, half, support = kernel_twins.sample(parameters, z, 255 * layer.sum())
                end = kernel_twins.fixed((ray * z + T[:3, 3]) / voxel_size)
                rays.append(kernel_twins.make_ray(end, ray, half, weight, normal=normal, support=support))
                used += int(layer.sum())
    return rays, used


def close(found: NDArray[np.int32], expected: list[NDArray[np.int32]]) -> None:
    """Compare rays in order, up to the last bits of rounded floats."""
    wanted = np.array(expected, np.int64)
    assert found.shape == wanted.shape
    ends = [ray_ends(rays.astype(np.float64)) for rays in (found, wanted)]
    assert np.abs(ends[0] - ends[1]).max() <= 0.01  # voxels
    assert (np.abs(found[:, 9:12] - wanted[:, 9:12]) <= 64 + abs(wanted[:, 9:12]) / 64).all()
    assert (found[:, 14] & 7 == wanted[:, 14] & 7).all()
    assert np.abs(found[:, 14] - wanted[:, 14]).max() <= 512
    assert np.abs((found[:, 15] >> 24 & 255) - (wanted[:, 15] >> 24 & 255)).max() <= 1


def ray_ends(rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n,) the distance of the coordinate origin to each ray's plane, voxels: free of the first voxel."""
    downward = rays[:, 14].astype(int)[:, None] >> np.arange(3) & 1
    gradient = rays[:, 9:12] * (1 - 2 * downward)
    return (((rays[:, :3] + 0.5) * gradient).sum(axis=1) + rays[:, 12]) / 65536


@pytest.mark.parametrize("bundled", [True, False])
@pytest.mark.parametrize("kind", ["uint16", "float", "disparity"])
def test_rays_from_images_equal_the_twin(kind: str, bundled: bool) -> None:
    keyframe, voxel_size = image_keyframe(11, kind), 0.05
    parameters = model_parameters(SENSORS["stereo"], voxel_size, keyframe.baseline_fx)
    buffers = RayBuffers(color=False, regularised=False)
    config = VolumeConfig(sensor="stereo", voxel_size=voxel_size, bundle=bundled)
    buffers.make_rays(keyframe, config)
    expected, used = expected_rays(keyframe, parameters, voxel_size, bundled, filtered=True)
    assert 0 < used < np.count_nonzero(depth_of(keyframe, parameters))  # some lone pixels are dropped
    assert buffers.samples == used
    close(rays_of(buffers), expected)


def test_the_colour_of_a_ray_is_the_mean_of_its_samples() -> None:
    random = np.random.default_rng(17)
    shape, voxel_size = (30, 41), 0.05  # tiles that the image cuts, and cells with holes
    depth = np.where(random.random(shape) < 0.02, 0, 1000).astype(np.uint16)
    color = random.integers(0, 256, (*shape, 3), np.uint8)
    camera = Intrinsics(60.0, 60.0, 19.5, 14.5)
    keyframe = Keyframe(depth=depth, intrinsics=camera, T_world_camera=np.eye(4), color=color)
    buffers = RayBuffers(color=True, regularised=False)
    buffers.make_rays(keyframe, VolumeConfig(voxel_size=voxel_size, outlier_filter=False))
    expected = []
    for top, left in np.ndindex(3, 4):
        tile = depth[12 * top : 12 * top + 12, 12 * left : 12 * left + 12] / 1000
        colors = color[12 * top : 12 * top + 12, 12 * left : 12 * left + 12].astype(int)
        wide, high = kernel_twins.cell_shape(tile, 1 / 60 / voxel_size)
        for y, x in np.ndindex(-(-tile.shape[0] // high), -(-tile.shape[1] // wide)):
            cell = np.s_[y * high : (y + 1) * high, x * wide : (x + 1) * wide]
            if tile[cell].any():
                blue, green, red = colors[cell][tile[cell] > 0].sum(axis=0) // np.count_nonzero(tile[cell])
                expected.append(red << 16 | green << 8 | blue)
    found = rays_of(buffers)[:, 15] & 0xFFFFFF
    assert wide * high > 1
    assert (depth == 0).any()
    assert found.tolist() == expected


def test_a_plane_is_met_exactly_by_every_voxel_beside_a_ray() -> None:
    normal, offset = np.array([0.6, -0.48, 0.64]), 1.5
    keyframe = plane_keyframe(np.eye(4), normal, offset)
    voxel_size = 0.05
    here = RayMap()
    here.buffers.make_rays(keyframe, VolumeConfig(voxel_size=voxel_size))
    here.apply(rays_of(here.buffers))
    errors, across = [], []
    for voxel, at in here.voxels().items():
        centre = (np.array(voxel) + 0.5) * voxel_size
        ray = centre / np.linalg.norm(centre)
        truth = (offset - centre @ normal) / (ray @ normal) / voxel_size
        errors.append(here.value(at) / QUANTA - truth)
        across.append(abs(offset - centre @ normal) / voxel_size)
    near = np.array(across) < 1
    assert near.sum() > 1000
    # rays of neighbouring directions meet in a voxel, so not every value is exact, but none is biased
    assert np.abs(np.array(errors)[near]).mean() < 0.05
    assert abs(np.array(errors)[near].mean()) < 0.01


@pytest.mark.parametrize("bundled", [True, False])
@pytest.mark.parametrize("own_origins", [True, False])
def test_rays_from_points_equal_the_twin(own_origins: bool, bundled: bool) -> None:
    random = np.random.default_rng(13)
    points = random.uniform(-3, 3, 3) + np.cumsum(random.normal(0, 0.1, (700, 3)), axis=0)
    points = points.astype(np.float32)
    points[5] = np.nan
    origins = random.uniform(-0.2, 0.2, (700, 3)).astype(np.float32) if own_origins else None
    pose = np.eye(4)
    pose[:3, 3] = (1.0, -2.0, 3.0)
    keyframe = Keyframe(points=points, origins=origins, T_world_camera=pose)
    voxel_size, model = 0.2, SENSORS["scanner"]
    buffers = RayBuffers(color=False, regularised=False)
    config = VolumeConfig(sensor="scanner", voxel_size=voxel_size, bundle=bundled)
    buffers.make_rays(keyframe, config)
    parameters = model_parameters(model, voxel_size, None)
    starts = np.zeros((700, 3)) if origins is None else origins.astype(np.float64)
    expected = []
    for strip in range(STRIPS):
        part = slice(strip * 700 // STRIPS, (strip + 1) * 700 // STRIPS)
        p, o = points[part].astype(np.float64), starts[part]
        valid = np.flatnonzero(np.isfinite(p).all(axis=1))
        for run in kernel_twins.runs(p, voxel_size) if bundled else [[i] for i in valid]:
            end, start = p[run].mean(axis=0), o[run].mean(axis=0)
            direction, trust = end - start, 255 * len(run)
            weight, half, support = kernel_twins.sample(parameters, float(np.linalg.norm(direction)), trust)
            end = kernel_twins.fixed((end + pose[:3, 3]) / voxel_size)
            expected.append(kernel_twins.make_ray(end, direction, half, weight, support=support))
    assert buffers.samples == 699
    close(rays_of(buffers), expected)
