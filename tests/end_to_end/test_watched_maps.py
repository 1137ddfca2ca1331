# SPDX-License-Identifier: MIT
"""A map on a server, watched: real processes, real sockets. In the end a watcher holds the map's surface."""

import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import zmq
from bad_network import Proxy
from keyframes_and_servers import (
    DEADLINE,
    VOLUME,
    Server,
    lasting_address,
    pose,
    secured,
    serving,
    wall,
)
from watched_surfaces import Held, Surfaces, fresh

from tsfusion import Client, Volume
from tsfusion.core.config import ClientConfig, VolumeConfig, override
from tsfusion.geometry.keyframe import Intrinsics, Keyframe
from tsfusion.journal.journaled_keyframes import JournalRecording
from tsfusion.wire.asking import map_watcher
from tsfusion.wire.asking.followed_map import HealthSeen, LinkSeen
from tsfusion.wire.asking.map_watcher import MapWatcher
from tsfusion.wire.asking.queries import fetch_health, forget
from tsfusion.wire.keys import key_folder
from tsfusion.wire.messages.forget_messages import Selection
from tsfusion.wire.sockets import sockets
from tsfusion.wire.sockets.curve import client_keys

NORMAL = override(VOLUME, surface="normal")  # whose cells depend on the map alone, to the last bit
RAW = override(VOLUME, surface="raw")
SOON = 0.05
SLOW = 1e5  # bytes a second


class Watching:
    """A watcher, and what it has shown."""

    def __init__(self, address: str, map_name: str = "default", **options: Any) -> None:
        self.watcher = MapWatcher(address, map_name, **options)
        self.held = Held()
        self.links: list[str] = []
        self.healths = 0

    def step(self) -> None:
        events = self.watcher.events(SOON)
        self.held.take(events)
        self.links += [event.problem for event in events if isinstance(event, LinkSeen)]
        self.healths += sum(isinstance(event, HealthSeen) for event in events)

    def until(self, reached: Callable[[], bool]) -> None:
        end = time.monotonic() + DEADLINE
        while not reached():
            assert time.monotonic() < end, f"deadline; {self.links}"
            self.step()

    def until_holds(self, expected: Surfaces) -> None:
        """Watch until the surface is the expected one, refined."""
        self.until(lambda: self.held.surfaces == expected and not self.held.raw)

    def close(self) -> None:
        self.watcher.close()


@contextmanager
def watching(address: str, map_name: str = "default", **options: Any) -> Iterator[Watching]:
    with closing(Watching(address, map_name, **options)) as made:
        yield made


def send(server: Server, *numbers: int, **options: Any) -> None:
    with Client(server.address, config=ClientConfig(policy="spool_all"), **options) as client:
        for i in numbers:
            client.send(wall(i))
        client.wait_settled(DEADLINE)


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """One server for the tests that do not care what its map holds."""
    with serving(tmp_path_factory.mktemp("watched"), RAW) as running:
        yield running


def surface_of(*keyframes: Keyframe, config: VolumeConfig = NORMAL) -> Surfaces:
    volume = Volume(config)
    for keyframe in keyframes:
        volume.integrate(keyframe)
    return fresh(volume)


def surface_now(server: Server, map_name: str = "default") -> Surfaces:
    """The surface of all keyframes that a server has journaled."""
    return surface_of(*JournalRecording(server.state, map_name), config=RAW)


