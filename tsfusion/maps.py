# SPDX-License-Identifier: MIT
"""Where a server keeps its maps: `STATE/maps/NAME/`, each with its journal and its last checkpoint."""

import re
from pathlib import Path

from tsfusion.errors import JournalError

MAPS_FOLDER = "maps"
JOURNAL_FOLDER = "journal"
QUARANTINE_FOLDER = "quarantine"
CORRECTIONS_FOLDER = "corrections"
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
