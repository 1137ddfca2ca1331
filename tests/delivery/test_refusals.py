# SPDX-License-Identifier: MIT
"""A server that says no: to a keyframe, for a while, to the map that is asked for, to the client."""

import time
from pathlib import Path

import pytest
from clients_and_spools import NOBODY, joined, noise, send_all
from keyframes_and_servers import DEADLINE, pose, serving, until, wall
from quick_fusers import SUMS
from scripted_server import number, scripted
from sum_map import TOO_MUCH

from tsfusion import Client
from tsfusion.core.config import ClientConfig
from tsfusion.core.errors import FlushTimeout, InvalidConfig, JournalError, KeyframeRefused, ServerUnreachable
from tsfusion.delivery.spool import Spool
from tsfusion.journal.journaled_keyframes import JournalRecording
from tsfusion.wire.asking.queries import fetch_health, fetch_status
from tsfusion.wire.records import codec
from tsfusion.wire.records.record_header import unpack

# --- for a while ---


def test_a_held_client_waits_says_why_and_goes_on() -> None:
    with scripted(hold=(0.3, "disk", "the disk is full")) as server, joined(server) as client:
        send_all(client, range(3))
        until(lambda: server.held >= 3)
        with pytest.raises(FlushTimeout, match=r"takes nothing for now \(disk\): the disk is full"):
            client.flush(0.1)
        asked = server.held
        until(lambda: server.held >= asked + 3)  # it tries again by itself
        assert len(server.hellos) == 1  # and does not take it for a stall
        server.hold = None
        client.flush(DEADLINE)
        assert server.numbers == [0, 1, 2]


def test_a_hold_that_is_over_is_tried_with_one_keyframe() -> None:
    """On a robot's radio link: 8 keyframes that waited for a full disk were sent 97 times in 10 seconds."""
    with scripted() as server, joined(server) as client:
        client.send(wall(0))
        client.flush(DEADLINE)  # the window is open
        server.hold = (0.2, "disk", "the disk is full")
        send_all(client, range(1, 9))
        until(lambda: client._sender._control_session.held)
        time.sleep(0.1)  # what was under way before the hold came
        before = server.held
        began = time.monotonic()
        until(lambda: server.held >= before + 3)
        holds = (time.monotonic() - began) / 0.2 + 1
        assert server.held <= before + holds
        server.hold = None
        client.flush(DEADLINE)
        assert server.numbers == list(range(9))


def test_a_held_client_sends_nothing() -> None:
    with scripted(hold=(60.0, "disk", "the disk is full")) as server, joined(server) as client:
        client.send(wall(0))
        until(lambda: client._sender._control_session.held)
        client.send(wall(1))
        pings = len(server.pings)
        until(lambda: len(server.pings) > pings + 1)
        assert server.held == 1


@pytest.mark.parametrize("seconds", [float("nan"), float("inf"), 1e300, -5.0, 0.0])
def test_no_server_holds_a_client_for_ever_or_in_a_frenzy(seconds: float) -> None:
    with scripted(hold=(seconds, "quota", "slower")) as server, joined(server) as client:
        client.send(wall())
        until(lambda: server.held > 0)
        server.hold = None
        if seconds in (-5.0, 0.0):
            client.flush(DEADLINE)
        else:
            until(lambda: client._sender._control_session.held)
            held = client._sender._control_session._held_until - time.monotonic()
            assert 30 < held <= 60


# --- at the door ---


def test_a_denied_client_keeps_asking_and_says_why(caplog: pytest.LogCaptureFixture) -> None:
    with scripted(denial=("map", "there is no map yard, and no room for one")) as server:
        with joined(server, map="yard") as client:
            client.send(wall())
            with pytest.raises(ServerUnreachable, match="refuses this client: there is no map yard"):
                client.connect(DEADLINE)  # at once
            with pytest.raises(FlushTimeout, match="there is no map yard, and no room for one"):
                client.flush(0.1)
            assert not client.connected
            asked = len(server.hellos)
            until(lambda: len(server.hellos) >= asked + 2)
            assert {hello.map for hello in server.hellos} == {"yard"}
            server.denial = None
            client.flush(DEADLINE)
            client.connect(DEADLINE)
        assert server.numbers == [0]
    assert caplog.text.count("there is no map yard") == 1