@pytest.mark.parametrize("ending", ["server", pytest.param("fuser", marks=pytest.mark.nightly)])
def test_early_and_late_watchers_hold_the_map_through_everything(tmp_path: Path, ending: str) -> None:
    """Scans, a correction, keyframes forgotten, another fuser or server."""
    address = lasting_address()
    with ExitStack() as stack:
        server = stack.enter_context(serving(tmp_path, NORMAL, listen=address, checkpoint_every=2))
        early = stack.enter_context(watching(server.address))
        early.until(lambda: early.held.cleared == 1)
        assert (early.held.map, early.held.voxel_size) == ("default", VOLUME.voxel_size)
        send(server, 0)
        with Client(server.address, config=ClientConfig(policy="spool_all")) as client:
            for i in (10, 20):
                client.send(wall(i))
            client.wait_settled(DEADLINE)
            early.until_holds(surface_of(wall(0), wall(10), wall(20)))
            late = stack.enter_context(watching(server.address))
            late.until_holds(early.held.surfaces)
            late.until(lambda: bool(late.held.paths))
            assert {*late.held.client.values()} >= {*late.held.paths}
            session = early.held.seen[-1].session
            check_paths(early, late, session)
            client.correct({1: pose(1.2)})
            client.wait_settled(DEADLINE)
            moved = wall(10, T_world_camera=pose(1.2))
            for one in (early, late):
                one.until_holds(surface_of(wall(0), moved, wall(20)))
                one.until(lambda held=one.held: place_of(held, session, 1) == 1.2)
            forget(server.address, Selection(session=session.hex()))
        for one in (early, late):
            one.until_holds(surface_of(wall(0)))
            one.until(lambda held=one.held: session not in held.paths)
        if ending == "server":
            server.kill()
            early.until(lambda: "no server answers" in early.links[-1])
            server = stack.enter_context(serving(tmp_path, NORMAL, listen=address))
        else:
            os.kill(server.fuser_pid(), signal.SIGKILL)
        for one in (early, late):
            one.until(lambda held=one.held: held.cleared == 2)
        send(server, 30)
        for one in (early, late):
            one.until_holds(surface_of(wall(0), wall(30)))
            one.until(lambda links=one.links: not links or links[-1] == "")


def place_of(held: Held, session: bytes, seq: int) -> float | None:
    """Where a keyframe was found last, along x."""
    T = held.paths.get(session, {}).get(seq)
    return None if T is None else float(T[0, 3])


def check_paths(early: Watching, late: Watching, session: bytes) -> None:
    """The early one heard of each keyframe as it came; the late one asked where they are."""
    seen = {(one.session, one.seq): one for one in early.held.seen if one.picture is not None}
    assert seen[session, 1].picture[:2] == b"\xff\xd8"  # a JPEG
    assert seen[session, 1].shape == wall().shape
    assert seen[session, 1].intrinsics == wall().intrinsics
    assert {one.seq: one.T_world_camera[0, 3] for one in early.held.seen if one.session == session} == {
        seq: T[0, 3] for seq, T in late.held.paths[session].items()
    }
    np.testing.assert_allclose(late.held.paths[session][2], pose(0.6))


def test_watchers_cost_a_scanner_nothing_and_a_stalled_one_is_right_in_the_end(server: Server) -> None:
    numbers = [*range(0, 40, 2)]
    before = fetch_health(server.address).maps["default"].keyframes_fused
    with ExitStack() as stack:
        three = [stack.enter_context(watching(server.address)) for _ in range(3)]
        stalled = stack.enter_context(watching(server.address))
        for one in (*three, stalled):
            one.until(lambda held=one.held: held.cleared == 1)
        sending = threading.Thread(target=send, args=(server, *numbers))
        sending.start()
        while sending.is_alive():
            for one in three:
                one.step()
        sending.join()
        expected = surface_now(server)
        for one in (*three, stalled):
            one.until_holds(expected)
            assert one.held.cleared == 1
        health = fetch_health(server.address)
        assert health.maps["default"].keyframes_fused == before + len(numbers)
        assert (health.refused, health.duplicates) == ({}, 0)


def test_over_a_slow_link_the_map_comes_in_smaller_pieces(tmp_path: Path) -> None:
    """All of it at once takes longer than a server may be silent."""
    v, u = np.mgrid[:240, :320]
    depth = (1500 + 60 * np.sin(u / 40) + 40 * np.sin(v / 25)).astype(np.uint16)
    seen = Keyframe(
        depth=depth, intrinsics=Intrinsics(262.5, 262.5, 159.5, 119.5), T_world_camera=pose(), timestamp_ns=1
    )
    fine = override(RAW, voxel_size=0.015)
    expected = surface_of(seen, config=fine)
    assert 50 * sum(map(len, expected.values())) > 10 * SLOW
    with serving(tmp_path, fine) as server, Proxy() as proxy:
        proxy.target(server.address, server.control)
        with Client(server.address) as client:
            client.send(seen)
            client.wait_settled(DEADLINE)
        proxy.throttle(SLOW)
        with watching(proxy.address) as far:
            far.until_holds(expected)
            assert far.links == [""]
            proxy.heal()


