# SPDX-License-Identifier: MIT
"""Saved maps as feeds: whose triangles arrive, which map is meant, and what cannot be shown."""

import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from saved_maps import ANNA, BOB, make_map
from watched_surfaces import Held, ordered

from tsfusion import Volume
from tsfusion.core.errors import CheckpointError, JournalError, TsfusionError
from tsfusion.core.folder_lock import lock_folder
from tsfusion.journal import state_folder
from tsfusion.pipelines.shown import view_process, viewed_maps
from tsfusion.pipelines.shown.viewed_maps import Open, Opened, SavedMapFeed, Took, open_feed
from tsfusion.wire.asking.map_events import LinkSeen, SurfaceUpdate

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
    with pytest.MonkeyPatch.context() as patch, closing(open_feed(state, map_name="yard")) as feed:
        patch.setattr("tsfusion.pipelines.shown.viewed_maps._ANSWER_S", DEADLINE_S)
        yield feed


def follow(feed: SavedMapFeed, until: Callable[[Held], bool], watched: Held) -> None:
    deadline = time.monotonic() + DEADLINE_S
    while not until(watched):
        assert time.monotonic() < deadline, "the feed has not come so far"
        watched.take(feed.events(0.1))


def is_whole(watched: Held) -> bool:
    return bool(watched.paths) and not watched.raw


def mesh_of(state: Path, name: str) -> Any:
    file = state_folder.map_folder(state, name) / state_folder.MAP_FILE
    return ordered(Volume.load(file, 1).extract_mesh())


def test_maps_are_shown_chosen_and_taken_back_in_time(state: Path, feed: SavedMapFeed) -> None:
    watched = Held()
    assert (feed.maps(), feed.title) == (["attic", "hall", "yard"], f"{state.name}, map yard")
    assert feed.time_line is not None
    assert feed.time_line.keyframes == 2
    follow(feed, is_whole, watched)
    assert np.array_equal(watched.triangles(), mesh_of(state, "yard"))
    points = watched.triangles()[:50, :3]
    volume = Volume.load(state_folder.map_folder(state, "yard") / state_folder.MAP_FILE, 1)
    assert np.array_equal(feed.weights(points), volume.sample(points, surface="raw").weight)

    feed.choose("hall")
    follow(feed, lambda seen: ANNA in seen.paths and is_whole(seen), watched)
    assert np.array_equal(watched.triangles(), mesh_of(state, "hall"))
    assert feed.time_line.keyframes == 4
    assert feed.title.endswith("map hall")

    for place in (3, 1, 0):  # the last wish counts
        feed.seek(place)
    follow(feed, lambda seen: not seen.paths, watched)
    assert not len(watched.triangles())
    with pytest.raises(JournalError, match="it has: attic, hall, yard"):
        feed.choose("cellar")
    feed.choose("attic")
    follow(feed, lambda seen: any("has no map.tsf yet" in one for one in seen.problems), watched)


def test_a_map_that_a_server_has_open_says_so(tmp_path: Path) -> None:
    folder = make_map(state_folder.map_folder(tmp_path, "hall"), range(1))
    with lock_folder(folder, "map", "fuser", name=state_folder.LOCK_FILE):
        assert "view its address" in view_process.find(tmp_path, None).note
    assert view_process.find(tmp_path, None).note == ""


def test_a_map_that_does_not_know_its_journal_stays_at_its_time(tmp_path: Path) -> None:
    folder = make_map(tmp_path, range(2))
    Volume.load(folder / state_folder.MAP_FILE, 1).save(folder / state_folder.MAP_FILE, meta={})
    found = view_process.find(folder, None)
    assert found.journaled is None
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
        view_process.find(tmp_path, None)


def test_errors_of_the_process_reach_who_opens(tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="does not exist"):
        open_feed(tmp_path / "absent.tsf")


def test_a_process_that_dies_is_said_once(state: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with closing(open_feed(state, map_name="hall")) as feed:
        feed._process.kill()
        found: list[str] = []
        deadline = time.monotonic() + DEADLINE_S
        while not found and time.monotonic() < deadline:
            found += [one.problem for one in feed.events(0.1) if isinstance(one, LinkSeen) and one.problem]
        assert found == [viewed_maps._GONE]
        assert feed.weights(np.zeros((1, 3), np.float32)) is None
        feed.seek(1)
        assert feed.events(0.0) == []


class Page:
    """The other end of the process's connection: it takes nothing until the process waits."""

    def __init__(self, path: Path) -> None:
        self.messages = deque[object]([Open(0, path, None)])
        self.held = self.most = self.waits = 0
        self.sent: list[Any] = []

    def poll(self, timeout: float | None) -> bool:
        if timeout is None and not self.messages:
            self.waits += 1
            if not self.held:
                raise EOFError  # all was taken: the page is closed
            self.messages.append(Took(self.held))
            self.held = 0
        return bool(self.messages)

    def recv(self) -> object:
        return self.messages.popleft()

    def send(self, message: Any) -> None:
        self.sent.append(message)
        self.held += getattr(message, "nbytes", 0)
        self.most = max(self.most, self.held)


def test_triangles_wait_for_a_slow_page(state: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(view_process, "_MOST_BYTES", 100_000)
    monkeypatch.setattr("tsfusion.pipelines.shown.piecewise_map.CELLS", 20)
    page = Page(state)
    view_process._Viewing(page).run()  # type: ignore[arg-type]
    assert isinstance(page.sent[0], Opened)
    assert page.sent[0].name == "hall"
    updates = [one for message in page.sent[1:] for one in message.events if isinstance(one, SurfaceUpdate)]
    largest = max(message.nbytes for message in page.sent[1:])
    assert len(updates) > 5
    assert page.waits > 1
    assert page.most <= 100_000 + largest
    watched = Held()
    watched.take(updates)
    assert np.array_equal(watched.triangles(), mesh_of(state, "hall"))


def test_a_run_has_no_other_time(state: Path, tmp_path: Path) -> None:
    file = state_folder.map_folder(state, "hall") / state_folder.MAP_FILE
    (tmp_path / "map.tsf").write_bytes(file.read_bytes())
    (tmp_path / "run.json").write_text("{}")
    page = Page(tmp_path)
    view_process._Viewing(page).run()  # type: ignore[arg-type]
    assert (page.sent[0].name, page.sent[0].time_line) == (tmp_path.name, None)
    watched = Held()
    for message in page.sent[1:]:
        watched.take(message.events)
    assert np.array_equal(watched.triangles(), mesh_of(state, "hall"))
