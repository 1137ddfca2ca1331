# SPDX-License-Identifier: MIT
"""Corrected poses: as bytes, on the disk, and from a scanner to a server that may die, or be older."""

import os
import signal
import struct
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from hostile_messages import hostile_corrections
from keyframes_and_servers import DEADLINE, Secured, Server, connected, pose, secured, serving, until, wall
from repository import GOLDEN, SUPPORT
from scripted_server import scripted

from tsfusion import Client, journal
from tsfusion.core.config import ClientConfig
from tsfusion.core.errors import DecodeError, FlushTimeout, InvalidKeyframe, JournalError, KeyframeRefused
from tsfusion.delivery.outbox import Outbox
from tsfusion.delivery.spool import Spool
from tsfusion.gateway import correction_store
from tsfusion.gateway.correction_store import Revisions
from tsfusion.geometry import se3
from tsfusion.journal.inspection import summarize
from tsfusion.journal.state_folder import find_journal
from tsfusion.wire import codec, corrections, key_folder, messages, sockets
from tsfusion.wire.corrections import Corrections, SessionCorrections, checked, nothing
from tsfusion.wire.keyframe_header import Refused
from tsfusion.wire.queries import fetch_health

SESSION = bytes(range(16))
QUICK = ClientConfig(stall_timeout=0.5)


def said(
    poses: Mapping[int, Any], *, revision: int = 1, T: Any = None, session: bytes = SESSION
) -> SessionCorrections:
    seqs, found = checked(poses)
    return SessionCorrections(session=session, seqs=seqs, poses=found, T_map_odometry=T, revision=revision)


def some(count: int, seed: int = 0, first: int = 1) -> dict[int, np.ndarray]:
    """That many poses that are anything but round."""
    rng = np.random.default_rng(seed)
    return {first + i: se3.exp(rng.normal(size=6)) for i in range(count)}


def unpacked(frames: list[bytes]) -> SessionCorrections:
    head = messages.decode_to_server(frames[0])
    assert isinstance(head, Corrections)
    return corrections.unpack(head, frames[1:])


def same(a: SessionCorrections, b: SessionCorrections) -> bool:
    """To the bit."""
    T = [b"" if one.T_map_odometry is None else one.T_map_odometry.tobytes() for one in (a, b)]
    heads = [(one.session, one.revision, one.map) for one in (a, b)]
    arrays = [(one.seqs.tobytes(), one.poses.tobytes()) for one in (a, b)]
    return heads[0] == heads[1] and arrays[0] == arrays[1] and T[0] == T[1]


# --- as bytes ---


