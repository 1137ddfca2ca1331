# SPDX-License-Identifier: MIT
"""Segments and folders that somebody deletes, moves or replaces under the process that writes them."""

import errno
import logging
import os
import shutil
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
from failures import refuse

from tsfusion import journal
from tsfusion.core.errors import JournalError
from tsfusion.journal import Journal, Position, segment_path
from tsfusion.journal.quarantine import Quarantine
from tsfusion.journal.segments import OpenSegment

BIG = 1 << 30
SESSION = bytes(range(16))


def fill(log: Journal, *numbers: int) -> list[Position]:
    return [log.append([b"head", bytes(1000)], session=SESSION, seq=seq) for seq in numbers]


def seqs(folder: Path) -> list[int]:
    return [found.seq for found in Journal(folder, BIG).found]


def unlinked(path: Path) -> None:
    path.unlink()


def moved(path: Path) -> None:
    path.rename(path.with_name("aside"))


def replaced(path: Path) -> None:
    copy = path.with_name("copy")
    shutil.copy(path, copy)
    copy.replace(path)


def made_again(path: Path) -> None:
    shutil.rmtree(path.parent)
    path.parent.mkdir()


@pytest.mark.parametrize("take", [unlinked, moved, replaced, made_again])
def test_an_open_segment_that_is_taken_away_is_put_back_with_every_record(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, take: Callable[[Path], None]
) -> None:
    folder = tmp_path / "journal"
    log = Journal(folder, BIG)
    positions = fill(log, 1, 2, 3)
    take(segment_path(folder, 1))
    positions += fill(log, 4)
    assert [journal.read(folder, position).seq for position in positions] == [1, 2, 3, 4]
    assert log.put_back == 1
    (line,) = [one for one in caplog.records if one.levelno == logging.ERROR]
    assert "000001.mcap was taken away" in line.getMessage()
    fill(log, 5)
    log.close()
    assert seqs(folder) == [1, 2, 3, 4, 5]


def test_a_large_segment_is_put_back_piece_by_piece(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Whoever waits for the same process waits for a piece at most; nothing is written meanwhile."""
    monkeypatch.setattr(sys.modules["tsfusion.journal.segments"], "_COPY_BYTES", 1 << 10)
    log, path = Journal(tmp_path, BIG, longest_wait=-1.0), segment_path(tmp_path, 1)
    fill(log, 1, 2, 3, 4)
    path.unlink()
    for call in (log.check, lambda: fill(log, 5)):
        with pytest.raises(JournalError, match=r"000001.mcap was taken away and is being put back") as raised:
            call()
        assert raised.value.temporary
    assert not path.exists()
    while not path.exists():
        with suppress(JournalError):
            log.check()
    fill(log, 5)
    path.rename(tmp_path / "aside")  # a closed one now
    segment_path(tmp_path, 2).unlink()
    log.close()  # does not end before it is whole
    (tmp_path / "aside").rename(path)
    assert (seqs(tmp_path), log.put_back) == ([1, 2, 3, 4, 5], 2)


def test_a_record_that_was_taken_back_is_not_put_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The record was reported as not written when the copy had it: nobody may find it twice."""
    log = Journal(tmp_path, BIG, longest_wait=-1.0)
    fill(log, 1)
    with monkeypatch.context() as patched:
        sync = OpenSegment.sync

        def too_late(segment: OpenSegment) -> None:
            sync(segment)
            segment.path.unlink()

        patched.setattr(OpenSegment, "sync", too_late)
        with pytest.raises(JournalError, match="is being put back"):
            fill(log, 2)
    fill(log, 2, 3)
    log.close()
    assert seqs(tmp_path) == [1, 2, 3]


def test_a_segment_that_comes_back_by_itself_is_not_put_back_any_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.modules["tsfusion.journal.segments"], "_COPY_BYTES", 1 << 10)
    log, path = Journal(tmp_path, BIG, longest_wait=-1.0), segment_path(tmp_path, 1)
    fill(log, 1, 2, 3, 4)
    path.rename(tmp_path / "aside")
    with pytest.raises(JournalError, match="is being put back"):
        log.check()
    (tmp_path / "aside").rename(path)
    fill(log, 5)
    log.close()
    assert (seqs(tmp_path), log.put_back) == ([1, 2, 3, 4, 5], 0)
    assert [one.name for one in tmp_path.iterdir()] == [path.name]


def test_what_lies_in_its_place_is_kept(tmp_path: Path) -> None:
    log, path = Journal(tmp_path, BIG), segment_path(tmp_path, 1)
    fill(log, 1)
    path.unlink()
    path.write_bytes(b"somebody's")
    fill(log, 2)
    assert path.with_name("000001.mcap.replaced").read_bytes() == b"somebody's"
    assert seqs(tmp_path) == [1, 2]


