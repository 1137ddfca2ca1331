# SPDX-License-Identifier: MIT
"""Memory that the system counts of this process, by what it is for."""

import re
from pathlib import Path

_MAPPING = re.compile(r"^[0-9a-f]+-[0-9a-f]+ ")


def unnamed_files_rss(folder: Path) -> int:
    """Resident bytes of this process's mappings of files without names in a folder (Linux)."""
    total, counts = 0, False
    for line in Path("/proc/self/smaps").read_text(encoding="utf-8").splitlines():
        if _MAPPING.match(line):
            counts = f" {folder}/" in line and line.endswith("(deleted)")
        elif counts and line.startswith("Rss:"):
            total += int(line.split()[1]) * 1024
    return total