@pytest.mark.parametrize("count", [0, 1, 700, 10_000])
def test_poses_survive_the_wire_to_the_bit(count: int) -> None:
    sent = said(some(count), T=se3.exp(np.ones(6)))
    frames = corrections.pack(sent)
    assert len(frames) == 1 + -(-count * corrections.KEYFRAME_BYTES // corrections.FRAME_BYTES)
    assert all(len(frame) < sockets.CONTROL_MAX_BYTES - 1024 for frame in frames)
    assert same(unpacked(frames), sent)


def test_the_golden_message_and_file_stay_readable(tmp_path: Path) -> None:
    """As others implement them: a change here is a new wire version."""
    quarter = np.array([[0.0, -1, 0, 1.5], [1, 0, 0, -2], [0, 0, 1, 1 / 3], [0, 0, 0, 1]])
    wanted = said({2: quarter, 7: pose(1e5, -1e-300)}, revision=9, T=pose(0.1, 0.2, 0.3))
    stored = (GOLDEN / "corrections-v1.tsc").read_bytes()
    assert same(corrections.load(GOLDEN / "corrections-v1.tsc"), wanted)
    corrections.write(tmp_path / "again.tsc", wanted)
    assert (tmp_path / "again.tsc").read_bytes() == stored
    (length,) = struct.unpack_from("<I", stored, 8)
    assert corrections.pack(wanted) == [stored[12 : 12 + length], stored[12 + length : -16]]


def test_the_answers_keep_their_bytes() -> None:
    key = "000102030405060708090a0b0c0d0e0f"
    for message, stored in (
        (
            messages.Corrected(SESSION, 9),
            f"83a474797065a9636f72726563746564a773657373696f6ec410{key}a87265766973696f6e09",
        ),
        (
            messages.Uncorrected(SESSION, 9, "quota", "slower", 2.0),
            f"86a474797065ab756e636f72726563746564a773657373696f6ec410{key}a87265766973696f6e09"
            "a6726561736f6ea571756f7461a76d657373616765a6736c6f776572a7616761696e5f73cb4000000000000000",
        ),
    ):
        assert messages.encode(message).hex() == stored
        assert messages.decode_to_client(bytes.fromhex(stored)) == message


def test_a_welcome_of_an_older_server_takes_no_corrections() -> None:
    welcome = messages.Welcome("e", 1, 3, 2, 8, 1, 1, 4)
    fields = msgspec.msgpack.decode(messages.encode(welcome))
    assert fields.pop("corrections") == 4
    older = messages.decode_to_client(msgspec.msgpack.encode(fields))
    assert isinstance(older, messages.Welcome)
    assert older.corrections is None


def test_the_newest_pose_of_each_keyframe_counts() -> None:
    old, new = some(6), some(5, seed=1, first=4)
    both = said(old, T=pose(1)).merged(said(new, revision=2))
    assert both.seqs.tolist() == [1, 2, 3, 4, 5, 6, 7, 8]
    for seq, found in zip(both.seqs.tolist(), both.poses, strict=True):
        assert np.array_equal(found, {**old, **new}[seq])
    assert both.revision == 2
    assert both.T_map_odometry is not None
    assert both.up_to(4).seqs.tolist() == [1, 2, 3, 4]
    assert same(both.merged(both), both)


def test_what_was_said_is_not_left_to_say() -> None:
    pending = said({**some(6), 3: pose(5)}, T=pose(1))
    left = pending.without(said(some(5), T=pose(1)))
    assert left.seqs.tolist() == [3, 6]  # 3 was corrected anew meanwhile
    assert left.T_map_odometry is None
    assert pending.without(said({}, T=pose(2))).T_map_odometry is not None
    assert not pending.without(pending)
    assert not nothing(SESSION).without(pending)


@pytest.mark.parametrize(("name", "reason", "frames"), hostile_corrections(SESSION))
def test_messages_that_are_none_are_refused(name: str, reason: str, frames: list[bytes]) -> None:
    with pytest.raises((Refused, DecodeError)) as caught:
        unpacked(frames)
    assert getattr(caught.value, "reason", "control") == reason, name


def test_poses_are_checked_before_they_are_sent() -> None:
    seqs, found = checked({7: pose(1), np.int64(3): np.round(se3.exp(np.ones(6)), 5)})
    assert seqs.tolist() == [3, 7]
    assert np.abs(found[0, :3, :3] @ found[0, :3, :3].T - np.eye(3)).max() < 1e-15  # made exact
    for poses, message in (
        ({0: pose()}, "number is an integer > 0, got 0"),
        ({-1: pose()}, "got -1"),
        ({1 << 63: pose()}, "got 9223372036854775808"),
        ({1.5: pose()}, "got 1.5"),
        ({5: np.diag([1.0, 1, -1, 1])}, "pose of keyframe 5: T_world_camera must hold a rotation"),
        ({1: pose(), 5: pose(np.nan)}, "keyframe 5: T_world_camera must be finite"),
        ({5: pose(2e6)}, "keyframe 5: T_world_camera must translate by at most"),
        ({1: pose(), 5: np.eye(3)}, r"keyframe 5: T_world_camera must have shape \(4, 4\)"),
        ({5: "a pose"}, "keyframe 5: T_world_camera must be a"),
        (dict.fromkeys(range(1, corrections.MAX_KEYFRAMES + 2)), "at most 100000 keyframes"),
    ):
        with pytest.raises(InvalidKeyframe, match=message):
            checked(poses)  # type: ignore[arg-type]


# --- on the disk ---


def test_a_damaged_file_is_never_believed(tmp_path: Path) -> None:
    path = tmp_path / "a.tsc"
    corrections.write(path, said(some(2)))
    good = path.read_bytes()
    for at in range(len(good)):
        for content in (good[:at], good[:at] + bytes([good[at] ^ 4]) + good[at + 1 :]):
            path.write_bytes(content)
            with pytest.raises(DecodeError):
                corrections.load(path)
    with pytest.raises(JournalError, match="is damaged"):
        corrections.read(tmp_path)


def test_a_write_that_fails_leaves_the_one_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept = Revisions(tmp_path, 0)
    kept.take(said(some(3)))

    def refuse(_: int) -> None:
        raise OSError(5, "Input/output error")

    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", refuse)
        with pytest.raises(JournalError, match=r"cannot write .*: Input/output error"):
            kept.take(said(some(3, seed=1), revision=2))
    assert [path.name for path in tmp_path.iterdir()] == [f"{SESSION.hex()}.tsc"]
    assert (kept.of(SESSION).revision, kept.taken) == (1, 1)
    assert same(corrections.read(tmp_path)[SESSION], said(some(3)))


def test_revisions_of_a_session_become_one(tmp_path: Path) -> None:
    kept = Revisions(tmp_path / "new", 0)
    assert kept.of(SESSION).revision == 0
    kept.take(said(some(3), T=pose(1)))
    again = Revisions(tmp_path / "new", 0)
    again.take(said(some(3, seed=1, first=3), revision=5))
    found = corrections.read(tmp_path / "new")[SESSION]
    assert same(found, said({**some(3), **some(3, seed=1, first=3)}, revision=5, T=pose(1)))
    assert (again.of(SESSION).revision, again.of(SESSION).keyframes) == (5, 5)
    assert corrections.read(tmp_path / "nowhere") == {}


def test_a_damaged_file_is_set_aside(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    Revisions(tmp_path, 0).take(said(some(3)))
    path = tmp_path / f"{SESSION.hex()}.tsc"
    path.write_bytes(path.read_bytes()[:-1])
    kept = Revisions(tmp_path, 0)
    assert (kept.damaged, kept.of(SESSION).revision) == (1, 0)
    assert "its corrections are lost; it is kept as" in caplog.text
    assert path.with_suffix(".damaged").exists()
    kept.take(said(some(1)))
    assert len(corrections.read(tmp_path)) == 1


def test_corrections_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    kept = Revisions(tmp_path, 0)
    kept.take(said(some(8)))
    other = said(some(1), session=bytes(16))
    for place, name, most, new in (
        (corrections, "MAX_KEYFRAMES", 8, said({9: pose()}, revision=2)),
        (correction_store, "MAX_SESSIONS", 1, other),
        (correction_store, "MAX_BYTES", 2900, other),
    ):
        with monkeypatch.context() as patched:
            patched.setattr(place, name, most)
            with pytest.raises(Refused) as caught:
                kept.take(new)
            assert caught.value.reason == "limits"
            kept.take(said(some(1), revision=2))  # what is no more than before still goes
    with pytest.raises(JournalError, match="must stay free"):
        Revisions(tmp_path, 1 << 60).take(other)
    assert len(corrections.read(tmp_path)) == 1


# --- between a scanner and a server ---


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Server, Path]]:
    state = tmp_path_factory.mktemp("shared")
    with serving(state) as server:
        yield server, state


