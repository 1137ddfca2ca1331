# SPDX-License-Identifier: MIT
"""Nothing of a stranger reaches journal or map: a real server with keys, and those it should not let in."""

import os
import socket
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import zmq
from clients_and_spools import QUICK, send_all
from http_requests import get
from keyframes_and_servers import DEADLINE, Server, serving, until, wall
from quick_fusers import SUMS

import tsfusion
from tsfusion import Client, MapClient
from tsfusion.core.errors import FlushTimeout, NotAllowed, TransportError
from tsfusion.journal.journaled_keyframes import JournalRecording
from tsfusion.wire.asking.queries import fetch_health, fetch_mesh, fetch_new_map, fetch_status, request
from tsfusion.wire.keys import key_folder
from tsfusion.wire.messages import messages
from tsfusion.wire.messages.messages import Command
from tsfusion.wire.messages.questions import Cells, Scans
from tsfusion.wire.records import codec
from tsfusion.wire.sockets import sockets
from tsfusion.wire.sockets.curve import ClientKeys, client_keys, server_keys


class Site:
    """A server with keys, and a folder of keys for each of its friends and enemies."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.keys = folder / "server-keys"
        self.state = folder / "state"
        key_folder.create_pair(self.keys, "server")
        self.public = server_keys(self.keys).public
        for name in ("robot", "cart", "guest", "stranger"):
            key_folder.create_pair(folder / name, name)
        for name in ("robot", "cart"):
            key_folder.allow(self.keys, name, str(folder / name / f"{name}.key"))
        key_folder.allow(self.keys, "guest", str(folder / "guest/guest.key"), maps=["yard-*", "shed"])

    def key_file(self, name: str) -> Path:
        return self.folder / name / f"{name}.key_secret"

    def of(self, name: str) -> ClientKeys:
        made = client_keys(str(self.key_file(name)), self.public)
        assert made is not None
        return made

    def client(self, server: Server, name: str, spool: Path | None = None, **more: str) -> Client:
        return Client(
            server.address, spool=spool, key=self.key_file(name), server_key=self.public, config=QUICK, **more
        )


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Site:
    return Site(tmp_path_factory.mktemp("site"))


@pytest.fixture(scope="module")
def server(site: Site) -> Iterator[Server]:
    with serving(site.state, keys=str(site.keys)) as made:
        yield made


class Raw:
    """Data and control sockets without a client's manners."""

    def __init__(self, server: Server, own: ClientKeys | None) -> None:
        self._context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self.push = sockets.push(self._context, keys=own)
        self.dealer = sockets.dealer(self._context, keys=own)
        self.push.connect(server.address)
        self.dealer.connect(server.control)

    def __enter__(self) -> "Raw":
        return self

    def __exit__(self, *_: object) -> None:
        self.push.close()
        self.dealer.close()
        self._context.term()

    def send(self, frames: list[bytes]) -> None:
        assert self.push.poll(10_000, zmq.POLLOUT)
        self.push.send_multipart(frames, zmq.NOBLOCK)

    def say(self, message: messages.ToServer) -> messages.ToClient:
        assert self.dealer.poll(10_000, zmq.POLLOUT)
        self.dealer.send(messages.encode(message))
        assert self.dealer.poll(10_000)
        return messages.decode_to_client(self.dealer.recv())


def refused(server: Server, site: Site) -> int:
    """Messages for a session of another client."""
    return fetch_health(server.address, keys=site.of("cart")).refused.get("session", 0)


def test_the_allowed_come_in_and_their_name_is_in_the_journal(site: Site, server: Server) -> None:
    with site.client(server, "robot") as client:
        client.connect()
        client.send(wall(0, captured_ns=time.monotonic_ns()))
        client.wait_fused(timeout=DEADLINE)
        health = fetch_health(server.address, keys=site.of("robot"))
        assert {one.client for one in health.clients} == {"robot"}
    assert len(fetch_mesh(server.address, min_weight=0.5, keys=site.of("cart")).faces) > 0
    assert sampled(server.address, "default", site.of("cart")) == 1
    journal = site.state / "maps/default/journal"
    (found,) = tsfusion.journal.list_records(journal / "000001.mcap")[0]
    assert found.client == "robot"


