# SPDX-License-Identifier: MIT
"""Disks that are full, slow to forget, read-only or failing, and folders with more in them than segments."""

import errno
import logging
import os
import shutil
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from failures import raising, refuse

from tsfusion import journal
from tsfusion.core.errors import JournalError
from tsfusion.journal import Journal, Position, inspection, mcap_layout, segment_path, state_folder
from tsfusion.journal.segments import OpenSegment

BIG = 1 << 30
SESSION = bytes(range(16))


def fill(log: Journal, count: int, first: int = 1, size: int = 1000) -> list[Position]:
    return [log.append([b"head", bytes(size)], session=SESSION, seq=first + i) for i in range(count)]


def write(folder: Path, count: int, segment_bytes: int = BIG) -> None:
    log = Journal(folder, segment_bytes)
    fill(log, count)
    log.close()


def seqs(folder: Path) -> list[int]:
    return [found.seq for found in Journal(folder, BIG).found]


# --- a full disk ---


def test_a_disk_that_really_fills_up_loses_nothing_and_takes_more_when_there_is_room(
    small_disk: Callable[[int], Path],
) -> None:
    disk = small_disk(1)
    ballast = disk / "ballast"
    ballast.write_bytes(bytes(400_000))
    log = Journal(disk / "journal", 200_000)
    written, refused = [], []
    for seq in range(1, 100):
        try:
            fill(log, 1, first=seq, size=30_000)
            written.append(seq)
        except JournalError as error:
            refused.append(str(error))
            if len(refused) == 10:
                ballast.unlink()
    log.close()
    again = Journal(disk / "journal", 200_000)
    assert ([found.seq for found in again.found], again.damaged) == (written, 0)
    assert len(refused) > 10
    assert all("No space left on device" in why for why in refused)
    assert len(written) > 20


def test_append_stops_before_the_disk_is_full(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    free = [100_000_000]
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=free[0]))
    log = Journal(tmp_path, BIG, min_free_bytes=64_000_000)
    fill(log, 1)
    free[0] = 64_000_500
    monkeypatch.setattr(time, "monotonic", lambda: 1e9)  # the last look was long ago
    with pytest.raises(JournalError, match=r"64\.0 MB free, and 64\.0 MB must stay so"):
        fill(log, 1, first=2)
    free[0] = 70_000_000  # and the next one is at once
    fill(log, 1, first=2)
    log.close()
    assert seqs(tmp_path) == [1, 2]


def test_the_disk_is_looked_at_now_and_then_and_never_filled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    limit, looks = 64 << 20, 0
    free = limit + (40 << 20)
    log = Journal(tmp_path, BIG, sync=False, min_free_bytes=limit)

    def left(folder: Path) -> SimpleNamespace:
        nonlocal looks
        looks += 1
        return SimpleNamespace(free=free - log.nbytes)

    monkeypatch.setattr(shutil, "disk_usage", left)
    monkeypatch.setattr(time, "monotonic", lambda: 5.0)
    with pytest.raises(JournalError, match="must stay so"):
        fill(log, 1000, size=1 << 20)
    assert limit - 2000 <= free - log.nbytes <= limit + (1 << 20)
    assert looks <= 4
    log.close()


def test_the_real_disk_says_how_much_is_free(tmp_path: Path) -> None:
    with pytest.raises(JournalError, match="must stay so: free some space"):
        fill(Journal(tmp_path, BIG, min_free_bytes=1 << 60), 1)


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EIO, errno.EROFS, errno.EDQUOT])
@pytest.mark.parametrize("call", ["fdatasync", "fsync"])
def test_a_disk_that_refuses_is_an_error_and_not_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int, call: str
) -> None:
    log = Journal(tmp_path, BIG)
    with monkeypatch.context() as patched:
        patched.setattr(os, call, refuse(code))  # fsync: of the folder that a first segment is made in
        with pytest.raises(JournalError, match=os.strerror(code)):
            fill(log, 1)
    assert journal.segments(tmp_path) == []
    fill(log, 2)
    with monkeypatch.context() as patched:
        patched.setattr(os, "fdatasync", refuse(code))
        with pytest.raises(JournalError, match=os.strerror(code)):
            fill(log, 1, first=3)
    assert seqs(tmp_path) == [1, 2]  # a later scan would take the third for the one that comes now
    (position,) = fill(log, 1, first=4)
    assert journal.read(tmp_path, position).seq == 4
    log.close()
    assert seqs(tmp_path) == [1, 2, 4]