def test_a_map_that_is_being_opened_is_no_problem() -> None:
    with scripted(denial=("opening", "wait")) as server, joined(server) as client:
        client.send(wall())
        with pytest.raises(
            ServerUnreachable, match=r"the server is opening the map default \(waited 0.2 s\)"
        ):
            client.connect(0.2)
        with pytest.raises(FlushTimeout, match="the server is opening the map default"):
            client.flush(0.1)
        server.denial = None
        client.flush(DEADLINE)
        assert server.numbers == [0]


def test_a_copied_spool_is_told_and_loses_nothing(tmp_path: Path) -> None:
    with scripted() as server, joined(server, spool=tmp_path) as client:
        client.send(wall())
        client.flush(DEADLINE)
        session = server.taken[0][0]
        server.sessions[session].durable = 500  # another scanner with our session
        with pytest.raises(
            ServerUnreachable, match="keyframe 500 of this session, which was never sent from"
        ):
            until(lambda: client.connect(0.1) is not None)
        send_all(client, range(1, 4))
        with pytest.raises(FlushTimeout, match="another scanner works with a copy of"):
            client.flush(0.2)
        assert (client.stats.durable, client.stats.waiting) == (1, 3)


# --- keyframes that are given up ---


def test_refused_keyframes_are_kept_aside_and_the_rest_arrives(tmp_path: Path) -> None:
    with scripted(refuses=lambda header: number(header) % 3 == 1) as server:
        with joined(server, spool=tmp_path, policy="spool_all") as client:
            send_all(client, range(10))
            with pytest.raises(KeyframeRefused, match=r"keyframe 2 was refused \(values\).* \(and 2 more\)"):
                client.flush(DEADLINE)
            client.flush(DEADLINE)
            assert client.stats.refused == {"values": 3}
            assert client.stats.durable == 7
        assert server.numbers == [0, 2, 3, 5, 6, 8, 9]
    kept = [keyframe.timestamp_ns - 10**9 for keyframe in JournalRecording(tmp_path / "refused")]
    assert kept == [1, 4, 7]


def test_what_is_larger_than_the_server_takes_is_not_sent(tmp_path: Path) -> None:
    """The server would end the connection, again and again."""
    with (
        scripted(max_frame_bytes=20_000) as server,
        joined(server, spool=tmp_path, policy="spool_all") as client,
    ):
        client.send(noise(0))
        client.send(wall(1))
        with pytest.raises(KeyframeRefused, match=r"\(size\): \d+ bytes, the server takes 20000"):
            client.flush(DEADLINE)
        client.flush(DEADLINE)
        assert (client.stats.refused, server.numbers) == ({"size": 1}, [1])


def test_a_real_server_refuses_some_and_fuses_the_rest(tmp_path: Path) -> None:
    """Keyframes that look from too far away are refused; what is kept aside is not sent again, by nobody."""
    spool = tmp_path / "spool"
    with serving(tmp_path / "state", fuser=SUMS, quota_extent=10.0) as server:
        with Client(server.address, spool=spool, policy="spool_all") as client:
            for i in range(12):
                client.send(wall(i, T_world_camera=pose(100.0 if i in (3, 4, 11) else 0.03 * i)))
            with pytest.raises(KeyframeRefused, match="and 2 more"):
                client.flush(DEADLINE)
            client.wait_fused(DEADLINE)
            assert client.stats.fused == 9
        with Client(server.address, spool=spool) as client:
            client.send(wall(12))
            client.wait_fused(DEADLINE)
            assert client.stats.durable == 1
        assert fetch_status(server.address).keyframes_fused == 10
        assert server.terminate() == 0
    kept = [keyframe.timestamp_ns - 10**9 for keyframe in JournalRecording(spool / "refused")]
    assert kept == [3, 4, 11]


