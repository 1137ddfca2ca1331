# SPDX-License-Identifier: MIT
"""Where a server keeps its maps: `STATE/maps/NAME/`, each with its journal and its last checkpoint."""

import re
from collections.abc import Callable, Iterator
from pathlib import Path

from msgspec import Struct

from tsfusion.core.errors import JournalError
from tsfusion.journal.mcap_layout import Position, Record
from tsfusion.journal.record_scan import Damage, failed, segment_number, walk
from tsfusion.journal.segments import segment_path, segments

MAPS_FOLDER = "maps"
JOURNAL_FOLDER = "journal"
QUARANTINE_FOLDER = "quarantine"
MAP_FILE = "map.tsf"
PREVIOUS_FILE = "map.previous.tsf"
_NAME = re.compile(r"[a-z0-9][a-z0-9_-]{0,31}")  # as config.MapName


def folder(state: str | Path, name: str) -> Path:
    """Where a map is, or will be."""
    return Path(state) / MAPS_FOLDER / name


def names(state: str | Path) -> list[str]:
    """The maps that a state folder holds."""
    return sorted(
        path.name
        for path in (Path(state) / MAPS_FOLDER).glob("*")
        if path.is_dir() and _NAME.fullmatch(path.name)
    )


def is_state(path: Path) -> bool:
    """Whether it is a server's state folder."""
    return (path / MAPS_FOLDER).is_dir()


def resolve(path: Path, name: str | None = None) -> Path:
    """The map's folder when `path` is a state folder; any other path as it is.

    Args:
        name: which of several.

    Raises:
        JournalError: when it holds no map of that name, or several and none was named.
    """
    if not is_state(path):
        if name is not None:
            raise JournalError(f"--map has no effect on {path}: only a state folder has several maps")
        return path
    found = names(path)
    if name is None and len(found) == 1:
        return folder(path, found[0])
    if name in found:
        return folder(path, name)
    there = ", ".join(found) or "none"
    if name is None and found:
        raise JournalError(
            f"{path} has several maps ({there}): choose one with --map NAME, or give "
            f"{path / MAPS_FOLDER}/NAME"
        )
    missing = f"no map {name}" if name else "no map with a journal"
    raise JournalError(f"{path} has {missing}; it has: {there}")


Watcher = Callable[[int, int], None]  # bytes read, bytes of all


class JournalPlace(Struct, frozen=True):
    """A journal on the disk.

    Attributes:
        path: a folder of segments, or one segment file.
        quarantine: where the server of its map keeps what could not be fused; None = it is no map's.
    """

    path: Path
    quarantine: Path | None = None

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


def find(path: Path, map_name: str | None = None) -> JournalPlace:
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
    path = resolve(path, map_name)
    if (path / JOURNAL_FOLDER).is_dir():
        return _of_map(path)
    if path.name == JOURNAL_FOLDER and _is_map(path.parent):
        return _of_map(path.parent)
    if path.is_dir():
        return JournalPlace(path)
    if path.suffix != ".mcap":
        raise JournalError(f"{path} is no journal; expected a folder or an .mcap file")
    return JournalPlace(path)


def _of_map(folder: Path) -> JournalPlace:
    return JournalPlace(folder / JOURNAL_FOLDER, folder / QUARANTINE_FOLDER)


def _is_map(folder: Path) -> bool:
    return (folder / QUARANTINE_FOLDER).is_dir()


def _size(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0
