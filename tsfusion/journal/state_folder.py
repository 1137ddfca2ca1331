# SPDX-License-Identifier: MIT
"""Find the folders of a server's maps, `STATE/maps/NAME/`, and the journals in them."""

import errno
import os
import re
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

from msgspec import Struct

from tsfusion.core.config import MAP_NAME, SERVER_SESSION
from tsfusion.core.durable_files import size_of
from tsfusion.core.errors import JournalError, OutputError
from tsfusion.core.readable_numbers import OnProgress, count_of
from tsfusion.journal.mcap_layout import Position, Record
from tsfusion.journal.quarantine import quarantined_files
from tsfusion.journal.record_scan import Damage, scan_records
from tsfusion.journal.segments import is_segment, journal_errors, segment_number, segment_path, segments

MAPS_FOLDER = "maps"
JOURNAL_FOLDER = "journal"
QUARANTINE_FOLDER = "quarantine"
MAP_FILE = "map.tsf"
ARRIVED_FILE = "arrived.json"  # in the folder of a map that came from another server
MOVED_FOLDER = "moved"  # for maps that another server has taken over
LOCK_FILE = "fuser.lock"
PREVIOUS_FILE = "map.previous.tsf"

# Errors of a segment that mean damage; others, such as missing rights, say nothing of its content
_BAD_FILE = (None, errno.EIO, errno.EISDIR, errno.ELOOP, errno.ENOENT)


def map_folder(state: str | Path, name: str) -> Path:
    """Return the folder of a map; it need not exist yet."""
    return _maps(state) / name


def _maps(state: str | Path) -> Path:
    """Return the folder of the maps; `state` may be the path of a URL, which `Path` does not accept."""
    return (Path(state) if isinstance(state, str) else state) / MAPS_FOLDER


def map_names(state: str | Path) -> list[str]:
    """Return the names of the maps in a state folder.

    Raises:
        JournalError: the folder cannot be listed.
    """
    folder = _maps(state)
    with journal_errors("list", folder), suppress(FileNotFoundError):
        names = [path.name for path in folder.iterdir() if re.fullmatch(MAP_NAME, path.name)]
        return sorted(name for name in names if (folder / name).is_dir())
    return []


def holds_a_map(folder: Path) -> bool:
    """Return True if a map's folder holds any file besides its lock file, such as a record or a checkpoint.

    Raises:
        JournalError: the folder cannot be listed.
    """
    with journal_errors("list", folder), suppress(FileNotFoundError):
        return any(name != LOCK_FILE for _, _, names in os.walk(folder, onerror=_fail) for name in names)
    return False


def holds_records(folder: Path) -> bool:
    """Return True if a map's folder holds a checkpoint, or a non-empty segment of a journal.

    Raises:
        JournalError: the folder cannot be listed.
    """
    journal = folder / JOURNAL_FOLDER
    numbers = segments(journal) if journal.is_dir() else []
    paths = [segment_path(journal, number) for number in numbers]
    return (folder / MAP_FILE).exists() or any(map(size_of, paths))


def _fail(error: OSError) -> None:
    raise error


def is_state_folder(path: Path) -> bool:
    return (path / MAPS_FOLDER).is_dir()


def check_no_map_of_a_server(path: Path) -> None:
    """Raise OutputError if a file at this path would replace the checkpoint of a server's map."""
    if path.name == MAP_FILE and (path.absolute().parent / JOURNAL_FOLDER).is_dir():
        raise OutputError(
            f"cannot write {path}: a server keeps its map there, beside the journal; choose another name"
        )


def resolve_map(path: Path, name: str | None = None) -> Path:
    """Return the map's folder if `path` is a state folder; return any other path unchanged.

    Args:
        name: the map's name, needed if the state folder has several maps.

    Raises:
        JournalError: the folder has no map of that name, or has several and no name was given.
    """
    if not is_state_folder(path):
        if name is not None:
            raise JournalError(f"--map has no effect on {path}: only a state folder has several maps")
        return path
    found = map_names(path)
    if name is None and len(found) == 1:
        return map_folder(path, found[0])
    if name in found:
        return map_folder(path, name)
    there = ", ".join(found) or "none"
    if name is None and found:
        raise JournalError(
            f"{path} has several maps ({there}): choose one, {path / MAPS_FOLDER}/NAME (or --map NAME, of "
            "verbs that have it)"
        )
    missing = f"no map {name}" if name else "no map with a journal"
    raise JournalError(f"{path} has {missing}; it has: {there}")