def kept_by(state: Path) -> dict[bytes, SessionCorrections]:
    return corrections.read(state / "maps" / "default" / "corrections")


def scan(client: Client, count: int = 3) -> list[int]:
    """So many keyframes that the server has."""
    found = [client.send(wall(i)) for i in range(count)]
    client.flush(DEADLINE)
    return [seq for seq in found if seq is not None]


def test_corrections_reach_the_servers_disk(shared: tuple[Server, Path], tmp_path: Path) -> None:
    server, state = shared
    with Client(server.address, spool=tmp_path) as client:
        session = client._outbox.spool.session
        seqs = scan(client)
        first = dict(zip(seqs, some(3).values(), strict=True))
        assert client.correct(first, T_map_odometry=pose(0.5)) == 1
        assert client.correct({seqs[1]: pose(9)}) == 2
        client.flush(DEADLINE)
        assert (client.stats.corrections_sent, client.stats.corrections_acknowledged) == (2, 2)
        assert client.stats.corrections_refused == {}
        found = kept_by(state)[session]
        assert found.seqs.tolist() == seqs
        for seq, kept in zip(seqs, found.poses, strict=True):
            assert np.array_equal(kept, {**first, seqs[1]: pose(9)}[seq])
        assert np.array_equal(found.T_map_odometry, pose(0.5))  # type: ignore[arg-type]
        health = fetch_health(server.address)
        (own,) = [one for one in health.clients if one.session == session.hex()[:8]]
        assert (own.revision, own.corrected) == (found.revision, 3)
        assert health.maps["default"].corrections > 0
    info = summarize(find_journal(state), lambda *_: None)
    (shown,) = [one for one in info.sessions if one.session == session.hex()]
    assert (shown.revision, shown.corrected) == (found.revision, 3)
    moves = [se3.inverse(pose(0.03 * i)) @ T for i, T in enumerate(found.poses)]
    assert shown.moved_m == pytest.approx(max(map(se3.distance, moves)))
    assert shown.turned_deg == pytest.approx(np.degrees(max(map(se3.angle, moves))))
    assert not any(tmp_path.glob("*.*"))  # nothing is left to say, the next scanner begins anew


