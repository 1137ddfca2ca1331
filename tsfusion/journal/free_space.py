# SPDX-License-Identifier: MIT
"""Room on the disk of a folder, asked for now and then."""

import time
from pathlib import Path

from tsfusion.core import durable_files
from tsfusion.core.errors import JournalError

_CHECK_BYTES = 16 << 20  # written between two checks of the disk, at most
_CHECK_S = 1.0


class FreeSpace:
    """Room to write on a folder's disk, of which `min_free_bytes` stay free."""

    def __init__(self, folder: Path, min_free_bytes: int) -> None:
        self._folder = folder
        self._kept = min_free_bytes
        self._left = 0  # bytes to write before the next check
        self._check_at = 0.0

    def reserve(self, nbytes: int) -> None:
        """Raise JournalError when writing so much would leave too little."""
        now = time.monotonic()
        if self._kept and (now >= self._check_at or nbytes > self._left):
            spare = self.free_bytes - self._kept
            self._left = min(spare, max(_CHECK_BYTES, nbytes))
            self._check_at = now + _CHECK_S
            if nbytes > spare:
                self._check_at = 0.0
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
            return durable_files.free_bytes(self._folder)
        except OSError as error:
            raise JournalError(
                f"cannot tell how full the disk of {self._folder} is: {error.strerror}", error.errno
            ) from error


def _mb(count: int) -> str:
    return f"{count / 1e6:.1f} MB"