@pytest.mark.parametrize("when", ["while it is written", "when it is there"])
def test_what_was_refused_is_cut_off_on_the_disk_as_well(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, when: str
) -> None:
    """A power cut must not bring back a record that was reported as not written."""
    log, path = Journal(tmp_path, BIG), segment_path(tmp_path, 1)
    fill(log, 1)
    size, synced = path.stat().st_size, list[int]()
    with monkeypatch.context() as patched:
        refused = refuse(errno.EIO)
        if when == "while it is written":
            patched.setattr(os, "fdatasync", refused)
        else:
            looks = [refused, lambda *_: True]

            def is_in_place(segment: OpenSegment) -> bool:
                return bool(looks.pop()(segment))

            patched.setattr(OpenSegment, "is_in_place", property(is_in_place))
        patched.setattr(os, "fsync", lambda descriptor: synced.append(os.fstat(descriptor).st_size))
        with pytest.raises(JournalError, match=os.strerror(errno.EIO)):
            fill(log, 1, first=2)
    assert synced[-1:] == [size]
    assert path.stat().st_size == size


def test_an_interrupted_append_leaves_nothing_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = Journal(tmp_path, BIG)
    fill(log, 1)

    with monkeypatch.context() as patched:
        patched.setattr(os, "fdatasync", raising(KeyboardInterrupt()))
        with pytest.raises(KeyboardInterrupt):
            fill(log, 1, first=2)
    fill(log, 1, first=3)
    log.close()
    assert seqs(tmp_path) == [1, 3]


def test_a_read_only_folder_is_read_and_not_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path, 2)
    real = os.open

    def read_only(path: Any, flags: int, *more: Any, **options: Any) -> int:
        if flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
            raise OSError(errno.EROFS, "Read-only file system")
        return real(path, flags, *more, **options)

    monkeypatch.setattr(os, "open", read_only)
    log = Journal(tmp_path, BIG)
    assert len(log.found) == 2
    with pytest.raises(JournalError, match="Read-only file system"):
        fill(log, 1, first=3)
    log.close()


