# SPDX-License-Identifier: MIT
"""One coordinate frame a map: keyframes of another world are refused, whatever ends and whoever is first."""

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
from clients_and_spools import NOBODY, send_all
from idle_fuser import keeping
from keyframes_and_servers import DEADLINE, Server, connected, serving, until, wall
from quick_fusers import SUMS

from tsfusion import Client, journal
from tsfusion.core.errors import InvalidConfig, TransportError, WorldRefused
from tsfusion.journal import state_folder
from tsfusion.journal.journaled_keyframes import JournalRecording
from tsfusion.journal.recovery import recover
from tsfusion.wire.asking.queries import fetch_health, fetch_new_map
from tsfusion.wire.messages import messages
from tsfusion.wire.records import codec
from tsfusion.wire.records.record_header import unpack
from tsfusion.wire.sockets import sockets

REFUSED = r"map {} has [0-9]+ keyframes? of another session, .*: use --map \S+ or --map auto, or --same-frame"


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    with keeping(tmp_path_factory.mktemp("worlds")) as running:
        yield running


def delivered(address: str, *numbers: int, **settings: object) -> None:
    """Keyframes that the server has."""
    with Client(address, **{"policy": "spool_all", **settings}) as client:  # type: ignore[arg-type]
        client.connect(DEADLINE)
        for number in numbers:
            client.send(wall(number))
        client.flush(DEADLINE)


def refused(address: str, map_name: str = "default", **settings: object) -> str:
    """The words in which a client is turned away, at once."""
    with (
        Client(address, map=map_name, **settings) as client,  # type: ignore[arg-type]
        pytest.raises(WorldRefused, match=REFUSED.format(map_name)) as error,
    ):
        client.connect(DEADLINE)
    return str(error.value)


def worlds(state: Path, map_name: str = "default") -> list[str]:
    """The world that each journaled record names."""
    place = state_folder.find_journal(state, map_name)
    return [unpack(record.frames[0]).world for path in place.files() for record in journal.records(path)]


def test_a_map_takes_one_world_and_those_that_share_its_frame(tmp_path: Path) -> None:
    with serving(tmp_path / "state", fuser=SUMS) as server:
        delivered(server.address, 0, 1, world="a")
        assert "map default has 2 keyframes" in refused(server.address, world="b")
        refused(server.address)  # given poses: nobody knows in which frame
        delivered(server.address, 2, world="a")  # another scanner of the same world
        delivered(server.address, 3, world="c", same_frame=True)
        delivered(server.address, 4, world="c")  # its frame is known by now
        assert fetch_health(server.address).refused["world"] >= 2
        assert server.terminate() == 0
    assert worlds(tmp_path / "state") == ["a", "a", "a", "c", "c"]
    with serving(tmp_path / "state", fuser=SUMS) as server:  # from the checkpoint and the journal
        assert "map default has 5 keyframes" in refused(server.address, world="b")
        refused(server.address)
        delivered(server.address, 5, world="c")
        server.kill()
    with keeping(tmp_path / "state") as server:  # after a crash
        refused(server.address, world="b")
    place = state_folder.find_journal(tmp_path / "state")
    recover(place, tmp_path / "new/maps/default/journal", 1 << 20, lambda _done, _all: None)
    with keeping(tmp_path / "new") as server:  # from a journal that was recovered
        refused(server.address, world="b")
        delivered(server.address, 6, world="a")


def test_given_poses_share_a_map_and_a_scan_that_localises_itself_does_not(server: Server) -> None:
    delivered(server.address, 0, map="given")
    delivered(server.address, 1, map="given")
    refused(server.address, "given", world="a")
    delivered(server.address, 2, map="given", world="a", same_frame=True)