def test_only_what_was_sent_can_be_corrected(shared: tuple[Server, Path], tmp_path: Path) -> None:
    server, _ = shared
    with Client(server.address, spool=tmp_path) as client:
        (seq,) = scan(client, 1)
        with pytest.raises(InvalidKeyframe, match=f"keyframe {seq + 1} was never sent from here"):
            client.correct({seq: pose(), seq + 1: pose()})
        with pytest.raises(InvalidKeyframe, match="T_world_camera must have shape"):
            client.correct({seq: pose()}, T_map_odometry=np.eye(3))
        assert client.stats.corrections_sent == 0


def test_ten_thousand_poses(shared: tuple[Server, Path], tmp_path: Path) -> None:
    """And keyframes go on meanwhile."""
    server, state = shared
    count = 10_000
    left = journal.Journal(tmp_path, 1 << 20, sync=False)  # of a scanner that came so far
    frames = codec.encode(wall(), session=SESSION, seq=count, previous=0, jpeg_quality=90)
    left.append(frames, session=SESSION, seq=count)
    left.close()
    poses = some(count)
    with Client(server.address, spool=tmp_path) as client:
        client.flush(DEADLINE)
        client.correct(poses)
        seqs = scan(client)
        assert client.stats.corrections_acknowledged == 1
        client.correct({seqs[-1]: pose(1)})
        client.flush(DEADLINE)
    found = kept_by(state)[SESSION]
    assert len(found) == count + 1
    assert found.poses[:count].tobytes() == np.array(list(poses.values())).tobytes()


def test_what_the_server_refuses_is_told(tmp_path: Path) -> None:
    with serving(tmp_path / "state", quota_extent=100.0) as server, Client(server.address) as client:
        (seq,) = scan(client, 1)
        client.correct({seq: pose(101)})
        with pytest.raises(KeyframeRefused, match=r"were refused \(quota\): a sensor may be 100 m"):
            client.flush(DEADLINE)
        assert client.stats.corrections_refused == {"quota": 1}
        client.correct({seq: pose(99)})
        client.flush(DEADLINE)
    (found,) = kept_by(tmp_path / "state").values()
    assert found.poses[0, 0, 3] == 99


# --- strangers ---


def asked(link: sockets.AnySocket, frames: list[bytes]) -> messages.ToClient | None:
    """What the server says to a message, in the end; None = nothing."""
    answer = asked_once(link, frames)
    while isinstance(answer, messages.Uncorrected) and answer.again_s:
        assert answer.reason == "quota"
        answer = asked_once(link, frames)
    return answer


def asked_once(link: sockets.AnySocket, frames: list[bytes]) -> messages.ToClient | None:
    """What it says before it answers the next message."""
    link.send_multipart(frames)
    link.send(messages.encode(messages.Ping(b"", 1)))
    assert link.poll(1000 * DEADLINE)
    answer = messages.decode_to_client(link.recv())
    if isinstance(answer, messages.Pong):
        return None
    assert link.poll(1000 * DEADLINE)
    assert isinstance(messages.decode_to_client(link.recv()), messages.Pong)
    return answer


