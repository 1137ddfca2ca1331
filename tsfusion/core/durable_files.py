# SPDX-License-Identifier: MIT
"""Write files that survive a power cut, and make folders that only their owner can change."""

import errno
import os
import re
import shlex
import shutil
import stat
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from tsfusion.core.errors import InvalidConfig, OutputError, refusals_as

_RESERVE_BYTES = 16 << 20
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


def make_folder(folder: Path) -> None:
    """Make a folder and its parents, durable through a power cut. Raises OSError."""
    missing = [folder, *folder.parents]
    missing = missing[: next((i for i, one in enumerate(missing) if one.exists()), None)]
    folder.mkdir(parents=True, exist_ok=True)
    for made in reversed(missing):
        sync_folder(made.parent)


def sync_folder(folder: Path) -> None:
    """Make creations, renames and deletions in a folder survive a power cut (POSIX; no effect elsewhere)."""
    if os.name != "posix":
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def replacing(path: Path, *, private: bool = False) -> Iterator[BinaryIO]:
    """Yield a new file to write; at the end of the block it is durable and replaces `path`.

    Until then, and after an error, the old file stays unchanged. Remains of a killed process are overwritten.
    With `private`, only the owner may read the file (0600), from its first byte. Raises OSError.
    """
    partial = path.with_name(f".{path.name}.partial")
    mode = 0o600 if private else 0o666
    try:
        partial.unlink(missing_ok=True)  # an old file may have another mode
        with open(partial, "xb", opener=lambda name, flags: os.open(name, flags, mode)) as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
        sync_folder(path.parent)
    except BaseException:  # an interrupted block leaves no partial file either
        with suppress(OSError):
            partial.unlink(missing_ok=True)
        raise


@contextmanager
def written(path: Path, *, private: bool = False) -> Iterator[BinaryIO]:
    """Yield a new file as `replacing` does. Raises OutputError, which names the file."""
    with refusals_as(OutputError, f"cannot write {path}"), replacing(path, private=private) as file:
        yield file


@contextmanager
def replacing_folder(path: Path) -> Iterator[Path]:
    """Yield a new folder to fill; at the end of the block it replaces `path`.

    After an error the old folder stays unchanged. A file at `path` is not replaced. Raises OSError.
    """
    partial, before = (path.with_name(f".{path.name}.{kind}") for kind in ("partial", "before"))
    if path.exists() and not path.is_dir():
        raise NotADirectoryError(errno.ENOTDIR, "it is a file, not a folder")
    try:
        for one in (partial, before):
            shutil.rmtree(one, ignore_errors=True)
        partial.mkdir()
        yield partial
        if path.exists():
            os.replace(path, before)
        os.replace(partial, path)
        sync_folder(path.parent)
    finally:  # an interrupted block leaves no partial folder either
        for one in (partial, before):
            shutil.rmtree(one, ignore_errors=True)


def sweep(folder: Path, pattern: str) -> None:
    """Delete files that a killed process left; `pattern`, a regular expression, fits the whole name."""
    with suppress(OSError):
        for name in os.listdir(folder):
            if re.fullmatch(pattern, name):
                with suppress(OSError):
                    (folder / name).unlink()


def require_room(folder: Path, nbytes: int) -> None:
    """Raise OSError (ENOSPC) if `nbytes` more would leave less than 16 MB on a folder's disk."""
    free = shutil.disk_usage(folder).free
    if nbytes + _RESERVE_BYTES > free:
        needed = f"{nbytes / 1e6:.0f} MB are needed, {free / 1e6:.0f} MB are free on that disk"
        raise OSError(errno.ENOSPC, needed)


def is_in_memory(folder: Path) -> bool:
    """Return True if a folder is on a RAM disk, where files use memory (Linux; always False elsewhere)."""
    with suppress(OSError):
        device = os.stat(folder).st_dev
        number = f"{os.major(device)}:{os.minor(device)}"
        for line in Path("/proc/self/mountinfo").read_text(encoding="utf-8").splitlines():
            if line.split()[2] == number:
                return line.partition(" - ")[2].split()[0] in ("tmpfs", "ramfs", "devtmpfs")
    return False


def make_private_folder(folder: Path) -> None:
    """Make a folder that only its owner can open (0700), unless it exists.

    Raises InvalidConfig if others can change the existing folder, OutputError if it cannot be made.
    """
    with refusals_as(OutputError, f"cannot make the folder {folder}", "choose another"):
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    check_private_folder(folder)


def check_private_folder(folder: Path) -> None:
    """Raise InvalidConfig if a folder is missing, or if other users can write into it."""
    with refusals_as(InvalidConfig, f"cannot read the folder {folder}"):
        mode = folder.stat().st_mode
    if not stat.S_ISDIR(mode):
        raise InvalidConfig(f"{folder} is not a folder")
    if others_can_write(mode):
        raise InvalidConfig(
            f"others can change the folder {folder} (mode {stat.S_IMODE(mode):04o}): run "
            f"`chmod 700 {shlex.quote(str(folder))}`, or choose another"
        )


def size_of(path: Path) -> int:
    """Return the size of a file in bytes; 0 for a missing or unreadable file."""
    try:
        return path.stat().st_size
    except OSError:
        return 0


def others_can_write(mode: int) -> bool:
    """Return True if users other than the owner can change a file or folder with this mode."""
    return bool(mode & _OTHERS_WRITE)
