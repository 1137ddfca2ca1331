# SPDX-License-Identifier: MIT
"""The journal that a person means by a path."""

from collections.abc import Callable, Iterator
from pathlib import Path

from msgspec import Struct

from tsfusion import maps
from tsfusion.errors import JournalError
from tsfusion.journal.layout import Position, Record
from tsfusion.journal.segments import segment_path, segments
from tsfusion.journal.walk import Damage, failed, segment_number, walk

Watcher = Callable[[int, int], None]  # bytes read, bytes of all


class Place(Struct, frozen=True):
    """A journal on the disk.

    Attributes:
        path: a folder of segments, or one segment file.
        quarantine: where the server of its map keeps what could not be fused; None = it is no map's.
        corrections: where it keeps corrected poses; None = it is no map's.
    """

    path: Path
    quarantine: Path | None = None
    corrections: Path | None = None

    def files(self) -> list[Path]:
        """Its segments, oldest first.

        Raises:
            JournalError: when the folder cannot be listed.
        """
        if not self.path.is_dir():
            return [self.path]
        return [segment_path(self.path, number) for number in segments(self.path)]

    def quarantined(self) -> list[Path]:
        """The files in quarantine, by name.

        Raises:
            JournalError: when the folder cannot be listed.
        """
        if self.quarantine is None or not self.quarantine.is_dir():
            return []
        try:
            return sorted(path for path in self.quarantine.iterdir() if path.suffix == ".mcap")
        except OSError as error:
            raise failed("list", self.quarantine, error) from error

    def steps(self, watch: Watcher = lambda _done, _all: None) -> Iterator[tuple[Path, Record | Damage]]:
        """Each record and each damaged place, with its file. A file that cannot be read is one such place."""
        files = [(path, _size(path)) for path in self.files()]
        total, before = sum(size for _, size in files), 0
        for path, size in files:
            try:
                for step in walk(path):
                    yield path, step
                    watch(before + min(step.position.offset, size), total)
            except JournalError as error:
                yield path, Damage(Position(segment_number(path), 0), size, 1, str(error))
            before += size
            watch(before, total)


def find(path: Path, map_name: str | None = None) -> Place:
    """The journal at a path: a state folder, a map's folder in it, a folder of segments, or one segment.

    Args:
        map_name: which map of a state folder with several.

    Raises:
        JournalError: when there is none, or no single one.
    """
    if not path.exists():
        raise JournalError(
            f"{path} does not exist; expected a state folder, a map's, a journal or an .mcap file"
        )
    path = maps.resolve(path, map_name)
    if (path / maps.JOURNAL_FOLDER).is_dir():
        return _of_map(path)
    if path.name == maps.JOURNAL_FOLDER and _is_map(path.parent):
        return _of_map(path.parent)
    if path.is_dir():
        return Place(path)
    if path.suffix != ".mcap":
        raise JournalError(f"{path} is no journal; expected a folder or an .mcap file")
    return Place(path)


def _of_map(folder: Path) -> Place:
    beside = (folder / name for name in (maps.QUARANTINE_FOLDER, maps.CORRECTIONS_FOLDER))
    return Place(folder / maps.JOURNAL_FOLDER, *beside)


def _is_map(folder: Path) -> bool:
    return any((folder / name).is_dir() for name in (maps.QUARANTINE_FOLDER, maps.CORRECTIONS_FOLDER))


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0
