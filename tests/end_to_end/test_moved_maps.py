# SPDX-License-Identifier: MIT
"""A live map that moves between two servers while a client sends: no keyframe lost, none twice, one hash."""

import os
import signal
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Any

import pytest
from command_processes import Here
from keyframes_and_servers import DEADLINE, Server, lasting_address, map_hash, pose, serving, until, wall
from quick_fusers import SUMS
from sum_map import SumMap, hash_of

from tsfusion import Client, MapClient, journal
from tsfusion.core.config import ClientConfig
from tsfusion.core.errors import TransportError
from tsfusion.geometry import map_questions
from tsfusion.journal import state_folder
from tsfusion.wire.asking import queries
from tsfusion.wire.asking.followed_map import MapEvent, SurfaceUpdate
from tsfusion.wire.asking.map_watcher import MapWatcher

QUICK = ClientConfig(stall_timeout=0.5)
FEW = 12


class Sender:
    """A client that sends keyframes one after the other from a thread of its own, until `end`."""

    def __init__(self, address: str, folder: Path) -> None:
        self.client = Client(address, spool=folder, config=QUICK, policy="spool_all")
        self.count = 0
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._send)
        self._thread.start()

    def _send(self) -> None:
        while not self._stopping.wait(0.05):
            assert self.client.send(wall(self.count % 40)) is not None
            self.count += 1

    def end(self) -> list[int]:
        """End, when all is fused; which keyframes were sent."""
        self._stopping.set()
        self._thread.join()
        self.client.wait_fused(DEADLINE)
        self.client.close()
        return [i % 40 for i in range(self.count)]


@contextmanager
def sending(tmp_path: Path, **settings: Any) -> Iterator[tuple[Server, Server, Sender]]:
    """Two servers, and a client that has sent some keyframes to the first."""
    with serving(tmp_path / "one", **settings) as one, serving(tmp_path / "two", **settings) as two:
        sender = Sender(one.address, tmp_path / "spool")
        try:
            until(lambda: sender.client.stats.durable >= FEW)
            yield one, two, sender
        finally:
            sender._stopping.set()
            sender._thread.join()
            sender.client.close()


def acknowledged_more(sender: Sender) -> None:
    """Wait until the server has some more keyframes."""
    before = sender.client.stats.durable
    until(lambda: sender.client.stats.durable >= before + FEW)


def see(watcher: MapWatcher, reached: Callable[[], bool]) -> None:
    """Wait until the watcher is somewhere, and has the map's surface from there."""
    seen: list[MapEvent] = []

    def has_surface() -> bool:
        seen.extend(watcher.events(0.1))
        return reached() and any(isinstance(event, SurfaceUpdate) for event in seen)

    until(has_surface)


def journaled(state: Path) -> Counter[int]:
    """How often each number is in the journal of the default map."""
    folder = state_folder.map_folder(state, "default") / state_folder.JOURNAL_FOLDER
    if not folder.exists():
        return Counter()
    records = (journal.list_records(journal.segment_path(folder, one))[0] for one in journal.segments(folder))
    return Counter(record.seq for found in records for record in found)


def check_map(state: Path, sent: list[int]) -> None:
    """The map of sums in a state folder is that of these keyframes, each once."""
    assert journaled(state) == Counter(range(1, len(sent) + 1))
    saved = SumMap.load(state_folder.map_folder(state, "default") / state_folder.MAP_FILE)
    assert saved.map_hash() == hash_of(map(wall, sent))


def test_a_live_map_moves_and_every_keyframe_is_in_it_once(tmp_path: Path, here: Here) -> None:
    with sending(tmp_path) as (one, two, sender):
        with closing(MapWatcher(one.address)) as watcher:
            see(watcher, lambda: watcher.address == one.address)
            moved = here("map", "move", "default", "--from", one.address, "--to", two.address)
            assert moved.returncode == 0, moved.stderr
            assert f"map default is at {two.address}" in moved.stdout
            see(watcher, lambda: watcher.address == two.address)
        acknowledged_more(sender)
        status = here("status", "--connect", one.address, "--map", "default")
        assert status.returncode == 0, status.stdout + status.stderr
        with MapClient(one.address, timeout=map_questions.LONGEST_S) as live:
            assert live.sample([[0.0, 0.0, 1.0]]).state.keyframes >= FEW
            assert live.address == two.address
        assert len(queries.fetch_mesh(one.address).faces)
        with Client(one.address, spool=tmp_path / "late", config=QUICK) as late:  # knows the first one only
            late.send(wall(41, T_world_camera=pose(5.0)))
            late.flush(DEADLINE)
        assert queries.fetch_health(two.address).maps["default"].sessions == 2
        sent = sender.end()
        assert (one.terminate(), two.terminate()) == (0, 0)
        folder = state_folder.map_folder(tmp_path / "two", "default") / state_folder.JOURNAL_FOLDER
        assert sum(journaled(tmp_path / "two").values()) == len(sent) + 1
        assert len(journal.segments(folder)) >= 2
        expected = map_hash([*map(wall, sent), wall(41, T_world_camera=pose(5.0))])
        assert here("map", "hash", tmp_path / "two").stdout.strip() == expected
        assert (tmp_path / "one" / "moved" / "default.json").exists()


