# SPDX-License-Identifier: MIT
"""A saved map in pieces: the same triangles, at any time of its journal."""

from pathlib import Path

import numpy as np
import pytest
from corrected_maps import fresh_map
from keyframes_and_servers import VOLUME, map_hash, pose, wall
from saved_maps import ANNA, BOB, correct, decoded, forget, make_map
from tsfusion.pipelines.shown.map_rewinding import RewoundMap
from tsfusion.pipelines.shown.piecewise_map import PiecewiseMap
from watched_surfaces import Cell, Held, ordered

from tsfusion import Volume, VolumeConfig
from tsfusion.core.config import override
from tsfusion.journal import state_folder
from tsfusion.journal.journaled_keyframes import JournaledKeyframes
from tsfusion.pipelines.shown import piecewise_map
from tsfusion.tsdf.surface import field_regularizer

RAW = override(VOLUME, surface="raw")


class Shown:
    """A map's folder, shown until there is nothing more to do."""

    def __init__(self, folder: Path) -> None:
        journaled = JournaledKeyframes(state_folder.find_journal(folder))
        self.rewound = RewoundMap(folder / state_folder.MAP_FILE, journaled)
        self.watched = Held()
        self.map = PiecewiseMap("wall", self.rewound, send=self.watched.take)
        self.map.begin()
        self.finish()

    def finish(self) -> None:
        while self.map.work():
            pass

    def seek(self, keyframes: int) -> None:
        self.map.seek(keyframes)
        self.finish()
        assert self.rewound.place == keyframes

    @property
    def volume(self) -> Volume:
        return self.rewound.volume


def of_views(views: range, config: VolumeConfig = VOLUME) -> Volume:
    volume = Volume(config)
    for view in views:
        volume.integrate(decoded(wall(view)))
    return volume


