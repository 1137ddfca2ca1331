# SPDX-License-Identifier: MIT
"""Every cut and every flipped bit of a segment: what was written comes back, and damage is reported."""

import errno
import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tsfusion import journal
from tsfusion.core.errors import JournalError
from tsfusion.journal import Damage, Journal, Position, Record, mcap_layout, scan_records, segment_path

BIG = 1 << 30
COUNT = 4
Plain = tuple[Position, bytes, int, str, int, list[bytes]]


def fill(log: Journal, count: int = COUNT, first: int = 1) -> list[Position]:
    return [
        log.append([b"head", bytes([i]) * 40, b""], session=bytes(range(16)), seq=first + i, client="anna")
        for i in range(count)
    ]


def plain(record: Record) -> Plain:
    frames = [bytes(frame) for frame in record.frames]
    return record.position, record.session, record.seq, record.client, record.logged_ns, frames


class Segment:
    """A segment's bytes, and what a reader must find in them."""

    def __init__(self, folder: Path, *, closed: bool) -> None:
        self.path = segment_path(folder, 1)
        log = Journal(folder, BIG, sync=False)
        self.places = fill(log)
        if closed:
            log.close()
        else:
            log._abandon()  # without its index, as a killed process leaves it
        self.whole = self.path.read_bytes()
        self.records = {record.position: plain(record) for record in journal.records(self.path)}
        assert list(self.records) == self.places
        raw = [mcap_layout.parse_head(self.whole[place.offset :]) for place in self.places]
        self.ends = [place.offset + head.nbytes for place, head in zip(self.places, raw, strict=True) if head]

    def read(self, content: bytes) -> tuple[list[Position], list[Damage]]:
        """Records that a scan of altered bytes finds; fails unless each is one that was written."""
        self.path.write_bytes(content)
        found, damages = [], []
        for step in scan_records(self.path):
            if isinstance(step, Damage):
                damages.append(step)
            else:
                assert plain(step) == self.records[step.position]
                found.append(step.position)
        assert found == sorted(found)
        return found, damages


@pytest.fixture(params=["closed", "open"])
def segment(request: pytest.FixtureRequest, tmp_path: Path) -> Segment:
    return Segment(tmp_path / request.param, closed=request.param == "closed")


def flipped(whole: bytes, at: int, bit: int) -> bytes:
    return whole[:at] + bytes([whole[at] ^ 1 << bit]) + whole[at + 1 :]


def check_flip(segment: Segment, at: int, bit: int) -> None:
    """One flipped bit costs the record it is in, or nothing; and it is reported."""
    found, damages = segment.read(flipped(segment.whole, at, bit))
    missing = set(segment.places) - set(found)
    hit = {place for place, end in zip(segment.places, segment.ends, strict=True) if place.offset <= at < end}
    assert missing <= hit
    assert sum(damage.lost for damage in damages) == len(missing)
    assert damages
    assert not any(damage.torn for damage in damages)


# --- bits ---


@pytest.mark.parametrize("every", [8, pytest.param(1, marks=pytest.mark.nightly)])
def test_a_flipped_bit_at_any_byte_costs_at_most_the_record_it_hit(segment: Segment, every: int) -> None:
    for at in range(len(segment.whole)):
        for bit in range(at % every, 8, every):
            check_flip(segment, at, bit)


def test_any_flipped_bit_in_the_head_of_a_record_costs_at_most_that_record(segment: Segment) -> None:
    for place in (segment.places[1], segment.places[-1]):
        for at in range(place.offset, place.offset + mcap_layout.HEAD_BYTES + 12):
            for bit in range(8):
                check_flip(segment, at, bit)


def test_damage_to_several_records_is_counted_exactly_where_there_is_an_index(tmp_path: Path) -> None:
    segment = Segment(tmp_path, closed=True)
    first, last = segment.places[1].offset, segment.places[3].offset
    content = segment.whole[:first] + bytes(last - first) + segment.whole[last:]
    found, damages = segment.read(content)
    assert found == [segment.places[0], segment.places[3]]
    assert sum(damage.lost for damage in damages) == 2


def test_neighbours_that_are_damaged_each_count(segment: Segment) -> None:
    content = segment.whole
    for place in segment.places[1:3]:
        content = flipped(content, place.offset + 160, 0)
    found, damages = segment.read(content)
    assert found == [segment.places[0], segment.places[3]]
    assert [damage.lost for damage in damages] == [1, 1]


def test_a_keyframe_cannot_pass_off_its_own_bytes_as_records(tmp_path: Path) -> None:
    """Another segment's chunk inside a keyframe: a search behind a damaged place does not take it."""
    forged = Segment(tmp_path / "forged", closed=False)
    chunk = forged.whole[forged.places[0].offset : forged.ends[0]]
    log = Journal(tmp_path / "journal", BIG)
    places = [log.append([b"head", chunk * 3], session=bytes(16), seq=seq) for seq in (1, 2)]
    log._abandon()  # without its index, as a killed process leaves it
    path = segment_path(tmp_path / "journal", 1)
    whole = path.read_bytes()
    for at in (1, 4, 30, 60, 90):  # opcode, lengths, CRC, message, identity
        path.write_bytes(flipped(whole, places[0].offset + at, 1))
        assert [found.seq for found in journal.list_records(path)[0]] == [2]
    for end in range(places[1].offset, len(whole), 7):
        path.write_bytes(whole[:end])
        assert [found.seq for found in journal.list_records(path)[0]] in ([1], [1, 2])


