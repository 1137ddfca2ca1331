# SPDX-License-Identifier: MIT
"""A spool whose disk is full, failing, read-only or at its limit: the scan goes on, and so does the spool."""

import errno
import logging
import os
import resource
import signal
import socket
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from clients_and_spools import NOBODY, joined, noise, send_all
from failures import raising, refuse
from keyframes_and_servers import DEADLINE, pose, until, wall
from scripted_server import scripted

from tsfusion import Client, Keyframe, journal
from tsfusion.core.config import ClientConfig
from tsfusion.core.errors import FlushTimeout, JournalError, KeyframeRefused, TransportError
from tsfusion.delivery import backpressure
from tsfusion.delivery.spool import Spool

ALL = ClientConfig(policy="spool_all", min_free_bytes=0, segment_bytes=1 << 16)


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Try a disk that refused again at the next keyframe."""
    monkeypatch.setattr(backpressure, "_RETRY_INTERVAL", 0.0)
    monkeypatch.setattr(backpressure, "_LOOK_INTERVAL", 0.0)


@pytest.fixture
def full_disk(small_disk: Callable[[int], Path]) -> Path:
    """A file system of 1 MiB."""
    return small_disk(1)


def messages_of(caplog: pytest.LogCaptureFixture, level: int) -> list[str]:
    names = ("tsfusion.delivery.backpressure",)
    return [r.getMessage() for r in caplog.records if r.levelno == level and r.name in names]


def delivered(spool: Path, count: int) -> list[int]:
    """Keyframes that a server gets of a spool that was left behind."""
    with scripted() as server, joined(server, spool=spool) as client:
        client.flush(DEADLINE)
        assert client.stats.durable == count
        return server.numbers


def test_a_full_disk_costs_keyframes_and_nothing_else(
    full_disk: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """A real one: it fills, gets room again, and fills again; twice each keyframe that was taken arrives."""
    caplog.set_level(logging.INFO)
    spool, ballast = full_disk / "spool", full_disk / "ballast"
    ballast.write_bytes(bytes(400_000))
    taken = []
    with Client(NOBODY, spool=spool, config=ALL) as client:
        for i in range(30):
            taken += [i] * (client.send(noise(i)) is not None)
        assert 8 < len(taken) < 20
        assert taken == [*range(len(taken))]
        assert client.stats.state == "disk"
        assert "No space left on device" in client.problem
        assert client.stats.skipped == {"disk": 30 - len(taken)}
        assert len(messages_of(caplog, logging.ERROR)) == 1
        assert "No space left on device" in messages_of(caplog, logging.ERROR)[0]
        ballast.unlink()
        for i in range(30, 60):
            taken += [i] * (client.send(noise(i)) is not None)
        assert 30 in taken
        assert 59 not in taken
        stats = client.stats
    assert len(messages_of(caplog, logging.INFO)) == 1
    assert len(messages_of(caplog, logging.ERROR)) == 2
    assert stats.skipped == {"disk": 60 - len(taken)}
    assert stats.waiting == len(taken)
    assert delivered(spool, len(taken)) == taken


def test_what_is_acknowledged_makes_room(full_disk: Path) -> None:
    with Client(NOBODY, spool=full_disk, config=ALL) as client:
        assert len([i for i in range(60) if client.send(noise(i)) is not None]) < 30
    with scripted() as server, joined(server, spool=full_disk, config=ALL) as client:
        until(lambda: client.send(noise(100)) is not None)
        with suppress(KeyframeRefused):  # attempts before there was room
            client.flush(DEADLINE)
        client.flush(DEADLINE)
        assert client.stats.state == "ok"
        assert server.numbers[-1] == 100


def test_a_read_only_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As the kernel makes it after errors: nothing can be created or written, what is there can be read."""
    usual, usual_os, read_only = Path.open, os.open, [False]

    def refusing(path: Path, mode: str = "r", *rest: Any, **options: Any) -> Any:
        if read_only[0] and mode not in ("r", "rb"):
            raise OSError(errno.EROFS, "Read-only file system")
        return usual(path, mode, *rest, **options)

    def refusing_os(path: Any, flags: int, *rest: Any, **options: Any) -> int:
        if read_only[0] and flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
            raise OSError(errno.EROFS, "Read-only file system")
        return usual_os(path, flags, *rest, **options)

    monkeypatch.setattr(Path, "open", refusing)
    monkeypatch.setattr(os, "open", refusing_os)
    config = ClientConfig(policy="spool_all", segment_bytes=1 << 16)
    with scripted(taking=False) as server, joined(server, spool=tmp_path, config=config) as client:
        assert [client.send(noise(i)) for i in range(4)] == [1, 2, 3, 4]
        read_only[0] = True
        assert [client.send(noise(i)) for i in range(4, 7)] == [None] * 3
        assert client.stats.state == "disk"
        assert "Read-only file system" in client.problem
        server.taking = True
        with pytest.raises(KeyframeRefused, match=r"Read-only file system \(and 2 more\)$"):
            client.flush(DEADLINE)
        read_only[0] = False
        assert client.send(noise(7)) == 8
        assert "cannot keep" not in client.problem
        client.flush(DEADLINE)
        assert (client.stats.state, server.numbers) == ("ok", [0, 1, 2, 3, 7])
        read_only[0] = True
        with pytest.raises(JournalError, match=r"cannot write the spool folder .*: Read-only file system"):
            Client(NOBODY, spool=tmp_path / "new", config=config)