def test_hostile_messages_are_counted_and_change_nothing(shared: tuple[Server, Path], tmp_path: Path) -> None:
    server, state = shared
    with Client(server.address, spool=tmp_path) as client:
        session = client._outbox.spool.session
        seqs = scan(client)
        client.correct({seqs[0]: pose(1)})
        client.flush(DEADLINE)
        before = kept_by(state)[session]
        hostile = list(hostile_corrections(session, revision=100))
        good = corrections.pack(said({1: pose()}, revision=100, session=session))
        hostile += [
            ("behind a greeting", "control", [messages.encode(messages.Hello(session, 1)), good[1]]),
            ("many frames", "control", [good[0]] + [b""] * (corrections.MAX_FRAMES + 1)),
            ("unsent", "values", corrections.pack(said({99: pose()}, revision=100, session=session))),
            ("nobody's", "session", corrections.pack(said({1: pose()}, session=bytes(16)))),
        ]
        refused = fetch_health(server.address).refused
        with connected(sockets.dealer, server.control) as stranger:
            for name, reason, frames in hostile:
                answer = asked(stranger, frames)
                if reason == "control":
                    assert answer is None, name
                else:
                    assert isinstance(answer, messages.Uncorrected), name
                    assert answer.reason == reason, name
            older = corrections.pack(said({seqs[0]: pose(5)}, revision=1, session=session))
            assert asked(stranger, older) == messages.Corrected(session, before.revision)
        counted = fetch_health(server.address).refused
        for _, reason, _ in hostile:
            assert counted[reason] > refused.get(reason, 0)
        assert same(kept_by(state)[session], before)
        client.correct({seqs[0]: pose(2)})
        client.flush(DEADLINE)
        assert kept_by(state)[session].poses[0, 0, 3] == 2


def test_another_clients_session_cannot_be_corrected(tmp_path: Path) -> None:
    robot = secured(tmp_path)
    key_folder.allow(tmp_path / "server", "cart", key_folder.create_pair(tmp_path / "cart", "cart").public)
    cart = Secured({}, {**robot.client, "key": str(tmp_path / "cart" / "cart.key_secret")})
    with (
        serving(tmp_path / "state", **robot.server) as server,  # type: ignore[arg-type]
        Client(server.address, spool=tmp_path / "spool", **robot.client) as client,  # type: ignore[arg-type]
    ):
        session = client._outbox.spool.session
        seqs = scan(client)
        frames = corrections.pack(said({seqs[0]: pose(7)}, revision=50, session=session))
        with connected(lambda context: sockets.dealer(context, cart.keys), server.control) as thief:
            answer = asked(thief, frames)
        assert isinstance(answer, messages.Uncorrected)
        assert answer.reason == "session"
        assert fetch_health(server.address, keys=robot.keys).refused["session"] == 1
        assert kept_by(tmp_path / "state") == {}
        client.correct({seqs[0]: pose(8)})
        client.flush(DEADLINE)
        assert kept_by(tmp_path / "state")[session].poses[0, 0, 3] == 8


def test_corrections_have_a_quota(shared: tuple[Server, Path], tmp_path: Path) -> None:
    """Each writes its session's file anew. Who keeps to it is not told of it."""
    server, _ = shared
    with Client(server.address, spool=tmp_path) as client, connected(sockets.dealer, server.control) as link:
        session = client._outbox.spool.session
        seqs = scan(client)
        answers = [
            asked_once(link, corrections.pack(said({seqs[0]: pose(i)}, revision=i, session=session)))
            for i in range(1, 101)
        ]
        waits = [one for one in answers if isinstance(one, messages.Uncorrected)]
        assert {one.reason for one in waits} == {"quota"}
        assert all(0 < one.again_s <= 10 for one in waits)
        taken = [one.revision for one in answers if isinstance(one, messages.Corrected)]
        assert 1 <= len(taken) < 100
        client.correct({seqs[1]: pose(1)})
        client.flush(DEADLINE)


# --- who dies, and who is older ---

_DIES = """
import os, signal
from tsfusion.wire import corrections
real = corrections.write
def write(path, content):
    if {writes}:
        real(path, content)
    os.kill(os.getpid(), signal.SIGKILL)
corrections.write = write
"""


