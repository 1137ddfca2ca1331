# SPDX-License-Identifier: MIT
"""A client's connections: cut, made anew, turned away by their keys; and the states of its link."""

import time
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
import zmq
from clients_and_spools import joined, send_all
from keyframes_and_servers import DEADLINE, until, wall
from scripted_server import ScriptedServer, bind, scripted

from tsfusion import Client
from tsfusion.core.config import ClientConfig
from tsfusion.core.errors import FlushTimeout, InvalidConfig, NotAllowed, ServerUnreachable
from tsfusion.delivery.outbox import LinkKind, LinkState, Outbox
from tsfusion.delivery.sender import Sender
from tsfusion.delivery.spool import Spool
from tsfusion.wire.keys import key_folder
from tsfusion.wire.messages.messages import PROTOCOL_VERSION, Welcome
from tsfusion.wire.records import codec
from tsfusion.wire.sockets import sockets
from tsfusion.wire.sockets.connection import ServerLink
from tsfusion.wire.sockets.curve import server_keys

PATIENT = ClientConfig(stall_timeout=1000.0, policy="spool_all")


class Pair:
    """A key in a file, as `tsfusion keys new` makes it."""

    def __init__(self, folder: Path, name: str) -> None:
        self.public = key_folder.create_pair(folder / name, name).public
        self.file = folder / name / f"{name}.key_secret"

    def joined(self, server: ScriptedServer) -> Client:
        assert server.keys is not None
        return joined(server, key=self.file, server_key=server.keys.public)


@pytest.fixture
def robot(tmp_path: Path) -> Pair:
    return Pair(tmp_path, "robot")


@pytest.fixture
def keyed(tmp_path: Path, robot: Pair) -> Iterator[ScriptedServer]:
    key_folder.create_pair(tmp_path / "keys", "server")
    keys = server_keys(tmp_path / "keys")
    with scripted(keys=keys, allowed={robot.public: "robot"}) as server:
        yield server


# --- cut ---


def test_what_a_cut_took_is_sent_again_at_once() -> None:
    """Not after a stall: the connection's end is noticed."""
    with scripted(taking=False, same_epoch=True) as server, joined(server, config=PATIENT) as client:
        send_all(client, range(20))
        until(lambda: client._outbox.outstanding == server.window)
        server.stop()  # with eight keyframes in its memory
        server.taking = True
        server.start()
        client.flush(DEADLINE)
        client.wait_fused(DEADLINE)
        assert server.numbers == [*range(20)]


class Carrier:
    """A connection of a sender, in a state that a test gives it."""

    problem, finds_nobody, ended = "", False, False
    monitor = SimpleNamespace(refused=False, connected=True)

    def __init__(self) -> None:
        self.socket = self
        self.sent: list[list[Any]] = []
        self.is_full = False

    def check(self, _now: float) -> tuple[None, bool]:
        return None, self.ended

    def send_multipart(self, frames: list[Any], *_: object, **__: object) -> None:
        if self.is_full:
            raise zmq.Again
        self.sent.append(frames)


@pytest.fixture
def sender(tmp_path: Path) -> Iterator[tuple[Sender, Outbox, Carrier]]:
    """A sender with three keyframes, let in; its outbox; its connection for them."""
    outbox = Outbox(Spool(tmp_path, 1 << 20))
    for i in range(3):
        frames = codec.encode(
            wall(i), session=outbox.spool.session, seq=outbox.spool.next_seq, jpeg_quality=90
        )
        outbox.add(outbox.spool.write(frames), wall(i))
    sender, carrier = Sender("", "", outbox, PATIENT), Carrier()
    sender._control, sender._data = cast("Any", Carrier()), cast("Any", carrier)
    sender._control_session.welcome = Welcome("epoch", PROTOCOL_VERSION, 0, 0, 2, 1 << 20, 1 << 20)
    sender._control_session.clock.add(1, 2, 2, 3)
    yield sender, outbox, carrier
    sender._waker.close()
    sender._woken.close()
    outbox.close()


def test_what_was_under_way_over_the_keyframes_connection_alone_is_sent_again(
    sender: tuple[Sender, Outbox, Carrier],
) -> None:
    """A server may make that one anew, and nothing tells what it took of it."""
    its, outbox, carrier = sender
    its._pump(1.0)
    assert (len(carrier.sent), outbox.outstanding) == (2, 2)
    its._watch_connections(1.0)
    assert outbox.outstanding == 2
    carrier.ended = True
    its._watch_connections(1.0)
    assert outbox.outstanding == 0


