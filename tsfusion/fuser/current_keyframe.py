# SPDX-License-Identifier: MIT
"""The keyframe that a fuser process is at, for the gateway to read."""

import mmap
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tsfusion.core.errors import MapError
from tsfusion.fuser.messages import NOT_WORKING


class CurrentKeyframe:
    """The file that says which keyframe the process is at, also after its death."""

    def __init__(self, path: str) -> None:
        try:
            with Path(path).open("r+b") as file:
                self._word = mmap.mmap(file.fileno(), 8)
        except (OSError, ValueError) as error:  # ValueError: the file is too short
            raise MapError(f"cannot share memory with the gateway: {error}") from error

    @property
    def is_set(self) -> bool:
        return bool(struct.unpack_from("<q", self._word, 0) != (NOT_WORKING,))

    @contextmanager
    def aside(self) -> Iterator[None]:
        """Be at no keyframe for the block: what happens in it is not the keyframe's fault."""
        (index,) = struct.unpack_from("<q", self._word, 0)
        self.set(NOT_WORKING)
        yield
        self.set(index)

    def set(self, index: int) -> None:
        """Write the index of the keyframe; `messages.NOT_WORKING` = none."""
        struct.pack_into("<q", self._word, 0, index)
