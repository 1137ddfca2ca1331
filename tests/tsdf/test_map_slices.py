# SPDX-License-Identifier: MIT
"""Slices of a map are where things stand, follow the map exactly, and are read by map_server's rules."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from formula_scenes import sphere_views, volume_of
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image
from ruamel.yaml import YAML
from small_recordings import first_views

from tsfusion import OccupancySlice, Volume
from tsfusion.core.errors import InvalidConfig, MapError, OutputError
from tsfusion.geometry import up_direction
from tsfusion.geometry.up_direction import Up

RADIUS, VOXEL = 0.4, 0.04
VIEWS = sphere_views(RADIUS, 12)
BOX = (-0.9, -0.9, 0.9, 0.9)


@pytest.fixture(scope="module")
def sphere() -> Volume:
    return volume_of(VIEWS, voxel_size=VOXEL)


@pytest.mark.parametrize("up", ["z", "-y", "x", "0.2,-0.3,0.8"])
def test_distances_are_those_from_the_body_between_the_heights(sphere: Volume, up: str) -> None:
    found = sphere.distance_slice(-0.1, 0.1, box=BOX, up=up, max_distance=0.5, unseen_is_free=True)
    u, v = np.moveaxis(found.grid.centres()[..., None, :] @ found.grid.axes.T, -1, 0)[:2, ..., 0]
    radius = np.hypot(u, v)
    assert found.distance.dtype == np.float32
    assert found.distance.shape == found.grid.shape == found.cells.shape
    near = (radius > RADIUS + 2 * VOXEL) & (radius < RADIUS + 0.45)
    error = found.distance - (radius - RADIUS)
    # across the map's axes samples are half a voxel off, and the least counts: distances are short
    assert np.abs(error[near]).mean() < (0.15 if "," not in up else 0.5) * VOXEL
    assert np.abs(error[near]).max() < VOXEL
    assert (found.cells[np.abs(radius - RADIUS + VOXEL) < VOXEL / 2] == 100).all()
    assert (found.distance[radius > RADIUS + 0.6] == np.float32(0.5)).all()
    rows, columns = np.indices(found.grid.shape)
    cells = found.grid.cells_of(found.grid.centres().reshape(-1, 3))
    assert (cells == np.stack([rows.ravel(), columns.ravel()], axis=1)).all()


def test_heights_leave_out_what_is_above_and_below(sphere: Volume) -> None:
    assert (sphere.occupancy_slice(0.5, 0.7, box=BOX, up="z").cells != 100).all()
    for heights, radius in (((-0.05, 0.05), RADIUS), ((0.3, 0.4), np.sqrt(RADIUS**2 - 0.3**2))):
        found = sphere.occupancy_slice(*heights, box=BOX, up="z")
        centres = found.grid.centres()[found.cells == 100]
        farthest = np.hypot(centres[:, 0], centres[:, 1]).max()
        assert farthest == pytest.approx(radius, abs=1.5 * VOXEL)


@settings(max_examples=12, deadline=None)
@given(
    st.lists(st.tuples(st.integers(0, 11), st.booleans()), min_size=1, max_size=6),
    st.sampled_from(["z", "0.3,-0.2,0.9"]), st.sampled_from([None, 0.1]),
    st.integers(-50, 30), st.integers(0, 40),
)  # fmt: skip
def test_a_slice_that_follows_is_a_fresh_one(
    changes: list[tuple[int, bool]], up: str, resolution: float | None, low_cm: int, thick_cm: int
) -> None:
    volume = volume_of(VIEWS[:1], voxel_size=VOXEL)
    how: dict[str, Any] = {
        "box": (-0.7, -0.5, 0.3, 0.6),
        "up": up,
        "resolution": resolution,
        "max_distance": 0.3,
    }
    heights = low_cm / 100, (low_cm + thick_cm) / 100
    kept = volume.current_slice(*heights, **how)
    held = [0]
    for view, retracts in changes:
        if retracts and held:
            volume.retract(VIEWS[held.pop()])
            volume.release_empty()
        else:
            volume.integrate(VIEWS[view])
            held.append(view)
        before = kept.distances().distance, kept.occupancy().cells
        changed = kept.update()
        fresh = volume.current_slice(*heights, **how)
        ours, theirs = kept.distances(), fresh.distances()
        assert ours.distance.tobytes() == theirs.distance.tobytes()
        assert (ours.cells == theirs.cells).all()
        assert changed or ((before[0] == ours.distance).all() and (before[1] == ours.cells).all())
    assert not kept.update()


def read_by_map_server(path: Path) -> tuple[NDArray[np.int8], dict[str, Any]]:
    """What nav2's and ROS 1's map_server make of a pair of files, after their sources (mode trinary)."""
    text = YAML(typ="safe").load(path.read_text())
    pixels = np.asarray(Image.open(path.parent / text["image"]), np.float64)
    occupancy = (pixels if text["negate"] else 255 - pixels) / 255.0
    cells = np.full(pixels.shape, -1, np.int8)
    cells[occupancy > text["occupied_thresh"]] = 100
    cells[occupancy < text["free_thresh"]] = 0
    return cells[::-1], text  # the origin is the lower left pixel's


def test_map_server_reads_the_pair_of_files(sphere: Volume, tmp_path: Path) -> None:
    found = sphere.occupancy_slice(-0.1, 0.1, box=(-0.9, -0.5, 0.7, 0.6), up="z")
    assert set(np.unique(found.cells)) == {-1, 0, 100}
    for name in ("yard.yaml", 'a "b": #c.pgm'):
        files = found.save(tmp_path / name)
        assert [file.suffix for file in files] == [".yaml", ".pgm"]
        cells, text = read_by_map_server(files[0])
        assert (cells == found.cells).all()
        assert text["resolution"] == VOXEL
        assert text["origin"] == [*found.grid.origin, 0.0]
        assert text["mode"] == "trinary"
    # where the files say the sphere's middle is, there it is
    column, row = ((-np.array(text["origin"][:2])) / text["resolution"]).astype(int)
    ring = np.argwhere(cells == 100).mean(axis=0)
    assert np.abs(ring - (row, column)).max() < 2


def test_pictures_and_arrays_are_the_slice(sphere: Volume, tmp_path: Path) -> None:
    cells, distances = (
        ask(-0.1, 0.1, box=BOX, up="z") for ask in (sphere.occupancy_slice, sphere.distance_slice)
    )
    assert (np.asarray(Image.open(cells.save(tmp_path / "a.png")[0]))[..., 0] == cells.pixels()).all()
    assert (
        np.asarray(Image.open(distances.save(tmp_path / "b.png")[0])) == distances.picture()[..., ::-1]
    ).all()
    for one, name in ((cells, "cells"), (distances, "distance")):
        found = np.load(one.save(tmp_path / "c.npz")[0])
        assert (found[name] == getattr(one, name)).all()
        assert found["origin"].tolist() == list(one.grid.origin)
        assert (found["axes"] == np.eye(3)).all()
    with pytest.raises(InvalidConfig, match="must end in"):
        cells.save(tmp_path / "a.jpg")
    with pytest.raises(InvalidConfig, match="must end in"):
        distances.save(tmp_path / "a.pgm")
    with pytest.raises(OutputError, match="cannot write"):
        cells.save(tmp_path / "none" / "a.pgm")


def test_free_space_within_a_block_needs_carving() -> None:
    """Before the sphere no block as a whole is looked through."""
    maps = [volume_of(VIEWS, voxel_size=VOXEL, space_carving=carves) for carves in (False, True)]
    slices: list[OccupancySlice] = [one.occupancy_slice(-0.1, 0.1, box=BOX, up="z") for one in maps]
    assert [one.knows_free_space for one in slices] == [False, True]
    band, carved = ((one.cells == 0).mean() for one in slices)
    assert carved > 2 * band
    with pytest.raises(MapError, match="knows free space near surfaces"):
        maps[0].occupancy_slice(-0.1, 0.1, box=BOX, up="z", need_free=True)


def seen_from_above(height: float, **settings: Any) -> Volume:
    """A level plate of 1.0 × 0.8 m, seen by a camera 1.5 m above."""
    down = np.diag([1.0, -1, -1, 1])
    down[2, 3] = height + 1.5
    volume = Volume(**settings)
    volume.integrate(
        depth=np.full((240, 300), 1500, np.uint16), intrinsics=(450, 450, 149.5, 119.5), T_world_camera=down
    )
    return volume


def test_what_was_seen_from_above_alone_stands_in_the_way() -> None:
    """Nothing was seen beside the top of a table: no surface leads down there."""
    table = seen_from_above(0.75, voxel_size=0.02, space_carving=True)
    ahead = np.eye(4)
    ahead[:3] = [[1, 0, 0, 1.2], [0, 0, 1, -0.5], [0, -1, 0, 0.75]]  # a level camera looks past it
    table.integrate(
        depth=np.full((240, 320), 2500, np.uint16), intrinsics=(600, 600, 159.5, 119.5), T_world_camera=ahead
    )
    current = table.current_slice(0.6, 0.9, up="z", max_distance=2.0, box=(-1, -1, 2, 2))
    found = current.distances()
    x, y = np.moveaxis(found.grid.centres()[..., :2], -1, 0)
    beside = np.hypot(np.maximum(np.abs(x) - 0.5, 0), np.maximum(np.abs(y) - 0.4, 0))
    wall = np.hypot(np.maximum(np.abs(x - 1.2) - 0.667, 0), 2 - y)  # at which the level camera looks
    clear = (found.cells == 0) & (beside > 0.1)
    assert clear.sum() > 1000
    error = found.distance - np.minimum(np.minimum(beside, wall), 2)
    assert np.abs(error[clear]).max() < 0.04
    inside = np.minimum(0.5 - np.abs(x), 0.4 - np.abs(y))
    assert np.abs(found.distance + inside)[inside > 0.1].max() < 0.04
    table.retract(
        depth=np.full((240, 320), 2500, np.uint16), intrinsics=(600, 600, 159.5, 119.5), T_world_camera=ahead
    )
    current.update()
    fresh = table.distance_slice(0.6, 0.9, up="z", max_distance=2.0, box=(-1, -1, 2, 2))
    np.testing.assert_array_equal(current.distances().distance, fresh.distance)


@pytest.mark.parametrize("high", [0.19, 0.239, 0.289, 0.3, 0.31])
def test_no_layer_of_voxels_is_left_out(high: float) -> None:
    plate = seen_from_above(0.085, voxel_size=0.1)
    assert (plate.occupancy_slice(0.04, high, up="z", box=(-0.4, -0.3, 0.4, 0.3)).cells == 100).all()


def test_up_is_found_or_asked_for(sphere: Volume, monkeypatch: pytest.MonkeyPatch) -> None:
    found = sphere.occupancy_slice(-0.1, 0.1, box=BOX).grid
    up = up_direction.find(sphere.extract_mesh(), sphere.held)
    assert up is not None
    assert found.axes[2] @ up.direction > 0.99
    monkeypatch.setattr(sphere, "held", up_direction.SensorPosture())
    with pytest.raises(MapError, match="up direction of this map cannot be found"):
        sphere.occupancy_slice(0, 1)
    with pytest.raises(InvalidConfig, match="up must be"):
        sphere.occupancy_slice(0, 1, up="w")


def test_heights_count_from_the_floor(tmp_path: Path) -> None:
    shift = np.eye(4)
    shift[2, 3] = -0.7
    keyframes = [replace(one, T_world_camera=shift @ one.T_world_camera) for one in first_views(6)]
    room = volume_of(keyframes, voxel_size=0.06)
    found = room.occupancy_slice(0.2, 1.0, above_floor=True)
    assert found.grid.floor == pytest.approx(-0.7, abs=0.02)
    assert (found.grid.low, found.grid.high) == (found.grid.floor + 0.2, found.grid.floor + 1.0)
    same = room.occupancy_slice(found.grid.low, found.grid.high)
    assert same.grid.floor is None
    assert (found.cells == same.cells).all()
    text, _ = found.save(tmp_path / "room.yaml")
    words = (
        f"# What stands between 0.2 and 1 m above the floor, which is {-found.grid.floor:.3f} m below the "
    )
    assert text.read_text().startswith(words)
    command = text.read_text().splitlines()[1].split()
    assert command[1:5] == ["ros2", "run", "tf2_ros", "static_transform_publisher"]
    x, y, z, w = (float(command[command.index(f"--q{axis}") + 1]) for axis in "xyzw")
    turn = trimesh.transformations.quaternion_matrix((w, x, y, z))[:3, :3]
    assert turn == pytest.approx(found.grid.axes, abs=1e-6)  # takes the map's frame to the slice's
    (arrays,) = room.distance_slice(0.2, 1.0, above_floor=True, up="z").save(tmp_path / "room.npz")
    assert np.load(arrays)["floor"] == pytest.approx(found.grid.floor, abs=0.01)
    with pytest.raises(MapError, match=r"no floor is found in this map: .* faces up, -y"):
        room.occupancy_slice(0.2, 1.0, above_floor=True, up=Up((0.0, -0.7, 0.7), "given"))


def test_slices_that_cannot_be_are_refused(sphere: Volume) -> None:
    with pytest.raises(MapError, match="the map is empty"):
        volume_of([]).occupancy_slice(0, 1, up="z")
    assert (volume_of([]).occupancy_slice(0, 1, box=BOX, up="z").cells == -1).all()
    whole = sphere.distance_slice(-1, 1, up="z", max_distance=0.2)
    assert (whole.distance < 0).any()
    for box in ((0, 0, 0, 1), (0, 0, 1), (0, 0, np.nan, 1)):
        with pytest.raises(InvalidConfig, match="a slice's box must be"):
            sphere.occupancy_slice(0, 1, box=box, up="z")
    for heights in ((1, 0), (np.nan, 1), (0, np.inf)):
        with pytest.raises(InvalidConfig, match="low ≤ high"):
            sphere.occupancy_slice(*heights, box=BOX, up="z")
    with pytest.raises(InvalidConfig, match=r"too large .at most"):
        sphere.occupancy_slice(0, 1, box=(-1e4, -1e4, 1e4, 1e4), up="z")
    with pytest.raises(InvalidConfig, match="a cell would have"):
        sphere.occupancy_slice(0, 1000, box=BOX, up="z")
    for wrong in (0.01, np.nan, np.inf):
        with pytest.raises(InvalidConfig, match="resolution must be at least"):
            sphere.occupancy_slice(0, 1, box=BOX, up="z", resolution=wrong)
