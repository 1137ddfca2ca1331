# SPDX-License-Identifier: MIT
"""Read the records of a segment file in order, and continue after damaged stretches.

After damage, the scan searches for the next chunk by its shape, its segment's identity and its CRC. So damage
loses only the records that it hit.
"""

import errno
import logging
import os
import re
import struct
import zlib
from collections.abc import Callable, Generator, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Literal

from mcap.opcode import Opcode
from msgspec import Struct

from tsfusion.core.errors import JournalError
from tsfusion.core.readable_numbers import count_of
from tsfusion.journal import mcap_layout
from tsfusion.journal.mcap_layout import END_OF_DATA, MAGIC, Position, Record
from tsfusion.journal.segments import (
    RecordEntry,
    SegmentFile,
    journal_errors,
    read_at,
    segment_number,
    segment_path,
)

log = logging.getLogger(__name__)


_FOOTER = struct.Struct("<BQQQI")  # opcode, length, start of the summary, start of its offsets, CRC
_RECORD = struct.Struct("<BQ")
_COUNT = struct.Struct("<Q")
_MAX_SUMMARY_BYTES = 1 << 28


class SegmentEnd(Struct, frozen=True):
    """The index at the end of a segment: its state, where the records end, and their number."""

    # `whole`; `open` = never closed, or cut off within the index; `broken` = closed, then damaged
    state: Literal["whole", "broken", "open"]
    data_end: int | None = None  # offset at which the last record ends
    keyframes: int | None = None  # number of keyframes in the segment when it was closed


def read_segment_end(source: SegmentFile) -> SegmentEnd:
    """Read the index at the end of a segment."""
    closing = (
        source.read(source.size - len(MAGIC), len(MAGIC)) == MAGIC if source.size > len(MAGIC) else False
    )
    at = source.size - len(MAGIC) - _FOOTER.size
    summary = _summary(source, at) if at > 0 else None
    if summary is None:
        return SegmentEnd("broken" if closing else "open")
    start, content = summary
    keyframes = _keyframes(content)
    return SegmentEnd("whole" if closing else "broken", start - len(END_OF_DATA), keyframes)


def _summary(source: SegmentFile, footer_at: int) -> tuple[int, bytes] | None:
    """Return the offset of the summary and its bytes; None unless its CRC agrees."""
    footer = source.read(footer_at, _FOOTER.size)
    opcode, length, start, _, crc32 = _FOOTER.unpack(footer)
    if (opcode, length) != (Opcode.FOOTER, _FOOTER.size - _RECORD.size):
        return None
    if not len(END_OF_DATA) + len(MAGIC) < start <= footer_at or footer_at - start > _MAX_SUMMARY_BYTES:
        return None
    content = source.read(start, footer_at - start)
    return (start, content) if zlib.crc32(footer[:-4], zlib.crc32(content)) == crc32 else None


def _keyframes(summary: bytes) -> int | None:
    """Return the number of keyframes by the statistics: all messages except the segment's own first one."""
    at = 0
    while at + _RECORD.size + _COUNT.size <= len(summary):
        opcode, length = _RECORD.unpack_from(summary, at)
        if opcode == Opcode.STATISTICS:
            return int(_COUNT.unpack_from(summary, at + _RECORD.size)[0]) - 1
        at += _RECORD.size + length
    return None


_WINDOW_BYTES = 1 << 20
_MAX_SEGMENT_CHUNK_BYTES = 1 << 16
# Bytes that a search may spend on chunks with a wrong CRC, in file sizes: in a malicious file
# every byte could be the start of a chunk that ends with the file.
_PATIENCE = 64
# The head of a keyframe's chunk, with lengths under 2^40 (see `mcap_layout.ChunkHead`).
_HEAD_SHAPE = re.compile(rb"(?s)\x06(?=.{5}\0{3}.{16}.{5}\0{3}.{4}\0{4}.{5}\0{3}\x05.{5}\0{3}\x01\0)")

# First bytes of what may follow a record: the next record, an index, or the end-of-data mark.
_FIRST_BYTES = (b"\x06", mcap_layout.INDEX_START[:1], mcap_layout.END_OF_DATA[:1])


class Damage(Struct, frozen=True):
    """A stretch of a segment that differs from what was written."""

    position: Position
    nbytes: int
    lost: int  # lower bound of the keyframes destroyed; 0 = readers do not need these bytes
    what: str
    torn: bool = False  # the end of the last write, cut off before it was acknowledged: no keyframe is lost


