# SPDX-License-Identifier: MIT
"""Stops writing before a disk is full, so that there is room left for what must be written."""

import time
from pathlib import Path

from tsfusion import disk
from tsfusion.errors import JournalError

_LOOK_BYTES = 16 << 20  # written between two looks at the disk, at most
_LOOK_SECONDS = 1.0


class Room:
    """The room for writing on a folder's disk, of which `min_free_bytes` are not for us."""

    def __init__(self, folder: Path, min_free_bytes: int) -> None:
        self._folder = folder
        self._kept = min_free_bytes
        self._left = 0  # may be written without another look
        self._look_at = 0.0

    def take(self, nbytes: int) -> None:
        """Raise JournalError when writing so much would leave too little."""
        now = time.monotonic()
        if self._kept and (now >= self._look_at or nbytes > self._left):
            spare = self.free_bytes - self._kept
            self._left = min(spare, max(_LOOK_BYTES, nbytes))
            self._look_at = now + _LOOK_SECONDS
            if nbytes > spare:
                self._look_at = 0.0
                raise JournalError(
                    f"cannot write {self._folder}: its disk has {_mb(spare + self._kept)} free, "
                    f"and {_mb(self._kept)} must stay so: free some space"
                )
        self._left -= nbytes

    @property
    def free_bytes(self) -> int:
        """Room on the disk.

        Raises:
            JournalError: when the disk does not say.
        """
        try:
            return disk.free_bytes(self._folder)
        except OSError as error:
            raise JournalError(
                f"cannot tell how full the disk of {self._folder} is: {error.strerror}"
            ) from error


def _mb(count: int) -> str:
    return f"{count / 1e6:.1f} MB"
