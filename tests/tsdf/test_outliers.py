# SPDX-License-Identifier: MIT
"""Lone pixels and things that have moved on should not be in the map; thin things should."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import trimesh
from formula_scenes import CAMERA, SHAPE, directions, look_at, plane_keyframe, volume_of, with_noise
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from tsfusion import Intrinsics, Keyframe, Mesh, Volume
from tsfusion.datasets import Synthetic
from tsfusion.kernels.integration.integrate import QUANTA_PER_VOXEL
from tsfusion.kernels.surface.surface_cells import NO_LIMITS
from tsfusion.tsdf.store.block_store import unpack_keys

WALL = plane_keyframe(np.eye(4), np.array([0.0, 0.0, 1.0]), 2.0)


def with_depth(depth: NDArray[np.float32]) -> Keyframe:
    return replace(WALL, depth=depth)


def passer_by() -> Keyframe:
    """Somebody, a disc 60 cm wide, before the wall."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    depth = WALL.measurement.copy()
    depth[np.hypot(u - CAMERA.cx, v - CAMERA.cy) < 0.3 * CAMERA.fx / 1.2] = 1.2
    return with_depth(depth)


def mesh_depths(keyframes: list[Keyframe], **settings: object) -> NDArray[np.float32]:
    """z of every vertex."""
    return volume_of(keyframes, voxel_size=0.03, color=False, **settings).extract_mesh().vertices[:, 2]


def test_lone_pixels_are_dropped_and_counted() -> None:
    random = np.random.default_rng(3)
    depth = WALL.measurement.copy()
    lone = np.zeros(depth.shape, bool)
    lone[3::8, 3::8] = True
    depth[lone] = random.uniform(0.5, 1.6, lone.sum())
    nearest = []
    for chosen in (False, True):
        volume = Volume(voxel_size=0.03, threads=2, color=False, outlier_filter=chosen)
        stats = volume.integrate(with_depth(depth))
        assert stats.invalid == (lone.sum() if chosen else 0)
        nearest.append(unpack_keys(volume._store.keys)[:, 2].min() * 8 * 0.03)
    assert nearest[0] < 0.6
    assert nearest[1] > 1.5


@pytest.mark.parametrize("bundle", [True, False])
def test_the_filter_costs_a_clean_view_nothing(bundle: bool) -> None:
    for keyframe in (WALL, passer_by()):
        stats = Volume(voxel_size=0.03, bundle=bundle).integrate(keyframe)
        assert stats.samples == np.count_nonzero(keyframe.measurement)


def test_carving_removes_who_has_left_and_keeps_the_wall() -> None:
    keyframes = [passer_by()] * 4 + [WALL] * 20
    ghost, carved = (
        mesh_depths(keyframes, space_carving=chosen, regularizer="off") for chosen in (False, True)
    )
    assert (ghost < 1.5).sum() > 100
    assert (carved < 1.5).sum() == 0
    wall = mesh_depths([WALL] * 20, regularizer="off")
    assert (carved > 1.9).sum() >= 0.98 * len(wall)
    assert np.abs(carved - 2).mean() <= np.abs(wall - 2).mean() + 0.001


def board_view(eye: NDArray[np.float64], target: NDArray[np.float64]) -> Keyframe:
    """A board of 60 cm at z = 1.2 before the wall."""
    T = look_at(eye, target)
    wall, board = (plane_keyframe(T, np.array([0.0, 0.0, 1.0]), z).measurement for z in (2.0, 1.2))
    p = directions(T) * board[..., None] + eye
    hits = (np.abs(p[..., :2]) < 0.3).all(axis=-1) & (board > 0)
    keyframe = plane_keyframe(T, np.array([0.0, 0.0, 1.0]), 2.0)
    return replace(keyframe, depth=np.where(hits, board, wall).astype(np.float32))


@pytest.mark.parametrize("surface", ["raw", "field"])
def test_what_is_seen_behind_a_thing_is_not_its_back(surface: str) -> None:
    """A board, seen from its front and by somebody who looks past its edge: the band behind it ends beside
    free space there, and nobody has measured a surface."""
    views = [
        board_view(np.array(eye), np.array(target))
        for eye, target in (
            ((0.0, 0, 0), (0.0, 0, 1)),
            ((1.3, 0, 0.7), (0.0, 0, 1.7)),
            ((-1.3, 0, 0.7), (0.0, 0, 1.7)),
        )
    ]
    volume = volume_of(views, voxel_size=0.02, color=False, space_carving=True)

    def faces() -> tuple[int, int]:
        """Triangles behind the board, and all others."""
        mesh = volume.extract_mesh(surface=surface)
        z = mesh.vertices[mesh.faces][..., 2].mean(axis=1)
        behind = (z > 1.215) & (z < 1.9)
        return int(behind.sum()), int((~behind).sum())

    behind, others = faces()
    volume._store.back_limits = NO_LIMITS
    ghosts, all_others = faces()
    assert ghosts > 300
    assert behind < 0.8 * ghosts
    assert others > 0.99 * all_others


