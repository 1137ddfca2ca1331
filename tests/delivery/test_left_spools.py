# SPDX-License-Identifier: MIT
"""Spools that earlier scans left: found, described, gone on with in their own world only, deleted."""

import os
from pathlib import Path

import pytest
from clients_and_spools import NOBODY, send_all
from failures import raising
from keyframes_and_servers import pose

from tsfusion import Client
from tsfusion.core.errors import JournalError
from tsfusion.delivery import left_spools
from tsfusion.delivery import spool as spool_module
from tsfusion.delivery.spool import TOMBSTONES, Spool, Tombstones
from tsfusion.journal import Journal


def left(folder: Path, count: int = 2, **settings: object) -> None:
    """Keyframes that no server took."""
    with Client(NOBODY, spool=folder, policy="spool_all", **settings) as client:  # type: ignore[arg-type]
        send_all(client, range(count))
        if count > 1:
            client.correct({1: pose(1)})


def test_what_waits_is_described_by_its_own_records(tmp_path: Path) -> None:
    left(tmp_path / "default", 3, world="w1")
    left(tmp_path / "whatever", 1, map="hall")  # neither world nor the layout of names: an older version's
    (tmp_path / "empty").mkdir()
    Client(NOBODY, spool=tmp_path / "sent").close()
    first, second = left_spools.find(tmp_path)
    assert (first.folder.name, first.map, first.world, first.own_world) == ("default", "default", "w1", "w1")
    assert (second.map, second.world, second.own_world) == ("hall", "", second.session.hex())
    assert first.since_ns < second.since_ns
    assert first.used_by is None
    assert first.count()[:2] == (3, 1)
    assert first.count()[2] > 1000
    assert left_spools.find(tmp_path / "default") == [first]
    assert left_spools.find(tmp_path / "nowhere") == []


def test_a_new_scan_never_writes_where_another_ones_keyframes_wait(tmp_path: Path) -> None:
    assert left_spools.free_folder(tmp_path, "hall") == tmp_path / "hall"
    left(tmp_path / "hall", 1)
    assert left_spools.free_folder(tmp_path, "hall") == tmp_path / "hall.2"
    with Client(NOBODY, spool=tmp_path / "hall.2"):  # in use, though empty
        assert left_spools.free_folder(tmp_path, "hall") == tmp_path / "hall.3"
    assert left_spools.free_folder(tmp_path, "hall") == tmp_path / "hall.2"


def test_a_spool_goes_on_in_its_own_world_only(tmp_path: Path) -> None:
    left(tmp_path, world="w1")
    with pytest.raises(JournalError, match="holds 3 keyframes of another world, w1: send them first"):
        Client(NOBODY, spool=tmp_path, world="w2")
    with Client(NOBODY, spool=tmp_path) as client:
        assert client._outbox.spool.world == "w1"
    left(tmp_path / "older", 1)
    with Client(NOBODY, spool=tmp_path / "older", world="w2") as client:  # it names none: so it is told
        assert client._outbox.spool.world == "w2"


def test_a_spool_in_use_is_neither_taken_nor_deleted(tmp_path: Path) -> None:
    left(tmp_path / "default", 2)
    with Client(NOBODY, spool=tmp_path / "default"):
        (found,) = left_spools.find(tmp_path)
        assert found.used_by == str(os.getpid())
        with pytest.raises(JournalError, match=r"in use by another scanner \(pid"):
            left_spools.drop(found)
    left_spools.drop(found)
    assert left_spools.find(tmp_path) == []
    assert not list((tmp_path / "default").glob("*.mcap"))


def test_what_left_a_spool_stays_out_of_it_and_few_numbers_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(spool_module, "_MANY_TOMBSTONES", 8)
    spool = Spool(tmp_path, 5000)
    for _ in range(100):
        spool.add(spool.write([bytes(1000)]))
        if len(spool.waiting) > 1:
            spool.remove(1)
    assert (tmp_path / TOMBSTONES).stat().st_size < 16 + 8 * 50
    spool.close()
    again = Spool(tmp_path, 5000)
    assert [entry.seq for entry in again.waiting] == [1]
    assert again.used_bytes == sum(path.stat().st_size for path in tmp_path.glob("*.mcap"))
    again.close()


def test_a_folder_of_two_sessions_is_no_spool(tmp_path: Path) -> None:
    """Both would be sent as one, and of two records with one number the second would count as sent."""
    for number in range(2):
        writer = Journal(tmp_path, 1 << 16)
        writer.append([b"head"], session=bytes([number]) * 16, seq=1)
        writer.close()
    with pytest.raises(JournalError, match="holds keyframes of 2 sessions: not one spool"):
        Spool(tmp_path, 1 << 16)


def test_a_number_that_nobody_may_find_is_not_used_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The tombstone of a number would hide the record that gets that number again."""
    spool = Spool(tmp_path, 1 << 16)
    spool.add(spool.write([b"head"]))
    with monkeypatch.context() as broken:
        broken.setattr(Journal, "append", raising(JournalError("the disk fails")))
        with pytest.raises(JournalError):
            spool.write([b"head"])
    spool.close()
    monkeypatch.setattr(spool_module, "_RESTART_GAP", 1)
    monkeypatch.setattr(spool_module, "_RESTART_SPREAD", 1)
    again = Spool(tmp_path, 1 << 16)
    assert (again.left, again.next_seq) == (2, 3)
    again.close()


def test_numbers_that_another_session_left_mean_nothing(tmp_path: Path) -> None:
    Tombstones(tmp_path, bytes(16)).add(1)
    for _ in range(2):
        assert Tombstones(tmp_path, bytes(range(16))).numbers == set()