def test_a_file_size_limit_tears_no_record(tmp_path: Path) -> None:
    """RLIMIT_FSIZE: the kernel takes part of a write and refuses the rest, at every place of the record."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    usual = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    taken = []
    try:
        with Client(NOBODY, spool=tmp_path, config=ALL) as client:
            for i in range(60):
                limit = (20_000 + 1_777 * i) if i % 2 else resource.RLIM_INFINITY
                resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
                taken += [i] * (client.send(noise(i)) is not None)
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
            assert client.stats.skipped["disk"] == 60 - len(taken) > 5
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, usual)
    assert delivered(tmp_path, len(taken)) == taken


@pytest.mark.parametrize("number", [errno.EIO, errno.ENOSPC, errno.EROFS, errno.EDQUOT])
def test_a_failing_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, number: int) -> None:
    sync, failing, taken = os.fdatasync, [False], []

    def fdatasync(descriptor: int) -> None:
        if failing[0]:
            raise OSError(number, os.strerror(number))
        sync(descriptor)

    monkeypatch.setattr(os, "fdatasync", fdatasync)
    with Client(NOBODY, spool=tmp_path, config=ALL) as client:
        for i in range(20):
            failing[0] = i % 5 == 3
            taken += [i] * (client.send(wall(i)) is not None)
        assert client.stats.skipped == {"disk": 4}
    assert delivered(tmp_path, 16) == taken == [i for i in range(20) if i % 5 != 3]


def test_a_client_that_cannot_begin_leaves_its_spool_to_the_next(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patched:
        patched.setattr(socket, "socketpair", refuse(errno.EMFILE))
        with pytest.raises(TransportError, match="cannot open a socket: Too many open files"):
            Client(NOBODY, spool=tmp_path)
    with Client(NOBODY, spool=tmp_path) as client:
        assert client.send(wall(0)) == 1


def test_a_record_that_cannot_be_taken_back_does_not_pass_for_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk fails, and fails again when the journal cuts the failed record off."""

    with Client(NOBODY, spool=tmp_path, config=ALL) as client:
        assert client.send(wall(0)) == 1
        with monkeypatch.context() as patch:
            patch.setattr(os, "fdatasync", refuse(errno.EIO))
            patch.setattr(os, "ftruncate", refuse(errno.EIO))
            assert client.send(wall(1)) is None
        assert client.send(wall(2)) == 3
    with scripted() as server, joined(server, spool=tmp_path) as client:
        client.flush(DEADLINE)
        assert server.numbers == [0, 2]  # and not 1, which was reported as not kept


def test_a_mistake_of_ours_is_not_blamed_on_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with Client(NOBODY, spool=tmp_path) as client:
        monkeypatch.setattr(journal.Journal, "append", raising(TypeError("a mistake")))
        with pytest.raises(TypeError, match="a mistake"):
            client.send(wall())


