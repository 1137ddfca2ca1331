# SPDX-License-Identifier: MIT
"""The difference between two maps of one place, by voxels and by surface."""

import numpy as np
import pytest
from formula_scenes import look_at, plane_keyframe, sphere_views, volume_of

from tsfusion import Keyframe
from tsfusion.core.errors import InvalidConfig, MapError
from tsfusion.tsdf.sums.map_difference import COLORS

VIEWS = sphere_views(0.4, 6)
UP = np.array([0.0, 0.0, 1.0])


def floor(box: bool) -> Keyframe:
    """The floor z = 0 from above, with a box of 40 × 40 cm and 30 cm height in the middle, or without."""
    T = look_at(np.array([0.0, 0.0, 2.0]), np.zeros(3))
    floor = plane_keyframe(T, UP, 0.0)
    top = plane_keyframe(T, UP, 0.3).depth
    x, y = (np.mgrid[:120, :160][::-1] - np.array([79.5, 59.5])[:, None, None]) / 120 * top
    inside = (np.abs(x) < 0.2) & (np.abs(y) < 0.2)
    depth = np.where(inside & box, top, floor.depth).astype(np.float32)
    return Keyframe(depth=depth, intrinsics=floor.intrinsics, T_world_camera=T)


def colors_around(vertices: np.ndarray, colors: np.ndarray, height: float) -> set[tuple[int, ...]]:
    """Colours in the middle of the box, at a height."""
    near = (np.abs(vertices - (0, 0, height)) < (0.1, 0.1, 0.03)).all(axis=1)
    assert near.any()
    return {tuple(color) for color in colors[near].tolist()}


def test_equal_maps_have_no_difference() -> None:
    found = volume_of(VIEWS[:3]).diff(volume_of(VIEWS[2::-1]))
    assert found.is_same
    assert {kind for kind, count in found.voxels.items() if count} == {"same"}
    assert {kind for kind, area in found.area_m2.items() if area} == {"unchanged"}
    assert found.area_m2["unchanged"] > 0.5
    assert np.unique(found.mesh.colors, axis=0).tolist() == [list(COLORS["unchanged"])]


def test_voxels_and_blocks_are_counted_where_they_are() -> None:
    earlier, later = volume_of(VIEWS[:2], voxel_size=0.03), volume_of(VIEWS[1:3], voxel_size=0.03)
    found = earlier.diff(later)
    stores = earlier._store, later._store
    rows = [dict(zip(one.keys.tolist(), one.sums[: one.count], strict=True)) for one in stores]
    nothing = np.zeros(512, np.int64)
    pairs = [
        (rows[0].get(key, nothing), rows[1].get(key, nothing)) for key in rows[0].keys() | rows[1].keys()
    ]
    a, b = (np.array(side) for side in zip(*pairs, strict=True))
    assert found.voxels == {
        "same": ((a == b) & (a != 0)).sum(),
        "changed": ((a != b) & (a != 0) & (b != 0)).sum(),
        "only_earlier": ((a != 0) & (b == 0)).sum(),
        "only_later": ((a == 0) & (b != 0)).sum(),
    }
    assert not found.is_same
    used = [set(one.keys[one.used()].tolist()) for one in stores]
    assert found.blocks["only_earlier"] == len(used[0] - used[1])
    assert found.blocks["same"] + found.blocks["changed"] == len(used[0] & used[1])


@pytest.mark.parametrize("carving", [True, False])
def test_a_box_that_appeared_and_one_that_is_gone(carving: bool) -> None:
    without, with_box = (
        volume_of([floor(box)] * 3, voxel_size=0.02, space_carving=carving, surface="raw")
        for box in (False, True)
    )
    came = without.diff(with_box)
    seen, other = ("appeared", "new") if carving else ("new", "appeared")
    assert came.area_m2[seen] == pytest.approx(0.16, rel=0.6)  # its sides, too
    assert came.area_m2[other] < 0.01
    assert came.area_m2["gone"] < 0.01  # the floor below the box was not seen again
    assert came.area_m2["not_seen_again"] == pytest.approx(0.16 * (2 / 1.7) ** 2, rel=0.3)
    assert colors_around(came.mesh.vertices, came.mesh.colors, 0.3) == {COLORS[seen]}
    assert colors_around(came.mesh.vertices, came.mesh.colors, 0.0) == {COLORS["not_seen_again"]}
    went = with_box.diff(without)
    left = "gone" if carving else "not_seen_again"
    assert went.area_m2[left] == pytest.approx(0.16, rel=0.6)
    assert colors_around(went.mesh.vertices, went.mesh.colors, 0.3) == {COLORS[left]}
    assert went.area_m2["unchanged"] > 3


def test_an_empty_map_and_wrong_questions() -> None:
    volume = volume_of(VIEWS[:2])
    assert volume.diff(volume_of([])).area_m2["not_seen_again"] > 0.1
    assert volume_of([]).diff(volume).area_m2["new"] > 0.1
    assert volume_of([]).diff(volume_of([])).is_same
    with pytest.raises(MapError, match="voxels of"):
        volume.diff(volume_of([], voxel_size=0.05))
    with pytest.raises(InvalidConfig, match="tolerance"):
        volume.diff(volume, tolerance=float("nan"))