def test_who_is_slow_to_read_gets_no_smaller_answers(server: Server) -> None:
    """A busy page is no slow link."""
    with watching(server.address) as busy:
        busy.until(lambda: busy.held.cleared == 1)
        for i in range(3):
            send(server, 50 + i)
            time.sleep(1.2)
            busy.step()
        assert busy.watcher._inquiry.most_bytes >= map_watcher._FIRST_BYTES
        busy.until_holds(surface_now(server))


def test_maps_are_chosen_and_may_be_opened_later(server: Server) -> None:
    with watching(server.address, "yard") as one:
        one.until(lambda: bool(one.links))
        assert "no map yard is open" in one.links[-1]
        assert one.watcher.weights(np.zeros((1, 3), np.float32)) is None
        send(server, 0, map="yard")
        one.until_holds(surface_now(server, "yard"))
        one.until(lambda: one.links[-1] == "")
        points = np.array([[0, 0, 1.2], [9, 9, 9]], np.float32)
        weights = one.watcher.weights(np.repeat(points, 15_000, axis=0))
        assert weights is not None
        assert (len(weights), weights[0] > 0, weights[-1]) == (30_000, True, 0)
        assert one.watcher.maps() == ["default", "yard"]
        one.watcher.choose("default")
        one.until(lambda: one.held.map == "default")
        send(server, 8)
        one.until_holds(surface_now(server))
        one.watcher.choose("yard")
        one.until(lambda: one.held.map == "yard")
        one.until_holds(surface_now(server, "yard"))
        assert one.watcher.title == f"yard at {server.address}"


def test_a_key_for_another_map_sees_nothing_and_is_told(tmp_path: Path) -> None:
    keys = secured(tmp_path)
    guest = key_folder.create_pair(tmp_path / "guest", "guest").public
    key_folder.allow(tmp_path / "server", "guest", guest, maps=("theirs",))
    own = client_keys(str(tmp_path / "guest" / "guest.key_secret"), keys.client["server_key"])
    with (
        serving(tmp_path / "state", RAW, **keys.server) as server,
        watching(server.address, keys=keys.keys) as robot,
        watching(server.address, keys=own) as stranger,
        watching(server.address) as nobody,
    ):
        robot.until(lambda: robot.held.cleared == 1)
        send(server, 0, **keys.client)
        robot.until_holds(surface_of(wall(0), config=RAW))
        robot.until(lambda: [one.client for one in robot.held.seen if one.picture] == ["robot"])
        stranger.until(lambda: stranger.healths > 1)
        assert (stranger.held.surfaces, stranger.held.seen, stranger.held.cleared) == ({}, [], 0)
        assert "no map default is open" in stranger.links[-1]
        nobody.until(lambda: bool(nobody.links))
        assert "takes only connections with keys" in nobody.links[-1]


def test_a_server_of_another_version_is_named() -> None:
    """A server of version 2 answers a ping without its version."""
    context: zmq.Context[Any] = zmq.Context()
    link = sockets.router(context)
    port = link.bind_to_random_port("tcp://127.0.0.1")
    done = threading.Event()

    def answer() -> None:
        while not done.is_set():
            if link.poll(50):
                identity, content = link.recv_multipart()
                if msgspec.msgpack.decode(content)["name"] == "ping":
                    reply = {"type": "reply", "name": "ping", "watches": True}
                    link.send_multipart([identity, msgspec.msgpack.encode(reply)])

    thread = threading.Thread(target=answer)
    thread.start()
    try:
        with watching(f"tcp://127.0.0.1:{port - 1}") as one:
            one.until(lambda: bool(one.links))
            assert "the server speaks version 2 of the wire format, this client 3" in one.links[-1]
    finally:
        done.set()
        thread.join()
        link.close()
        context.term()