def test_a_map_comes_into_the_process_of_an_empty_one_which_gets_another(tmp_path: Path) -> None:
    """And goes back."""
    with serving(tmp_path / "one", fuser=SUMS) as one, serving(tmp_path / "two", fuser=SUMS) as two:
        with Client(one.address, spool=tmp_path / "spool", map="yard", config=QUICK) as client:
            client.send(wall(0))
            client.wait_fused(DEADLINE)
        queries.move_map("yard", one.address, two.address)
        with Client(two.address, spool=tmp_path / "other", config=QUICK) as client:
            client.send(wall(1))
            client.wait_fused(DEADLINE)
        assert {each.fuser_restarts for each in queries.fetch_health(two.address).maps.values()} == {0}
        assert queries.move_map("yard", two.address, one.address).address == one.address
        with Client(two.address, spool=tmp_path / "spool", map="yard", config=QUICK) as client:
            client.send(wall(2))
            client.wait_fused(DEADLINE)
        assert (one.terminate(), two.terminate()) == (0, 0)
    for place, name, numbers in (("one", "yard", (0, 2)), ("two", "default", (1,))):
        saved = SumMap.load(state_folder.map_folder(tmp_path / place, name) / state_folder.MAP_FILE)
        assert saved.map_hash() == hash_of(map(wall, numbers))
    assert (tmp_path / "two" / "moved" / "yard.json").exists()


def test_a_map_that_cannot_go_stays_and_goes_on(tmp_path: Path) -> None:
    with sending(tmp_path, fuser=SUMS) as (one, two, sender):
        with Client(two.address, spool=tmp_path / "other") as other:
            other.send(wall(0))
            other.flush(DEADLINE)
        with pytest.raises(TransportError, match="has a map default of its own"):
            queries.move_map("default", one.address, two.address)
        with pytest.raises(TransportError, match="no map yard is open here"):
            queries.move_map("yard", one.address, two.address)
        acknowledged_more(sender)
        sent = sender.end()
        assert one.terminate() == 0
        check_map(tmp_path / "one", sent)


_DIES_AT = """
import os, signal
from tsfusion.gateway.migration import map_arrivals, map_departures
def die(*_arguments, **_more):
    os.kill(os.getpid(), signal.SIGKILL)
{patch}
"""
_DEATHS = {
    # The giver: it wrote down that the map is the other's, and nobody heard so.
    "giver": "real = map_departures.moved_maps.put_aside; map_departures.moved_maps.put_aside = die",
    # The taker: it has all, and died before it asked for the last word.
    "taker": "map_arrivals.MapArrival._commit = die",
    # The taker again: the map is its own by the last word, and it has not opened it.
    "taker, late": "map_departures.moved_maps.install = die",
}


@pytest.mark.parametrize(
    "who", ["taker, late", *(pytest.param(one, marks=pytest.mark.nightly) for one in ("giver", "taker"))]
)
def test_a_server_that_dies_while_a_map_moves_loses_nothing(tmp_path: Path, who: str) -> None:
    addresses = {"giver": lasting_address(), "taker": lasting_address()}
    role = who.partition(",")[0]
    code = {role: _DIES_AT.format(patch=_DEATHS[who])}
    states = {name: tmp_path / name for name in addresses}
    servers = {
        name: Server(states[name], listen=address, code=code.get(name, ""), fuser=SUMS)
        for name, address in addresses.items()
    }
    sender = Sender(addresses["giver"], tmp_path / "spool")
    try:
        until(lambda: sender.client.stats.durable >= FEW)
        asked = threading.Thread(target=_try_to_move, args=(addresses,), daemon=True)
        asked.start()
        assert servers[role].process.wait(DEADLINE) == -signal.SIGKILL
        servers[role].close()
        servers[role] = Server(states[role], listen=addresses[role], fuser=SUMS)
        acknowledged_more(sender)
        sent = sender.end()
        assert [one.terminate() for one in servers.values()] == [0, 0]
        asked.join(DEADLINE)
    finally:
        sender._stopping.set()
        sender.client.close()
        for server in servers.values():
            server.close()
    holder = "giver" if who == "taker" and journaled(states["giver"]) else "taker"
    check_map(states[holder], sent)
    assert not journaled(states[{"giver": "taker", "taker": "giver"}[holder]])


def _try_to_move(addresses: dict[str, str]) -> None:
    with suppress(TransportError):
        queries.move_map("default", addresses["giver"], addresses["taker"], timeout=30.0)


def test_a_directory_tells_where_a_map_is(tmp_path: Path) -> None:
    directory = str(tmp_path / "maps.sqlite")
    with (
        serving(tmp_path / "one", fuser=SUMS, directory=directory) as one,
        serving(tmp_path / "two", fuser=SUMS, directory=directory) as two,
    ):
        with Client(one.address, spool=tmp_path / "first", map="yard", world="w") as first:
            first.send(wall(0))
            first.flush(DEADLINE)
        with Client(two.address, spool=tmp_path / "second", map="yard", world="w") as second:
            second.send(wall(1))
            second.wait_fused(DEADLINE)
        health = queries.fetch_health(one.address).maps["yard"]
        assert (health.keyframes_durable, health.sessions) == (2, 2)
        assert "yard" not in queries.fetch_health(two.address).maps
    assert os.path.exists(directory)
