# SPDX-License-Identifier: MIT
"""Corrections from a scanner to a server's journal, whoever dies on the way or would rather not have them."""

import os
import signal
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from clients_and_spools import NOBODY, QUICK
from corrected_maps import final_keyframes, fresh_map
from hostile_messages import hostile_corrections
from keyframes_and_servers import (
    DEADLINE,
    Secured,
    Server,
    connected,
    journaled_corrections,
    lasting_address,
    pose,
    secured,
    serving,
    until,
    wall,
)
from quick_fusers import SUMS
from sum_map import hash_of

from lab.reliability.delivery_verdict import VOXEL_SIZE
from tsfusion import Client, Volume, journal
from tsfusion.core.errors import FlushTimeout, InvalidKeyframe, KeyframeRefused
from tsfusion.geometry import se3
from tsfusion.journal import state_folder
from tsfusion.journal.inspection import summarize
from tsfusion.wire.asking.queries import fetch_health, fetch_status
from tsfusion.wire.keys import key_folder
from tsfusion.wire.messages.health import MapHealth
from tsfusion.wire.records import codec, corrections
from tsfusion.wire.sockets import sockets

SESSION = bytes(range(16))
FUSER = SUMS  # but where keyframes are moved in a real map


def scan(client: Client, count: int = 3) -> list[int]:
    """So many keyframes that the server has."""
    found = [client.send(wall(i)) for i in range(count)]
    client.flush(DEADLINE)
    return [seq for seq in found if seq is not None]


def session_of(client: Client) -> bytes:
    return client._outbox.spool.session


def records(state: Path, session: bytes) -> list[tuple[int, bool]]:
    """Number and whether it is a correction, of a session's records in the journal."""
    paths = state_folder.find_journal(state).files()
    found = [record for path in paths for record in journal.records(path)]
    return [(record.seq, record.is_correction) for record in found if record.session == session]


def health_of(server: Server) -> MapHealth:
    return fetch_health(server.address).maps["default"]


def fresh_hash(state: Path) -> str:
    return fresh_map(state_folder.find_journal(state).path, VOXEL_SIZE).map_hash()


def hash_of_all(state: Path) -> str:
    """Hash of the sums of all keyframes of a journal, at their last poses."""
    return hash_of(final_keyframes(state_folder.find_journal(state).path))