@pytest.mark.parametrize("surface", ["raw", "field", "normal"])
def test_the_cells_make_up_the_whole_mesh(
    surface: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(field_regularizer, "BATCH", 64)
    monkeypatch.setattr(piecewise_map, "CELLS", 50)
    folder = make_map(tmp_path, range(4), config=override(VOLUME, surface=surface))
    shown = Shown(folder)
    assert np.array_equal(shown.watched.triangles(), ordered(shown.volume.extract_mesh()))
    assert not shown.watched.raw
    assert shown.watched.updates > len(shown.watched.surfaces) / 50
    assert len(shown.watched.triangles()) > 1000
    assert shown.watched.problems == [""]
    assert set(shown.watched.client.values()) == {ANNA}
    assert list(shown.watched.paths[ANNA]) == [1, 2, 3, 4]


@pytest.mark.parametrize("keyframes", [0, 1, 4, 5])
def test_the_map_after_some_keyframes(keyframes: int, tmp_path: Path) -> None:
    shown = Shown(make_map(tmp_path, range(6), config=RAW))
    shown.seek(keyframes)
    fresh = of_views(range(keyframes), RAW)
    assert shown.volume.map_hash() == fresh.map_hash()
    assert shown.volume.color_hash() == fresh.color_hash()
    assert np.array_equal(shown.watched.triangles(), ordered(fresh.extract_mesh()))
    assert len(shown.watched.paths.get(ANNA, ())) == keyframes
    if keyframes:
        seen = shown.watched.seen[-1]
        assert (seen.session, seen.seq, seen.shape) == (ANNA, keyframes, wall().shape)
        assert seen.picture is not None
        assert seen.picture.startswith(b"\xff\xd8")


def test_there_and_back_again_is_the_same_map(tmp_path: Path) -> None:
    shown = Shown(make_map(tmp_path, range(8)))
    hashes, meshes = [], []
    for place in (8, 0, 8, 3, 4, 3, 8, 7, 0, 8):
        shown.seek(place)
        hashes.append((place, shown.volume.map_hash()))
        mesh = shown.volume.extract_mesh(surface="raw")
        meshes.append((place, ordered(mesh).tobytes()))
        refined = shown.watched.triangles()
        assert len(refined) == len(ordered(shown.volume.extract_mesh()))
    assert len(set(hashes)) == len({place for place, _ in hashes})
    assert len(set(meshes)) == len({place for place, _ in meshes})
    assert dict(hashes)[8] == map_hash(decoded(wall(i)) for i in range(8))


def test_after_a_walk_back_the_refined_surface_is_that_of_the_map(tmp_path: Path) -> None:
    shown = Shown(make_map(tmp_path, range(6)))
    for place in (5, 4, 5):  # keyframe by keyframe, not from the file
        shown.seek(place)
    new, fresh = shown.watched.triangles(), ordered(shown.volume.extract_mesh())
    assert len(new) == len(fresh)
    centres = [np.sort(one.reshape(-1, 3, 3).mean(axis=1).round(3), axis=0) for one in (new, fresh)]
    assert np.abs(centres[0] - centres[1]).max() < VOLUME.voxel_size / 20


def test_what_the_saved_map_lacks_is_fused(tmp_path: Path) -> None:
    folder = make_map(tmp_path, range(5), behind=2, config=RAW)
    correct(folder, ANNA, 6, {1: pose(0.5), 5: pose(0.2)}, removed=[2])
    forget(folder, ANNA, [3], 1)
    shown = Shown(folder)
    fresh = fresh_map(folder / "journal", RAW.voxel_size)
    assert shown.volume.map_hash() == fresh.map_hash()
    assert list(shown.watched.paths[ANNA]) == [1, 4, 5]
    assert "6 keyframes behind its journal" in shown.watched.problems[0]
    assert shown.watched.problems[-1] == ""
    whole = ordered(fresh.extract_mesh(surface="raw"))
    assert np.array_equal(shown.watched.triangles(), whole)
    for place in (0, 3):
        shown.seek(place)
    assert shown.volume.map_hash() == fresh.map_hash()


def test_a_keyframe_that_the_map_refused_stays_out_of_it(tmp_path: Path) -> None:
    shown = Shown(make_map(tmp_path, range(4), refused=[2], config=RAW))
    assert shown.rewound.count == 3
    for place in (0, 3):
        shown.seek(place)
    assert shown.volume.map_hash() == map_hash(decoded(wall(i)) for i in (0, 2, 3))


def test_a_record_that_cannot_be_read_any_more_is_said(tmp_path: Path) -> None:
    folder = make_map(tmp_path, range(3), config=RAW)
    shown = Shown(folder)
    for path in (folder / "journal").iterdir():
        path.unlink()
    shown.map.seek(0)
    shown.finish()
    assert shown.volume.map_hash() == Volume(RAW).map_hash()  # for which nothing has to be read
    shown.map.seek(1)
    shown.finish()
    assert "cannot" in shown.watched.problems[-1]
    assert "000001.mcap" in shown.watched.problems[-1]


def test_two_sessions_are_in_the_order_of_the_journal(tmp_path: Path) -> None:
    folder = make_map(tmp_path, range(3), config=RAW)
    make_map(folder, range(3, 5), session=BOB, client="bob", config=RAW)
    shown = Shown(folder)
    shown.seek(4)
    assert shown.watched.seen[-1].client == "bob"
    assert [len(shown.watched.paths[key]) for key in (ANNA, BOB)] == [3, 1]
    assert shown.volume.map_hash() == map_hash(decoded(wall(i)) for i in range(4))


def last_touched(keyframes: list[tuple[bytes, int]], cells: list[Cell]) -> list[bytes]:
    volume, by_version = Volume(RAW), [b""]
    for session, view in keyframes:
        volume.integrate(decoded(wall(view)))
        by_version.append(session)
    versions = volume.surface.cell_versions(np.array(cells, np.int32))[1]
    return [by_version[version] for version in versions.tolist()]


@pytest.mark.parametrize("place", [6, 5, 2])
def test_whose_keyframe_touched_a_cell_last(place: int, tmp_path: Path) -> None:
    folder = make_map(tmp_path, [0, 12], config=RAW)
    make_map(folder, [13, 90], session=BOB, config=RAW)
    make_map(folder, [1, 25], config=RAW)
    keyframes = [(ANNA, 0), (ANNA, 12), (BOB, 13), (BOB, 90), (ANNA, 1), (ANNA, 25)]
    shown = Shown(folder)
    before = shown.volume.map_hash()
    shown.seek(place)
    cells = list(shown.watched.surfaces)
    found = [shown.watched.client[cell] for cell in cells]
    assert found == last_touched(keyframes[:place], cells)
    assert len(set(found)) == len({session for session, _ in keyframes[:place]})
    shown.seek(6)
    assert shown.volume.map_hash() == before


def test_a_new_wish_ends_a_long_piece_and_nothing_is_lost(tmp_path: Path) -> None:
    folder = make_map(tmp_path, range(3))
    watched, wishes = Held(), [False]
    journaled = JournaledKeyframes(state_folder.find_journal(folder))
    rewound = RewoundMap(folder / state_folder.MAP_FILE, journaled)
    shown = PiecewiseMap("wall", rewound, send=watched.take, attend=lambda: wishes[0])
    while not watched.paths:  # the raw surface is there then
        assert shown.work()
    wishes[0] = True
    assert shown.work()
    assert watched.raw == set(watched.surfaces)
    wishes[0] = False
    while shown.work():
        pass
    assert np.array_equal(watched.triangles(), ordered(rewound.volume.extract_mesh()))


def test_weights_are_those_of_the_map(tmp_path: Path) -> None:
    shown = Shown(make_map(tmp_path, range(2), config=RAW))
    points = shown.volume.extract_mesh().vertices[:100]
    weights = shown.map.weights(points)
    assert weights is not None
    assert np.array_equal(weights, shown.volume.sample(points, surface="raw").weight)
    assert weights.min() > 0