@pytest.mark.parametrize(
    ("who", "why"),
    [
        (lambda site: site.of("stranger"), "does not know"),
        (lambda _: None, "keys"),
        (lambda site: ClientKeys(*_pair(site.of("robot")), site.of("stranger").public), "key"),
    ],
    ids=["not-allowed", "no-keys", "wrong-server-key"],
)
def test_strangers_stay_out_and_are_told_why(site: Site, server: Server, who: object, why: str) -> None:
    own = who(site)  # type: ignore[operator]
    before = fetch_health(server.address, keys=site.of("robot"))
    with pytest.raises(TransportError, match=why):
        fetch_status(server.address, timeout=1.0, keys=own)
    with Raw(server, own) as raw:
        assert not raw.push.poll(500, zmq.POLLOUT)  # no connection: nothing can be sent
        assert not raw.dealer.poll(200, zmq.POLLOUT)
    after = fetch_health(server.address, keys=site.of("robot"))
    assert after.maps["default"].keyframes_durable == before.maps["default"].keyframes_durable


def _pair(own: ClientKeys) -> tuple[str, str]:
    return own.public, own.secret


def test_anothers_session_is_not_to_be_had(site: Site, server: Server) -> None:
    """The cart is allowed, and knows the robot's session: it can neither add to it, nor have it refused."""
    with site.client(server, "robot") as client:
        client.send(wall(2))
        client.wait_fused(timeout=DEADLINE)
        session = client._outbox.spool.session
        before = fetch_health(server.address, keys=site.of("robot"))
        with Raw(server, site.of("cart")) as cart:
            denied = cart.say(messages.Hello(session, messages.PROTOCOL_VERSION))
            assert isinstance(denied, messages.Denied)
            assert (denied.reason, "another client's" in denied.message) == ("session", True)
            good = codec.encode(wall(3), session=session, seq=2, jpeg_quality=90)
            cart.send(good)
            cart.send([good[0], good[1][:-1] + b"x", good[2]])
            cart.send(codec.encode(wall(2), session=session, seq=1, jpeg_quality=90))
            until(lambda: refused(server, site) >= before.refused.get("session", 0) + 3)
            pong = cart.say(messages.Ping(session, 1, skipped={"forged": 1}))
            assert isinstance(pong, messages.Pong)
            assert pong.durable == 0
        client.send(wall(4))
        client.wait_fused(timeout=DEADLINE)
        assert (client.stats.fused, client.stats.refused) == (2, {})
        after = fetch_health(server.address, keys=site.of("robot"))
        assert after.maps["default"].keyframes_durable == before.maps["default"].keyframes_durable + 1
        assert all("forged" not in one.skipped for one in after.clients)


def test_a_replayed_message_counts_once(site: Site, server: Server) -> None:
    before = fetch_health(server.address, keys=site.of("cart"))
    frames = codec.encode(wall(5), session=os.urandom(16), seq=1, jpeg_quality=90)
    with Raw(server, site.of("cart")) as cart:
        for _ in range(3):
            cart.send(frames)
        until(lambda: fetch_health(server.address, keys=site.of("cart")).duplicates == before.duplicates + 2)
    with Raw(server, site.of("robot")) as thief:  # taken off a disk, say
        thief.send(frames)
        until(lambda: refused(server, site) > before.refused.get("session", 0))
    after = fetch_health(server.address, keys=site.of("cart"))
    assert after.maps["default"].keyframes_durable == before.maps["default"].keyframes_durable + 1


# --- a key for some maps ---


