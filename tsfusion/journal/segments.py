# SPDX-License-Identifier: MIT
"""A folder of segments, and the records in it."""

import errno
import logging
import os
import re
from collections.abc import Iterator
from pathlib import Path

from msgspec import Struct

from tsfusion.core.errors import JournalError
from tsfusion.journal import mcap_layout, segment_file
from tsfusion.journal.mcap_layout import Position, Record
from tsfusion.journal.record_scan import Damage, failed, segment_number, walk
from tsfusion.journal.segment_file import SegmentFile

log = logging.getLogger(__name__)


class Scan(Struct, frozen=True):
    """A record that a scan found, without its frames."""

    position: Position
    session: bytes
    seq: int
    client: str
    nbytes: int
    is_correction: bool = False


def segments(folder: Path) -> list[int]:
    """The numbers of a folder's segments, oldest first. Files that are named otherwise are not looked at.

    Raises:
        JournalError: when the folder cannot be listed.
    """
    try:
        names = os.listdir(folder)
    except OSError as error:
        raise failed("list", folder, error) from error
    return sorted(
        int(name[:-5])
        for name in names
        if re.fullmatch(r"[0-9]{6}|[1-9][0-9]{6,8}", name[:-5]) and name.endswith(".mcap")
    )


def segment_path(folder: Path, number: int) -> Path:
    """The file of a segment."""
    return folder / f"{number:06d}.mcap"


def read(folder: Path, position: Position) -> Record:
    """One record by its position, also while its segment is being written.

    Raises:
        JournalError: when it is not there or its CRC differs.
    """
    return read_at(segment_path(folder, position.segment), position.offset)


def read_at(path: Path, offset: int) -> Record:
    """One record of a segment file.

    Raises:
        JournalError: when it is not there or its CRC differs; from an OSError when the system refuses.
    """
    try:
        with SegmentFile(path) as source:
            head = mcap_layout.head(source.read(offset, mcap_layout.HEAD_BYTES))
            raw = b"" if head is None else source.read(offset, head.nbytes)
            record = mcap_layout.unpack(raw, Position(segment_number(path), offset))
            if record is None and source.failed:
                raise OSError(errno.EIO, os.strerror(errno.EIO))
    except OSError as error:
        raise failed("read", path, error) from error
    if record is None:
        raise JournalError(f"{path} holds no whole keyframe at byte {offset}")
    return record


def scan(path: Path) -> tuple[list[Scan], int]:
    """Every whole record of a segment in order, and how many keyframes are lost to damage between them.

    A torn tail was never acknowledged and does not count as damage. Each damaged place is logged.

    Raises:
        JournalError: when the file cannot be opened or read.
    """
    found, lost = [], 0
    for step in walk(path):
        if isinstance(step, Damage):
            lost += step.lost
            level = logging.ERROR if step.lost else logging.WARNING
            log.log(level, "%s", describe(path, step))
        else:
            place = (step.position, step.session, step.seq, step.client)
            found.append(Scan(*place, step.nbytes, step.is_correction))
    return found, lost


def describe(path: Path, damage: Damage) -> str:
    """A damaged place in a line."""
    if damage.torn:
        outcome = "; nothing that was acknowledged is lost"
    else:
        outcome = f"; {damage.lost} keyframes are lost" if damage.lost else "; no keyframe is lost"
    return f"{path}, byte {damage.position.offset}: {damage.what}{outcome}"


def is_closed(path: Path) -> bool:
    """Whether a segment ends with an index, as normal MCAP readers need it; False when it cannot be read."""
    try:
        with SegmentFile(path) as source:
            return segment_file.read(source).state == "whole"
    except OSError:
        return False


def records(path: Path) -> Iterator[Record]:
    """The whole records of one segment file.

    Raises:
        JournalError: when the file cannot be opened or read.
    """
    return (step for step in walk(path) if isinstance(step, Record))