def test_carving_is_a_sum_like_everything_else() -> None:
    keyframes = ([passer_by(), WALL], [WALL, passer_by()], [WALL])
    both, turned, alone = (
        volume_of(each, voxel_size=0.03, space_carving=True, regularizer="off") for each in keyframes
    )
    assert both.map_hash() == turned.map_hash()
    both.retract(passer_by())
    assert both.map_hash() == alone.map_hash()


def test_rays_that_carve_smooth_the_surface_all_the_same() -> None:
    dataset = Synthetic("room", "stereo", count=12, width=160, color=False)
    error, hashes = {}, set()
    for regularizer in ("off", "ray"):
        volume = Volume(voxel_size=0.04, sensor="stereo", space_carving=True, regularizer=regularizer)
        for keyframe in dataset:
            volume.integrate(keyframe)
        vertices = volume.extract_mesh(surface="raw").vertices
        error[regularizer] = np.abs(dataset.distance(vertices)).mean()
        hashes.add(volume.map_hash())
    assert error["ray"] < 0.92 * error["off"]
    assert len(hashes) == 1


def plate_views(thickness: float) -> list[Keyframe]:
    """A plate across z = 0, seen from both sides, straight and aslant."""
    views = []
    for side in (-1, 1):
        for x in (-0.6, -0.3, 0.0, 0.3, 0.6):
            eye = np.array([x, 0.1 * x, side * 1.0])
            T = look_at(eye, np.zeros(3))
            keyframe = plane_keyframe(T, np.array([0.0, 0.0, float(side)]), thickness / 2)
            d = directions(T) * keyframe.measurement[..., None] + eye
            inside = (np.abs(d[..., 0]) < 0.3) & (np.abs(d[..., 1]) < 0.3)
            depth = np.where(inside, keyframe.measurement, 0)
            views.append(replace(keyframe, depth=depth.astype(np.float32)))
    return views


def share_found(mesh: Mesh, z: float, reach: float) -> float:
    """Share of a face of the plate, at this z, that has the mesh within `reach` metres."""
    steps = np.arange(-0.25, 0.25, reach)
    face = np.stack([*map(np.ravel, np.meshgrid(steps, steps)), np.full(steps.size**2, z)], axis=1)
    solid = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    points, _ = trimesh.sample.sample_surface(solid, 100_000, seed=1)
    return float((cKDTree(points).query(face)[0] <= reach).mean())


@pytest.mark.parametrize("noise", [0.0, 0.0025])
@pytest.mark.parametrize("voxel_size", [0.01, 0.02, 0.05])
def test_both_faces_of_a_wall_of_two_voxels_are_where_they_are(voxel_size: float, noise: float) -> None:
    """A door of 4 cm at 2 cm, a wall of 10 cm at 5 cm: no face is pulled through by the other one."""
    random = np.random.default_rng(5)
    views = [with_noise(view, noise, random) for view in plate_views(2 * voxel_size)]
    mesh = volume_of(views, voxel_size=voxel_size, color=False).extract_mesh()
    symmetric = volume_of(views, voxel_size=voxel_size, color=False, min_behind=16).extract_mesh()
    for z in (-voxel_size, voxel_size):
        assert share_found(mesh, z, voxel_size / 2) > 0.95
        assert share_found(symmetric, z, voxel_size / 2) < 0.5


@pytest.mark.parametrize("voxels", [1.5, 3.0, 8.0])
def test_a_plate_seen_from_both_sides_is_no_worse_than_without_bundling(voxels: float) -> None:
    """Bands of opposite sides overlap in a plate thinner than two of them: each side pushes the other
    outward, as in any fusion that averages. Bundling, planes and the filter must add next to nothing."""
    size, thickness = 0.02, voxels * 0.02
    errors = []
    for settings in ({"bundle": True}, {"bundle": False, "outlier_filter": False}):
        volume = volume_of(plate_views(thickness), color=False, regularizer="off", **settings)
        vertices = volume.extract_mesh().vertices
        middle = vertices[(np.abs(vertices[:, :2]) < 0.25).all(axis=1)]
        both = (middle[:, 2] > 0).any() and (middle[:, 2] < 0).any()
        errors.append((np.abs(np.abs(middle[:, 2]) - thickness / 2).mean() / size, both, len(middle)))
    (ours, ours_both, ours_count), (plain, plain_both, plain_count) = errors
    assert ours <= 1.1 * plain
    assert ours_both == plain_both
    assert ours_count >= 0.95 * plain_count


