# SPDX-License-Identifier: MIT
"""One server, several maps and several scanners: real processes and sockets."""

import contextlib
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any, cast

import pytest
from clients_and_spools import send_all
from failures import raising
from keyframes_and_servers import DEADLINE, Server, at_once, connected, serving, until, wall
from quick_fusers import SUMS
from sum_map import hash_of

import tsfusion
from tsfusion import Client
from tsfusion.core import config
from tsfusion.core.config import ServerConfig, VolumeConfig
from tsfusion.core.errors import JournalError, ServerUnreachable, TransportError
from tsfusion.gateway.clients.client_routes import ClientRoutes
from tsfusion.gateway.health.metrics import Metrics
from tsfusion.gateway.intake.keyframe_intake import Quotas
from tsfusion.gateway.maps import map_registry
from tsfusion.gateway.maps.map_registry import MapRegistry
from tsfusion.journal import state_folder
from tsfusion.journal.journaled_keyframes import JournalRecording
from tsfusion.wire.asking.queries import fetch_health, fetch_status
from tsfusion.wire.messages import messages
from tsfusion.wire.records import codec
from tsfusion.wire.records.record_header import Refused, unpack
from tsfusion.wire.sockets import sockets


def scan(address: str, map_name: str, numbers: range) -> None:
    with Client(address, map=map_name, policy="spool_all") as client:
        send_all(client, numbers)
        client.flush(timeout=DEADLINE)
        client.wait_fused(timeout=DEADLINE)


def test_two_scanners_two_maps(tmp_path: Path) -> None:
    with serving(tmp_path, fuser=SUMS) as server:
        numbers = {"default": range(6), "yard-2": range(4, 12)}
        at_once(*(partial(scan, server.address, name, which) for name, which in numbers.items()))
        for name, which in numbers.items():
            status = fetch_status(server.address, map_name=name)
            assert (status.map, status.keyframes_fused) == (name, len(which))
            assert status.map_hash == hash_of(map(wall, which))
            assert status.delay_bound_ms > 0
        health = fetch_health(server.address)
        assert health.ready
        assert {name: one.keyframes_fused for name, one in health.maps.items()} == {"default": 6, "yard-2": 8}
        assert {client.map for client in health.clients} == set(numbers)
        with pytest.raises(TransportError, match="no map attic is open"):
            fetch_status(server.address, map_name="attic")
        assert server.terminate() == 0
    assert state_folder.map_names(tmp_path) == ["default", "yard-2"]
    with pytest.raises(JournalError, match=r"has several maps \(default, yard-2\): choose one, .*--map NAME"):
        JournalRecording(tmp_path)
    assert len(JournalRecording(tmp_path, "yard-2")) == len(JournalRecording(tmp_path / "maps/yard-2")) == 8
    with serving(tmp_path, fuser=SUMS) as server:  # both are taken up again, without anybody asking
        until(lambda: set(fetch_health(server.address).maps) == set(numbers))
        status = fetch_status(server.address, map_name="yard-2", timeout=DEADLINE)  # it opens now
        assert status.map_hash == hash_of(map(wall, numbers["yard-2"]))
        assert server.terminate() == 0


def test_a_server_opens_only_so_many_maps(tmp_path: Path) -> None:
    why = r"map attic cannot be opened: 1 are open; use one of them .* max_maps"
    refused = pytest.raises(ServerUnreachable, match=why)
    with (
        serving(tmp_path, fuser=SUMS, max_maps=1) as server,
        Client(server.address, map="attic") as client,
        refused,
    ):
        client.connect(timeout=5)
    assert state_folder.map_names(tmp_path) == ["default"]