class Erased(Damage, frozen=True):
    """A record whose bytes were deleted on purpose; it does not count as a lost keyframe.

    `is_clear`: True if none of its old bytes is left; False after a crash during the erasing.
    """

    session: bytes = b""
    seq: int = 0
    client: str = ""
    is_clear: bool = True


def scan_records(path: Path, on_read: Callable[[], None] = lambda: None) -> Iterator[Record | Damage]:
    """Yield the records and damaged stretches of a segment file in order, reading one record at a time.

    Raises:
        JournalError: the file cannot be opened or read.
    """
    with journal_errors("read", path), SegmentFile(path, on_read) as source:
        yield from _RecordScan(source, segment_number(path)).steps()


def _was_index(raw: bytes) -> bool:
    """Return True if these bytes are an index rather than a record's start, even with one byte damaged."""
    return mcap_layout.INDEX_START[:1] == raw[:1] or mcap_layout.INDEX_START[1:9] == raw[1:9]


class _RecordScan:
    def __init__(self, source: SegmentFile, number: int) -> None:
        self._source = source
        self._number = number
        self._segment_end = read_segment_end(source)
        self._end = source.size if self._segment_end.data_end is None else self._segment_end.data_end
        self._identity: bytes | None = None
        self._next: tuple[int, int | None] | None = None  # the last search: its start offset, its result
        self._patience = _PATIENCE * source.size
        self._found = self._lost = 0

    def steps(self) -> Iterator[Record | Damage]:
        at = yield from self._opening()
        while at < self._end and not self._is_end_of_data(at):
            found = self._record_at(at)
            if found is None and (erased := self._erased_at(at)) is not None:
                self._found += 1
                yield erased
                at += erased.nbytes
                continue
            if found is None:
                damage = self._damage(at)
                self._lost += damage.lost
                yield damage
                at += damage.nbytes
                continue
            record, head = found
            self._found += 1
            yield record
            if not head.first_ns == head.last_ns == head.logged_ns:
                yield self._note(at, mcap_layout.HEAD_BYTES, "the times of its chunk differ from its own")
            at = self._behind(at + head.nbytes, head.message_index)
        yield from self._closing(at)

    def _note(self, at: int, nbytes: int, what: str, *, lost: int = 0, torn: bool = False) -> Damage:
        return Damage(Position(self._number, at), nbytes, lost, what, torn)

    def _behind(self, end: int, index: bytes) -> int:
        """Return the offset after a chunk, which ends at `end`, and its index; `end` if that is damaged."""
        return end + len(index) if self._source.read(end, len(index), self._end) == index else end

    def _is_end_of_data(self, at: int) -> bool:
        marker = mcap_layout.END_OF_DATA
        return self._segment_end.data_end is None and self._source.read(at, len(marker)) == marker

    def _record_at(self, at: int) -> tuple[Record, mcap_layout.ChunkHead] | None:
        head = mcap_layout.parse_head(self._source.read(at, mcap_layout.HEAD_BYTES, self._end))
        if head is None or at + head.nbytes > self._end:
            return None
        if self._identity is not None and head.segment != self._identity:
            return None
        record = mcap_layout.parse_record(self._source.read(at, head.nbytes), Position(self._number, at))
        if record is None:
            self._patience -= head.nbytes
            return None
        self._identity = head.segment  # of a segment whose own chunk is damaged: that of the first record
        return record, head

    def _erased_at(self, at: int) -> Erased | None:
        raw = self._source.read(at, mcap_layout.ERASED_BYTES, self._end)
        head = mcap_layout.parse_erased(raw)
        if head is None or at + head.nbytes > self._end or self._identity not in (None, head.segment):
            return None
        name = f"keyframe {head.seq} of session {head.session.hex()[:8]}"
        is_clear = self._is_zero(at + len(raw), at + head.nbytes)
        what = f"{name} was erased" if is_clear else f"{name} is being erased: forget it again with --erase"
        return Erased(
            Position(self._number, at), head.nbytes, 0, what,
            session=head.session, seq=head.seq, client=head.client, is_clear=is_clear,
        )  # fmt: skip

    # --- the start ---

    def _opening(self) -> Generator[Damage, None, int]:
        """Yield damage at the start of the file; return the offset of the first record."""
        expected, size = mcap_layout.OPENING, self._source.size
        opening = self._source.read(0, len(expected))
        if self._segment_end.state == "open" and size < mcap_layout.segment_start_bytes():
            if size and (expected.startswith(opening) or opening.startswith(expected) or self._is_zero(0)):
                yield self._note(0, size, "its first write was cut off", torn=True)
            elif size:
                yield self._note(0, size, "no segment of tsfusion", lost=1)
            return size
        known = mcap_layout.parse_segment_chunk(self._source.read(0, _MAX_SEGMENT_CHUNK_BYTES, self._end))
        if known is not None and not known.is_ours:
            raise JournalError(f"cannot read {self._source.path}: another version of tsfusion wrote it")
        first = self._search(len(expected)) if known is None else None
        if self._source.failed and not self._source.answered:
            raise OSError(errno.EIO, os.strerror(errno.EIO))  # the disk is away, rather than bad in places
        if opening != expected and known is None and first is None:
            self._lost += 1
            yield self._note(0, size, "no segment of tsfusion, or damaged from end to end", lost=1)
            return size
        if opening != expected:
            yield self._note(0, len(expected), "its opening is damaged")
        if known is not None:
            self._identity = known.identity
            return self._behind(known.end, known.message_index)
        end = self._end if first is None else first
        lost = int(end != mcap_layout.segment_start_bytes())
        self._lost += lost
        yield self._note(len(expected), end - len(expected), "the segment's own chunk is damaged", lost=lost)
        return end

    # --- between records ---

    def _damage(self, at: int) -> Damage:
        """Return the damage that begins at this offset, where a record should start."""
        raw = self._source.read(at, mcap_layout.HEAD_BYTES, self._end)
        head = mcap_layout.parse_head(raw)
        end = at + head.nbytes if head is not None else None
        is_open = self._segment_end.state == "open"
        if is_open and end is not None and end > self._end:
            return self._torn(at)  # no search in there: all its lengths agree, it was cut off
        following = self._search(at + 1)
        stop = self._end if following is None else following
        if stop - at == mcap_layout.INDEX_BYTES and (stop < self._source.size or _was_index(raw)):
            return self._note(at, stop - at, "the index of the keyframe before it is damaged")
        begins = stop - at < mcap_layout.HEAD_BYTES and raw[:1] in _FIRST_BYTES
        if is_open and following is None and (begins or self._is_zero(at)):
            return self._torn(at)
        what = "nothing can be read here"
        if head is not None and end is not None and end <= stop:
            stop = self._over_index(end)
            what = f"keyframe {head.seq} of session {head.session.hex()[:8]} is damaged"
        if is_open and stop == self._end:
            what += " (the last write; perhaps it was never acknowledged)"
        return self._note(at, stop - at, what, lost=1)

    def _torn(self, at: int) -> Damage:
        return self._note(at, self._end - at, "the last write was cut off", torn=True)

    def _over_index(self, end: int) -> int:
        start, behind = mcap_layout.INDEX_START, end + mcap_layout.INDEX_BYTES
        is_there = self._source.read(end, len(start), self._end) == start
        return behind if is_there and behind <= self._end else end

    def _is_zero(self, at: int, end: int | None = None) -> bool:
        """Return True for zeros, which nobody wrote: a file may grow before its bytes reach the disk."""
        end = self._end if end is None else end
        starts = range(at, end, _WINDOW_BYTES)
        rest = any(self._source.read(start, _WINDOW_BYTES, end).strip(b"\0") for start in starts)
        return not rest and not self._source.failed

    def _ends_behind(self, at: int) -> bool:
        """Return True if a closed file's end mark comes after this offset: nothing was cut off here."""
        magic, size = mcap_layout.MAGIC, self._source.size
        count = _WINDOW_BYTES + len(magic) - 1
        return any(magic in self._source.read(start, count) for start in range(at, size, _WINDOW_BYTES))

    def _search(self, start: int) -> int | None:
        """Return the offset of the next intact record from `start` on; None without one."""
        if self._next is not None:
            begun, found = self._next
            if begun <= start and (found is None or start <= found):
                return found
        found = next((at for at in self._candidates(start) if self._record_at(at) is not None), None)
        self._next = start, found
        return found

    def _candidates(self, start: int) -> Iterator[int]:
        for window_at in range(start, self._end, _WINDOW_BYTES):
            window = self._source.read(window_at, _WINDOW_BYTES + mcap_layout.HEAD_BYTES, self._end)
            for match in _HEAD_SHAPE.finditer(window):
                if match.start() >= _WINDOW_BYTES or self._patience <= 0:
                    break
                yield window_at + match.start()

    # --- the end ---

    def _closing(self, at: int) -> Iterator[Damage]:
        end, size = self._segment_end, self._source.size
        if end.keyframes is not None and end.keyframes > self._found + self._lost:
            missing = end.keyframes - self._found - self._lost
            yield self._note(at, 0, f"its index counts {end.keyframes} keyframes", lost=missing)
        if end.data_end is not None:
            marker = mcap_layout.END_OF_DATA
            if self._source.read(end.data_end, len(marker)) != marker:
                yield self._note(end.data_end, len(marker), "the mark after the last keyframe is damaged")
        if end.state == "broken":
            yield self._note(at, size - at, "its index is damaged")
        elif end.state == "open" and at < size:
            is_whole = self._ends_behind(at)
            what = "something stands behind its index" if is_whole else "its index was cut off"
            yield self._note(at, size - at, what, torn=not is_whole)