def test_corrections_stand_in_the_journal_between_keyframes(shared: Server, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    first = [se3.exp(rng.normal(size=6)) for _ in range(3)]
    with Client(shared.address, spool=tmp_path) as client:
        session = session_of(client)
        seqs = scan(client)
        assert client.correct(dict(zip(seqs, first, strict=True)), T_map_odometry=pose(0.5)) == 4
        assert client.send(wall(3)) == 5
        assert client.correct({seqs[1]: pose(9)}, removed=[5]) == 6
        client.wait_fused(DEADLINE)
        stats = client.stats
        assert (stats.sent, stats.durable, stats.fused, stats.waiting) == (4, 4, 4, 0)
        assert (stats.corrections_sent, stats.corrections_acknowledged) == (2, 2)
        assert [one.seq for one in client.records] == [1, 2, 3, 5]
        client.wait_settled(DEADLINE)
        client.wait_meshed(DEADLINE)
        health = fetch_health(shared.address)
        (own,) = [one for one in health.clients if one.session == session.hex()[:8]]
        assert (own.corrections, own.durable, own.fused) == (2, 4, 4)
        told = health.maps["default"]
        assert told.corrections >= 2
        assert (told.waiting, told.corrections_waiting, told.corrections_unavailable) == (0, 0, 0)
        assert told.keyframes_moved > 0
        assert told.keyframes_durable > told.keyframes_fused  # one was taken out
    assert fetch_status(shared.address).map_hash == hash_of_all(shared.state)
    assert records(shared.state, session) == [(seq, seq in (4, 6)) for seq in range(1, 7)]
    older, newer = journaled_corrections(shared.state)[-2:]
    assert older.poses.tobytes() == np.array(first).tobytes()
    assert np.array_equal(older.T_map_odometry, pose(0.5))  # type: ignore[arg-type]
    assert (newer.seqs.tolist(), newer.removed.tolist()) == ([seqs[1]], [5])
    info = summarize(state_folder.find_journal(shared.state), lambda *_: None)
    (shown,) = [one for one in info.sessions if one.session == session.hex()]
    assert (shown.keyframes, shown.corrections, shown.corrected, shown.removed) == (4, 2, 3, 1)
    newest = [first[0], pose(9), first[2]]
    moves = [se3.inverse(pose(0.03 * i)) @ T for i, T in enumerate(newest)]
    assert shown.moved_m == pytest.approx(max(map(se3.distance, moves)))
    assert shown.turned_deg == pytest.approx(np.degrees(max(map(se3.angle, moves))))


@pytest.mark.nightly
def test_a_fuser_that_dies_while_it_moves_keyframes(tmp_path: Path) -> None:
    count = 25
    with serving(tmp_path, checkpoint_every=15) as server:
        with Client(server.address) as client:
            seqs = scan(client, count)
            client.correct({seq: pose(0.1 * seq, 0.05) for seq in seqs})
            until(lambda: (own := health_of(server)).corrections_waiting or own.keyframes_moved)
            os.kill(server.fuser_pid(), signal.SIGKILL)
            client.send(wall(count))
            client.wait_settled(DEADLINE)
            assert client.is_settled
        told = fetch_status(server.address)
        assert (told.keyframes_fused, told.fuser_restarts) == (count + 1, 1)
        assert told.map_hash == fresh_hash(tmp_path)
        server.process.terminate()
        assert server.process.wait(DEADLINE) == 0
    assert Volume.load(tmp_path / "maps/default/map.tsf").map_hash() == told.map_hash


def test_a_server_that_ends_moves_what_waits_first(tmp_path: Path) -> None:
    with serving(tmp_path, fuser=FUSER) as server, Client(server.address) as client:
        client.correct({seq: pose(1.0 * seq) for seq in scan(client, 10)}, T_map_odometry=pose(0, 0.3))
        client.flush(DEADLINE)
        server.process.terminate()
        assert server.process.wait(DEADLINE) == 0
    with serving(tmp_path, fuser=FUSER) as server:
        own = health_of(server)
        assert (own.corrections_waiting, own.keyframes_moved) == (0, 0)
        assert fetch_status(server.address).map_hash == hash_of_all(tmp_path)


def test_only_what_was_sent_can_be_corrected(shared: Server, tmp_path: Path) -> None:
    with Client(shared.address, spool=tmp_path) as client:
        (seq,) = scan(client, 1)
        for poses, removed in (({seq: pose(), seq + 1: pose()}, []), ({seq: pose()}, [seq + 1])):
            with pytest.raises(InvalidKeyframe, match=f"keyframe {seq + 1} was never sent by this client"):
                client.correct(poses, removed=removed)
        with pytest.raises(InvalidKeyframe, match="T_world_camera must have shape"):
            client.correct({seq: pose()}, T_map_odometry=np.eye(3))
        assert client.stats.corrections_sent == 0


def test_ten_thousand_poses_while_keyframes_go_on(shared: Server, tmp_path: Path) -> None:
    count = 10_000
    left = journal.Journal(tmp_path, 1 << 20, sync=False)  # of a scanner that came so far
    frames = codec.encode(wall(), session=SESSION, seq=count, previous=0, jpeg_quality=90)
    left.append(frames, session=SESSION, seq=count)
    left.close()
    rng = np.random.default_rng(0)
    poses = {1 + i: se3.exp(rng.normal(size=6)) for i in range(count)}
    with Client(shared.address, spool=tmp_path) as client:
        client.correct(poses)
        scan(client)
        assert client.stats.corrections_acknowledged == 1
    assert journaled_corrections(shared.state)[-1].poses.tobytes() == np.array(list(poses.values())).tobytes()


def test_what_the_server_refuses_is_told_and_kept_aside(tmp_path: Path) -> None:
    with (
        serving(tmp_path / "state", fuser=FUSER, quota_extent=100.0) as server,
        Client(server.address, spool=tmp_path / "spool") as client,
    ):
        (seq,) = scan(client, 1)
        client.correct({seq: pose(101)})
        with pytest.raises(KeyframeRefused, match=r"correction 2 was refused \(quota\): a sensor may be 100"):
            client.flush(DEADLINE)
        assert (client.stats.refused, client.stats.corrections_refused) == ({}, {"quota": 1})
        assert len(list((tmp_path / "spool" / "refused").glob("*.mcap"))) == 1
        client.correct({seq: pose(99)})
        scan(client, 1)
    (found,) = journaled_corrections(tmp_path / "state")
    assert found.poses[0, 0, 3] == 99


# --- strangers ---


def test_hostile_corrections_are_counted_and_change_nothing(shared: Server, tmp_path: Path) -> None:
    with Client(shared.address, spool=tmp_path) as client:
        session = session_of(client)
        seqs = scan(client)
        client.correct({seqs[0]: pose(1)})
        client.flush(DEADLINE)
        before = records(shared.state, session)
        later = corrections.checked({9: pose()})
        hostile = [
            *hostile_corrections(session, seq=5, previous=4),
            ("of one to come", "values", corrections.encode(later, session=session, seq=5)),
        ]
        refused = Counter(fetch_health(shared.address).refused)
        with connected(sockets.push, shared.address) as stranger:
            for _, _, frames in hostile:
                stranger.send_multipart(frames)
            expected = Counter(reason for _, reason, _ in hostile)
            until(lambda: expected + refused <= Counter(fetch_health(shared.address).refused))
        assert records(shared.state, session) == before
        client.correct({seqs[0]: pose(2)})
        client.flush(DEADLINE)
        assert records(shared.state, session) == [*before, (5, True)]


def test_another_clients_session_cannot_be_corrected(tmp_path: Path) -> None:
    robot = secured(tmp_path)
    key_folder.allow(tmp_path / "server", "cart", key_folder.create_pair(tmp_path / "cart", "cart").public)
    cart = Secured({}, {**robot.client, "key": str(tmp_path / "cart" / "cart.key_secret")})
    with (
        serving(tmp_path / "state", fuser=FUSER, **robot.server) as server,  # type: ignore[arg-type]
        Client(server.address, spool=tmp_path / "spool", **robot.client) as client,  # type: ignore[arg-type]
    ):
        seqs = scan(client)
        forged = corrections.checked({seqs[0]: pose(7)})
        frames = corrections.encode(forged, session=session_of(client), seq=seqs[-1] + 1)
        with connected(sockets.push, server.address, cart.keys) as thief:
            thief.send_multipart(frames)
            until(lambda: fetch_health(server.address, keys=robot.keys).refused.get("session", 0) == 1)
        assert journaled_corrections(tmp_path / "state") == []
        client.correct({seqs[0]: pose(8)})
        client.flush(DEADLINE)
    (found,) = journaled_corrections(tmp_path / "state")
    assert found.poses[0, 0, 3] == 8


def test_corrections_count_in_the_quota(tmp_path: Path) -> None:
    with (
        serving(tmp_path / "state", fuser=FUSER, quota_keyframes=10.0) as server,
        Client(server.address, spool=tmp_path / "spool") as client,
    ):
        seqs = scan(client)
        for i in range(25):
            client.correct({seqs[0]: pose(i)})
        client.flush(DEADLINE)
        assert fetch_health(server.address).refused["held"] > 0
    found = journaled_corrections(tmp_path / "state")
    assert [one.poses[0, 0, 3] for one in found] == list(range(25))


# --- who dies ---

_DIES = """
import os, signal
from tsfusion.journal import writer
real = writer.Journal.append_all
def append_all(self, messages, **more):
    if any(bytes(one.frames[0][:3]) == b"TSC" for one in messages):
        if {writes}:
            real(self, messages, **more)
        os.kill(os.getpid(), signal.SIGKILL)
    return real(self, messages, **more)
writer.Journal.append_all = append_all
"""


@pytest.mark.parametrize("writes", [False, True])
def test_a_server_that_dies_before_it_answers(tmp_path: Path, writes: bool) -> None:
    state = tmp_path / "state"
    with serving(state, fuser=FUSER, listen=lasting_address(), code=_DIES.format(writes=writes)) as first:
        address = first.address
        client = Client(address, spool=tmp_path / "spool", config=QUICK)
        try:
            seqs = scan(client)
            client.correct({seqs[0]: pose(1)}, T_map_odometry=pose(2))
            first.process.wait(DEADLINE)
            assert len(journaled_corrections(state)) == writes
            client.correct({seqs[1]: pose(3)})
            client.send(wall(3))
            with pytest.raises(FlushTimeout, match="1 keyframe and 2 corrections not acknowledged"):
                client.flush(0.1)
            assert client.stats.corrections_acknowledged == 0
            with serving(state, fuser=FUSER, listen=address):
                client.wait_fused(DEADLINE)
                assert client.stats.corrections_acknowledged == 2
                status = fetch_status(address)
                assert (status.keyframes_durable, status.keyframes_fused) == (4, 4)
        finally:
            client.close()
    assert [one.poses[0, 0, 3] for one in journaled_corrections(state)] == [1, 3]


_SCANS = """
import os, signal, sys
from keyframes_and_servers import pose, wall
from tsfusion import Client
client = Client(sys.argv[1], spool=sys.argv[2])
seqs = [client.send(wall(i)) for i in range(3)]
client.flush(60)
print("durable", flush=True)
sys.stdin.readline()
client.correct({seqs[0]: pose(1)})
client.correct({seqs[1]: pose(2)})
if sys.argv[3] == "killed":
    os.kill(os.getpid(), signal.SIGKILL)
client.close()
"""


@pytest.mark.parametrize("end", ["killed", "closed"])
def test_a_scanner_that_dies_before_the_answer_leaves_them_to_the_next(tmp_path: Path, end: str) -> None:
    state, spool = tmp_path / "state", tmp_path / "spool"
    with serving(state, fuser=FUSER) as server:
        command = [sys.executable, "-c", _SCANS, server.address, str(spool), end]
        with subprocess.Popen(command, stdin=-1, stdout=-1, text=True) as scanner:
            assert scanner.stdin is not None
            assert scanner.stdout is not None
            assert scanner.stdout.readline() == "durable\n"
            server.kill()
            scanner.stdin.write("\n")
            scanner.stdin.flush()
            assert scanner.wait(DEADLINE) == (-signal.SIGKILL if end == "killed" else 0)
    assert journaled_corrections(state) == []
    with serving(state, fuser=FUSER) as server, Client(server.address, spool=spool) as client:
        session = session_of(client)
        client.flush(DEADLINE)
        assert client.stats.corrections_acknowledged == 2
        client.correct({1: pose(5)})
        client.flush(DEADLINE)
        assert fetch_health(server.address).maps["default"].keyframes_durable == 3
    assert [one.poses[0, 0, 3] for one in journaled_corrections(state)] == [1, 2, 5]
    with Client(NOBODY, spool=spool) as client:
        assert session_of(client) != session


def test_a_restart_goes_on_behind_corrections(tmp_path: Path) -> None:
    """The checkpoint covers them; without one the journal is read again, and no count is off."""
    state = tmp_path / "state"
    with serving(state, fuser=FUSER) as server, Client(server.address, spool=tmp_path / "spool") as client:
        seqs = scan(client)
        client.correct({seqs[0]: pose(1)})
        client.wait_fused(DEADLINE)
        map_hash = fetch_status(server.address).map_hash
        assert server.terminate() == 0
    for lost in (False, True):
        if lost:
            (state / "maps" / "default" / "map.tsf").unlink()
        with serving(state, fuser=FUSER) as server:
            until(lambda: fetch_status(server.address).fuser == "idle")
            status = fetch_status(server.address)
            assert (status.keyframes_durable, status.keyframes_fused) == (3, 3)
            assert status.map_hash == map_hash
            assert fetch_health(server.address).maps["default"].corrections == 1
            assert server.terminate() == 0


def test_corrections_of_an_earlier_development_version_are_named(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    spool = tmp_path / "spool"
    spool.mkdir()
    (spool / "corrections.tsc").write_bytes(b"TSFCOR")
    with serving(tmp_path / "state", fuser=FUSER) as server, Client(server.address, spool=spool) as client:
        scan(client)
        assert server.terminate() == 0
        assert caplog.text.count("as an earlier development version kept them") == 1
