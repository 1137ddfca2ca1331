# SPDX-License-Identifier: MIT
"""Scanner, gateway and fuser as real processes over real sockets and files."""

import os
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import zmq
from clients_and_spools import NOBODY, QUICK, deliver, send_all
from command_processes import alive
from keyframes_and_servers import (
    DEADLINE,
    Server,
    at_once,
    connected,
    lasting_address,
    map_hash,
    pose,
    serving,
    until,
    wall,
)
from quick_fusers import SUMS
from sum_map import SumMap, hash_of

from tsfusion import Client, Keyframe, VolumeConfig
from tsfusion.core.errors import (
    FlushTimeout,
    KeyframeRefused,
    ServerUnreachable,
    TransportError,
    WorldRefused,
)
from tsfusion.datasets import open_dataset
from tsfusion.journal import state_folder
from tsfusion.journal.journaled_keyframes import JournalRecording
from tsfusion.wire.asking.queries import fetch_health, fetch_mesh, fetch_status, request
from tsfusion.wire.messages import messages
from tsfusion.wire.messages.messages import Command
from tsfusion.wire.records import codec
from tsfusion.wire.sockets import sockets

COUNT = 8


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """One server for the tests that leave it as it was or do not care what it holds."""
    with serving(tmp_path_factory.mktemp("shared"), max_frame_bytes=30_000) as server:
        yield server


def fused(address: str) -> int:
    return fetch_status(address).keyframes_fused


def test_five_lines_reach_the_map(tmp_path: Path) -> None:
    with serving(tmp_path / "state") as server:
        with Client(server.address, spool=tmp_path / "spool") as client:
            client.connect()
            taken = [client.send(wall(i, captured_ns=time.monotonic_ns())) for i in range(COUNT)]
            assert taken == [*range(1, 9)]
            client.flush(timeout=DEADLINE)
            client.wait_fused(timeout=DEADLINE)
            client.wait_meshed(timeout=DEADLINE)
            stats, records = client.stats, client.records
        status = fetch_status(server.address)
        mesh = fetch_mesh(server.address, min_weight=0.5)
        assert server.terminate() == 0
    assert stats.sent == stats.durable == stats.fused == COUNT
    assert stats.refused == stats.rejected == {}
    assert (status.keyframes_durable, status.keyframes_fused) == (COUNT, COUNT)
    assert status.map_hash == map_hash(map(wall, reversed(range(COUNT))))
    assert (status.fuser, status.sessions, status.duplicates) == ("idle", 1, 0)
    assert status.delay_ms.count == COUNT
    assert 0 < status.delay_ms.mean < 1e3 * DEADLINE
    assert len(mesh.faces) > 100
    assert mesh.colors is not None
    for times in records:
        stages = [times.captured_ns, times.sent_ns, times.received_ns, times.durable_ns, times.fuse_start_ns,
                  times.fused_ns, times.meshed_ns]  # fmt: skip
        assert all(b - a >= -2 * times.clock_bound_ns for a, b in pairwise(stages)), times
        assert 0 < times.clock_bound_ns < 1e9 * DEADLINE
    assert list((tmp_path / "spool").glob("*.mcap")) == []
    assert [keyframe.timestamp_ns for keyframe in JournalRecording(tmp_path / "state")] == [
        10**9 + i for i in range(COUNT)
    ]


def test_a_killed_server_loses_nothing_acknowledged(tmp_path: Path) -> None:
    """The server dies without warning, with a checkpoint behind it; its fuser goes with it."""
    state = tmp_path / "state"
    with Client(NOBODY, spool=tmp_path / "nowhere") as early:
        with pytest.raises(ServerUnreachable, match="no server answers at"):
            early.connect(timeout=0.1)
        early.send(wall(0))
        with pytest.raises(
            FlushTimeout, match=r"1 keyframe not acknowledged after 0\.1 s: no server answers"
        ):
            early.flush(timeout=0.1)
    with (
        serving(state, fuser=SUMS, listen=lasting_address(), checkpoint_every=3) as server,
        Client(server.address, config=QUICK) as client,
    ):
        send_all(client, range(5))
        client.flush(timeout=DEADLINE)
        until(lambda: fused(server.address) >= 3)
        fuser = server.fuser_pid()
        server.kill()
        until(lambda: not alive(fuser))
        send_all(client, range(5, COUNT))
        with serving(state, fuser=SUMS, listen=server.address) as again:
            client.flush(timeout=DEADLINE)
            client.wait_fused(timeout=DEADLINE)
            status = fetch_status(again.address)
            assert again.terminate() == 0
        assert client.stats.fused == COUNT
    expected = hash_of(map(wall, range(COUNT)))
    assert (status.keyframes_durable, status.keyframes_fused, status.map_hash) == (COUNT, COUNT, expected)
    assert SumMap.load(state_folder.map_folder(state, "default") / "map.tsf").map_hash() == expected