def test_records_of_an_older_client_are_given_poses(server: Server) -> None:
    """Neither its greeting nor its records name a world."""
    session = bytes(range(16))
    with (
        connected(sockets.dealer, server.control) as control,
        connected(sockets.push, server.address) as push,
    ):

        def greeted() -> bool:
            control.send(messages.encode(messages.Hello(session, messages.PROTOCOL_VERSION, "older")))
            answer = messages.decode_to_client(control.recv())
            return isinstance(answer, messages.Welcome)

        until(greeted)
        push.send_multipart(codec.encode(wall(), session=session, seq=1, map_name="older", jpeg_quality=90))
        until(lambda: fetch_health(server.address).maps["older"].keyframes_durable == 1)
    refused(server.address, "older", world="a")
    delivered(server.address, 1, map="older")


def test_of_two_scanners_that_meet_in_a_new_map_one_has_it(server: Server, tmp_path: Path) -> None:
    """Both are let in, as nobody has the map. The first keyframe decides; nothing of the other is lost."""
    with ExitStack() as stack:
        clients = [
            stack.enter_context(Client(server.address, spool=tmp_path / name, map="race", world=name))
            for name in ("a", "b")
        ]
        for client in clients:
            client.connect(DEADLINE)
        for client in clients:
            send_all(client, range(3))
        outcomes = []
        for client in clients:
            try:
                client.flush(DEADLINE)
                outcomes.append("has it")
            except WorldRefused:
                outcomes.append("is refused")
                assert (client.stats.waiting, client.stats.durable, client.stats.refused) == (3, 0, {})
        assert sorted(outcomes) == ["has it", "is refused"]
    loser = tmp_path / ("a" if outcomes[0] == "is refused" else "b")
    assert len(JournalRecording(loser)) == 3
    winner = "b" if loser.name == "a" else "a"
    assert worlds(server.state, "race") == [winner] * 3


def test_a_client_that_is_refused_later_keeps_all_and_says_so_once(
    server: Server, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    delivered(server.address, 0, map="late", world="a")
    with Client(NOBODY, spool=tmp_path, map="late", world="b") as client:
        send_all(client, range(2))  # nobody answers yet
    with Client(server.address, spool=tmp_path, map="late") as client:  # goes on in its world
        until(lambda: client.is_of_other_world)
        send_all(client, range(2, 5))
        assert client.stats.waiting == 5
    assert caplog.text.count("nothing is sent: the server at") == 1
    assert len(JournalRecording(tmp_path)) == 5
    delivered(server.address, map="late", spool=tmp_path, same_frame=True)
    assert worlds(server.state, "late") == ["a"] + ["b"] * 5


def test_that_both_share_a_frame_is_remembered_with_what_waits(server: Server, tmp_path: Path) -> None:
    delivered(server.address, 0, map="shared", world="a")
    with Client(NOBODY, spool=tmp_path, map="shared", world="b", same_frame=True) as client:
        send_all(client, range(1, 3))
    delivered(server.address, map="shared", spool=tmp_path)
    assert worlds(server.state, "shared") == ["a", "b", "b"]


def test_the_next_free_name_is_given_out_once(server: Server) -> None:
    names = [fetch_new_map(server.address, "free") for _ in range(3)]
    assert names == ["free", "free-2", "free-3"]
    delivered(server.address, 0, map="free-2", world="a")
    assert "use --map free-4 or" in refused(server.address, "free-2", world="b")
    long = "x" * 32
    assert [fetch_new_map(server.address, long) for _ in range(2)] == [long, "x" * 30 + "-2"]


def test_a_full_server_has_no_free_name(tmp_path: Path) -> None:
    with keeping(tmp_path, max_maps=1) as server:
        assert fetch_new_map(server.address) == "default"  # it is open, and nobody has it
        with pytest.raises(TransportError, match="no room for another map: 1 are open; use one"):
            fetch_new_map(server.address)


@pytest.mark.parametrize("name", ["../x", "a b", "ä", "x" * 65, "a\n"])
def test_a_world_has_a_plain_name(name: str) -> None:
    with pytest.raises(InvalidConfig, match="world must be 1 to 64 letters"):
        Client(NOBODY, world=name)