def test_a_segment_of_another_version_is_not_taken_for_a_damaged_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as patched:
        patched.setattr(mcap_layout, "_SEGMENT_MAGIC", b"TSFSEG2\0")
        log = Journal(tmp_path, BIG, sync=False)
        fill(log)
        log.close()
    with pytest.raises(JournalError, match="another version of tsfusion wrote it"):
        journal.list_records(segment_path(tmp_path, 1))
    with pytest.raises(JournalError, match="another version of tsfusion wrote it; make it readable, or move"):
        Journal(tmp_path, BIG, sync=False)


# --- cuts ---


def test_a_cut_at_any_byte_costs_what_is_behind_it(segment: Segment) -> None:
    for cut in range(len(segment.whole)):
        found, damages = segment.read(segment.whole[:cut])
        expected = [place for place, end in zip(segment.places, segment.ends, strict=True) if end <= cut]
        assert found == expected
        assert all(damage.torn and not damage.lost for damage in damages)


def test_after_a_torn_write_at_any_byte_the_journal_goes_on(tmp_path: Path) -> None:
    segment = Segment(tmp_path, closed=False)
    for cut in range(segment.places[-1].offset, segment.ends[-1]):
        segment.path.write_bytes(segment.whole[:cut])
        log = Journal(tmp_path, BIG, sync=False)
        assert [found.seq for found in log.found] == [1, 2, 3]
        assert log.damaged == 0
        with pytest.raises(JournalError, match="no whole keyframe"):
            journal.read(tmp_path, segment.places[-1])
        fill(log, 1, first=4)
        log.close()
        again = Journal(tmp_path, BIG, sync=False)
        assert [found.seq for found in again.found] == [1, 2, 3, 4]
        again.forget(2)


def test_a_file_that_grew_before_its_bytes_came_is_torn(tmp_path: Path) -> None:
    segment = Segment(tmp_path, closed=False)
    found, damages = segment.read(segment.whole[: segment.places[-1].offset] + bytes(5000))
    assert found == segment.places[:-1]
    assert [(damage.torn, damage.lost) for damage in damages] == [(True, 0)]


@pytest.mark.parametrize("junk", [b"garbage!", b"\xff", bytes(3) + b"\x01"])
def test_what_no_write_leaves_is_no_torn_one(tmp_path: Path, junk: bytes) -> None:
    segment = Segment(tmp_path, closed=False)
    found, damages = segment.read(segment.whole + junk)
    assert found == segment.places
    assert [(damage.torn, damage.lost, damage.nbytes) for damage in damages] == [(False, 1, len(junk))]
    found, damages = segment.read(junk)
    assert [(damage.torn, damage.lost, damage.what) for damage in damages] == [
        (False, 1, "no segment of tsfusion")
    ]


def test_what_stands_behind_an_index_is_no_cut_in_it(tmp_path: Path) -> None:
    segment = Segment(tmp_path, closed=True)
    found, damages = segment.read(segment.whole + b"garbage!")
    assert found == segment.places
    assert [(damage.torn, damage.lost, damage.what) for damage in damages] == [
        (False, 0, "something stands behind its index")
    ]


# --- lengths that lie, disks that fail ---


