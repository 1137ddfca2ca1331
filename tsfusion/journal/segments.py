# SPDX-License-Identifier: MIT
"""A folder of segments, and the records in it."""

import errno
import logging
import os
import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path

from msgspec import Struct

from tsfusion.core.errors import JournalError
from tsfusion.core.readable_numbers import count_of
from tsfusion.journal import mcap_layout, segment_file
from tsfusion.journal.mcap_layout import Position, Record
from tsfusion.journal.record_scan import Damage, Erased, journal_error, scan_records, segment_number
from tsfusion.journal.segment_file import SegmentFile

log = logging.getLogger(__name__)


class RecordEntry(Struct, frozen=True):
    """A record without its frames, as a list of a journal holds it."""

    position: Position
    session: bytes
    seq: int
    client: str
    nbytes: int
    is_correction: bool = False
    world: str = ""  # as its header names it
    is_erased: bool = False


def segments(folder: Path) -> list[int]:
    """The numbers of a folder's segments, oldest first. Files with other names are passed over.

    Raises:
        JournalError: when the folder cannot be listed.
    """
    try:
        names = [path.name for path in folder.iterdir()]
    except OSError as error:
        raise journal_error("list", folder, error) from error
    return sorted(
        int(name[:-5])
        for name in names
        if re.fullmatch(r"[0-9]{6}|[1-9][0-9]{6,8}", name[:-5]) and name.endswith(".mcap")
    )


def is_away(folder: Path, home: os.stat_result | None) -> bool:
    """True if a folder of segments is not to be found, or an empty one is in its place: it may come back.

    Args:
        home: of the folder as it was; None = it was not there.
    """
    try:
        return (home is None or not os.path.samestat(os.stat(folder), home)) and not segments(folder)
    except (JournalError, OSError):
        return True


def segment_path(folder: Path, number: int) -> Path:
    """The file of a segment."""
    return folder / f"{number:06d}.mcap"


def read(folder: Path, position: Position) -> Record:
    """One record by its position, also while its segment is being written.

    Raises:
        JournalError: when it is not there or its CRC differs.
    """
    return read_at(segment_path(folder, position.segment), position.offset)


def logged_ns(folder: Path, position: Position) -> int:
    """Wall clock of a record by its position; only the first bytes of it are read, and none is checked.

    Raises:
        JournalError: when it is not there.
    """
    path = segment_path(folder, position.segment)
    try:
        with SegmentFile(path) as source:
            head = mcap_layout.parse_head(source.read(position.offset, mcap_layout.HEAD_BYTES))
    except OSError as error:
        raise journal_error("read", path, error) from error
    if head is None:
        raise JournalError(f"{path} holds no whole keyframe at byte {position.offset}")
    return head.logged_ns


def read_at(path: Path, offset: int) -> Record:
    """One record of a segment file.

    Raises:
        JournalError: when it is not there or its CRC differs, or with an `errno` when the system refuses.
    """
    try:
        source = SegmentFile(path)
    except OSError as error:
        raise journal_error("read", path, error) from error
    with source:
        return record_at(source, segment_number(path), offset)


def has_another(folder: Path, session: bytes, seq: int, position: Position, *, until_ns: int) -> bool:
    """True if a journal has another record where it had this one. Damage and missing files show nothing.

    Args:
        until_ns: when the journal had it: one that was logged later begins a journal anew.
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


class Reading:
    """Records of segments, one after the other: a segment stays open until one of another is read."""

    def __init__(self) -> None:
        self._path: Path | None = None
        self._open = ExitStack()

    def __enter__(self) -> "Reading":
        return self

    def __exit__(self, *_: object) -> None:
        self._open.close()

    def at(self, path: Path, offset: int) -> Record:
        """One record of a segment file; raises JournalError as `read_at`."""
        if path != self._path:
            self._open.close()
            self._path = None
            try:
                self._source = self._open.enter_context(SegmentFile(path))
            except OSError as error:
                raise journal_error("read", path, error) from error
            self._path = path
        return record_at(self._source, segment_number(path), offset)


def record_at(source: SegmentFile, number: int, offset: int) -> Record:
    """One record of the open segment file of this number; raises JournalError as `read_at`."""
    try:
        start = source.read(offset, mcap_layout.HEAD_BYTES)
        head = mcap_layout.parse_head(start)
        raw = b"" if head is None else source.read(offset, head.nbytes)
        record = mcap_layout.parse_record(raw, Position(number, offset))
        if record is None and source.failed:
            raise OSError(errno.EIO, os.strerror(errno.EIO))
    except OSError as error:
        raise journal_error("read", source.path, error) from error
    if record is None and mcap_layout.parse_erased(start) is not None:
        raise JournalError(f"the keyframe at byte {offset} of {source.path} was erased", is_erased=True)
    if record is None:
        raise JournalError(f"{source.path} holds no whole keyframe at byte {offset}")
    return record


def list_records(
    path: Path,
    watch: Callable[[int, int], None] = lambda _at, _records: None,
    damaged: Callable[[Damage], None] = lambda _damage: None,
) -> tuple[list[RecordEntry], int]:
    """Every whole or erased record of a segment, and how many keyframes are lost to damage between them.

    A torn tail was never acknowledged and does not count as damage. Each damaged place is logged.

    Args:
        watch: called at each read with the byte that the list has come to, and its records so far.
        damaged: called with each damaged place.

    Raises:
        JournalError: when the file cannot be opened or read.
    """
    found: list[RecordEntry] = []
    at = lost = 0

    def note() -> None:
        watch(at, len(found))

    for step in scan_records(path, note):
        at = step.position.offset
        if isinstance(step, Erased):
            place = (step.position, step.session, step.seq, step.client)
            found.append(RecordEntry(*place, step.nbytes, is_erased=True))
            if not step.is_clear:
                log.warning("%s", describe(path, step))
        elif isinstance(step, Damage):
            lost += step.lost
            damaged(step)
            level = logging.ERROR if step.lost else logging.WARNING
            log.log(level, "%s", describe(path, step))
        else:
            place = (step.position, step.session, step.seq, step.client)
            found.append(RecordEntry(*place, step.nbytes, step.is_correction, step.world))
    return found, lost


def describe(path: Path, damage: Damage) -> str:
    """Describe a damaged place in one line."""
    if damage.torn:
        outcome = "; nothing that was acknowledged is lost"
    else:
        lost = count_of(damage.lost, "keyframe is", "keyframes are")
        outcome = f"; {lost} lost" if damage.lost else "; no keyframe is lost"
    return f"{path}, byte {damage.position.offset}: {damage.what}{outcome}"


def is_segment(path: Path) -> bool:
    """True for an `.mcap` file of a journal, damaged or not, and False for another program's recording."""
    if path.suffix != ".mcap":
        return False
    try:
        with SegmentFile(path) as file:
            opening = file.read(0, len(mcap_layout.OPENING))
    except OSError:  # to be reported by who reads it
        return True
    is_whole = len(opening) == len(mcap_layout.OPENING) and opening.startswith(mcap_layout.MAGIC)
    return opening == mcap_layout.OPENING or not is_whole


def is_closed(path: Path) -> bool:
    """True if a segment ends with an index, as normal MCAP readers need it; False when it cannot be read."""
    try:
        with SegmentFile(path) as source:
            return segment_file.read_segment_end(source).state == "whole"
    except OSError:
        return False


def records(path: Path) -> Iterator[Record]:
    """The whole records of one segment file.

    Raises:
        JournalError: when the file cannot be opened or read.
    """
    return (step for step in scan_records(path) if isinstance(step, Record))
