# SPDX-License-Identifier: MIT
"""Lock folders, so that only one process at a time uses each."""

import fcntl
import os
import time
from contextlib import ExitStack, suppress
from pathlib import Path
from weakref import WeakSet

from tsfusion.core import durable_files
from tsfusion.core.errors import JournalError, TsfusionError

_POLL_S = 0.05
_locks: WeakSet[ExitStack] = WeakSet()


def _let_go() -> None:
    """Close the inherited locks in a forked process: only its parent holds them."""
    for lock in list(_locks):
        lock.close()


os.register_at_fork(after_in_child=_let_go)


def hold(folder: Path, name: str | None = None, *, wait: float = 0.0) -> ExitStack:
    """Lock a folder against other callers of this function, until the result is closed or this process ends.

    Args:
        name: name of the lock file in the folder, made if absent; None = lock the folder itself.
        wait: seconds to wait for a process that has the lock.

    Raises BlockingIOError if another process has the lock, OSError if it cannot be opened.
    """
    if name is None:
        descriptor = os.open(folder, os.O_RDONLY)
    else:
        descriptor = os.open(folder / name, os.O_RDWR | os.O_CREAT, 0o666)
    with ExitStack() as lock:
        lock.callback(os.close, descriptor)
        _lock(descriptor, time.monotonic() + wait)
        _locks.add(made := lock.pop_all())
        return made


def _lock(descriptor: int, deadline: float) -> None:
    while True:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        except BlockingIOError:
            if time.monotonic() >= deadline:
                raise
            time.sleep(_POLL_S)


def owner_of(folder: Path, *, name: str = "lock") -> str | None:
    """Return the pid of the process that holds a folder, "?" if it is unknown; None if no process does."""
    is_named = (folder / name).exists()
    try:
        hold(folder, name if is_named else None).close()
    except BlockingIOError:
        with suppress(OSError):
            return (folder / name).read_text(encoding="ascii", errors="replace") or "?"
        return "?"
    except OSError:
        return None
    return None


def _hold_itself(folder: Path, lock: ExitStack, wait: float) -> None:
    """Lock a folder in addition to its lock file; do nothing on a file system without locks of folders."""
    try:
        lock.push(hold(folder, wait=max(wait, _POLL_S)))  # another process may test the lock for a moment
    except BlockingIOError:
        lock.close()
        raise
    except OSError:
        return


def lock_folder(
    folder: Path,
    kind: str,
    owner: str,
    *,
    name: str = "lock",
    wait: float = 0.0,
    error_type: type[TsfusionError] = JournalError,
    make: bool = True,
) -> ExitStack:
    """Make a folder and hold it for this process; the lock file `name` contains the process's pid.

    The folder itself is locked, too, because the file may be deleted.

    Args:
        kind: kind of folder for an error's text: `spool`, `state`, `map`.
        owner: the program that uses such a folder: `scanner`, `server`, `fuser`.
        wait: seconds to wait for another owner.
        make: make the folder if it is absent.

    Raises `error_type` if the folder cannot be written, or another process holds it.
    """
    path = folder / name
    try:
        if make:
            durable_files.make_folder(folder)
        lock = hold(folder, name, wait=wait)
        _hold_itself(folder, lock, wait)
    except BlockingIOError as error:
        with suppress(OSError):
            if pid := path.read_text(encoding="ascii", errors="replace"):
                owner += f" (pid {pid})"
        in_use = f"the {kind} folder {folder} is in use by another {owner}: end that first"
        raise error_type(in_use) from error
    except (OSError, ValueError) as error:  # ValueError: a name with a NUL
        reason = getattr(error, "strerror", error)
        raise error_type(f"cannot write the {kind} folder {folder}: {reason}; choose another") from error
    with suppress(OSError):  # the pid is only for messages of waiting processes
        path.write_text(str(os.getpid()), encoding="ascii")
    return lock
