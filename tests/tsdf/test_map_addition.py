# SPDX-License-Identifier: MIT
"""Maps of one frame add up to the map of all their keyframes, or stay as they were."""

from pathlib import Path

import numpy as np
import pytest
from formula_scenes import sphere_views, volume_of
from hypothesis import given
from hypothesis import settings as given_settings
from hypothesis import strategies as st
from keyframes_and_servers import wall
from saved_maps import ANNA, BOB, decoded, make_map

from tsfusion import Volume
from tsfusion.core.config import SERVER_SESSION
from tsfusion.core.errors import MapError, MapFull, WeightOverflow
from tsfusion.journal import state_folder
from tsfusion.journal.ledger import Ledger
from tsfusion.kernels.integration.integrate import COLOR_LIMIT, WEIGHT_LIMIT, WEIGHT_MASK
from tsfusion.tsdf.files.map_history import of_clients, sessions

VIEWS = sphere_views(0.4, 6)


def state_of(volume: Volume) -> tuple[object, ...]:
    layers = volume._store.layers()
    return (
        volume.map_hash(),
        volume.color_hash(),
        volume.keyframes,
        volume.held.numbers,
        [layer[volume._store.used()].tobytes() for layer in layers.values()],
    )


@given_settings(max_examples=12, deadline=None)
@given(parts=st.lists(st.integers(0, 2), min_size=6, max_size=6), order=st.permutations(range(3)))
def test_maps_of_any_split_add_up_to_the_map_of_all(parts: list[int], order: list[int]) -> None:
    whole = volume_of(VIEWS, voxel_size=0.03)
    volumes = [
        volume_of((view for view, part in zip(VIEWS, parts, strict=True) if part == number), voxel_size=0.03)
        for number in range(3)
    ]
    first, *others = (volumes[number] for number in order)
    for other in others:
        first.merge(other)
    assert state_of(first) == state_of(whole)
    for number, part in enumerate(parts):
        if part == 1:
            first.retract(VIEWS[number])
    rest = [view for view, part in zip(VIEWS, parts, strict=True) if part != 1]
    assert first.map_hash() == volume_of(rest, voxel_size=0.03).map_hash()


def test_a_merged_map_is_saved_meshed_and_goes_on(tmp_path: Path) -> None:
    here, there = volume_of(VIEWS[:3], voxel_size=0.03), volume_of(VIEWS[3:5], voxel_size=0.03)
    here.take_dirty()
    here.merge(there)
    assert {tuple(block) for block in there.take_dirty()} <= {tuple(block) for block in here.take_dirty()}
    here.integrate(VIEWS[5])
    whole = volume_of(VIEWS, voxel_size=0.03)
    assert Volume.load(here.save(tmp_path / "map.tsf")).map_hash() == whole.map_hash()
    assert np.array_equal(np.sort(here.extract_mesh().vertices, axis=0),
                          np.sort(whole.extract_mesh().vertices, axis=0))  # fmt: skip


def test_smoothed_values_stay_where_one_map_alone_has_the_block() -> None:
    here, there = (volume_of(views, voxel_size=0.03, regularizer="ray") for views in (VIEWS[:1], VIEWS[1:2]))
    ours, theirs = set(here._store.keys.tolist()), set(there._store.keys.tolist())
    assert ours - theirs
    assert theirs - ours
    assert ours & theirs
    before = {
        int(key): row.copy()
        for v in (there, here)
        for key, row in zip(v._store.keys, v._store.correction, strict=False)
    }
    here.merge(there)
    for key, row in zip(here._store.keys.tolist(), here._store.correction, strict=False):
        assert np.array_equal(row, np.zeros(512) if key in ours & theirs else before[key])


def test_maps_that_do_not_fit_are_refused() -> None:
    volume = volume_of(VIEWS[:1], voxel_size=0.03)
    before = state_of(volume)
    for other, words in (
        (volume, "with itself"),
        (volume_of(VIEWS[1:2], voxel_size=0.02), "0.03 m and 0.02 m"),
        (volume_of(VIEWS[1:2], voxel_size=0.03, color=False), "different layers"),
        (volume_of(VIEWS[1:2], voxel_size=0.03, regularizer="ray"), "different layers"),
    ):
        with pytest.raises(MapError, match=words):
            volume.merge(other)
        assert state_of(volume) == before


def test_a_sum_without_room_leaves_the_map_as_it_was() -> None:
    there = volume_of(VIEWS[1:4], voxel_size=0.03)
    blocks = volume_of(VIEWS[:4], voxel_size=0.03).stats().blocks
    volume = volume_of(VIEWS[:1], voxel_size=0.03, max_blocks=blocks - 1)
    before = state_of(volume)
    with pytest.raises(MapFull, match=f"together they have {blocks}"):
        volume.merge(there)
    assert state_of(volume) == before
    volume = volume_of(VIEWS[:1], voxel_size=0.03)
    volume.limit_memory(volume.stats().bytes)
    with pytest.raises(MemoryError):
        volume.merge(there)
    assert state_of(volume) == before
    volume.limit_memory(1 << 40)
    slot, voxel = np.argwhere(volume._store.sums != 0)[0]
    volume._store.sums[slot, voxel] |= WEIGHT_LIMIT - 1
    volume._store.measure_bounds()
    with pytest.raises(WeightOverflow, match="1 blocks"):
        volume.merge(volume_of(VIEWS[:1], voxel_size=0.03))
    volume.merge(volume_of(VIEWS[:1], voxel_size=0.03).crop((9, 9, 9, 10, 10, 10)))


