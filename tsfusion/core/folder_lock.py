# SPDX-License-Identifier: MIT
"""Locks that let only one process at a time use a folder."""

import fcntl
import os
import time
from contextlib import suppress
from pathlib import Path

from tsfusion.core import durable_files
from tsfusion.core.errors import JournalError, TsfusionError

_POLL_S = 0.05


class FolderLock:
    """The lock of a folder, held until `close` or the end of this process; made by `hold`."""

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor

    def __enter__(self) -> "FolderLock":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Let go of the folder; a second call does nothing."""
        if self.descriptor >= 0:
            os.close(self.descriptor)
            self.descriptor = -1


def hold(folder: Path, name: str | None = None, *, wait: float = 0.0) -> FolderLock:
    """Keep other processes that call this out of a folder.

    Args:
        name: of the file in the folder that is locked, made when absent; None = the folder itself.
        wait: seconds to wait for a process that has the lock.

    Raises:
        BlockingIOError: when another process has the lock.
        OSError: when the file or folder cannot be opened.
    """
    if name is None:
        descriptor = os.open(folder, os.O_RDONLY)
    else:
        descriptor = os.open(folder / name, os.O_RDWR | os.O_CREAT, 0o666)
    try:
        _lock(descriptor, time.monotonic() + wait)
    except BaseException:
        os.close(descriptor)
        raise
    return FolderLock(descriptor)


def _lock(descriptor: int, deadline: float) -> None:
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except BlockingIOError:
            if time.monotonic() >= deadline:
                raise
            time.sleep(_POLL_S)


def lock_folder(
    folder: Path,
    kind: str,
    owner: str,
    *,
    name: str = "lock",
    wait: float = 0.0,
    error_type: type[TsfusionError] = JournalError,
) -> FolderLock:
    """Make a folder and hold it for this process; the lock file `name` says which process that is.

    Args:
        kind: the folder, in the words of an error: `spool`, `state`, `map`.
        owner: the program that uses such a folder: `scanner`, `server`, `fuser`.
        wait: seconds to wait for another owner.

    Raises:
        TsfusionError: of `error_type`, when the folder cannot be written, or another process holds it.
    """
    try:
        durable_files.make_folder(folder)
        lock = hold(folder, name, wait=wait)
    except BlockingIOError as error:
        with suppress(OSError):
            if pid := (folder / name).read_text(encoding="ascii", errors="replace"):
                owner += f" (pid {pid})"
        raise error_type(
            f"the {kind} folder {folder} is in use by another {owner}: end that first"
        ) from error
    except (OSError, ValueError) as error:  # ValueError: a name with a NUL
        reason = getattr(error, "strerror", error)
        raise error_type(f"cannot write the {kind} folder {folder}: {reason}") from error
    with suppress(OSError):  # only a message to whoever has to wait
        os.truncate(lock.descriptor, 0)
        os.pwrite(lock.descriptor, b"%d" % os.getpid(), 0)
    return lock
