# SPDX-License-Identifier: MIT
"""What makes a file outlast a power cut, and how much room is left for it."""

import contextlib
import os
from collections.abc import Iterable
from pathlib import Path


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
