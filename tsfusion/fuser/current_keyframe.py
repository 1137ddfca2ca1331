# SPDX-License-Identifier: MIT
"""The keyframe that a fuser process is at, for the gateway to read."""

import mmap
import struct
from pathlib import Path

from tsfusion.core.errors import MapError


class CurrentKeyframe:
    """The file that says which keyframe the process is at, also after its death."""

    def __init__(self, path: str) -> None:
        try:
            with Path(path).open("r+b") as file:
                self._word = mmap.mmap(file.fileno(), 8)
        except (OSError, ValueError) as error:  # ValueError: the file is too short
            raise MapError(f"cannot share memory with the gateway: {error}") from error

    def set(self, index: int) -> None:
        """Write the index of the keyframe; `messages.NOT_WORKING` = none."""
        struct.pack_into("<q", self._word, 0, index)