def list_records(
    path: Path,
    watch: Callable[[int, int], None] = lambda _at, _records: None,
    damaged: Callable[[Damage], None] = lambda _damage: None,
) -> tuple[list[RecordEntry], int]:
    """Return every intact or erased record of a segment, and the number of keyframes lost to damage.

    A tail whose writing was cut off was never acknowledged: it is no damage. Each damaged stretch is logged.

    Args:
        watch: called at each read with the current byte offset and the number of records so far.

    Raises:
        JournalError: the file cannot be opened or read.
    """
    found: list[RecordEntry] = []
    at = lost = 0

    def note() -> None:
        watch(at, len(found))

    for step in scan_records(path, note):
        at = step.position.offset
        if isinstance(step, Erased):
            place = (step.position, step.session, step.seq, step.client)
            found.append(RecordEntry(*place, step.nbytes, is_erased=True, is_clear=step.is_clear))
            if not step.is_clear:
                log.warning("%s", describe(path, step))
        elif isinstance(step, Damage):
            lost += step.lost
            damaged(step)
            level = logging.ERROR if step.lost else logging.WARNING
            log.log(level, "%s", describe(path, step))
        else:
            place = (step.position, step.session, step.seq, step.client)
            more = step.nbytes, step.is_correction, step.world
            found.append(RecordEntry(*place, *more, logged_ns=step.logged_ns))
    return found, lost