@pytest.mark.parametrize("writes", [False, True])
def test_a_server_that_dies_before_it_answers(tmp_path: Path, writes: bool) -> None:
    state = tmp_path / "state"
    with serving(state, code=_DIES.format(writes=writes)) as first:  # type: ignore[arg-type]
        address = first.address
        client = Client(address, spool=tmp_path / "spool", config=QUICK)
        try:
            seqs = scan(client)
            client.correct({seqs[0]: pose(1)}, T_map_odometry=pose(2))
            first.process.wait(DEADLINE)
            assert len(kept_by(state)) == writes
            client.correct({seqs[1]: pose(3)})
            with pytest.raises(FlushTimeout, match="corrections of 2 keyframes are not acknowledged"):
                client.flush(0.1)
            assert client.stats.corrections_acknowledged == 0
            with serving(state, listen=address) as second:
                client.flush(DEADLINE)
                assert client.stats.corrections_acknowledged == 2
                (found,) = kept_by(state).values()
                assert found.seqs.tolist() == seqs[:2]
                assert found.poses[:, 0, 3].tolist() == [1, 3]
                client.correct({seqs[2]: pose(4)})  # its revision is newer than all before
                client.flush(DEADLINE)
                assert second.process.poll() is None
            assert len(next(iter(kept_by(state).values()))) == 3
        finally:
            client.close()


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
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(SUPPORT), *sys.path])}
    with serving(state) as server:
        command = [sys.executable, "-c", _SCANS, server.address, str(spool), end]
        with subprocess.Popen(command, stdin=-1, stdout=-1, text=True, env=environment) as scanner:
            assert scanner.stdin is not None
            assert scanner.stdout is not None
            assert scanner.stdout.readline() == "durable\n"
            server.kill()
            scanner.stdin.write("\n")
            scanner.stdin.flush()
            assert scanner.wait(DEADLINE) == (-signal.SIGKILL if end == "killed" else 0)
    assert kept_by(state) == {}
    with serving(state) as server, Client(server.address, spool=spool) as client:
        client.flush(DEADLINE)
        (found,) = kept_by(state).values()
        assert found.poses[:, 0, 3].tolist() == [1, 2]
        client.correct({int(found.seqs[0]): pose(5)})
        client.flush(DEADLINE)
        (again,) = kept_by(state).values()
        assert again.poses[:, 0, 3].tolist() == [5, 2]
        assert again.revision > found.revision
        fused = fetch_health(server.address).maps["default"]
        assert fused.keyframes_durable == 3
    with Client("tcp://127.0.0.1:9", spool=spool) as client:
        assert client._outbox.spool.session != found.session


def test_an_older_server_is_sent_nothing_it_does_not_know(caplog: pytest.LogCaptureFixture) -> None:
    with (
        scripted() as server,
        Client(server.address, control=server.control, config=QUICK) as client,
    ):
        seqs = [client.send(wall(i)) for i in range(3)]
        client.flush(DEADLINE)
        assert client.correct({seqs[0]: pose(1)}) == 1  # type: ignore[dict-item]
        client.flush(DEADLINE)  # nothing to wait for
        assert client.stats.corrections_acknowledged == 0
        pings = len(server.pings)
        until(lambda: len(server.pings) > pings + 1)
        server.stop()
        server.start()
        hellos = len(server.hellos)
        until(lambda: len(server.hellos) > hellos)
        client.send(wall(3))
        client.flush(DEADLINE)  # it lives: anything else than greetings and pings ends it
        until(lambda: "takes no corrections" in caplog.text)
    assert caplog.text.count("takes no corrections") == 1
    assert "the corrections of 1 keyframes are lost" in caplog.text


# --- the client's part, step by step ---


@contextmanager
def outbox(folder: Path) -> Iterator[Outbox]:
    """One with three keyframes that wait."""
    made = Outbox(Spool(folder, 1 << 20))
    try:
        for i in range(3):
            spool = made.spool
            frames = codec.encode(wall(i), session=spool.session, seq=spool.next_seq, jpeg_quality=90)
            made.add(spool.write(frames), wall(i))
        with made.changed:
            yield made
    finally:
        made.spool.close()


def own(box: Outbox, poses: Mapping[int, Any]) -> SessionCorrections:
    return said(poses, session=box.spool.session)