def test_some_of_the_disk_stays_free(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    real, free = os.statvfs(tmp_path), [100 << 20]

    def statvfs(_: Any) -> os.statvfs_result:
        fields = list(real)
        fields[4] = free[0] // real.f_frsize  # f_bavail
        return os.statvfs_result(fields)

    monkeypatch.setattr(os, "statvfs", statvfs)
    with Client(NOBODY, spool=tmp_path, policy="spool_all") as client:
        assert client.send(wall(0)) is not None
        free[0] = 60 << 20
        assert client.send(wall(1)) is None
        assert client.send(wall(2)) is None
        assert (client.stats.state, client.stats.skipped) == ("disk", {"disk": 2})
        assert "67.1 MB must stay so" in client.problem
        free[0] = 65 << 20  # just over the limit: it would be under it again at once
        assert client.send(wall(3)) is None
        free[0] = 100 << 20
        assert client.send(wall(4)) is not None
        assert client.stats.state == "ok"
    errors = messages_of(caplog, logging.ERROR)
    assert len(errors) == 1
    assert "62.9 MB free, and 67.1 MB must stay so: free some space" in errors[0]
    assert len(messages_of(caplog, logging.INFO)) == 1


def test_the_free_space_is_asked_for_rarely(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    asked = []
    real = os.statvfs(tmp_path)
    monkeypatch.setattr(os, "statvfs", lambda path: asked.append(path) or real)
    monkeypatch.setattr(backpressure, "_LOOK_INTERVAL", 60.0)
    with Client(NOBODY, spool=tmp_path, policy="spool_all") as client:
        send_all(client, range(50))
    assert len(asked) == 1


# --- the spool's own limit ---


@pytest.mark.parametrize("policy", ["thin", "spool_all"])
def test_a_spool_stays_within_its_limit(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, policy: Any
) -> None:
    caplog.set_level(logging.INFO)
    config = ClientConfig(policy=policy, spool_bytes=1 << 20)
    with Client(NOBODY, spool=tmp_path, config=config) as client:
        taken = [i for i in range(150) if client.send(noise(i)) is not None]
        stats = client.stats
        assert (stats.state, stats.waiting) == ("spool", len(taken))
        assert 15 < len(taken) < 30
        assert stats.skipped["spool"] == 150 - len(taken) - stats.skipped.get("room", 0) > 0
        assert ("room" in stats.skipped) == (policy == "thin")
        assert _size(tmp_path) <= 1 << 20
    assert len(messages_of(caplog, logging.ERROR)) == 1
    with scripted() as server, joined(server, spool=tmp_path, config=config) as client:
        client.flush(DEADLINE)
        assert server.numbers == taken
        for i in range(200, 260):
            until(lambda i=i: client.send(noise(i)) is not None)
        client.flush(DEADLINE)
        assert client.stats.state == "ok"
        assert _size(tmp_path) <= 1 << 20


def _size(folder: Path) -> int:
    return sum(file.stat().st_size for file in folder.glob("*.mcap"))


def test_a_correction_that_the_spool_cannot_keep_is_counted(tmp_path: Path) -> None:
    config = ClientConfig(policy="spool_all", spool_bytes=1 << 20)
    with Client(NOBODY, spool=tmp_path, config=config) as client:
        first = client.send(noise(0))
        assert first is not None
        while client.send(noise(1)) is not None:
            pass
        skipped = client.stats.skipped["spool"]
        many = {1: pose(1), **dict.fromkeys(range(2, client.stats.sent), pose(2))}
        assert client.correct(many, removed=[client.stats.sent]) in (None, client.stats.sent + 1)
        while client.correct(many) is not None:
            pass
        assert client.stats.skipped == {"spool": skipped}  # keyframes alone
        assert client.stats.corrections_refused == {"spool": 1}
        assert client.stats.state == "spool"


def test_drop_oldest_makes_room_instead(tmp_path: Path) -> None:
    config = ClientConfig(policy="drop_oldest", backlog=1000, spool_bytes=1 << 20)
    with Client(NOBODY, spool=tmp_path, config=config) as client:
        assert all(client.send(noise(i)) is not None for i in range(100))
        stats = client.stats
        assert (stats.state, stats.waiting + stats.skipped["dropped"]) == ("ok", 100)
        assert 15 < stats.waiting < 30
        assert _size(tmp_path) <= 1 << 20
    with scripted() as server, joined(server, spool=tmp_path) as client:
        client.flush(DEADLINE)
        assert server.numbers[-stats.waiting :] == [*range(100 - stats.waiting, 100)]


def test_a_large_keyframe_does_not_fill_a_spool_for_ever(tmp_path: Path) -> None:
    """The newest file goes when its keyframe is acknowledged and the room is needed."""
    config = ClientConfig(policy="spool_all", spool_bytes=1 << 20)
    depth = np.random.default_rng(0).integers(0, 65536, (600, 600)).astype(np.uint16)
    large = Keyframe(depth=depth, intrinsics=wall().intrinsics, T_world_camera=pose())
    with scripted() as server, joined(server, spool=tmp_path, config=config) as client:
        for _ in range(3):
            assert client.send(large) is not None
            client.flush(DEADLINE)
        assert len(server.taken) == 3


def test_a_pinned_keyframe_does_not_keep_the_files_behind_it(tmp_path: Path) -> None:
    spool = Spool(tmp_path, 1)  # each keyframe fills a segment
    for _ in range(10):
        spool.add(spool.write([b"head", bytes(1000)]))
    while len(spool.waiting) > 2:
        spool.remove(1)
    assert journal.segments(tmp_path) == [1, 10]
    assert 2000 < spool.used_bytes < 6000
    spool.drop(10)
    spool.tidy()
    assert (journal.segments(tmp_path), spool.used_bytes, spool.waiting_bytes) == ([], 0, 0)
    spool.close()


# --- reading it back: all but the record that was just written ---


def left(spool: Path, count: int) -> None:
    """Keyframes of a scanner that found no server."""
    with Client(NOBODY, spool=spool, config=ALL) as client:
        send_all(client, range(count))


def test_the_newest_record_is_not_read_from_the_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    spool = Spool(tmp_path, 1 << 20)
    first, last = (spool.write([b"head", bytes([number])]) for number in range(2))
    monkeypatch.setattr(journal, "read", refuse(errno.EIO))
    assert [bytes(frame) for frame in spool.read(last)] == [b"head", b"\1"]
    with pytest.raises(OSError, match="Input/output error"):
        spool.read(first)
    spool.close()


def test_a_shortage_of_descriptors_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read, failing = journal.read, [True]

    def scarce(folder: Path, position: journal.Position) -> journal.Record:
        if failing[0]:
            raise JournalError("cannot read", errno.EMFILE)
        return read(folder, position)

    monkeypatch.setattr("tsfusion.delivery.sender._MAX_READS", 1)  # of a disk that fails
    left(tmp_path, 3)
    monkeypatch.setattr(journal, "read", scarce)
    with scripted() as server, joined(server, spool=tmp_path) as client:
        with pytest.raises(FlushTimeout):
            client.flush(0.2)
        until(lambda: client._outbox._claimed == 0)  # it may still be dropped
        failing[0] = False
        client.flush(DEADLINE)
        assert server.numbers == [0, 1, 2]


def test_a_keyframe_that_stays_unreadable_is_given_up(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = journal.read
    monkeypatch.setattr("tsfusion.delivery.sender._READ_INTERVAL", 0.01)

    def damaged(folder: Path, position: journal.Position) -> journal.Record:
        record = read(folder, position)
        if record.seq == 2:
            raise JournalError("cannot read", errno.EIO)
        return record

    left(tmp_path, 4)
    monkeypatch.setattr(journal, "read", damaged)
    with scripted() as server, joined(server, spool=tmp_path) as client:
        until(lambda: not client.stats.waiting)
        assert client.stats.refused == {"spool": 1}
        assert server.numbers == [0, 2, 3]


# --- a clock that is set back ---


def test_a_clock_that_jumps_back_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Wall clocks are set by people and by NTP; only the journal's log times show it."""
    now = [2 * 10**18]

    def back() -> int:
        now[0] -= 3600 * 10**9
        return now[0]

    monkeypatch.setattr(time, "time_ns", back)
    monkeypatch.setattr(time, "time", lambda: back() / 1e9)
    with Client(NOBODY, spool=tmp_path, policy="spool_all") as client:
        send_all(client, range(20))
    with scripted() as server, joined(server, spool=tmp_path, policy="spool_all") as client:
        send_all(client, range(20, 40))
        client.flush(DEADLINE)
        client.wait_fused(DEADLINE)
        assert server.numbers == [*range(40)]
        assert client.stats.fused == 40