def test_a_sum_knows_how_many_votes_its_voxels_have() -> None:
    """Else a keyframe that comes after it is added where its votes do not fit."""
    here, there = volume_of(VIEWS[:1], voxel_size=0.03), volume_of(VIEWS[:1], voxel_size=0.03)
    slot, voxel = np.argwhere(here._store.sums & WEIGHT_MASK)[0]
    row = there._store.slots_of(here._store.keys[slot : slot + 1])[0]
    one = int(here._store.sums[slot, voxel] & WEIGHT_MASK)
    there._store.sums[row, voxel] += WEIGHT_LIMIT - 1 - 2 * one
    there._store.measure_bounds()
    here.merge(there)
    assert here._store.sums[slot, voxel] & WEIGHT_MASK == WEIGHT_LIMIT - 1
    before = state_of(here)
    with pytest.raises(WeightOverflow):
        here.integrate(VIEWS[0])
    assert state_of(here) == before


def test_settled_colours_are_averaged() -> None:
    here, there = volume_of(VIEWS[:1], voxel_size=0.03), volume_of(VIEWS[:1], voxel_size=0.03)
    slot, voxel = np.argwhere(here._store.color_rgn & 65535)[0]
    key = here._store.keys[slot]
    for volume, votes, value in ((here, 20_000, 30), (there, 30_000, 80)):
        at = volume._store.slots_of(np.array([key]))[0], voxel
        volume._store.color_rgn[at] = (value * votes << 40) + (2 * value * votes << 16) + votes
        volume._store.color_b[at] = 3 * value * votes
    here.merge(there)
    rgn, blue = int(here._store.color_rgn[slot, voxel]), int(here._store.color_b[slot, voxel])
    assert rgn & 65535 == COLOR_LIMIT
    mean = [part / COLOR_LIMIT for part in (rgn >> 40, rgn >> 16 & 0xFFFFFF, blue)]
    assert mean == pytest.approx([60, 120, 180], abs=1e-4)


def loaded(folder: Path, views: range, **settings: object) -> Volume:
    return Volume.load(make_map(folder, views, **settings) / state_folder.MAP_FILE)  # type: ignore[arg-type]


def test_keyframes_that_both_maps_hold_are_not_counted_twice(tmp_path: Path) -> None:
    volume, same = loaded(tmp_path / "a", range(3)), loaded(tmp_path / "b", range(3, 5))
    before = state_of(volume)
    with pytest.raises(MapError, match=r"hold 2 keyframes of session 61616161 \(first number 1\)"):
        volume.merge(same)
    assert state_of(volume) == before
    volume.merge(loaded(tmp_path / "c", range(3, 5), session=BOB))
    assert sorted(volume.meta["done"]) == [ANNA.hex(), BOB.hex()]
    with pytest.raises(MapError, match="but no complete list of them"):
        volume.merge(same)


def test_parts_of_one_session_add_up_where_it_is_known_which(tmp_path: Path) -> None:
    """As where one map was told to forget what the other has kept."""
    folder = make_map(tmp_path / "a", range(6))
    parts = [Volume.load(folder / state_folder.MAP_FILE) for _ in range(2)]
    for part, removed in zip(parts, (range(3), range(3, 6)), strict=True):
        listed = part.meta["poses"]["sessions"][ANNA.hex()]
        fused = np.frombuffer(listed["fused"]).reshape(-1, 12).copy()
        for number in removed:
            part.retract(decoded(wall(number)))
            fused[number] = np.nan
        listed["fused"] = fused.tobytes()
        part.meta["poses"]["removed"] = 3
    one, other = parts
    one.meta["poses"]["waiting"] = [(ANNA.hex(), 5, b"")]
    one.meta["rejected"], other.meta["rejected"] = {"quota": 2}, {"quota": 1, "memory": 4}
    one.merge(other)
    assert one.map_hash() == Volume.load(folder / state_folder.MAP_FILE).map_hash()
    assert one.meta["rejected"] == {"quota": 3, "memory": 4}
    (listed,) = one.meta["poses"]["sessions"].values()
    assert (listed["unknown"], listed["missed"], one.meta["poses"]["removed"]) == (6, [5], 6)
    Ledger(one.meta["poses"])
    later = loaded(tmp_path / "b", range(6, 9), session=BOB)
    later.merge(one)
    assert later.keyframes == 9


def test_maps_of_other_worlds_are_merged_only_on_request(tmp_path: Path) -> None:
    given, found = (
        loaded(tmp_path / "a", range(3)),
        loaded(tmp_path / "b", range(3, 5), session=BOB, world="w"),
    )
    for here, there in ((given, found), (found, given)):
        with pytest.raises(MapError, match="coordinate frame of its own"):
            here.merge(there)
    given.merge(found, same_frame=True)
    given.merge(loaded(tmp_path / "c", range(5, 7), session=b"c" * 16, world="w"))
    assert [progress[2] for progress in given.meta["done"].values()] == ["", "w", "w"]
    empty = Volume(given.config)
    empty.merge(given)
    assert empty.map_hash() == given.map_hash()


def test_what_servers_forgot_neither_joins_worlds_nor_keeps_maps_apart(tmp_path: Path) -> None:
    given, found = (
        loaded(tmp_path / "a", range(3)),
        loaded(tmp_path / "b", range(3, 5), session=BOB, world="w"),
    )
    for number, volume in enumerate((given, found), 1):
        volume.meta["done"][SERVER_SESSION.hex()] = [number, "", ""]
    with pytest.raises(MapError, match="coordinate frame of its own"):
        given.merge(found)
    given.merge(found, same_frame=True)
    assert given.meta["done"][SERVER_SESSION.hex()][0] == 2
    third = loaded(tmp_path / "c", range(5, 7), session=b"c" * 16, world="w")
    third.meta["done"][SERVER_SESSION.hex()] = [1, "", ""]
    given.merge(third)
    assert sum(one.session == SERVER_SESSION.hex() for one in of_clients(sessions(given.meta))) == 0