def test_a_file_system_that_draws_inode_numbers_moves_no_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os.path, "samestat", lambda *_: False)  # some network file systems
    log = Journal(tmp_path, BIG)
    fill(log, 1, 2, 3)
    assert (log.put_back, log.segment) == (0, 1)


@pytest.mark.parametrize("end", ["check", "close"])
def test_it_is_put_back_although_nothing_more_is_written(tmp_path: Path, end: str) -> None:
    log = Journal(tmp_path, BIG)
    fill(log, 1, 2)
    segment_path(tmp_path, 1).unlink()
    getattr(log, end)()
    assert seqs(tmp_path) == [1, 2]


def test_a_record_is_not_acknowledged_in_a_file_that_vanished_meanwhile(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = Journal(tmp_path, BIG)
    fill(log, 1)
    sync = os.fdatasync

    def too_late(descriptor: int) -> None:
        sync(descriptor)
        segment_path(tmp_path, 1).unlink(missing_ok=True)

    monkeypatch.setattr(os, "fdatasync", too_late)
    (position,) = fill(log, 2)
    assert journal.read(tmp_path, position).seq == 2
    assert seqs(tmp_path) == [1, 2]


def test_a_record_of_a_file_whose_place_is_not_known_is_taken_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A record was reported as not written: nobody may find it beside the one that comes again."""
    log = Journal(tmp_path, BIG)
    fill(log, 1)
    with monkeypatch.context() as patched:
        patched.setattr(os, "fdatasync", lambda _: patched.setattr(OpenSegment, "is_in_place", refused))
        refused = property(refuse(errno.EIO))
        with pytest.raises(JournalError, match="Input/output error"):
            fill(log, 2)
    fill(log, 2, 3)
    log.close()
    again = Journal(tmp_path, BIG)
    assert ([found.seq for found in again.found], again.damaged) == ([1, 2, 3], 0)
    assert journal.segments(tmp_path) == [1, 2]  # nothing is written behind the place of what was taken back


def test_a_disk_that_cannot_take_it_back_now_loses_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = Journal(tmp_path, BIG)
    fill(log, 1, 2)
    segment_path(tmp_path, 1).unlink()
    for _ in range(3):
        with monkeypatch.context() as patched:
            patched.setattr(os, "fsync", refuse(errno.ENOSPC))
            with pytest.raises(JournalError, match="No space left"):
                fill(log, 3)
    assert list(tmp_path.iterdir()) == []
    fill(log, 4)
    log.close()
    assert seqs(tmp_path) == [1, 2, 4]


def test_a_folder_that_is_away_for_a_while_costs_nothing(tmp_path: Path) -> None:
    folder, aside = tmp_path / "journal", tmp_path / "aside"
    log = Journal(folder, BIG)
    fill(log, 1)
    folder.rename(aside)
    for call in (lambda: fill(log, 2), log.check):
        with pytest.raises(JournalError, match="No such file") as raised:
            call()
        assert (raised.value.errno, raised.value.temporary) == (errno.ENOENT, True)
    aside.rename(folder)
    log.check()
    fill(log, 3)
    log.close()
    assert (seqs(folder), journal.segments(folder), log.put_back) == ([1, 3], [1], 0)


@pytest.mark.parametrize("is_open", [True, False])
def test_nothing_is_written_into_an_empty_folder_in_the_place_of_the_journal(
    tmp_path: Path, is_open: bool
) -> None:
    """As a disk leaves it that is unmounted: what is written there is hidden when it is mounted again."""
    folder, aside = tmp_path / "journal", tmp_path / "aside"
    log = Journal(folder, BIG)
    fill(log, 1)
    if not is_open:
        log.rotate()
    folder.rename(aside)
    folder.mkdir()
    for call in (lambda: fill(log, 2), log.check):
        with pytest.raises(JournalError, match=r"none of its segments is there; put them back") as raised:
            call()
        assert raised.value.temporary
    assert list(folder.iterdir()) == []
    folder.rmdir()
    aside.rename(folder)
    log.check()
    fill(log, 3)
    log.close()
    assert seqs(folder) == [1, 3]


def test_a_journal_whose_files_are_all_deleted_goes_on_and_names_them(tmp_path: Path) -> None:
    log = Journal(tmp_path, 1)  # each record fills a segment
    fill(log, 1, 2)
    for number in (1, 2):
        segment_path(tmp_path, number).unlink()
    log.check()
    assert log.missing == [1, 2]
    fill(log, 3)
    assert (seqs(tmp_path), journal.segments(tmp_path)) == ([3], [3])


def test_closed_segments_that_vanish_are_named_until_they_are_back(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    log = Journal(tmp_path, 1)  # each record fills a segment
    fill(log, 1, 2, 3)
    segment_path(tmp_path, 2).rename(tmp_path / "aside")
    for _ in range(3):
        log.check()
    assert log.missing == [2]
    (line,) = [one for one in caplog.records if one.levelno == logging.ERROR]
    assert "000002.mcap is not there any more" in line.getMessage()
    (tmp_path / "aside").rename(segment_path(tmp_path, 2))
    log.check()
    assert log.missing == []
    segment_path(tmp_path, 2).unlink()
    fill(log, 4)
    again = Journal(tmp_path, 1)
    assert ([found.seq for found in again.found], again.absent) == ([1, 3, 4], 1)


def test_a_segment_that_is_gone_already_can_be_forgotten(tmp_path: Path) -> None:
    log = Journal(tmp_path / "journal", 1)
    fill(log, 1, 2)
    segment_path(log.folder, 1).unlink()
    log.forget(1)
    assert log.first == 2
    shutil.rmtree(log.folder)
    with pytest.raises(JournalError, match="No such file"):  # the folder may come back, and the file with it
        log.forget(2)


def test_a_file_with_the_next_number_is_stepped_over(tmp_path: Path) -> None:
    log = Journal(tmp_path, BIG)
    segment_path(tmp_path, 1).write_bytes(b"a copy from somewhere")
    (position,) = fill(log, 1)
    assert position.segment == 2
    assert segment_path(tmp_path, 1).read_bytes() == b"a copy from somewhere"


def test_records_are_read_from_files_that_are_deleted(tmp_path: Path) -> None:
    log = Journal(tmp_path / "spool", 3000, keep_open=True)
    positions = fill(log, 1, 2, 3, 4, 5)
    assert positions[-1].segment > 2
    shutil.rmtree(log.folder)
    kept = [log.read_kept(position) for position in positions]
    assert [record.seq for record in kept if record] == [1, 2, 3, 4, 5]
    with pytest.raises(JournalError):
        log.close()
    assert log.read_kept(positions[0]) is None
    assert not log.folder.exists()


def test_few_files_of_closed_segments_are_kept_open(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tsfusion.journal.writer._KEPT_OPEN", 4)
    log = Journal(tmp_path, 1, keep_open=True)
    before = len(os.listdir("/proc/self/fd"))
    positions = fill(log, *range(1, 21))
    assert len(os.listdir("/proc/self/fd")) <= before + 5
    assert log.read_kept(positions[0]) is None
    log.close()
    assert len(os.listdir("/proc/self/fd")) == before


def test_parts_of_killed_writers_are_swept_and_nothing_else(tmp_path: Path) -> None:
    ours = {tmp_path: ".000003.mcap.partial", tmp_path / "refused": ".00010203-7-values.mcap.partial"}
    (tmp_path / "refused").mkdir()
    theirs = ("notes.partial", ".notes.mcap.partial", "000007.mcap.partial", ".partial")
    for folder, name in ours.items():
        for one in (name, *theirs):
            (folder / one).write_bytes(b"half")
    Journal(tmp_path, BIG)
    Quarantine(tmp_path / "refused", BIG)
    for folder in ours:
        assert sorted(path.name for path in folder.iterdir() if path.is_file()) == sorted(theirs)


def test_a_quarantine_makes_no_folder_but_its_own(tmp_path: Path) -> None:
    """A map's folder that is away must not be made again: it could not be moved back."""
    kept = Quarantine(tmp_path / "map" / "quarantine", BIG)
    assert kept.keep([b"head"], session=SESSION, seq=1, reason="values") is None
    assert "No such file" in kept.problem
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "map").mkdir()
    assert kept.keep([b"head"], session=SESSION, seq=1, reason="values") is not None
    assert kept.problem == ""


def test_a_full_quarantine_says_so(tmp_path: Path) -> None:
    kept = Quarantine(tmp_path, 3000)
    for seq in range(1, 4):
        kept.keep([b"head", bytes(1000)], session=SESSION, seq=seq, reason="values")
    assert "is full: the oldest keyframes in it are deleted" in kept.problem


def test_what_is_put_aside_is_on_the_disk(tmp_path: Path, disk_calls: list[str]) -> None:
    name = "00010203-1-values.mcap"
    Quarantine(tmp_path / "refused", BIG).keep([b"head"], session=SESSION, seq=1, reason="values")
    part = f".{name}.partial"
    assert disk_calls == [f"sync {tmp_path.name}", f"sync {part}", f"{part} > {name}", "sync refused"]