def test_maps_that_cannot_be_opened_are_remembered_up_to_a_number(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(map_registry, "HostedMap", raising(JournalError("no room")))
    found: Any = MapRegistry(
        cast("Any", None), ServerConfig(state=str(tmp_path)), cast(ClientRoutes, None), Metrics()
    )
    found._volumes = {"default": VolumeConfig()}
    for i in range(200):
        assert found.open_for_client(f"map{i}") is None
    assert len(list(found.unopened())) == 64
    assert found.why_not("map199") == "no room"


def test_a_map_takes_only_so_many_sessions(tmp_path: Path) -> None:
    code = "from tsfusion.gateway.clients import client_routes; client_routes._MAX_SESSIONS = 2\n"
    with contextlib.closing(Server(tmp_path, code=code, fuser=SUMS)) as server:
        for i in range(2):
            scan(server.address, "default", range(i, i + 1))
        refused = pytest.raises(ServerUnreachable, match="map default has 2 sessions and takes no new one")
        with Client(server.address) as client, refused:
            client.connect(timeout=5)
        with connected(sockets.push, server.address) as push:  # without a greeting neither
            push.send_multipart(codec.encode(wall(), session=b"s" * 16, seq=1, jpeg_quality=90))
            until(lambda: fetch_health(server.address).refused.get("session", 0) == 1)
        assert fetch_health(server.address).maps["default"].sessions == 2
        assert server.terminate() == 0


@pytest.mark.parametrize("name", ["../up", "a/b", "", "A", "a" * 33, "a\n", "a\0", "ä", "."])
def test_a_name_is_never_a_path(name: str) -> None:
    with pytest.raises(tsfusion.InvalidConfig):
        config.make_settings(config.ClientConfig, {"map": name})
    hello = messages.encode(messages.Hello(bytes(16), messages.PROTOCOL_VERSION, map=name))
    with pytest.raises(tsfusion.DecodeError):
        messages.decode_to_server(hello)
    frames = codec.encode(wall(), session=bytes(16), seq=1, map_name=name, jpeg_quality=90)
    with pytest.raises(Refused):
        unpack(frames[0])


def test_maps_have_settings_of_their_own(tmp_path: Path) -> None:
    path = tmp_path / "tsfusion.toml"
    path.write_text('[volume]\nvoxel_size = 0.05\n[maps.yard]\nvoxel_size = 0.2\nsensor = "lidar"\n')
    loaded = config.load(path)
    assert loaded.volumes() == {"yard": VolumeConfig(voxel_size=0.2, sensor="lidar")}
    path.write_text(config.to_toml(loaded))
    assert config.load(path) == loaded
    path.write_text("[maps.yard]\nvoxel_size = -1.0\n")
    with pytest.raises(tsfusion.InvalidConfig, match=r"\[maps\.yard\]: voxel_size must be > 0, got -1\.0"):
        config.load(path)


# --- fairness and quotas ---


def test_a_flood_does_not_hold_up_another_scanner(tmp_path: Path) -> None:
    """200 keyframes of one client are journaled before the other's first: that is fused soon all the same."""
    with serving(tmp_path) as server:
        with Client(server.address, policy="spool_all") as flood:
            for i in range(200):
                flood.send(wall(i % 8))
            flood.flush(timeout=DEADLINE)
            with Client(server.address) as other:
                other.send(wall(1))
                other.wait_fused(timeout=DEADLINE)
                waiting = fetch_health(server.address).maps["default"].waiting
            flood.wait_fused(timeout=DEADLINE)
        assert fetch_status(server.address).keyframes_fused == 201
    assert waiting > 50, "the flood was over too early to tell"


def test_who_sends_too_much_has_to_wait_and_loses_nothing(tmp_path: Path) -> None:
    with serving(tmp_path, fuser=SUMS, quota_keyframes=5.0) as server:
        started = time.monotonic()
        scan(server.address, "default", range(8))
        scan(server.address, "default", range(8, 16))  # a new session is no way around it
        assert time.monotonic() - started > 1.0  # ten at once, then five a second
        health = fetch_health(server.address)
        assert health.refused["held"] > 0
        assert health.maps["default"].keyframes_fused == 16


def test_too_many_points_or_too_far_is_refused() -> None:
    frames = codec.encode(wall(), session=bytes(16), seq=1, jpeg_quality=90)
    with pytest.raises(Refused, match="a keyframe may have 3000 points, got 3072"):
        Quotas(ServerConfig(quota_points=3000)).check(codec.check(frames), frames)
    pose = wall().T_world_camera.copy()
    pose[:3, 3] = 80, 80, 0
    frames = codec.encode(wall(T_world_camera=pose), session=bytes(16), seq=1, jpeg_quality=90)
    with pytest.raises(Refused, match="a sensor may be 100 m from the origin, got 113 m"):
        Quotas(ServerConfig(quota_extent=100.0)).check(codec.check(frames), frames)


def test_a_sensor_that_no_map_knows_is_refused_before_it_is_journaled() -> None:
    frames = codec.encode(wall(sensor="sonar"), session=bytes(16), seq=1, jpeg_quality=90)
    with pytest.raises(Refused, match=r"sensor must be one of kinect, .*, got 'sonar'") as refused:
        Quotas(ServerConfig()).check(codec.check(frames), frames)
    assert refused.value.reason == "values"


def test_without_keys_a_connection_has_its_part_whatever_others_send() -> None:
    quotas = Quotas(ServerConfig(quota_keyframes=160.0, quota_bytes=1 << 30))
    quotas.wait("", 1000, 0.0, 7)  # the scanner is there first
    passed = {7: 0, 8: 0}
    for step in range(10_000):
        now = step / 1000
        passed[8] += not quotas.wait("", 1000, now, 8)
        if step % 125 == 0:
            passed[7] += not quotas.wait("", 1000, now, 7)
    assert passed[7] == 80  # eight a second, all of them
    assert passed[8] <= 320 + 1600 + 20 + 100
    for connection in range(100):
        quotas.wait("", 1000, 10.0, connection)
    assert len(quotas._shares) == 16
    assert quotas.wait("robot", 1000, 10.0, 7) == 0.0


def test_quotas_are_of_each_client_and_forget_strangers() -> None:
    quotas = Quotas(ServerConfig(quota_keyframes=10.0, quota_bytes=1 << 20))
    assert [quotas.wait("a", 1000, 0.0) for _ in range(20)] == [0.0] * 20
    assert quotas.wait("a", 1000, 0.0) == pytest.approx(0.1)
    assert quotas.wait("b", 1000, 0.0) == 0.0
    assert quotas.wait("a", 1000, 0.2) == 0.0
    assert quotas.wait("c", 1 << 30, 0.0) == 0.0  # more than the bucket holds passes when it is full
    assert quotas.wait("c", 1, 0.0) > 0
    assert [quotas.wait("a", 1000, 1000.0) for _ in range(20)] == [0.0] * 20
    assert quotas.wait("a", 1000, 1000.0) > 0  # nobody saves up for a flood
    for i in range(5000):
        quotas.wait(str(i), 1, 0.0)
    assert len(quotas._clients) == 4096


# --- the disk ---


def test_a_full_disk_is_said_and_waited_for(tmp_path: Path) -> None:
    """Nothing is lost: the client keeps what the server's disk has no room for."""
    most = 1 << 40
    with (
        serving(tmp_path / "state", fuser=SUMS, min_free_bytes=most) as server,
        Client(server.address) as client,
    ):
        client.connect()
        client.send(wall())
        until(lambda: not fetch_health(server.address).ready)
        health = fetch_health(server.address)
        assert "must stay so" in health.problems[0]
        until(lambda: any(one.held == "disk" for one in fetch_health(server.address).clients))
        with pytest.raises(tsfusion.FlushTimeout, match="must stay so"):
            client.flush(timeout=0.1)
        assert (client.stats.waiting, client.stats.skipped) == (1, {})


def test_a_full_disk_with_room_again(small_disk: Callable[[int], Path]) -> None:
    folder = small_disk(24)
    with (
        serving(folder, fuser=SUMS, min_free_bytes=4 << 20) as server,
        Client(server.address, policy="spool_all") as client,
    ):
        scan(server.address, "default", range(3))
        filler = folder / "filler"
        filler.write_bytes(bytes(20 << 20))
        sent = 3

        def noticed() -> bool:  # the disk is looked at once a second
            nonlocal sent
            client.send(wall(sent))
            sent += 1
            return "must stay so" in " ".join(fetch_health(server.address).problems)

        until(noticed)
        filler.unlink()
        client.wait_fused(timeout=DEADLINE)
        until(lambda: fetch_health(server.address).ready)  # the disk is looked at once a second
        assert fetch_status(server.address).map_hash == hash_of(map(wall, range(sent)))
        assert server.terminate() == 0


def test_a_journal_keeps_to_its_limit(tmp_path: Path) -> None:
    """Segments that two checkpoints cover are deleted; a restart still knows what was fused."""
    limit = 1 << 20
    settings = {"journal_bytes": limit, "segment_bytes": 1 << 16, "checkpoint_every": 20}
    with serving(tmp_path, fuser=SUMS, **settings) as server:
        scan(server.address, "default", range(600))
        until(lambda: fetch_health(server.address).maps["default"].journal_bytes < 1.2 * limit)
        server.kill()
    assert len(JournalRecording(tmp_path)) < 600
    with serving(tmp_path, fuser=SUMS, **settings) as server:
        until(lambda: fetch_health(server.address).maps["default"].keyframes_fused == 600)
        scan(server.address, "default", range(600, 610))
        assert fetch_status(server.address).map_hash == hash_of(map(wall, range(610)))
        assert server.terminate() == 0
