# SPDX-License-Identifier: MIT
"""A client's connections: cut, made anew, turned away by their keys, and what it says of that."""

import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import zmq
from clients_and_spools import joined, send_all
from keyframes_and_servers import DEADLINE, until, wall
from scripted_server import ScriptedServer, scripted

from tsfusion import Client
from tsfusion.core.config import ClientConfig
from tsfusion.core.errors import FlushTimeout, InvalidConfig, NotAllowed, ServerUnreachable
from tsfusion.wire.curve import ServerKeys

PATIENT = ClientConfig(stall_timeout=1000.0, policy="spool_all")


class Pair:
    """A key in a file, as `tsfusion keys new` makes it."""

    def __init__(self, folder: Path, name: str) -> None:
        public, secret = zmq.curve_keypair()
        self.public, self.secret = public.decode(), secret.decode()
        self.file = folder / f"{name}.key_secret"
        self.file.touch(mode=0o600)
        self.file.write_text(
            f'metadata\ncurve\n    public-key = "{self.public}"\n    secret-key = "{self.secret}"\n'
        )


@pytest.fixture
def robot(tmp_path: Path) -> Pair:
    return Pair(tmp_path, "robot")


@pytest.fixture
def keyed(tmp_path: Path, robot: Pair) -> Iterator[ScriptedServer]:
    own = Pair(tmp_path, "server")
    keys = ServerKeys(own.public, own.secret)
    with scripted(keys=keys, allowed={robot.public: "robot"}) as server:
        yield server


# --- cut ---


def test_what_a_cut_took_is_sent_again_at_once() -> None:
    """Not after a stall: the connection's end is noticed."""
    with scripted(taking=False, same_epoch=True) as server, joined(server, config=PATIENT) as client:
        send_all(client, range(20))
        until(lambda: client._outbox.outstanding == server.window)
        server.stop()  # with eight keyframes in its memory
        until(lambda: client._outbox.outstanding == 0)
        server.taking = True
        server.start()
        client.flush(DEADLINE)
        client.wait_fused(DEADLINE)
        assert server.numbers == [*range(20)]


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
    assert keyed.keys is not None
    with joined(keyed, key=robot.file, server_key=keyed.keys.public) as client:
        client.connect(DEADLINE)
        send_all(client, range(5))
        client.flush(DEADLINE)
        assert keyed.numbers == [*range(5)]


def test_an_unknown_key_is_told_and_let_in_when_it_is_known(
    keyed: ScriptedServer, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    assert keyed.keys is not None
    other = Pair(tmp_path, "other")
    with joined(keyed, key=other.file, server_key=keyed.keys.public) as client:
        client.send(wall())
        with pytest.raises(NotAllowed, match=r"does not know this client's key .* run `tsfusion keys allow"):
            client.connect(DEADLINE)  # at once
        with pytest.raises(FlushTimeout, match=r"1 keyframes are not acknowledged .* does not know this"):
            client.flush(0.1)
        keyed.allowed[other.public] = "other"
        client.flush(DEADLINE)
        client.connect(DEADLINE)
        assert keyed.numbers == [0]
    assert caplog.text.count("does not know") == 1


def test_a_revoked_key_is_told_and_keeps_its_keyframes(keyed: ScriptedServer, robot: Pair) -> None:
    assert keyed.keys is not None
    with joined(keyed, key=robot.file, server_key=keyed.keys.public) as client:
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
            client.connect(2.0)
    assert keyed.taken == []


def test_one_side_without_keys_is_told_so(keyed: ScriptedServer, robot: Pair) -> None:
    with joined(keyed) as client, pytest.raises(NotAllowed, match="takes only connections with keys"):
        client.connect(DEADLINE)
    assert keyed.keys is not None
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