class JournalPlace(Struct, frozen=True):
    """The location of a journal, and its folder of keyframes in quarantine, if it has one."""

    path: Path  # a folder of segments, or one segment file
    # Folder of the keyframes that could not be fused; None = the journal belongs to no map
    quarantine: Path | None = None

    def files(self) -> list[Path]:
        """Return the segment files, oldest first; in a quarantine folder, return its files.

        Raises:
            JournalError: the folder cannot be listed.
        """
        if not self.path.is_dir():
            return [self.path]
        numbered = [segment_path(self.path, number) for number in segments(self.path)]
        return numbered + quarantined_files(self.path)

    def quarantined(self) -> list[Path]:
        """Return the files in quarantine, sorted by name.

        Raises:
            JournalError: the folder cannot be listed.
        """
        if self.quarantine is None or not self.quarantine.is_dir():
            return []
        with journal_errors("list", self.quarantine):
            return sorted(path for path in self.quarantine.iterdir() if path.suffix == ".mcap")

    def last_logged_ns(self) -> int:
        """Return the wall clock time of a scanner's last record; 0 without a record. Raises JournalError."""
        for path in reversed(self.files()):
            steps = (step for step in scan_records(path) if isinstance(step, Record))
            if stamps := [step.logged_ns for step in steps if step.session != SERVER_SESSION]:
                return max(stamps)
        return 0

    @property
    def is_a_maps(self) -> bool:
        """True for the journal of a map, which deletes only its oldest segments: any other gap is a loss."""
        beside = self.path.parent
        is_there = (beside / MAP_FILE).exists() or (beside / LOCK_FILE).exists()
        return self.quarantine is not None or (self.path.name == JOURNAL_FOLDER and is_there)

    def steps(self, watch: OnProgress = lambda _done, _all: None) -> Iterator[tuple[Path, Record | Damage]]:
        """Yield records and damage, each with its file; a bad disk or a missing segment is damage.

        A segment that its writer deletes meanwhile, because it needs it no more, is passed over.

        Raises:
            JournalError: a file cannot be read for a reason that says nothing of its content.
        """
        files = [(path, size_of(path)) for path in self.files()]
        total, before, last = sum(size for _, size in files), 0, 0
        has_no_gaps = self.is_a_maps
        for path, size in files:
            if has_no_gaps and (gap := gap_before(path, last)) is not None:
                yield path, gap
            last = segment_number(path)
            try:
                for step in scan_records(path):
                    yield path, step
                    watch(before + min(step.position.offset, size), total)
            except JournalError as error:
                if error.errno not in _BAD_FILE:
                    raise
                if not os.path.lexists(path) and not (has_no_gaps and self._keeps_older_than(path)):
                    continue
                yield path, Damage(Position(segment_number(path), 0), size, 1, str(error))
            before += size
            watch(before, total)

    def _keeps_older_than(self, path: Path) -> bool:
        """Return True if a segment older than `path` is there: a map deletes its oldest segments alone."""
        return any(number < segment_number(path) for number in segments(self.path))


def gap_before(path: Path, last: int) -> Damage | None:
    """Return damage for segments missing between number `last` (0 = none) and the segment `path`, or None."""
    number = segment_number(path)
    count = number - last - 1
    if not last or count <= 0:
        return None
    what = f"{count_of(count, 'segment')} before this one {'is' if count == 1 else 'are'} missing"
    return Damage(Position(number, 0), 0, count, what)


def find_journal(path: Path, map_name: str | None = None) -> JournalPlace:
    """Return the journal at a path: a state folder, a map's folder, a folder of segments, or one segment.

    Args:
        map_name: the map's name, needed if the state folder has several maps.

    Raises:
        JournalError: the path has no journal, or several.
    """
    if not path.exists():
        raise JournalError(
            f"{path} does not exist; expected a state folder, a map's, a journal or an .mcap file"
        )
    path = resolve_map(path, map_name)
    if (path / JOURNAL_FOLDER).is_dir():
        return _of_map(path)
    if path.name == JOURNAL_FOLDER and (path.parent / QUARANTINE_FOLDER).is_dir():
        return _of_map(path.parent)
    if path.is_dir():
        return JournalPlace(path)
    if path.suffix != ".mcap":
        raise JournalError(f"{path} is no journal; expected a folder or an .mcap file")
    return JournalPlace(path)


def is_journal(path: Path) -> bool:
    """Return True if a path that `find_journal` accepts has any record to read.

    Raises:
        JournalError: a folder cannot be listed.
    """
    if not path.is_dir():
        return is_segment(path)
    inside = path / JOURNAL_FOLDER
    place = JournalPlace(inside if inside.is_dir() else path)
    return is_state_folder(path) or any(map(is_segment, place.files()))


def _of_map(folder: Path) -> JournalPlace:
    return JournalPlace(folder / JOURNAL_FOLDER, folder / QUARANTINE_FOLDER)
