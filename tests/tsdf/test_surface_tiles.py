# SPDX-License-Identifier: MIT
"""Surfaces kept of answers: the same as asked anew, whatever happened to the map."""

from collections.abc import Iterator

import numpy as np
import pytest
from formula_scenes import sphere_views, volume_of

from tsfusion import Keyframe, Samples, View, Volume
from tsfusion.core.config import Surface
from tsfusion.tsdf.answers import camera_views, point_samples
from tsfusion.tsdf.answers.camera_views import cast_settled
from tsfusion.tsdf.surface import surface_tiles

VOXEL = 0.03
SURFACES: tuple[Surface, ...] = ("raw", "normal", "field")


@pytest.fixture(scope="module")
def views() -> list[Keyframe]:
    return sphere_views(0.6, 6)


@pytest.fixture(scope="module")
def points(views: list[Keyframe]) -> np.ndarray:
    mesh = volume_of(views, voxel_size=VOXEL).extract_mesh()
    return mesh.vertices + np.random.default_rng(0).normal(0, VOXEL, mesh.vertices.shape).astype(np.float32)


def copy_of(volume: Volume) -> Volume:
    """Another map of the same sums, of which nobody has asked anything."""
    copy = Volume(volume.config)
    copy.merge(volume)
    return copy


def answers(volume: Volume, points: np.ndarray, camera: Keyframe) -> Iterator[Samples | View]:
    for surface in SURFACES:
        yield volume.sample(points, surface=surface)
        yield volume.raycast(camera.intrinsics, camera.T_world_camera, (60, 80), surface=surface)


def assert_same(found: Iterator[Samples | View], wanted: Iterator[Samples | View]) -> None:
    for one, other in zip(found, wanted, strict=True):
        for name in vars(one):
            assert np.array_equal(getattr(one, name), getattr(other, name), equal_nan=name != "colors"), name


def test_answers_follow_the_map(views: list[Keyframe], points: np.ndarray) -> None:
    volume = Volume(VOXEL, threads=2)
    volume.integrate(views[0])
    before = list(answers(volume, points, views[0]))
    assert_same(iter(before), answers(volume, points, views[0]))
    for change in (
        lambda: volume.integrate(views[1]),
        lambda: volume.retract(views[0]),
        volume.release_empty,
        lambda: volume.merge(volume_of(views[2:4], voxel_size=VOXEL)),
    ):
        change()
        volume.take_dirty()  # as the server does for its meshes
        assert_same(answers(volume, points, views[0]), answers(copy_of(volume), points, views[0]))
    after = list(answers(volume, points, views[0]))
    assert not np.array_equal(before[0].distance, after[0].distance)  # type: ignore[union-attr]


def test_a_question_cut_off_leaves_no_old_answers(
    views: list[Keyframe], points: np.ndarray, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    volume = Volume(VOXEL, threads=2)
    volume.integrate(views[0])
    volume.sample(points)
    volume.integrate(views[1])
    with monkeypatch.context() as patch:
        patch.setattr(surface_tiles.SurfaceTiles, "forget", interrupted)
        with pytest.raises(KeyboardInterrupt):
            volume.sample(points)
    assert_same(iter([volume.sample(points)]), iter([copy_of(volume).sample(points)]))


def test_an_answer_does_not_depend_on_what_was_asked_before(
    views: list[Keyframe], points: np.ndarray
) -> None:
    volume = volume_of(views, voxel_size=VOXEL, threads=2)
    some = volume.sample(points[:3]).distance
    whole = volume.sample(points).distance
    assert np.array_equal(whole[:3], some, equal_nan=True)
    assert np.array_equal(copy_of(volume).sample(points[::-1]).distance[::-1], whole, equal_nan=True)


def test_tiles_agree_with_the_whole_map(views: list[Keyframe], points: np.ndarray) -> None:
    volume = volume_of(views, voxel_size=VOXEL, threads=2)
    least = volume.model.min_weight
    for surface in SURFACES:
        found = volume.sample(points, surface=surface).distance
        wanted = point_samples.sample(points, volume._store, least, volume.surface.view(surface)).distance
        assert np.nanmax(np.abs(found - wanted)) < 0.01 * VOXEL
        camera = views[0].intrinsics, views[0].T_world_camera, (60, 80)
        view = volume.raycast(*camera, surface=surface)
        assert camera[0] is not None
        whole = camera_views.look_at(volume.extract_mesh(surface=surface), *camera)
        assert ((view.depth > 0) != (whole.depth > 0)).mean() < 2e-3
        both = (view.depth > 0) & (whole.depth > 0)
        assert np.median(np.abs(view.depth - whole.depth)[both]) < 1e-4
        assert both.any()


def test_a_view_is_the_same_drawn_in_parts(views: list[Keyframe], monkeypatch: pytest.MonkeyPatch) -> None:
    volume = volume_of(views, voxel_size=VOXEL, threads=2)
    camera = views[0].intrinsics, views[0].T_world_camera, (60, 80)
    whole = volume.raycast(*camera)
    monkeypatch.setattr(camera_views, "MOST_TRIANGLES", 100)
    monkeypatch.setattr(point_samples, "_MOST_SOLVED", 2)
    assert_same(iter([volume.raycast(*camera)]), iter([whole]))
    points = volume.extract_mesh().vertices[:50]
    found = volume.sample(points)
    monkeypatch.setattr(surface_tiles, "MOST_BYTES", 1)  # nothing can be kept
    anew = copy_of(volume)
    assert_same(iter([anew.sample(points), anew.raycast(*camera)]), iter([found, whole]))
    assert anew.stats().scratch_bytes < volume.stats().scratch_bytes
    monkeypatch.undo()
    assert_same(iter([found]), iter([volume.sample(points)]))


def test_what_is_kept_is_bounded_and_counted(views: list[Keyframe], monkeypatch: pytest.MonkeyPatch) -> None:
    volume = volume_of(views, voxel_size=VOXEL, threads=2)
    before = volume.stats().scratch_bytes
    points = volume.extract_mesh().vertices
    volume.sample(points)
    kept = volume.stats().scratch_bytes - before
    assert kept >= 2048 * len(volume.blocks()) // 2
    for weight in (0.5, 1.0, 2.0):
        volume.sample(points, min_weight=weight)
    assert volume.stats().scratch_bytes - before < 3 * kept


def test_what_a_settled_view_keeps_is_bounded(views: list[Keyframe], monkeypatch: pytest.MonkeyPatch) -> None:
    volume = Volume(VOXEL, threads=2)
    volume.integrate(views[0])
    camera = views[0].intrinsics, views[0].T_world_camera, (60, 80)
    seen = volume.raycast(*camera, surface="raw")
    volume.integrate(views[0])
    settled = cast_settled(volume.surface.kept("raw", None), *camera)
    assert settled is not None
    assert np.array_equal(settled.depth, seen.depth)
    tiles = volume.surface.kept("raw", None)
    assert tiles._state is not None
    assert tiles._state.nbytes
    monkeypatch.setattr(surface_tiles, "MOST_BYTES", 1000)
    volume.integrate(views[1])  # another side of the sphere
    assert volume.surface.kept("raw", None).settled is None
    assert cast_settled(volume.surface.kept("raw", None), *camera) is None
    assert tiles._state is None
    now, fresh = (one.raycast(*camera, surface="raw") for one in (volume, copy_of(volume)))
    assert np.array_equal(now.depth, fresh.depth)