def test_a_key_for_some_maps_sends_into_no_other(site: Site, server: Server) -> None:
    with site.client(server, "robot") as robot:
        robot.send(wall(20))
        robot.wait_fused(timeout=DEADLINE)
    before = fetch_health(server.address, keys=site.of("robot"))
    why = "this key may not use map default, but: yard-\\*, shed"
    with site.client(server, "guest") as guest, pytest.raises(TransportError, match=why):
        guest.connect(timeout=5)
    with Raw(server, site.of("guest")) as raw:
        for name in ("default", "yard", "attic"):  # one that is there, and others
            denied = raw.say(messages.Hello(os.urandom(16), messages.PROTOCOL_VERSION, map=name))
            assert isinstance(denied, messages.Denied)
            assert (denied.reason, denied.message) == ("map", why.replace("default", name).replace("\\", ""))
        raw.send(codec.encode(wall(21), session=os.urandom(16), seq=1, jpeg_quality=90))

        def refused_now() -> int:
            counts = fetch_health(server.address, keys=site.of("robot")).refused
            return counts["forbidden"] - before.refused.get("forbidden", 0)

        until(lambda: refused_now() >= 4)
    after = fetch_health(server.address, keys=site.of("robot"))
    assert after.maps["default"].keyframes_durable == before.maps["default"].keyframes_durable
    assert set(after.maps) == set(before.maps)
    with site.client(server, "guest", map="yard-1") as guest:
        guest.send(wall(22))
        guest.wait_fused(timeout=DEADLINE)
        assert guest.stats.fused == 1


def sampled(address: str, map_name: str, keys: ClientKeys) -> int:
    """Keyframes of a map that answers a question."""
    with MapClient(address, map_name, keys=keys, timeout=DEADLINE / 4) as asked:
        return asked.sample([[0.0, 0.0, 1.0]]).state.keyframes


def watched(address: str, map_name: str, keys: ClientKeys) -> bool:
    """Ask as a viewer does, first for cells, then for what scanners see. True if both come."""
    replies = []
    for question in (Cells(wait_s=0.0), Scans(wait_s=0.0)):
        command = Command(name="ask", map=map_name, question=question, timeout_s=DEADLINE / 4)
        replies.append(request(address, command, timeout=DEADLINE, keys=keys)[0].answer)
    return None not in replies


def test_a_key_for_some_maps_is_told_of_no_other(site: Site, server: Server) -> None:
    with site.client(server, "robot") as robot, site.client(server, "guest", map="yard-1") as guest:
        robot.connect()
        guest.connect()
        seen = fetch_health(server.address, keys=site.of("guest"))
        assert (set(seen.maps), {one.client for one in seen.clients}) == ({"yard-1"}, {"guest"})
        everything = fetch_health(server.address, keys=site.of("robot"))
        assert set(everything.maps) >= {"default", "yard-1"}
        assert {one.client for one in everything.clients} >= {"robot", "guest"}
    for name in ("default", "attic"):
        for ask in (fetch_status, fetch_mesh, sampled, watched):
            with pytest.raises(TransportError, match=f"this key may not use map {name}"):
                ask(server.address, map_name=name, keys=site.of("guest"))  # type: ignore[operator]
    with pytest.raises(TransportError, match="no map shed is open"):
        sampled(server.address, "shed", site.of("guest"))
    assert fetch_status(server.address, map_name="yard-1", keys=site.of("guest")).map == "yard-1"
    assert fetch_mesh(server.address, map_name="yard-1", keys=site.of("guest")) is not None
    assert watched(server.address, "yard-1", site.of("guest"))
    assert fetch_new_map(server.address, "yard-1", keys=site.of("guest")).startswith("yard-")
    assert fetch_new_map(server.address, "default", keys=site.of("guest")).startswith("yard-")


def test_other_maps_take_effect_at_once(tmp_path: Path) -> None:
    site = Site(tmp_path)
    with (
        serving(site.state, fuser=SUMS, keys=str(site.keys)) as server,
        site.client(server, "robot") as robot,
    ):
        robot.send(wall(0))
        robot.flush(timeout=DEADLINE)
        key_folder.allow(site.keys, "robot", maps=["yard-*"])
        robot.send(wall(1))
        until(lambda: "may not use map" in robot.problem)
        with pytest.raises(FlushTimeout, match="this key may not use map default, but: yard-"):
            robot.flush(timeout=0.1)
        assert fetch_health(server.address, keys=site.of("cart")).maps["default"].keyframes_durable == 1
        key_folder.allow(site.keys, "robot", maps=["*"])
        robot.flush(timeout=DEADLINE)
        assert fetch_health(server.address, keys=site.of("robot")).maps["default"].keyframes_durable == 2