def describe(path: Path, damage: Damage) -> str:
    """Return one line about a damaged stretch."""
    if damage.torn:
        outcome = "; nothing that was acknowledged is lost"
    else:
        lost = count_of(damage.lost, "keyframe is", "keyframes are")
        outcome = f"; {lost} lost" if damage.lost else "; no keyframe is lost"
    return f"{path}, byte {damage.position.offset}: {damage.what}{outcome}"


def records(path: Path) -> Iterator[Record]:
    """Yield the intact records of one segment file.

    Raises:
        JournalError: the file cannot be opened or read.
    """
    return (step for step in scan_records(path) if isinstance(step, Record))


def has_another(folder: Path, session: bytes, seq: int, position: Position, *, until_ns: int) -> bool:
    """Return True if another record stands where a saved map knows one: the journal is another one.

    Args:
        until_ns: when the map was saved. A record logged later proves nothing; damage neither.
    """
    path = segment_path(folder, position.segment)
    with suppress(JournalError):
        found = read_at(path, position.offset)
        return (found.session, found.seq) != (session, seq) and found.logged_ns <= until_ns
    with suppress(JournalError):
        own = (one for one in scan_records(path) if 0 < position.offset - one.position.offset < one.nbytes)
        return any(
            isinstance(one, Erased) or (isinstance(one, Record) and one.logged_ns <= until_ns) for one in own
        )
    return False


def is_closed(path: Path) -> bool:
    """Return True if a segment ends with an index, as MCAP readers need it; False if it cannot be read."""
    try:
        with SegmentFile(path) as source:
            return read_segment_end(source).state == "whole"
    except OSError:
        return False
