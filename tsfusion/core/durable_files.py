# SPDX-License-Identifier: MIT
"""What makes a file outlast a power cut, and how much room is left for it."""

import contextlib
import fcntl
import os
import secrets
import shlex
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from tsfusion.core.errors import InvalidConfig, OutputError


def make_folder(folder: Path) -> None:
    """Make a folder and those above it, so that they are still there after a power cut; raises OSError."""
    missing = [folder, *folder.parents]
    missing = missing[: next((i for i, one in enumerate(missing) if one.exists()), None)]
    folder.mkdir(parents=True, exist_ok=True)
    for made in reversed(missing):
        sync_folder(made.parent)


def sync_folder(folder: Path) -> None:
    """Make what was created, renamed or deleted in a folder durable (POSIX; elsewhere there is no way)."""
    if os.name != "posix":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def replace(path: Path, parts: Iterable[bytes]) -> None:
    """Write a file: on the disk when this returns, and the one before until then; raises OSError."""
    partial = path.with_name(f".{path.name}.partial")
    try:
        with partial.open("wb") as file:
            file.writelines(parts)
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
    except BaseException:  # an interrupted one leaves no part either
        with contextlib.suppress(OSError):
            partial.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def free_bytes(folder: Path) -> int:
    """Room that is left on a folder's disk for this user; raises OSError."""
    disk = os.statvfs(folder)
    return disk.f_bavail * disk.f_frsize


_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


def made(folder: Path) -> Path:
    """The folder, made (0700) if it is not there.

    Raises:
        InvalidConfig: when others can change it.
        OutputError: when it cannot be made.
    """
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"cannot make the folder {folder}: {error.strerror}") from error
    return checked(folder)


def checked(folder: Path) -> Path:
    """The folder, if nobody else could put other files into it.

    Raises:
        InvalidConfig: when it is not there or others can change it.
    """
    try:
        mode = folder.stat().st_mode
    except OSError as error:
        raise InvalidConfig(f"cannot read the folder {folder}: {error.strerror}") from error
    if not stat.S_ISDIR(mode):
        raise InvalidConfig(f"{folder} is not a folder")
    if others_can_change(mode):
        raise InvalidConfig(
            f"others can change the folder {folder} (mode {stat.S_IMODE(mode):04o}): run "
            f"`chmod 700 {shlex.quote(str(folder))}`, or choose another"
        )
    return folder


def others_can_change(mode: int) -> bool:
    """Whether a file of this mode is not its owner's alone to change."""
    return bool(mode & _OTHERS_WRITE)


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Let only one process at a time run such a block."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def write(path: Path, text: str) -> None:
    """Put a file (0600) in its place, whole and on the disk; what is there is replaced.

    Raises:
        OutputError: when it cannot be written; what was there is still there.
    """
    partial = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        _write_new(partial, text)
        partial.replace(path)
        _sync(path.parent)
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}") from error
    finally:
        with suppress(OSError):  # it has its name by now, or was never made
            partial.unlink()


def _write_new(path: Path, text: str) -> None:
    handle = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    with os.fdopen(handle, "w", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        os.fsync(handle)


def _sync(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