def test_a_spool_that_has_more_to_say_keeps_its_session(tmp_path: Path) -> None:
    """Though every file is full, and every keyframe at the server."""

    def emptied(*, corrects: bool) -> bytes:
        box = Outbox(Spool(tmp_path, 1))
        entry = box.spool.write(codec.encode(wall(), session=box.spool.session, seq=1, jpeg_quality=90))
        with box.changed:
            box.add(entry, wall())
            if corrects:
                box.correcting.save(box.correcting.add(own(box, {entry.seq: pose(1)})))
            box.progress(entry.seq, 0)
            box.spool.tidy()
        box.spool._lock.close()  # it dies
        return box.spool.session

    before = emptied(corrects=False)
    assert not list(tmp_path.glob("*.mcap"))
    assert emptied(corrects=True) != before
    assert len(list(tmp_path.glob("*.mcap"))) == 1
    left = Outbox(Spool(tmp_path, 1))
    assert left.correcting.pending == 1
    left.spool.close()


def test_a_correction_waits_for_its_keyframes(tmp_path: Path) -> None:
    with outbox(tmp_path) as box:
        talk = box.correcting
        talk.add(own(box, {1: pose(1), 3: pose(3)}))
        assert talk.message(0, now=0.0) == []  # nobody said yet whether it is wanted
        talk.welcomed(0, now=0.0)
        assert talk.message(box.durable, now=0.0) == []
        box.progress(2, 0)
        assert unpacked(talk.message(box.durable, now=0.0)).seqs.tolist() == [1]
        talk.told(1, now=1.0)
        assert (talk.acknowledged, talk.settled) == (0, False)
        assert talk.message(box.durable, now=9.0) == []
        box.progress(3, 0)
        assert talk.due(box.durable) == 1.5
        frames = talk.message(box.durable, now=9.0)
        assert unpacked(frames).seqs.tolist() == [3]
        assert talk.message(box.durable, now=13.0) == []  # links may be slow
        assert talk.message(box.durable, now=14.5) == frames
        talk.told(2, now=15.0)
        assert (talk.acknowledged, talk.settled, talk.pending) == (1, True, 0)


def test_a_correction_of_a_dropped_keyframe_is_not_waited_for(tmp_path: Path) -> None:
    with outbox(tmp_path) as box:
        talk = box.correcting
        talk.welcomed(0, now=0.0)
        box.progress(2, 0)
        talk.add(own(box, {3: pose(3)}))
        assert talk.message(2, now=0.0) == []
        box.refuse(box.spool.waiting[0], "values", "it will not do")
        assert talk.message(2, now=0.0) == []
        assert talk.settled


def test_a_scanner_that_forgot_its_revisions_finds_newer_ones(tmp_path: Path) -> None:
    with outbox(tmp_path) as box:
        talk = box.correcting
        box.progress(3, 3)
        talk.add(own(box, {1: pose(1)}))
        talk.welcomed(1, now=0.0)  # an earlier life's
        assert not talk.settled
        assert unpacked(talk.message(3, now=0.0)).revision == 2
        talk.told(7, now=1.0)
        assert not talk.settled
        assert unpacked(talk.message(3, now=2.0)).revision == 8
        talk.told(7, now=3.0)  # late
        assert not talk.settled
        talk.welcomed(8, now=4.0)  # the answer itself was lost
        assert talk.settled


def test_who_has_to_wait_says_the_same_again(tmp_path: Path) -> None:
    with outbox(tmp_path) as box:
        talk = box.correcting
        box.progress(3, 3)
        talk.welcomed(0, now=0.0)
        talk.add(own(box, {1: pose(1)}))
        frames = talk.message(3, now=0.0)
        talk.turned_away(1, "quota", "slower", 2.0, now=1.0)
        assert talk.held == "they have to wait (quota): slower"
        assert talk.message(3, now=2.9) == []
        assert talk.message(3, now=3.0) == frames
        talk.turned_away(1, "disk", "full", 1e300, now=4.0)
        assert talk.due(3) == 64.0
        talk.turned_away(9, "values", "of another revision", 0.0, now=4.0)
        assert talk.take_refusal() == ""
        talk.turned_away(1, "values", "no", 0.0, now=4.0)
        assert talk.settled
        assert talk.take_refusal() == "corrections were refused (values): no"
