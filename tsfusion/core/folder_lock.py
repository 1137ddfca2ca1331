# SPDX-License-Identifier: MIT
"""One process at a time in a folder."""

import fcntl
import os
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

from tsfusion.core import durable_files
from tsfusion.core.errors import JournalError, MapError

if TYPE_CHECKING:
    pass


def lock_folder(folder: Path, kind: str, owner: str) -> BinaryIO:
    """Make a folder and hold it for this process until the returned file is closed.

    Raises:
        JournalError: when it cannot be written, or another process holds it.
    """
    try:
        durable_files.make_folder(folder)
        file = (folder / "lock").open("ab")
    except (OSError, ValueError) as error:  # ValueError: a name with a NUL
        raise JournalError(
            f"cannot write the {kind} folder {folder}: {getattr(error, 'strerror', error)}"
        ) from error
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        file.close()
        raise JournalError(f"the {kind} folder {folder} is in use by another {owner}") from error
    return file


_LOCK_FILE = "fuser.lock"
_PATIENCE = 60.0  # seconds for another fuser to end: it may be reading a large map


def hold(folder: Path) -> int:
    """Keep other fusers off a map for as long as this process lives; one that is ending is waited for.

    Returns:
        A descriptor; closing it lets go.

    Raises:
        MapError: when another one has the map, or the folder cannot be written.
    """
    path, deadline = folder / _LOCK_FILE, time.monotonic() + _PATIENCE
    held = None
    try:
        held = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        while not _lock(held):
            if time.monotonic() >= deadline:
                owner = os.pread(held, 32, 0).decode("ascii", "replace").strip()
                raise MapError(f"the map {folder} is in use by another fuser (pid {owner}): end that first")
            time.sleep(0.05)
    except (OSError, MapError) as error:
        if held is not None:
            os.close(held)
        if isinstance(error, OSError):
            raise MapError(f"cannot lock {path}: {error.strerror}") from error
        raise
    with suppress(OSError):  # it only helps whoever has to wait
        os.truncate(held, 0)
        os.pwrite(held, b"%d" % os.getpid(), 0)
    return held


def _lock(descriptor: int) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