def test_what_a_full_connection_does_not_take_may_be_dropped(sender: tuple[Sender, Outbox, Carrier]) -> None:
    its, outbox, carrier = sender
    carrier.is_full = True
    its._pump(1.0)
    assert its._blocked
    assert outbox.drop_oldest()
    assert [entry.seq for entry in outbox.spool.waiting] == [2, 3]


def test_the_connection_after_a_cut_is_news_as_well() -> None:
    """For a moment after the cut libzmq still takes messages, and they are lost."""
    with zmq.Context() as context:
        server = sockets.pull(context, 1 << 20)
        server.bind("tcp://127.0.0.1:*")
        address = server.getsockopt_string(zmq.LAST_ENDPOINT)
        with closing(ServerLink(context, sockets.push, address, None)) as connection:
            cuts: list[bool] = []

            def news() -> int:
                cuts.append(connection.check(time.monotonic())[1])
                return sum(cuts)

            until(lambda: news() == 0 and connection.monitor.connected)
            server.close()
            until(lambda: news() == 1)
            with sockets.pull(context, 1 << 20) as server:
                bind(server, address)
                until(lambda: news() == 2)
            assert connection.monitor.connected


def test_a_lost_server_is_named_once_and_so_is_its_return(caplog: pytest.LogCaptureFixture) -> None:
    caplog.set_level("INFO", logger="tsfusion")
    with scripted() as server, joined(server, config=PATIENT) as client:
        send_all(client, range(3))
        client.flush(DEADLINE)
        server.stop()
        until(lambda: "is gone; keyframes wait in" in caplog.text)
        send_all(client, range(3, 5))
        assert "again" not in caplog.text
        server.start()
        client.flush(DEADLINE)
        until(lambda: "answers again; 2 keyframes wait for it" in caplog.text)
        assert caplog.text.count("is gone") == 1


def test_a_silent_server_is_named(caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch) -> None:
    caplog.set_level("INFO", logger="tsfusion")
    monkeypatch.setattr("tsfusion.delivery.sender._LEAST_SILENCE", 0.5)
    impatient = ClientConfig(stall_timeout=0.5)
    with scripted() as server, joined(server, config=impatient) as client:
        send_all(client, range(3))
        client.flush(DEADLINE)
        server.deaf = True
        until(lambda: "is silent; keyframes wait in" in caplog.text)
        server.deaf = False
        until(lambda: "answers again; 0 keyframes wait" in caplog.text)


def test_a_server_that_comes_and_goes_gets_everything_once() -> None:
    with scripted() as server, joined(server, config=PATIENT) as client:
        for life in range(4):
            send_all(client, range(10 * life, 10 * life + 10))
            until(lambda life=life: len(server.taken) >= 10 * life + 5)
            server.stop()
            server.start()
        client.flush(DEADLINE)
        assert server.numbers == [*range(40)]


@pytest.mark.parametrize("shown", [-(1 << 63), (1 << 64) - 1, 1 << 62])
def test_a_server_with_an_impossible_clock_does_no_harm(shown: int) -> None:
    with scripted(clock=lambda: shown) as server, joined(server, config=PATIENT) as client:
        client.send(wall())
        until(lambda: len(server.pings) > 2)
        with pytest.raises(ServerUnreachable, match="the server is behind"):
            client.connect(0.1)
        server.clock = time.monotonic_ns
        client.flush(DEADLINE)
        assert server.numbers == [0]


# --- keys ---


def test_a_client_with_keys_delivers(keyed: ScriptedServer, robot: Pair) -> None:
    with robot.joined(keyed) as client:
        client.connect(DEADLINE)
        send_all(client, range(5))
        client.flush(DEADLINE)
        assert keyed.numbers == [*range(5)]


