# SPDX-License-Identifier: MIT
"""File systems so small that they can be filled."""

import os
import subprocess
from pathlib import Path


def mount(folder: Path, mib: int) -> str:
    """Mount a file system of so many MiB at a folder, in memory; the reason why that cannot be done here."""
    folder.mkdir(parents=True, exist_ok=True)
    if os.geteuid():
        return "mounting a small file system takes root"
    command = ["mount", "-t", "tmpfs", "-o", f"size={mib}m", "none", folder]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return f"no small file system can be mounted here: {done.stderr.strip()}" if done.returncode else ""


def unmount(folder: Path) -> None:
    """Unmount what `mount` may have mounted."""
    if os.path.ismount(folder):
        subprocess.run(["umount", "-l", folder], check=True)


def fill(path: Path) -> None:
    """Fill a disk to its last byte by this file."""
    with path.open("ab", buffering=0) as file:
        for size in (1 << 20, 4096, 1):
            while True:
                try:
                    file.write(bytes(size))
                except OSError:
                    break
