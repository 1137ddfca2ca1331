# SPDX-License-Identifier: MIT
"""Find spools that still hold keyframes of an earlier scan, and a free folder for a new spool.

A scan writes into a spool in which nothing waits: `FOLDER/MAP`, or `FOLDER/MAP.2`, `FOLDER/MAP.3`, … if
keyframes of an earlier scan wait there. Record headers, not the folder's name, give a spool's map and world.
"""

import logging
from collections.abc import Iterator
from contextlib import suppress
from itertools import chain, count
from pathlib import Path

from msgspec import Struct

from tsfusion import journal
from tsfusion.core.errors import DecodeError, JournalError
from tsfusion.core.folder_lock import lock_folder, owner_of
from tsfusion.delivery import spool
from tsfusion.journal.mcap_layout import Record
from tsfusion.journal.record_scan import Damage, scan_records
from tsfusion.wire.records.record_header import unpack

log = logging.getLogger(__name__)


class LeftSpool(Struct, frozen=True):
    """Spool of an earlier scan that still holds records, described by its first record."""

    folder: Path
    map: str
    world: str  # name of the coordinate frame; empty = poses given from elsewhere, or an older version's scan
    session: bytes  # 16 bytes
    since_ns: int  # wall clock of that record
    used_by: str | None  # pid of the process that has it open; None = nobody has

    @property
    def own_world(self) -> str:
        """World (coordinate frame) of the records; for given poses a unique name made from the session."""
        return self.world or self.session.hex()

    def count(self) -> tuple[int, int, int]:
        """Return the numbers of waiting keyframes, corrections and bytes; reads the whole spool.

        Raises:
            JournalError: a file cannot be read.
        """
        kinds = [(record.is_correction, record.nbytes) for record in _waiting(self.folder)]
        corrections = sum(is_correction for is_correction, _ in kinds)
        return len(kinds) - corrections, corrections, sum(nbytes for _, nbytes in kinds)


def find(root: Path) -> list[LeftSpool]:
    """Return the spools with records in a folder, oldest first; the folder itself may be a spool."""
    found = (_describe(folder) for folder in _folders(root))
    return sorted((one for one in found if one is not None), key=lambda one: one.since_ns)


def _folders(root: Path) -> list[Path]:
    return [root, *(path for path in sorted(root.glob("*")) if path.is_dir())] if root.is_dir() else []


def damaged(root: Path) -> dict[Path, int]:
    """Return the damaged spools, each with a lower bound of its lost records; `root` may be a spool."""
    found = {}
    for folder in _folders(root):
        with suppress(JournalError):  # `find` tells
            steps = chain.from_iterable(
                scan_records(journal.segment_path(folder, number)) for number in journal.segments(folder)
            )
            found[folder] = sum(step.lost for step in steps if isinstance(step, Damage))
    return {folder: count for folder, count in found.items() if count}


def free_folder(root: Path, map_name: str) -> Path:
    """Return the first folder of MAP, MAP.2, MAP.3, … in which nothing waits and that no process has open."""
    names = (map_name if number == 1 else f"{map_name}.{number}" for number in count(1))
    folders = (root / name for name in names)
    return next(folder for folder in folders if not any(folder.glob("*.mcap")) and owner_of(folder) is None)


def drop(left: LeftSpool) -> None:
    """Delete a spool and all waiting records; records that the server refused stay in its folder `refused`.

    Raises:
        JournalError: another process has the spool open, or the disk refuses.
    """
    lock = lock_folder(left.folder, "spool", "scanner")
    try:
        for number in journal.segments(left.folder):
            journal.segment_path(left.folder, number).unlink()
        (left.folder / spool.TOMBSTONES).unlink(missing_ok=True)
    except OSError as error:
        raise JournalError(f"cannot delete {left.folder}: {error.strerror}", error.errno) from error
    finally:
        lock.close()


def _describe(folder: Path) -> LeftSpool | None:
    try:
        for record in _waiting(folder):
            with suppress(DecodeError, IndexError):  # damaged: a later record names the same map
                header = unpack(record.frames[0])
                place = (folder, header.map, header.world)
                return LeftSpool(*place, record.session, record.logged_ns, owner_of(folder))
    except JournalError as error:
        log.warning("the spool %s is passed over: %s", folder, error)
    return None


def _waiting(folder: Path) -> Iterator[Record]:
    gone: set[int] | None = None
    for number in journal.segments(folder):
        for step in scan_records(journal.segment_path(folder, number)):
            if isinstance(step, Damage):
                continue
            if gone is None:
                gone = spool.buried(folder, step.session) or set()
            if step.seq not in gone:
                yield step