def test_a_stop_drains_and_a_start_goes_on(tmp_path: Path) -> None:
    """Two clients at once, SIGTERM with most of it unfused, and another start."""

    def scan(numbers: range) -> None:
        with Client(server.address) as client:
            send_all(client, numbers)
            client.flush(timeout=DEADLINE)

    with serving(tmp_path, fuser=SUMS) as server:
        at_once(lambda: scan(range(0, COUNT, 2)), lambda: scan(range(1, COUNT, 2)))
        server.process.send_signal(signal.SIGTERM)  # as `timeout` does: to the process, and to its group
        assert server.terminate() == 0
    with serving(tmp_path, fuser=SUMS) as server:
        status, expected = fetch_status(server.address), hash_of(map(wall, range(COUNT)))
        assert (status.sessions, status.keyframes_fused, status.map_hash) == (2, COUNT, expected)
        assert server.terminate() == 0
    journal_folder = state_folder.map_folder(tmp_path, "default") / "journal"
    for segment in journal_folder.iterdir():  # somebody makes room
        segment.unlink()
    with serving(tmp_path, fuser=SUMS) as server:
        with Client(server.address) as client:
            client.send(wall(COUNT))
            client.flush(timeout=DEADLINE)
        with Client(server.address, world="another") as client, pytest.raises(WorldRefused):
            client.connect(timeout=DEADLINE)
        server.kill()
    with serving(tmp_path, fuser=SUMS) as server:
        until(lambda: fused(server.address) == COUNT + 1)


def test_a_dead_fuser_is_replaced(tmp_path: Path) -> None:
    with serving(tmp_path, fuser=SUMS) as server, Client(server.address) as client:
        send_all(client, range(4))
        client.wait_fused(timeout=DEADLINE)
        os.kill(server.fuser_pid(), signal.SIGKILL)
        send_all(client, range(4, COUNT))
        client.flush(timeout=DEADLINE)  # acknowledged while there is no fuser
        client.wait_fused(timeout=DEADLINE)
        until(lambda: _hash(server.address) == hash_of(map(wall, range(COUNT))))
        assert fetch_status(server.address).fuser_restarts == 1
        assert server.terminate() == 0


def _hash(address: str) -> str:
    with suppress(TransportError):  # "the fuser restarts; ask again"
        return fetch_status(address).map_hash
    return ""


def test_what_is_journaled_is_not_refused_when_it_comes_again(shared: Server) -> None:
    """Damaged on its second way, or after a limit was lowered: it is a duplicate before all else."""
    before = fetch_health(shared.address)
    frames = codec.encode(wall(), session=os.urandom(16), seq=1, jpeg_quality=90)
    with connected(sockets.push, shared.address) as push:
        push.send_multipart(frames)
        push.send_multipart([frames[0], frames[1][:-1] + b"x", frames[2]])
        until(lambda: fetch_health(shared.address).duplicates == before.duplicates + 1)
    assert fetch_health(shared.address).refused == before.refused


def test_a_refused_keyframe_is_told_and_the_rest_goes_on(shared: Server) -> None:
    noise = np.random.default_rng(0).integers(0, 65536, (200, 200)).astype(np.uint16)
    with Client(shared.address) as client:
        client.send(wall(0))
        client.send(Keyframe(depth=noise, intrinsics=wall().intrinsics, T_world_camera=pose()))
        client.send(wall(1))
        with pytest.raises(KeyframeRefused, match=r"keyframe 2 was refused \(size\)"):
            client.flush(timeout=DEADLINE)
        client.wait_fused(timeout=DEADLINE)
        client.flush(timeout=DEADLINE)
        assert client.stats.refused == {"size": 1}
        assert client.stats.fused == 2


def test_a_keyframe_the_map_cannot_take_is_counted_and_named_once(
    shared: Server, caplog: pytest.LogCaptureFixture
) -> None:
    """Depth in millimetres as float: on the server's disk, not in the map, not in the quarantine."""
    before = fetch_status(shared.address)
    metres = wall().intrinsics
    with Client(shared.address) as client:
        client.send(wall(0))
        for i in range(3):
            millimetres = wall(i).measurement.astype(np.float32)
            client.send(Keyframe(depth=millimetres, intrinsics=metres, T_world_camera=pose(0.1 * i)))
        client.send(wall(2))
        client.wait_fused(timeout=DEADLINE)
        status = fetch_status(shared.address)
        assert client.stats.rejected == status.keyframes_rejected == {"no_samples": 3}
        assert "looks like millimetres" in client.first_rejection
        assert (client.stats.durable, client.stats.fused) == (5, 2)
        assert status.keyframes_durable == before.keyframes_durable + 5
        assert status.keyframes_fused == before.keyframes_fused + 2
    assert len([one for one in caplog.records if "no usable sample" in one.message]) == 1
    assert not list(shared.state.rglob("quarantine/*.mcap"))


