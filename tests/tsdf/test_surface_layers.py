# SPDX-License-Identifier: MIT
"""Surfaces kept of answers: the same as asked anew, whatever happened to the map."""

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from formula_scenes import sphere_views, volume_of
from hypothesis import given, settings
from hypothesis import strategies as st

from tsfusion import Keyframe, Samples, View, Volume
from tsfusion.core.config import Surface
from tsfusion.tsdf.answers import camera_views, point_samples
from tsfusion.tsdf.surface import map_surface, surface_layers
from tsfusion.tsdf.surface.surface_layers import SurfaceCubes

VOXEL = 0.03
SURFACES: tuple[Surface, ...] = ("raw", "normal", "field")


@pytest.fixture(scope="module", autouse=True)
def every_surface_is_kept() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(map_surface, "MOST_SURFACES", len(SURFACES))
        yield


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


def window_of(view: Keyframe, column: int) -> Keyframe:
    """A view through a window: a small change near the middle, where cubes meet."""
    height, width = view.shape
    assert view.depth is not None
    depth = np.zeros_like(view.depth)
    window = slice(3 * height // 8, 5 * height // 8), slice(column * width // 32, (column + 2) * width // 32)
    depth[window] = view.depth[window]
    return replace(view, depth=depth)


CHANGES = st.tuples(
    st.sampled_from(["add", "add", "remove", "move", "prune", "merge", "ask", "ask"]),
    st.integers(0, 5),
    st.integers(8, 21),
)


@settings(max_examples=10, deadline=None)
@given(st.lists(CHANGES, min_size=3, max_size=10), st.sampled_from([30.0, 2000.0]))
def test_every_layer_answers_as_a_new_map_does(
    views: list[Keyframe], points: np.ndarray, history: list[tuple[str, int, int]], smoothness: float
) -> None:
    """Whatever was added, taken out, moved, pruned, merged and asked before."""
    made = {"voxel_size": VOXEL, "threads": 2, "field_smoothness": smoothness}
    asked, silent, held = volume_of(views[:1], **made), volume_of(views[:1], **made), [views[0]]
    list(answers(asked, points, views[0]))
    for change, number, place in history:
        if change == "ask":
            list(answers(asked, points[place::16], views[number]))
        gone = held.pop(place % len(held)) if change in ("remove", "move") and held else None
        T = views[number].T_world_camera.copy()
        T[:3, 3] += VOXEL * (change == "move")
        new = window_of(replace(views[number], T_world_camera=T), place)
        held += [new] * (change in ("add", "move", "merge"))
        for volume in (asked, silent):
            if gone is not None:
                volume.retract(gone)
            if change in ("add", "move"):
                volume.integrate(new)
            elif change == "merge":
                volume.merge(volume_of([new], **made), same_frame=True)
            elif change == "prune":
                volume.release_empty()
    assert_same(answers(asked, points, views[0]), answers(silent, points, views[0]))
    asked.release_empty()  # rings of neighbours go through empty blocks, too
    assert_same(answers(asked, points, views[0]), answers(volume_of(held, **made), points, views[0]))


@pytest.mark.parametrize("smoothness", [30.0, 2000.0])
def test_a_change_makes_old_all_that_it_reaches(views: list[Keyframe], smoothness: float) -> None:
    volume = volume_of(views, voxel_size=VOXEL, threads=2, field_smoothness=smoothness)
    store, least = volume._store, volume.model.min_weight
    numbers = volume.surface.cubes("raw", None).numbers().tolist()
    changed = dict.fromkeys(SURFACES, 0)
    for place in range(10, 20, 2):
        before = {
            surface: list(volume.surface.cubes(surface, None).meshes.of(numbers)) for surface in SURFACES
        }
        volume.integrate(window_of(views[0], place))
        for surface in SURFACES:
            cubes = volume.surface.cubes(surface, None)
            fresh = SurfaceCubes(store, volume.surface.view(surface), least, volume.surface.reach(surface))
            for was, one, other in zip(
                before[surface], cubes.meshes.of(numbers), fresh.meshes.of(numbers), strict=True
            ):
                changed[surface] += one is not was
                for name in ("vertices", "faces", "normals", "colors"):
                    assert np.array_equal(getattr(one, name), getattr(other, name)), (surface, place)
            keys = np.sort(store.keys)
            ours, theirs = (one.values(keys, store, least) for one in (cubes, fresh))
            assert np.array_equal(ours, theirs, equal_nan=True)
    assert 0 < changed["raw"] < changed["field"], changed


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
        patch.setattr(surface_layers.Layer, "forget", interrupted)
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
    monkeypatch.setattr(surface_layers, "MOST_BYTES", 1)  # nothing can be kept
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


def test_what_is_kept_of_a_settled_version_is_bounded(
    views: list[Keyframe], monkeypatch: pytest.MonkeyPatch
) -> None:
    volume = Volume(VOXEL, threads=2)
    volume.integrate(views[0])
    cubes = volume.surface.cubes("raw", None)
    numbers = cubes.numbers().tolist()
    before = list(cubes.meshes.of(numbers))
    cubes.meshes.settle()
    settled = volume.version
    assert cubes.meshes.of_version(settled - 1, numbers) is None
    volume.integrate(views[0])
    volume.integrate(views[0])
    now = list(cubes.meshes.of(numbers))
    kept = cubes.meshes.of_version(settled, numbers)
    assert kept is not None
    assert {id(one) for one in kept} == {id(one) for one in before}
    assert not {id(one) for one in kept} & {id(one) for one in now}
    assert cubes.meshes.nbytes == sum(one.nbytes for one in [*before, *now])
    monkeypatch.setattr(surface_layers, "MOST_BYTES", 1000)
    volume.integrate(views[1])  # another side of the sphere
    list(cubes.meshes.of(numbers))
    assert cubes.meshes.of_version(settled, numbers) is None
    assert cubes.meshes.nbytes <= max(1000, *(one.nbytes for one in now))