# --- revocation ---


def test_a_revocation_cuts_at_once_and_others_go_on(tmp_path: Path) -> None:
    site = Site(tmp_path)
    with (
        serving(site.state, fuser=SUMS, keys=str(site.keys)) as server,
        site.client(server, "robot", tmp_path / "spool") as robot,
        site.client(server, "cart") as cart,
    ):
        robot.connect()
        for i in range(6):
            cart.send(wall(i))
            if i < 3:
                robot.send(wall(i))
                robot.flush(timeout=DEADLINE)
        key_folder.revoke(site.keys, "robot")
        robot.send(wall(6))  # over a connection that was let in
        until(lambda: "does not know this client" in robot.problem)
        with pytest.raises(FlushTimeout, match="does not know this client"):
            robot.flush(timeout=0.1)
        send_all(cart, range(6, 9))
        cart.flush(timeout=DEADLINE)
        cart.wait_fused(timeout=DEADLINE)
        health = fetch_health(server.address, keys=site.of("cart"))
        assert health.refused["revoked"] >= 1
        assert (robot.stats.durable, health.maps["default"].keyframes_durable) == (3, 12)
        key_folder.allow(site.keys, "robot", str(site.folder / "robot/robot.key"))  # a mistake, put right
        robot.flush(timeout=DEADLINE)
        cart.wait_fused(timeout=DEADLINE)
        assert server.terminate() == 0
    assert len(JournalRecording(site.state)) == 13


def test_a_new_key_under_the_old_name_goes_on_with_the_spool(tmp_path: Path) -> None:
    site = Site(tmp_path)
    with serving(site.state, fuser=SUMS, keys=str(site.keys)) as server:
        with site.client(server, "robot", tmp_path / "spool") as robot:
            robot.send(wall(0))
            robot.flush(timeout=DEADLINE)
        key_folder.create_pair(site.folder / "robot", "robot", force=True)
        key_folder.allow(site.keys, "robot", str(site.folder / "robot/robot.key"))
        with site.client(server, "robot", tmp_path / "spool") as robot:
            robot.send(wall(1))
            robot.flush(timeout=DEADLINE)
        assert fetch_health(server.address, keys=site.of("robot")).maps["default"].keyframes_durable == 2


def test_with_keys_every_interface_may_be_served(tmp_path: Path) -> None:
    site = Site(tmp_path)
    with serving(site.state, fuser=SUMS, keys=str(site.keys), listen="tcp://0.0.0.0:0") as server:
        address = server.address.replace("0.0.0.0", "127.0.0.1")
        assert fetch_health(address, keys=site.of("robot")).ready
        with pytest.raises(TransportError):
            fetch_health(address, timeout=0.3)


def test_a_damaged_allow_list_lets_nobody_in_until_it_is_mended(tmp_path: Path) -> None:
    site = Site(tmp_path)
    listed = site.keys / key_folder.ALLOWED
    good = listed.read_bytes()
    with socket.create_server(("127.0.0.1", 0)) as drawn:
        page = f"127.0.0.1:{drawn.getsockname()[1]}"
    with serving(site.state, fuser=SUMS, keys=str(site.keys), metrics=page) as server:
        fetch_health(server.address, keys=site.of("robot"))
        listed.write_bytes(good + b"[")
        with pytest.raises(NotAllowed):
            fetch_health(server.address, keys=site.of("robot"))
        until(lambda: "nobody may connect: the allow-list" in get(page, "/readyz")[1])
        assert get(page, "/readyz")[0] == 503
        listed.write_bytes(good)
        assert fetch_health(server.address, keys=site.of("robot")).ready
    listed.write_bytes(good + b"[")
    with pytest.raises(RuntimeError, match=r"InvalidConfig: the allow-list .* is damaged"):
        serving(site.state, fuser=SUMS, keys=str(site.keys)).__enter__()