def test_no_length_makes_a_reader_ask_for_more_than_the_file(
    segment: Segment, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[int] = []
    real = os.pread

    def watched(descriptor: int, count: int, at: int) -> bytes:
        asked.append(count)
        return real(descriptor, count, at)

    monkeypatch.setattr(os, "pread", watched)
    place = segment.places[1].offset
    for length in (1, 1 << 20, 1 << 29, 1 << 40, 2**63, 2**64 - 1):
        for offsets in ((1,), (1, 25, 41), (1, 25, 41, 50)):  # all that say how long the record is
            content = bytearray(segment.whole)
            for at in offsets:
                struct.pack_into("<Q", content, place + at, length)
            found, _ = segment.read(bytes(content))
            assert set(segment.places) - set(found) <= {segment.places[1]}
            if segment.places[1] not in found:
                with pytest.raises(JournalError):
                    journal.read_at(segment.path, place)
    assert max(asked) <= len(segment.whole)


def test_frames_that_do_not_fill_their_record_make_it_none(tmp_path: Path) -> None:
    """A record whose CRC is right was made up by somebody."""
    segment = Segment(tmp_path, closed=False)
    place = segment.places[0]
    raw = bytearray(segment.whole[place.offset : segment.ends[0]])
    assert mcap_layout.parse_record(bytes(raw), place) is not None
    (length,) = struct.unpack_from("<I", raw, mcap_layout.HEAD_BYTES)
    for lie in (length - 1, length + 1):
        struct.pack_into("<I", raw, mcap_layout.HEAD_BYTES, lie)
        struct.pack_into("<I", raw, 41 - 8, zlib.crc32(raw[49:]))
        assert mcap_layout.parse_record(bytes(raw), place) is None


def test_a_file_of_heads_that_lie_is_read_in_bounded_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each byte could begin a record that reaches to the end of the file: the search gives up in time."""
    segment = Segment(tmp_path, closed=False)
    start = segment.places[0].offset
    head = bytearray(segment.whole[start : start + mcap_layout.HEAD_BYTES])
    content = bytearray(segment.whole[:start])
    size = 1 << 21
    while len(content) < size - 200:
        stored = size - len(content) - 49
        struct.pack_into("<Q", head, 1, stored + 40)
        struct.pack_into("<Q", head, 25, stored)
        struct.pack_into("<Q", head, 41, stored)
        struct.pack_into("<Q", head, 50, stored - 9)
        content += head
    segment.path.write_bytes(content + bytes(size - len(content)))
    asked, real = 0, os.pread

    def watched(descriptor: int, count: int, at: int) -> bytes:
        nonlocal asked
        asked += count
        assert asked < 100 * size
        return real(descriptor, count, at)

    monkeypatch.setattr(os, "pread", watched)
    assert [step for step in scan_records(segment.path) if isinstance(step, Record)] == []


def failing_sectors(bad: range) -> Callable[[int, int, int], bytes]:
    real = os.pread

    def pread(descriptor: int, count: int, at: int) -> bytes:
        if at < bad.stop and at + count > bad.start:
            raise OSError(errno.EIO, "Input/output error")
        return real(descriptor, count, at)

    return pread


def test_a_bad_sector_costs_the_records_in_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = Journal(tmp_path, BIG, sync=False)
    places = [log.append([b"head", bytes(100_000)], session=bytes(16), seq=seq) for seq in range(1, 9)]
    log.close()
    sector = places[3].offset + 50_000
    monkeypatch.setattr(os, "pread", failing_sectors(range(sector, sector + 512)))
    found, lost = journal.list_records(segment_path(tmp_path, 1))
    seqs = {record.seq for record in found}
    assert {1, 2, 3, 6, 7, 8} <= seqs
    assert 4 not in seqs
    assert lost == 8 - len(found)


def test_an_unreadable_end_is_no_torn_write(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = Journal(tmp_path, BIG, sync=False)
    places = [log.append([bytes(100_000)], session=bytes(16), seq=seq) for seq in (1, 2)]
    log._abandon()
    path = segment_path(tmp_path, 1)
    monkeypatch.setattr(os, "pread", failing_sectors(range(places[-1].offset, path.stat().st_size)))
    found = list(scan_records(path))
    assert [(step.lost, step.torn) for step in found if isinstance(step, Damage)] == [(1, False)]
    assert [step.seq for step in found if isinstance(step, Record)] == [1]


# --- anything at all ---

EXAMPLES = settings(max_examples=150, deadline=None, suppress_health_check=list(HealthCheck))


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Segment:
    return Segment(tmp_path_factory.mktemp("kept"), closed=True)


@EXAMPLES
@given(st.data())
def test_whatever_happens_to_a_segment_no_wrong_record_comes_back(kept: Segment, data: Any) -> None:
    content = bytearray(kept.whole)
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(content)))
        gone = data.draw(st.integers(0, 300))
        content[at : at + gone] = data.draw(st.binary(max_size=300))
    kept.path.write_bytes(content)
    written = [record[1:] for record in kept.records.values()]
    for step in scan_records(kept.path):
        if isinstance(step, Record):
            assert plain(step)[1:] in written
        else:
            assert 0 <= step.position.offset <= len(content)


@EXAMPLES
@given(st.binary(max_size=3000))
def test_bytes_of_any_kind_are_read_without_a_complaint(kept: Segment, content: bytes) -> None:
    mcap_layout.parse_segment_chunk(content)
    mcap_layout.parse_head(content)
    assert mcap_layout.parse_record(content, Position(1, 0)) is None
    for prefix in (b"", mcap_layout.OPENING, kept.whole[: mcap_layout.segment_start_bytes()]):
        kept.path.write_bytes(prefix + content)
        assert not [step for step in scan_records(kept.path) if isinstance(step, Record)]


def test_another_record_in_a_place_is_told_from_a_damaged_one(segment: Segment) -> None:
    def is_other(place: Position, seq: int, session: bytes = bytes(range(16))) -> bool:
        return journal.has_another(segment.path.parent, session, seq, place, until_ns=1 << 63)

    first, second, *_ = segment.places
    assert not is_other(first, 1)
    assert is_other(first, 2)
    assert is_other(first, 1, bytes(16))
    inside = Position(1, first.offset + 7)
    assert is_other(inside, 1)  # where a record of another journal began
    assert not is_other(Position(1, len(segment.whole) + 100), 1)  # the journal is shorter
    assert not is_other(Position(2, first.offset), 1)  # that segment is not there
    segment.path.write_bytes(flipped(segment.whole, first.offset + 100, 1))
    assert not is_other(first, 2)
    assert not is_other(inside, 1)
    assert not is_other(second, 2)