def test_an_unknown_key_is_told_and_let_in_when_it_is_known(
    keyed: ScriptedServer, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    other = Pair(tmp_path, "other")
    with other.joined(keyed) as client:
        client.send(wall())
        with pytest.raises(NotAllowed, match=r"does not know this client's key .* run `tsfusion keys allow"):
            client.connect(DEADLINE)  # at once
        with pytest.raises(FlushTimeout, match=r"1 keyframe not acknowledged .* does not know this"):
            client.flush(0.1)
        keyed.allowed[other.public] = "other"
        client.flush(DEADLINE)
        client.connect(DEADLINE)
        assert keyed.numbers == [0]
    assert caplog.text.count("does not know") == 1


def test_a_revoked_key_is_told_and_keeps_its_keyframes(keyed: ScriptedServer, robot: Pair) -> None:
    with robot.joined(keyed) as client:
        client.send(wall())
        client.flush(DEADLINE)
        keyed.allowed.clear()
        keyed.stop()
        keyed.start()
        client.send(wall(1))
        with pytest.raises(NotAllowed, match="or it was revoked"):
            until(lambda: client.connect(DEADLINE) is not None)
        assert (client.stats.waiting, client.connected, keyed.numbers) == (1, False, [0])


def test_the_wrong_server_is_not_talked_to(keyed: ScriptedServer, tmp_path: Path, robot: Pair) -> None:
    wrong = Pair(tmp_path, "wrong")
    with joined(keyed, key=robot.file, server_key=wrong.public) as client:
        client.send(wall())
        with pytest.raises(ServerUnreachable, match="the server's key is not the one given"):
            client.connect(1.0)
    assert keyed.taken == []


def test_one_side_without_keys_is_told_so(keyed: ScriptedServer, robot: Pair) -> None:
    with joined(keyed) as client, pytest.raises(NotAllowed, match="takes only connections with keys"):
        client.connect(DEADLINE)
    with (
        scripted() as plain,
        joined(plain, key=robot.file, server_key=keyed.keys.public) as client,
        pytest.raises(NotAllowed, match="was started without: leave them out"),
    ):
        client.connect(DEADLINE)


def test_keys_of_no_use_are_clear_errors(keyed: ScriptedServer, tmp_path: Path, robot: Pair) -> None:
    with pytest.raises(InvalidConfig, match="key needs server_key, too"):
        joined(keyed, key=robot.file)
    with pytest.raises(InvalidConfig, match="cannot read the key"):
        Client(keyed.address, key=tmp_path / "none", server_key=robot.public)
    robot.file.chmod(0o644)
    with pytest.raises(InvalidConfig, match="others can read the secret key"):
        Client(keyed.address, key=robot.file, server_key=robot.public)


# --- states ---

STATES: list[LinkState] = [
    LinkState(),
    LinkState("connecting", "no route"),
    LinkState("connected"),
    LinkState("held", "the disk is full"),
    LinkState("opening", "the map is being opened"),
    LinkState("refused", "another version"),
    LinkState("locked_out", "no such key"),
    LinkState("silent"),
]


@pytest.mark.parametrize("state", STATES, ids=str)
def test_a_server_that_lets_us_in_and_answers_is_connected(state: LinkState) -> None:
    assert state.welcomed().answered() == LinkState("connected")


def test_who_is_refused_stays_so_until_a_welcome() -> None:
    for refused in (LinkState("refused", "why"), LinkState("locked_out", "why")):
        assert refused.is_refused
        for next_one in (refused.answered(), refused.held("x"), refused.moved(), refused.silent()):
            assert next_one == refused
    assert LinkState("locked_out", "why").reachable("why") == LinkState()
    assert LinkState("refused", "why").reachable("another problem") == LinkState("refused", "why")


def kinds_after(event: str, *arguments: str) -> list[LinkKind]:
    return [getattr(state, event)(*arguments).kind for state in STATES]


def test_silence_a_hold_and_progress() -> None:
    assert kinds_after("silent") == [
        *("connecting", "connecting", "silent", "silent", "silent", "refused", "locked_out", "silent")
    ]
    assert kinds_after("held", "slower") == [*["held"] * 5, "refused", "locked_out", "held"]
    assert kinds_after("moved") == [
        *("connecting", "connecting", "connected", "connected", "opening", "refused", "locked_out", "silent")
    ]
    assert kinds_after("answered") == [
        *("connected", "connected", "connected", "held", "opening", "refused", "locked_out", "connected")
    ]


def test_only_connected_and_held_servers_count_as_connected() -> None:
    assert [state.kind for state in STATES if state.is_connected] == ["connected", "held"]
    assert LinkState("connecting", "no route").misunderstood("noise").why == "no route"
    assert LinkState().misunderstood("noise") == LinkState("connecting", "noise")