def test_a_disk_that_stays_full_leaves_no_heap_of_segments(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = Journal(tmp_path, BIG)
    monkeypatch.setattr(os, "fdatasync", refuse(errno.ENOSPC))
    for _ in range(20):
        with pytest.raises(JournalError):
            fill(log, 1)
    assert len(journal.segments(tmp_path)) <= 1
    monkeypatch.undo()
    (position,) = fill(log, 1)
    assert journal.read(tmp_path, position).seq == 1
    log.close()


def test_a_segment_that_cannot_be_closed_does_not_take_its_last_keyframe_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = Journal(tmp_path, 1)  # each keyframe fills a segment
    with monkeypatch.context() as patched:
        patched.setattr(Journal, "rotate", refuse(errno.ENOSPC))
        fill(log, 1)
    fill(log, 1, first=2)
    log.close()
    assert [found.position.segment for found in Journal(tmp_path, BIG).found] == [1, 2]
    assert seqs(tmp_path) == [1, 2]


def test_a_journal_whose_folder_vanishes_is_a_clear_error(tmp_path: Path) -> None:
    log = Journal(tmp_path / "journal", 1)
    fill(log, 1)
    shutil.rmtree(tmp_path / "journal")
    with pytest.raises(JournalError, match="No such file"):
        fill(log, 1, first=2)


# --- what outlasts a power cut ---


def test_everything_is_on_the_disk_in_the_order_that_recovery_needs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    happened: list[str] = []

    def watch(name: str) -> None:
        real = getattr(os, name)

        def watched(descriptor: int) -> None:
            path = Path(os.readlink(f"/proc/self/fd/{descriptor}"))
            happened.append(f"{path.name} {path.stat().st_size if path.is_file() else ''}".strip())
            real(descriptor)

        monkeypatch.setattr(os, name, watched)

    watch("fsync")
    watch("fdatasync")
    log = Journal(tmp_path / "maps" / "journal", BIG)
    assert happened == [tmp_path.name, "maps"]  # folders that were made, by those they are in
    happened.clear()
    first, second = fill(log, 2)
    # The start of a segment before its name, and both before its first record.
    assert happened[:2] == [f"000001.mcap {mcap_layout.segment_start_bytes()}", "journal"]
    assert happened[2:] == [f"000001.mcap {second.offset}", f"000001.mcap {log.nbytes}"]
    happened.clear()
    log.close()
    assert happened == [f"000001.mcap {log.nbytes}"]
    assert first.offset == mcap_layout.segment_start_bytes()


def test_order_is_by_place_whatever_the_clock_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = Journal(tmp_path, 4000)
    clock = iter(range(10**18, 0, -(10**15)))
    monkeypatch.setattr(time, "time_ns", lambda: next(clock))
    fill(log, 12)
    log.close()
    assert len(journal.segments(tmp_path)) > 2
    found = Journal(tmp_path, BIG)
    assert [record.seq for record in found.found] == list(range(1, 13))
    assert found.damaged == 0
    paths = [segment_path(tmp_path, number) for number in journal.segments(tmp_path)]
    stamps = [record.logged_ns for path in paths for record in journal.records(path)]
    assert stamps == sorted(stamps, reverse=True)


# --- retention ---


def test_the_oldest_segments_go_and_no_other(tmp_path: Path) -> None:
    log = Journal(tmp_path, 4000)
    fill(log, 19)
    numbers = journal.segments(tmp_path)
    sizes = {number: segment_path(tmp_path, number).stat().st_size for number in numbers}
    assert log.retire(numbers[-1], sum(sizes.values())) == 0
    freed = log.retire(numbers[-1], sum(sizes.values()) - sizes[numbers[0]] - 1)
    assert freed == sizes[numbers[0]] + sizes[numbers[1]]
    assert journal.segments(tmp_path) == numbers[2:]
    assert log.retire(numbers[3], 0) == sizes[numbers[2]]  # what is not below stays, however small the limit
    assert journal.segments(tmp_path) == numbers[3:]
    assert log.retire(10**9, 0) > 0
    assert journal.segments(tmp_path) == [log.segment]  # nor does the one that is written to go
    log.close()
    assert seqs(tmp_path) == [19]


def test_a_segment_that_cannot_be_deleted_is_passed_over(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    write(tmp_path, 10, 4000)
    log = Journal(tmp_path, 4000)
    segment_path(tmp_path, 1).unlink()
    segment_path(tmp_path, 1).mkdir()
    assert log.retire(10**9, 0) > 0
    assert journal.segments(tmp_path) == [1]
    assert "cannot delete" in caplog.text


# --- what else may lie in the folder ---


def test_foreign_files_are_left_alone(tmp_path: Path) -> None:
    write(tmp_path, 2)
    numbered = ("7.mcap", "0000001.mcap", "٣٣٣٣٣٣.mcap", "000009.mcap.bak", ".000005.mcap")
    for name in ("lock", "notes.mcap", *numbered):
        (tmp_path / name).write_bytes(b"not ours")
    (tmp_path / "000004").mkdir()
    log = Journal(tmp_path, BIG)
    assert journal.segments(tmp_path) == [1]
    assert (len(log.found), log.damaged, log.segment) == (2, 0, 2)


@pytest.mark.parametrize("content", [b"", mcap_layout.MAGIC, mcap_layout.OPENING, mcap_layout.OPENING[:20]])
def test_a_segment_that_was_just_begun_holds_nothing(tmp_path: Path, content: bytes) -> None:
    write(tmp_path, 2)
    segment_path(tmp_path, 2).write_bytes(content)
    log = Journal(tmp_path, BIG)
    assert ([found.seq for found in log.found], log.damaged) == ([1, 2], 0)
    fill(log, 1, first=3)
    log.close()
    assert seqs(tmp_path) == [1, 2, 3]


def test_a_segment_of_rubbish_costs_itself_alone(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write(tmp_path, 12, 4000)
    per_segment = Counter(found.position.segment for found in Journal(tmp_path, BIG).found)
    segment_path(tmp_path, 2).write_bytes(os.urandom(9000))
    log = Journal(tmp_path, BIG)
    del per_segment[2]
    assert Counter(found.position.segment for found in log.found) == per_segment
    assert log.damaged >= 1
    assert [one for one in caplog.records if one.levelno == logging.ERROR]
    fill(log, 1, first=100)
    log.close()


@pytest.mark.parametrize("what", ["folder", "EACCES", "EMFILE", "EIO", "dangling"])
def test_a_segment_that_cannot_be_read_is_not_passed_over(
    tmp_path: Path, what: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Keyframes in it may be there at the next start, when those behind them are in the map."""
    write(tmp_path, 12, 4000)
    before = Journal(tmp_path, BIG).found
    readable = sum(found.position.segment != 2 for found in before)
    bad, aside = segment_path(tmp_path, 2), tmp_path / "aside"
    if is_unseen := what in ("EACCES", "EMFILE"):
        code = getattr(errno, what)
        real = os.open

        def guarded(path: Any, *arguments: Any, **more: Any) -> int:
            if path == bad:
                raise OSError(code, os.strerror(code))
            return real(path, *arguments, **more)

        monkeypatch.setattr(os, "open", guarded)
    elif what == "EIO":
        pread, inode = os.pread, bad.stat().st_ino

        def failing(descriptor: int, count: int, at: int) -> bytes:
            if os.fstat(descriptor).st_ino == inode:
                raise OSError(errno.EIO, "Input/output error")
            return pread(descriptor, count, at)

        monkeypatch.setattr(os, "pread", failing)
    else:
        bad.rename(aside)
        if what == "folder":
            bad.mkdir()
        else:
            bad.symlink_to("nowhere")
    with pytest.raises(
        JournalError, match=r"cannot read .*000002\.mcap: .*; make it readable, or move it away"
    ):
        Journal(tmp_path, BIG)
    place = state_folder.find_journal(tmp_path)
    if is_unseen:
        for inspect in (inspection.summarize, inspection.verify):
            with pytest.raises(JournalError, match=r"cannot read .*000002\.mcap"):
                inspect(place, lambda *_: None)
    else:
        info, verdict = (of(place, lambda *_: None) for of in (inspection.summarize, inspection.verify))
        assert [one.segment for one in info.problems] == ["000002.mcap"]
        assert (info.keyframes, verdict.intact) == (readable, False)
    monkeypatch.undo()
    if aside.exists():
        bad.unlink() if bad.is_symlink() else bad.rmdir()
        aside.rename(bad)
    assert Journal(tmp_path, BIG).found == before


def test_only_bad_sectors_are_read_as_damage(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Files that the system refuses for want of memory may be there the next time."""
    write(tmp_path, 3)
    monkeypatch.setattr(os, "pread", refuse(errno.ENOMEM))
    with pytest.raises(JournalError) as raised:
        journal.list_records(segment_path(tmp_path, 1))
    assert raised.value.errno == errno.ENOMEM
    assert "the disk cannot read all of it" not in caplog.text


def test_a_folder_that_cannot_be_listed_is_one_clear_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "listdir", refuse(errno.EACCES))
    with pytest.raises(JournalError, match=r"cannot list .*: Permission denied"):
        Journal(tmp_path, BIG)


def test_maps_that_cannot_be_listed_are_one_clear_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert state_folder.map_names(tmp_path) == []  # there is none yet
    (tmp_path / "maps").mkdir()
    monkeypatch.setattr(os, "listdir", refuse(errno.EIO))
    with pytest.raises(JournalError, match=r"cannot list .*maps: Input/output error"):
        state_folder.map_names(tmp_path)


def test_a_name_that_is_too_long_is_not_cut_to_another_one(tmp_path: Path) -> None:
    log = Journal(tmp_path, BIG)
    with pytest.raises(JournalError, match="at most 32 bytes"):
        log.append([b"head"], session=SESSION, seq=1, client="ä" * 17)
    position = log.append([b"head"], session=SESSION, seq=1, client="ä" * 16)
    assert journal.read(tmp_path, position).client == "ä" * 16
    log.close()