def test_what_a_full_map_rejects_is_said_at_once(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with serving(tmp_path / "state", fuser=SUMS) as server:
        with Client(server.address, control=server.control) as client:
            for captured_ns in (0, 0, TOO_MUCH, TOO_MUCH, TOO_MUCH):
                client.send(wall(captured_ns=captured_ns))
            client.wait_fused()
            assert (client.stats.fused, client.stats.rejected) == (2, {"MapFull": 3})
        (problem,) = fetch_health(server.address).problems
    assert problem.startswith("map default: it is full, keyframes that need more room are rejected")
    told = [(one.levelname, one.getMessage()) for one in caplog.records if "is not in the map" in one.message]
    assert [(level, text[:41]) for level, text in told] == [
        ("ERROR", "keyframe 3 is not in the map (MapFull): t"),
        ("WARNING", "keyframe 4 is not in the map (MapFull): t"),
    ]


def test_what_is_kept_aside_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tsfusion.delivery.control_session.REFUSED_BYTES", 20_000)
    with (
        scripted(refuses=lambda header: True) as server,
        joined(server, spool=tmp_path, policy="spool_all") as client,
    ):
        send_all(client, range(30))
        with pytest.raises(KeyframeRefused, match="and 29 more"):
            client.flush(DEADLINE)
    files = list((tmp_path / "refused").glob("*.mcap"))
    assert sum(file.stat().st_size for file in files) <= 21_000
    assert list(JournalRecording(tmp_path / "refused"))[-1].timestamp_ns == 10**9 + 29
    with scripted() as server, joined(server, spool=tmp_path) as client:  # nobody sends these
        client.send(wall(99))
        client.flush(DEADLINE)
        assert server.numbers == [99]


# --- maps ---


def test_keyframes_say_which_map_they_are_for(tmp_path: Path) -> None:
    with Client(NOBODY, spool=tmp_path, map="yard") as client:
        client.send(wall())
        (entry,) = client._outbox.spool.waiting
        assert unpack(client._outbox.spool.read(entry)[0]).map == "yard"


def test_leftovers_for_another_map_are_not_sent_there(tmp_path: Path) -> None:
    with Client(NOBODY, spool=tmp_path, map="yard") as client:
        send_all(client, range(3))
    said = rf"{tmp_path} holds 3 keyframes for the map yard, not for hall: send them first .*map='yard'"
    with pytest.raises(JournalError, match=said):
        Client(NOBODY, spool=tmp_path, map="hall")
    with scripted() as server:
        with joined(server, spool=tmp_path, map="yard") as client:  # the folder was let go
            client.flush(DEADLINE)
        with joined(server, spool=tmp_path, map="hall") as client:
            client.send(wall(3))
            client.flush(DEADLINE)
        assert server.numbers == [0, 1, 2, 3]
        assert {hello.map for hello in server.hellos} == {"yard", "hall"}


def test_damaged_leftovers_do_not_hide_the_map_of_the_others(tmp_path: Path) -> None:
    spool = Spool(tmp_path, 1 << 20)
    spool.add(spool.write([b"rubbish", b"x"]))
    frames = codec.encode(wall(), session=spool.session, seq=spool.next_seq, map_name="yard", jpeg_quality=90)
    spool.add(spool.write(frames))
    spool.close()
    with pytest.raises(JournalError, match="keyframes for the map yard, not for default"):
        Spool(tmp_path, 1 << 20)


@pytest.mark.parametrize("name", ["", "Yard", "../x", "yard\n", "a" * 33, "-x"])
def test_a_map_has_a_plain_name(name: str) -> None:
    with pytest.raises(InvalidConfig, match="map must be"):
        Client(NOBODY, map=name)
    with pytest.raises(InvalidConfig, match="map must be"):
        Client(NOBODY, config=ClientConfig(map=name))


def test_a_policy_is_one_of_four() -> None:
    with pytest.raises(InvalidConfig, match="policy must be one of thin, block, drop_oldest, spool_all"):
        Client(NOBODY, policy="drop_newest")  # type: ignore[arg-type]
