# SPDX-License-Identifier: MIT
"""Records that are erased: their bytes are gone, and nothing else of the journal has changed."""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from keyframes_and_servers import wall
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader

from tsfusion import journal
from tsfusion.core.errors import JournalError
from tsfusion.core.number_ranges import NumberRanges, parse
from tsfusion.journal import Erased, Journal, Position, erasing, state_folder
from tsfusion.journal.inspection import summarize, verify
from tsfusion.journal.journaled_keyframes import JournalRecording
from tsfusion.journal.quarantine import Quarantine
from tsfusion.journal.recovery import recover
from tsfusion.wire.records import codec

SESSION = b"s" * 16


class Written:
    """A journal of six keyframes in two segments, the second one open."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.log = Journal(folder, 1 << 20)
        self.frames = [codec.encode(wall(i), session=SESSION, seq=i + 1, jpeg_quality=90) for i in range(6)]
        self.positions = [self._append(i) for i in range(4)]
        self.log.rotate()
        self.positions += [self._append(4), self._append(5)]

    def _append(self, i: int) -> Position:
        return self.log.append(self.frames[i], session=SESSION, seq=i + 1, client="robot")

    @property
    def content(self) -> bytes:
        return b"".join(path.read_bytes() for path in sorted(self.folder.glob("*.mcap")))

    def has(self, i: int) -> bool:
        """Whether any piece of the keyframe's bytes that no other one has is in any file of the folder."""
        others = b"".join(frame for j, frames in enumerate(self.frames) if j != i for frame in frames)
        pieces = [frame[at : at + 24] for frame in self.frames[i] for at in range(len(frame) - 24)]
        own = [piece for piece in pieces if piece not in others]
        assert len(own) > 100
        return any(piece in self.content for piece in own)

    def erase(self, *numbers: int) -> int:
        return list(self.log.erase(self.positions[seq - 1] for seq in numbers))[-1]


@pytest.fixture
def written(tmp_path: Path) -> Iterator[Written]:
    found = Written(tmp_path / "journal")
    yield found
    found.log.close()


def seqs(folder: Path) -> list[tuple[int, bool]]:
    """Number of each record, and whether it is erased."""
    return [
        (step.seq, isinstance(step, Erased))
        for number in journal.segments(folder)
        for step in journal.scan_records(journal.segment_path(folder, number))
    ]


def test_erased_bytes_are_gone_and_all_others_stay_where_they_are(written: Written) -> None:
    assert written.has(1)
    assert written.erase(2, 4, 5) == 3
    assert [written.has(i) for i in range(6)] == [True, False, True, False, False, True]
    assert seqs(written.folder) == [(1, 0), (2, 1), (3, 0), (4, 1), (5, 1), (6, 0)]
    for i in (0, 2, 5):
        assert [*map(bytes, journal.read(written.folder, written.positions[i]).frames)] == written.frames[i]
    with pytest.raises(JournalError, match="was erased") as caught:
        journal.read(written.folder, written.positions[1])
    assert caught.value.is_erased
    assert not caught.value.temporary
    assert written.erase(2, 3) == 2  # one of them a second time
    assert seqs(written.folder)[1:3] == [(2, True), (3, True)]


def test_the_open_segment_is_closed_first_and_the_journal_goes_on(written: Written) -> None:
    written.erase(6)
    position = written.log.append(written.frames[0], session=SESSION, seq=7)
    assert (position.segment, journal.read(written.folder, position).seq) == (3, 7)
    written.log.close()
    assert written.log.nbytes == len(written.content)


def test_a_new_writer_knows_the_numbers_and_no_damage(written: Written) -> None:
    written.erase(4, 6)
    written.log.close()
    again = Journal(written.folder, 1 << 20)
    assert [(one.seq, one.is_erased, one.client) for one in again.found if one.is_erased] == [
        (4, True, "robot"),
        (6, True, "robot"),
    ]
    assert (len(again.found), again.damaged) == (6, 0)
    again.close()


def test_mcap_tools_read_what_is_left(written: Written) -> None:
    written.erase(2)
    path = journal.segment_path(written.folder, 1)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert (summary.statistics.message_count, summary.statistics.chunk_count) == (4, 4)
        assert [message.sequence for _, _, message in reader.iter_messages("/keyframes")] == [1, 3, 4]
    with path.open("rb") as file:
        assert sum(1 for _ in StreamReader(file, validate_crcs=True).records) > 0