def test_a_closed_client_says_so(tmp_path: Path) -> None:
    client = Client(NOBODY, spool=tmp_path)
    client.close()
    client.close()
    with pytest.raises(TransportError, match="closed"):
        client.send(wall())
    with pytest.raises(TransportError, match="closed"):
        client.connect()


# --- hostile ---


def test_rubbish_is_counted_and_the_server_lives(shared: Server) -> None:
    before = fetch_status(shared.address)
    good = codec.encode(wall(), session=os.urandom(16), seq=1, jpeg_quality=90)
    rubbish = {
        "frames": [good[0]],
        "magic": [b"GET / HTTP/1.1", b""],
        "version": [b"TSF\x09" + good[0][4:], *good[1:]],
        "header": [b"TSF\x01" + b"\xc1" * 50, *good[1:]],
        "limits": good[:2],
        "size": [good[0], good[1] + b"x", good[2]],
        "crc": [good[0], good[1][:-1] + b"x", good[2]],
        "gap": codec.encode(wall(), session=os.urandom(16), seq=9, previous=8, jpeg_quality=90),
    }
    with (
        connected(sockets.push, shared.address) as push,
        connected(sockets.dealer, shared.control) as link,
    ):
        for message in rubbish.values():
            push.send_multipart(message)
        assert link.poll(10_000, zmq.POLLOUT)
        for message in (b"", b"rubbish", b"\xc1" * 1000, messages.encode(Command(name="ping"))[:-3]):
            link.send_multipart([message, b"", b"x"])

        def refused(reason: str) -> int:
            return fetch_status(shared.address).messages_refused.get(reason, 0)

        for reason in rubbish:
            until(lambda reason=reason: refused(reason) == before.messages_refused.get(reason, 0) + 1)
        until(lambda: refused("control") >= before.messages_refused.get("control", 0) + 4)
    after = fetch_status(shared.address)
    assert after.keyframes_durable == before.keyframes_durable
    with Client(shared.address) as client:
        client.send(wall())
        client.wait_fused(timeout=DEADLINE)


def test_questions_are_answered(shared: Server) -> None:
    assert request(shared.address, Command(name="ping"), timeout=DEADLINE)[0].name == "ping"
    with pytest.raises(TransportError, match="min_weight must be"):
        fetch_mesh(shared.address, min_weight=-1.0)


# --- starting ---


def refusal(*arguments: object, **settings: object) -> str:
    with pytest.raises(RuntimeError) as refused:
        serving(*arguments, **settings).__enter__()  # type: ignore[arg-type]
    return str(refused.value)


def test_a_busy_port_a_busy_folder_and_a_bad_folder_are_one_clear_line(
    shared: Server, tmp_path: Path
) -> None:
    assert refusal(tmp_path, listen=shared.address) == (
        f"TransportError: cannot listen on {shared.address}: Address already in use; "
        "choose another address (--listen), or end what has it"
    )
    state = str(Path(fetch_status(shared.address).state).parent.parent)
    assert f"JournalError: the state folder {state} is in use by another server" in refusal(Path(state))
    (tmp_path / "file").write_text("")
    assert f"JournalError: cannot write the state folder {tmp_path / 'file'}: " in refusal(tmp_path / "file")
    assert "InvalidConfig: without keys the server listens on" in refusal(tmp_path, listen="tcp://0.0.0.0:0")


# --- real scans ---


@pytest.mark.parametrize(
    ("name", "options", "volume"),
    [
        ("7scenes/redkitchen", {}, VolumeConfig(voxel_size=0.04)),
        pytest.param(
            "kitti_odometry",
            {"sequence": "00", "modality": "lidar"},
            VolumeConfig(voxel_size=0.5, sensor="lidar"),
            marks=pytest.mark.nightly,
        ),
    ],
    ids=["7scenes", "kitti-lidar"],
)
def test_a_real_scan_makes_the_same_map_by_file_and_by_socket(
    data: Callable[[str], Path], tmp_path: Path, name: str, options: dict[str, str], volume: VolumeConfig
) -> None:
    dataset = open_dataset(data(name), **options)
    keyframes = [dataset[i] for i in range(0, min(len(dataset), 40), 16)]
    with serving(tmp_path, volume) as server, Client(server.address) as client:
        deliver(client, keyframes)
        assert fetch_status(server.address).map_hash == map_hash(keyframes, volume)
        assert server.terminate() == 0
