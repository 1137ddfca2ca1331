# SPDX-License-Identifier: MIT
"""Saved maps as feeds: whose triangles arrive, which map is meant, and what cannot be shown."""

import time
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from keyframes_and_servers import VOLUME, pose, wall
from saved_maps import ANNA, BOB, correct, decoded, make_map, spoil_journal
from watched_surfaces import Held, ordered

from tsfusion import Volume
from tsfusion.core.errors import CheckpointError, JournalError, TsfusionError
from tsfusion.core.folder_lock import lock_folder
from tsfusion.journal import state_folder
from tsfusion.pipelines.shown import viewed_maps
from tsfusion.pipelines.shown.viewed_maps import SavedMapFeed, open_feed
from tsfusion.wire.asking.followed_map import LinkSeen

DEADLINE_S = 60.0


@pytest.fixture(scope="module")
def state(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A state folder with two maps, and a folder of a third one that was never saved."""
    state = tmp_path_factory.mktemp("state")
    make_map(state_folder.map_folder(state, "hall"), range(4))
    make_map(state_folder.map_folder(state, "yard"), range(4, 6), session=BOB)
    (state_folder.map_folder(state, "attic") / "journal").mkdir(parents=True)
    return state


@pytest.fixture(scope="module")
def feed(state: Path) -> Iterator[SavedMapFeed]:
    with closing(open_feed(state, map_name="yard")) as feed:
        yield feed


def follow(feed: SavedMapFeed, until: Callable[[Held], bool], watched: Held) -> None:
    """Take events until a condition holds and none comes any more."""
    deadline, quiet = time.monotonic() + DEADLINE_S, 0
    while not until(watched) or quiet < 3:
        assert time.monotonic() < deadline, "the feed has not come so far"
        events = feed.events(0.1)
        watched.take(events)
        quiet = 0 if events else quiet + 1


def is_whole(watched: Held) -> bool:
    return bool(watched.paths) and not watched.raw


def shows(watched: Held, volume: Volume) -> bool:
    """True if a page shows the surface of a map; where it is solved in parts, it differs by hundredths."""
    new, mesh = watched.triangles(), ordered(volume.extract_mesh())
    centres = [np.sort(one.reshape(-1, 3, 3).mean(axis=1).round(3), axis=0) for one in (new, mesh)]
    return len(new) == len(mesh) and bool(np.abs(centres[0] - centres[1]).max() < VOLUME.voxel_size / 20)


def map_of(state: Path, name: str) -> Volume:
    return Volume.load(state_folder.map_folder(state, name) / state_folder.MAP_FILE, 1)


def test_maps_are_shown_chosen_and_taken_back_in_time(state: Path, feed: SavedMapFeed) -> None:
    watched = Held()
    assert (feed.maps(), feed.title) == (["attic", "hall", "yard"], f"{state.name}, map yard")
    follow(feed, lambda seen: is_whole(seen) and bool(seen.seen), watched)
    assert feed.time_line is not None
    assert feed.time_line.keyframes == 2
    assert shows(watched, map_of(state, "yard"))
    points = watched.triangles()[:50, :3]
    volume = Volume.load(state_folder.map_folder(state, "yard") / state_folder.MAP_FILE, 1)
    assert np.array_equal(feed.weights(points), volume.sample(points, surface="raw").weight)

    feed.choose("hall")
    follow(feed, lambda seen: ANNA in seen.paths and is_whole(seen) and feed.time_line is not None, watched)
    assert shows(watched, map_of(state, "hall"))
    assert feed.time_line.keyframes == 4
    assert feed.title.endswith("map hall")

    for place in (3, 1, 0):  # the last wish counts
        feed.seek(place)
    follow(feed, lambda seen: not seen.paths and not seen.surfaces, watched)
    with pytest.raises(JournalError, match="it has: attic, hall, yard"):
        feed.choose("cellar")
    feed.choose("attic")
    follow(feed, lambda seen: any("has no map.tsf yet" in one for one in seen.problems), watched)


def test_a_map_that_a_server_has_open_says_so(tmp_path: Path) -> None:
    folder = make_map(state_folder.map_folder(tmp_path, "hall"), range(1))
    with lock_folder(folder, "map", "fuser", name=state_folder.LOCK_FILE):
        assert "view its address" in viewed_maps.find(tmp_path, None).note
    assert viewed_maps.find(tmp_path, None).note == ""


def test_a_map_that_does_not_know_its_journal_stays_at_its_time(tmp_path: Path) -> None:
    folder = make_map(tmp_path, range(2))
    Volume.load(folder / state_folder.MAP_FILE, 1).save(folder / state_folder.MAP_FILE, meta={})
    found = viewed_maps.find(folder, None)
    assert found.journal is None
    assert "no way back in time" in found.note


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda file: file.write_bytes(file.read_bytes()[:-7]), "damaged|differs|cut"),
        (lambda file: file.unlink(), "has no map.tsf yet"),
        (lambda file: (file.unlink(), (file.parents[2] / "run.json").write_text("{}")), "view that one"),
    ],
)
def test_what_cannot_be_shown_is_named(spoil: Callable[[Path], object], message: str, tmp_path: Path) -> None:
    spoil(make_map(state_folder.map_folder(tmp_path, "hall"), range(1)) / state_folder.MAP_FILE)
    with pytest.raises(TsfusionError, match=message):
        viewed_maps.find(tmp_path, None)


def test_errors_of_the_process_reach_who_opens(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="does not exist"):
        open_feed(tmp_path / "absent.tsf")


def test_a_server_that_dies_is_said_once(state: Path) -> None:
    with closing(open_feed(state, map_name="hall")) as feed:
        feed._server._process.kill()
        found: list[str] = []
        deadline = time.monotonic() + DEADLINE_S
        while viewed_maps._GONE not in found and time.monotonic() < deadline:
            found += [one.problem for one in feed.events(0.1) if isinstance(one, LinkSeen) and one.problem]
        assert found == [viewed_maps._GONE]
        assert feed.weights(np.zeros((1, 3), np.float32)) is None
        feed.seek(1)
        assert feed.events(0.0) == []


def test_a_run_has_no_other_time_and_stays_as_it_is(state: Path, tmp_path: Path) -> None:
    file = state_folder.map_folder(state, "hall") / state_folder.MAP_FILE
    (tmp_path / "map.tsf").write_bytes(file.read_bytes())
    (tmp_path / "run.json").write_text("{}")
    watched = Held()
    with closing(open_feed(tmp_path)) as feed:
        follow(feed, is_whole, watched)
        assert (feed.title, feed.maps(), feed.time_line) == (tmp_path.name, [tmp_path.name], None)
    assert watched.map == tmp_path.name
    assert shows(watched, map_of(state, "hall"))
    assert sorted(one.name for one in tmp_path.iterdir()) == ["map.tsf", "run.json"]


def test_damage_of_its_journal_is_told(tmp_path: Path) -> None:
    spoil_journal(make_map(tmp_path / "maps/hall", range(4), behind=3))
    watched = Held()
    with closing(open_feed(tmp_path)) as feed:
        follow(feed, lambda seen: any("has cost 1 keyframe" in one for one in seen.problems), watched)


def test_a_map_of_no_server(tmp_path: Path) -> None:
    made = Volume(VOLUME)
    made.integrate(decoded(wall(0)))
    made.save(tmp_path / "wall.tsf")
    watched = Held()
    with closing(open_feed(tmp_path / "wall.tsf")) as feed:
        follow(feed, lambda seen: shows(seen, made), watched)
        assert feed.time_line is None
    assert shows(watched, made)


def test_what_the_saved_map_lacks_is_fused(tmp_path: Path) -> None:
    folder = make_map(tmp_path / "maps/hall", range(5), behind=2)
    correct(folder, ANNA, 6, {1: pose(0.5), 5: pose(0.2)}, removed=[2])
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}
    watched = Held()
    with closing(open_feed(tmp_path)) as feed:
        follow(feed, lambda seen: is_whole(seen) and list(seen.paths[ANNA]) == [1, 3, 4, 5], watched)
        follow(feed, lambda seen: bool(seen.seen) and seen.seen[-1].seq == 5, watched)
        assert feed.time_line is not None
        assert feed.time_line.keyframes == 4
    assert watched.seen[-1].picture is not None
    assert watched.seen[-1].picture.startswith(b"\xff\xd8")
    assert watched.seen[-1].shape == wall().shape
    assert watched.problems[-1] == ""
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