def test_whoever_inspects_the_journal_calls_it_erased(written: Written, tmp_path: Path) -> None:
    written.erase(1, 2)
    written.log.close()
    place = state_folder.find_journal(written.folder)
    verdict = verify(place, lambda *_: None)
    assert (verdict.intact, verdict.lost, verdict.keyframes) == (True, 0, 4)
    assert [one.kind for one in verdict.problems] == ["erased", "erased"]
    info = summarize(place, lambda *_: None)
    assert (info.erased, info.lost, [one.state for one in info.segments]) == (2, 0, ["closed", "closed"])
    assert [keyframe.timestamp_ns for keyframe in JournalRecording(written.folder)] == [
        wall(i).timestamp_ns for i in range(2, 6)
    ]
    done = recover(place, tmp_path / "saved", 1 << 20, lambda *_: None)
    assert (done.keyframes, done.lost, done.problems) == (4, 0, [])


@pytest.mark.parametrize("after", range(6))
def test_a_crash_on_the_way_loses_nothing_else_and_the_next_run_goes_on(
    written: Written, after: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    written.log.close()
    path, write = journal.segment_path(written.folder, 1), os.pwrite
    left = after

    def dying(*given: Any) -> int:
        nonlocal left
        left -= 1
        if left < 0:
            raise KeyboardInterrupt
        return write(*given)

    offsets = [written.positions[i].offset for i in (1, 2)]
    with monkeypatch.context() as patch:
        patch.setattr(os, "pwrite", dying)
        if after < 5:  # two marks, two times zeros, one index
            with pytest.raises(KeyboardInterrupt):
                list(erasing.erase(path, offsets))
        else:
            list(erasing.erase(path, offsets))
    place = state_folder.find_journal(path)
    verdict = verify(place, lambda *_: None)
    assert (verdict.intact, verdict.lost) == (True, 0)
    assert [step.seq for step in journal.scan_records(path) if hasattr(step, "seq")] == [1, 2, 3, 4]
    is_left = [one.what for one in verdict.problems if "is being erased" in one.what]
    assert len(is_left) == max(min(after, 2) - max(after - 2, 0), 0)
    assert list(erasing.erase(path, offsets))[-1] == 2
    assert not any(map(written.has, (1, 2)))
    assert all(map(written.has, (0, 3)))


def test_nothing_is_erased_where_there_is_no_record(written: Written) -> None:
    before = written.content
    with pytest.raises(JournalError, match="holds no whole record at byte 99"):
        list(written.log.erase([written.positions[0], Position(1, 99)]))
    assert written.content == before
    written.log.rotate()
    journal.segment_path(written.folder, 1).unlink()
    assert written.erase(1) == 1  # gone with its segment


def test_keyframes_leave_the_quarantine(tmp_path: Path) -> None:
    kept = Quarantine(tmp_path, 1 << 20)
    for session, seq in ((SESSION, 1), (SESSION, 2), (b"t" * 16, 2)):
        kept.keep([b"head", b"body"], session=session, seq=seq, reason="crash")
    assert kept.drop(SESSION, NumberRanges([(2, 9)])) == 1
    names = sorted(path.name for path in tmp_path.iterdir())
    assert names == ["73737373-1-crash.mcap", "74747474-2-crash.mcap"]
    assert len(kept) == 2


def test_ranges_up_to_the_largest_number() -> None:
    last = (1 << 63) - 1
    ranges = NumberRanges([(5, last), (last, last), (1, 4)])
    assert (list(ranges), last in ranges, NumberRanges([(last, last)] * 2).count) == ([(1, last)], True, 1)


def test_a_large_range_needs_no_memory() -> None:
    assert parse("1-999999999999999999") == ((1, 999999999999999999),)


def test_ranges_of_numbers() -> None:
    ranges = NumberRanges(parse("3-5, 20,6 ,9-9"))
    assert (str(ranges), ranges.count) == ("3-6, 9, 20", 6)
    assert [number for number in range(25) if number in ranges] == [3, 4, 5, 6, 9, 20]
    for text in ("", "0", "5-3", "a", "1,,2", "-4"):
        with pytest.raises(ValueError, match="keyframes must be numbers"):
            parse(text)
