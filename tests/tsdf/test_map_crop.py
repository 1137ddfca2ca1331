# SPDX-License-Identifier: MIT
"""The part of a map in a box has exactly its voxels."""

import itertools
from pathlib import Path

import numpy as np
import pytest
from formula_scenes import sphere_views, volume_of
from saved_maps import make_map

from tsfusion import Volume
from tsfusion.core.errors import InvalidConfig, MapError
from tsfusion.journal import state_folder
from tsfusion.tsdf.store.block_store import unpack_keys

VIEWS = sphere_views(0.4, 6)
FAR = 100.0


def voxels(volume: Volume) -> dict[tuple[int, ...], tuple[int, ...]]:
    """The numbers of every voxel with votes, by its place."""
    store, found = volume._store, {}
    layers = list(store.layers().values())
    for slot, corner in enumerate(unpack_keys(store.keys) * 8):
        for o in np.flatnonzero(store.sums[slot]):
            place = tuple((corner + (o >> 6, o >> 3 & 7, o & 7)).tolist())
            found[place] = tuple(float(layer[slot, o]) for layer in layers)
    return found


@pytest.mark.parametrize("regularizer", ["off", "ray"])
def test_a_crop_has_the_voxels_whose_centres_lie_in_the_box(regularizer: str) -> None:
    volume = volume_of(VIEWS[:3], voxel_size=0.03, regularizer=regularizer)
    box = (-0.2, -FAR, -0.105, 0.33, 0.1, 0.225)
    cropped = volume.crop(box)
    whole = voxels(volume)
    inside = {
        place: numbers
        for place, numbers in whole.items()
        if all(low <= (i + 0.5) * 0.03 < high for i, low, high in zip(place, box[:3], box[3:], strict=True))
    }
    assert 0 < len(inside) < len(whole)
    assert voxels(cropped) == inside
    assert not cropped._store.sums[~np.isin(np.arange(len(cropped._store.sums)), cropped._store.used())].any()
    assert cropped.stats().blocks < volume.stats().blocks
    assert cropped.stats().keyframes == 3
    assert len(cropped.take_dirty()) == cropped.stats().blocks
    vertices = cropped.extract_mesh().vertices
    assert len(vertices)
    assert (vertices >= np.array(box[:3]) - 0.03).all()
    assert (vertices <= np.array(box[3:]) + 0.03).all()


def test_boxes_side_by_side_add_up(tmp_path: Path) -> None:
    volume = volume_of(VIEWS, voxel_size=0.03)
    edges = (-FAR, -0.135, 0.01, FAR)  # the second lies on centres
    parts = [volume.crop((low, -FAR, -FAR, high, FAR, FAR)) for low, high in itertools.pairwise(edges)]
    parts[0].merge(parts[1])
    assert parts[0].keyframes == volume.keyframes
    parts[0].merge(parts[2])
    assert parts[0].keyframes == volume.keyframes
    assert "part_of" not in parts[0].meta
    assert parts[0].map_hash() == volume.map_hash()
    assert parts[0].color_hash() == volume.color_hash()
    assert Volume.load(parts[0].save(tmp_path / "map.tsf")).map_hash() == volume.map_hash()


def test_parts_of_parts_are_parts_and_changed_ones_are_none() -> None:
    volume = volume_of(VIEWS[:2], voxel_size=0.03)
    volume.meta = {"done": {"61" * 16: (2, "", "")}}  # as a server writes it: of which keyframes a map is
    left, right = (volume.crop((low, -FAR, -FAR, high, FAR, FAR)) for low, high in ((-FAR, 0), (0, FAR)))
    upper, lower = (left.crop((-FAR, -FAR, low, FAR, FAR, high)) for low, high in ((-FAR, 0), (0, FAR)))
    for part in (right, lower):
        upper.merge(part)
    assert (upper.map_hash(), upper.keyframes) == (volume.map_hash(), 2)
    with pytest.raises(MapError, match="could count twice"):
        upper.merge(lower)
    with pytest.raises(MapError, match="could count twice"):
        left.merge(lower)
    right.integrate(VIEWS[2])  # now it holds more than a part
    with pytest.raises(MapError, match="could count twice"):
        left.merge(right)


def test_a_cut_keyframe_cannot_be_retracted_and_a_new_one_comes_in() -> None:
    volume = volume_of(VIEWS[:2], voxel_size=0.03).crop((-FAR, -FAR, -FAR, FAR, FAR, 0.1))
    before = volume.map_hash()
    with pytest.raises(MapError, match="does not hold"):
        volume.retract(VIEWS[0])
    assert volume.map_hash() == before
    volume.integrate(VIEWS[2])
    volume.retract(VIEWS[2])
    assert volume.map_hash() == before


def test_nothing_is_left_of_an_empty_box() -> None:
    cropped = volume_of(VIEWS[:1], voxel_size=0.03).crop((8, 8, 8, 9, 9, 9))
    assert (cropped.stats().blocks, cropped.stats().keyframes) == (0, 0)
    for box in ((0, 0, 0, 1, 1), (0, 0, 0, 0, 1, 1), (0, 0, 0, 1, 1, float("inf")), (1, 0, 0, 0, 1, 1)):
        with pytest.raises(InvalidConfig, match="x0 y0 z0 x1 y1 z1"):
            volume_of([]).crop(box)


def test_the_keyframes_of_a_cut_map_are_not_moved(tmp_path: Path) -> None:
    volume = Volume.load(make_map(tmp_path, range(3)) / state_folder.MAP_FILE)
    (one,) = volume.crop((0, -FAR, -FAR, FAR, FAR, FAR)).meta["poses"]["sessions"].values()
    assert (one["seqs"], one["unknown"]) == (b"", 3)
