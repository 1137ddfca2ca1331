# SPDX-License-Identifier: MIT
"""A spool whose files or folder somebody deletes or moves while a scan goes on."""

import errno
import logging
import os
import shutil
from pathlib import Path

import pytest
from clients_and_spools import NOBODY, joined, noise, send_all
from keyframes_and_servers import DEADLINE, until, wall
from scripted_server import scripted

from tsfusion import Client, journal
from tsfusion.core.config import ClientConfig
from tsfusion.core.errors import JournalError, KeyframeRefused
from tsfusion.delivery import backpressure, sender
from tsfusion.delivery.spool import TOMBSTONES, Spool, Tombstones

SMALL = ClientConfig(policy="spool_all", segment_bytes=1 << 16, stall_timeout=0.5)


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Try a disk that refused again at the next keyframe."""
    monkeypatch.setattr(backpressure, "_RETRY_INTERVAL", 0.0)


def test_a_spool_that_is_deleted_is_told_by_the_next_send_and_what_it_had_is_still_sent(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    spool = tmp_path / "spool"
    with scripted(taking=False) as server, joined(server, spool=spool, config=SMALL) as client:
        taken = [i for i in range(24) if client.send(noise(i)) is not None]
        assert len(list(spool.glob("*.mcap"))) > 2
        shutil.rmtree(spool)
        assert client.send(noise(24)) is None
        assert (client.stats.state, client.stats.skipped) == ("disk", {"disk": 1})
        assert f"keyframes are lost: the spool {spool} cannot keep them" in client.problem
        assert "No such file" in client.problem
        server.taking = True
        with pytest.raises(KeyframeRefused, match=r"^a keyframe was never sent; keyframes are lost"):
            client.flush(DEADLINE)
        client.flush(DEADLINE)  # it is told once
        assert server.numbers == taken == [*range(24)]
        assert (client.stats.durable, client.stats.refused) == (24, {})
        assert not spool.exists()
    lost = [one.getMessage() for one in caplog.records if one.levelno == logging.ERROR]
    assert len(lost) == 1  # when it began


def test_a_spool_that_is_away_for_a_while_costs_what_comes_meanwhile_and_no_more(tmp_path: Path) -> None:
    spool, aside = tmp_path / "spool", tmp_path / "aside"
    with scripted() as server, joined(server, spool=spool, config=SMALL) as client:
        client.connect(DEADLINE)
        server.taking = False
        send_all(client, range(3))
        spool.rename(aside)
        assert client.send(wall(3)) is None
        assert "cannot keep them" in client.problem
        aside.rename(spool)
        assert client.send(wall(4)) is not None
        assert client.problem == ""
        server.taking = True
        with pytest.raises(KeyframeRefused, match="a keyframe was never sent"):
            client.flush(DEADLINE)
        assert server.numbers == [0, 1, 2, 4]


def test_what_a_dead_scanner_left_is_waited_for_while_its_folder_is_away(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sender, "_MAX_READS", 1)  # of a file that is there
    spool, aside = tmp_path / "spool", tmp_path / "aside"
    with Client(NOBODY, spool=spool, config=SMALL) as client:
        send_all(client, range(3))
    with scripted() as server:
        opened = Spool(spool, 1 << 16)
        spool.rename(aside)
        with joined(server, spool=opened, config=SMALL) as client:
            client.connect(DEADLINE)
            until(lambda: client._sender._unread > 0)
            aside.rename(spool)
            client.flush(DEADLINE)
            assert (server.numbers, client.stats.refused) == ([0, 1, 2], {})


def test_a_file_that_is_deleted_alone_is_put_back(tmp_path: Path) -> None:
    with scripted(taking=False) as server, joined(server, spool=tmp_path, config=SMALL) as client:
        send_all(client, range(3))
        (tmp_path / "000001.mcap").unlink()
        assert client.send(wall(3)) is not None
        assert (tmp_path / "000001.mcap").exists()
    with scripted() as server, joined(server, spool=tmp_path, config=SMALL) as client:
        client.flush(DEADLINE)
        assert server.numbers == [0, 1, 2, 3]


def test_what_is_lost_with_a_deleted_spool_is_said_at_the_end(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with Client(NOBODY, spool=tmp_path / "spool", config=SMALL) as client:
        send_all(client, range(3))
        shutil.rmtree(tmp_path / "spool")
    (line,) = [one.getMessage() for one in caplog.records if one.levelno == logging.ERROR]
    assert "3 records are not in the spool any more" in line


def test_a_deleted_lock_file_lets_nobody_else_in(tmp_path: Path) -> None:
    with Client(NOBODY, spool=tmp_path, config=SMALL) as client:
        send_all(client, range(1))
        (tmp_path / "lock").unlink()
        with pytest.raises(JournalError, match="in use by another scanner"):
            Spool(tmp_path, 1 << 16)


@pytest.mark.parametrize("torn", [1, 7, 15, 16, 17, 23, 24, 25])
def test_a_number_that_was_cut_off_shifts_no_other(tmp_path: Path, torn: int) -> None:
    """A full disk takes part of a write: read out of step, the rest would be numbers of nobody."""
    session = bytes(range(1, 17))
    gone = Tombstones(tmp_path, session)
    gone.add(7)
    path = tmp_path / TOMBSTONES
    os.truncate(path, 16 + 8)
    path.write_bytes((path.read_bytes() + b"\xff" * 8)[:torn])
    gone.add(8)
    assert Tombstones(tmp_path, session).numbers == ({7, 8} if torn >= 24 else {8})


def test_the_spools_limit_is_a_problem_too(tmp_path: Path) -> None:
    config = ClientConfig(policy="spool_all", spool_bytes=1 << 20)
    with Client(NOBODY, spool=tmp_path, config=config) as client:
        until(lambda: client.send(noise(0)) is None)
        assert "it has reached its limit of 1048576 bytes (spool_bytes)" in client.problem


def test_a_spool_whose_folder_goes_between_two_looks_is_taken_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Client(NOBODY, spool=tmp_path, config=SMALL) as client:
        send_all(client, range(2))
    monkeypatch.setattr(journal, "segments", lambda _: [])  # what a look finds while the folder is away
    spool = Spool(tmp_path, 1 << 16)
    assert len(spool.waiting) == 2
    spool.close()


@pytest.mark.parametrize("what", ["EIO", "said to be gone", "folder away for a moment"])
def test_no_newer_file_is_deleted_before_an_older_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    """The next scanner goes on behind the last number that is there: the server may know a higher one."""
    first, last = Spool(tmp_path, 1), 0
    for _ in range(4):
        entry = first.write([b"a record", b"of a file of its own"])
        first.add(entry)
        last = entry.seq
    unlink = Path.unlink

    def refuse_the_first(path: Path, missing_ok: bool = False) -> None:
        if path.name != "000001.mcap":
            unlink(path, missing_ok)
        elif what != "said to be gone":
            code = errno.EIO if what == "EIO" else errno.ENOENT
            raise OSError(code, os.strerror(code))

    with monkeypatch.context() as broken:
        broken.setattr(Path, "unlink", refuse_the_first)
        first.drop(last)
        first.close()
    second = Spool(tmp_path, 1)
    assert (second.session, second.left) == (first.session, last)
    second.drop(last)
    second.close()
    assert not list(tmp_path.glob("*.mcap"))