def test_gross_outliers_do_not_reach_the_surface() -> None:
    room = Synthetic(world="room", sensor="kinect", count=8)
    random = np.random.default_rng(6)
    errors = []
    keyframes = []
    for i in range(len(room)):
        depth = room[i].measurement.copy()
        wrong = random.random(depth.shape) < 0.03
        depth[wrong] = random.uniform(0.5 / room[i].depth_scale, 3 / room[i].depth_scale, wrong.sum())
        keyframes.append(replace(room[i], depth=depth))
    for chosen in (False, True):
        mesh = volume_of(keyframes, voxel_size=0.03, color=False, outlier_filter=chosen).extract_mesh()
        errors.append(np.abs(room.distance(mesh.vertices.astype(np.float64))).mean() * 1e3)
    assert errors[0] > 20.0
    assert errors[1] < 3.0


def test_carving_leaves_nothing_out() -> None:
    """Every voxel that the view looks through is free, as sure as the pixels that see it say."""
    volume = volume_of([], voxel_size=0.02, color=False, space_carving=True, regularizer="off")
    stats = volume.integrate(WALL)
    blocks = volume.blocks()
    inside = np.stack(np.meshgrid(*[np.arange(8)] * 3, indexing="ij"), axis=-1)
    x, y, z = np.moveaxis((8 * blocks.coordinates[:, None, None, None] + inside + 0.5) * 0.02, -1, 0)
    u, v = x / z * CAMERA.fx + CAMERA.cx, y / z * CAMERA.fy + CAMERA.cy
    seen = (u > 2) & (u < SHAPE[1] - 3) & (v > 2) & (v < SHAPE[0] - 3) & (z > 0.4) & (z < 1.85)
    assert seen.sum() > 300_000
    sums = blocks.sums[seen]
    assert ((sums >> 27) > 0).all(), "free"
    pixels = CAMERA.fx * 0.02 * CAMERA.fy * 0.02 / z[seen] ** 2  # that a voxel covers
    votes = (sums & ((1 << 27) - 1)) / np.minimum(16 * pixels, 255)
    for near, far in ((0.4, 0.6), (0.6, 0.9), (0.9, 1.3), (1.3, 1.85)):
        assert 0.9 < votes[(z[seen] > near) & (z[seen] < far)].mean() < 1.1
    assert stats.updates < 0.4 * stats.rays * 2.0 / 0.02, "each ray alone would take 1.4 times its length"


def test_what_is_very_far_away_carves_what_is_next_to_the_camera() -> None:
    """A view of 3000 voxels' length is carved up to 2048 from the camera."""
    camera = Intrinsics(6000.0, 6000.0, 1.5, 1.5)
    far = Keyframe(depth=np.full((4, 4), 30.0, np.float32), intrinsics=camera, T_world_camera=np.eye(4))
    volume = volume_of(
        [], voxel_size=0.01, color=False, max_range=40.0, space_carving=True, regularizer="off"
    )
    stats = volume.integrate(far)
    assert stats.rays == 4
    along = 8 * np.unique(volume.blocks().coordinates[:, 2])
    free = along[along < 2900]
    assert 1900 < free.max() < 2048


@pytest.mark.parametrize(
    ("settings", "limits"),
    [
        ({"sensor": "kinect"}, (-1.0, 2.91)), ({"sensor": "kinect", "space_carving": False}, None),
        ({"sensor": "kinect", "voxel_size": 0.005}, None),  # where noise is wider than the band
        ({"sensor": "stereo", "voxel_size": 0.15}, None), ({"sensor": "lidar", "voxel_size": 0.1}, None),
        ({"sensor": "kinect", "min_support": 4.0, "min_behind": 6.0}, (-4 * 2 / 3, 3.88)),
    ],
)  # fmt: skip
def test_backs_are_left_out_where_bands_are_narrow(
    settings: dict[str, Any], limits: tuple[float, float] | None
) -> None:
    volume = Volume(**{"voxel_size": 0.02, "space_carving": True, **settings})
    found = volume._store.back_limits
    assert found == (NO_LIMITS if limits is None else pytest.approx(np.array(limits) * QUANTA_PER_VOXEL))
