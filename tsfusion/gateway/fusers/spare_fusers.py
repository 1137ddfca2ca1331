# SPDX-License-Identifier: MIT
"""Keep spare fuser processes with compiled kernels, so that a map opens at once."""

import logging
import time
from collections.abc import Callable

from tsfusion.core.config import ServerConfig, VolumeConfig
from tsfusion.core.readable_numbers import count_of
from tsfusion.fuser import fuser_messages
from tsfusion.gateway.ports.fuser_process import FuserProcess

log = logging.getLogger(__name__)

_LONGEST_PAUSE = 60.0  # most seconds between two starts that fail
StartFuser = Callable[..., FuserProcess]  # as `FuserProcess` is made: for a map's name, `waits`


class _Spare:
    """Spare process, and the map settings for which its kernels are compiled."""

    def __init__(self, process: FuserProcess, volume: VolumeConfig) -> None:
        self.process, self.volume = process, volume
        self.is_warm = False
        self.problem = ""  # why it cannot be used; empty if it can

    def fits(self, volume: VolumeConfig) -> bool:
        """True if the process is ready for a map with these settings."""
        return self.is_warm and self.volume == volume and self.process.status is None

    def receive(self) -> None:
        while (received := self.process.receive()) is not None:
            message, _ = received
            if isinstance(message, fuser_messages.Started):
                self.process.note_start()
                self.process.send(fuser_messages.Warm(self.volume))
            elif isinstance(message, fuser_messages.Failed):
                self.problem = message.message
            self.is_warm |= isinstance(message, fuser_messages.Prepared)


class SpareFusers:
    """Pool of up to `spare_fusers` spare processes for maps with equal settings. Call `step` regularly."""

    def __init__(self, start: StartFuser, server: ServerConfig) -> None:
        self._start, self._server = start, server
        self._spares: list[_Spare] = []
        self._was_full = self._is_closed = False
        self._failures = 0  # processes in a row that never became ready
        self._start_at = 0.0  # time.monotonic()

    def take(self, name: str, volume: VolumeConfig, *, waits: bool = False) -> FuserProcess:
        """Return a process for a map: a spare one, or a new one. With `waits`, a new one is not started yet.

        Raises:
            OSError: when the system cannot start it.
        """
        for one in self._spares:
            if one.fits(volume):
                self._spares.remove(one)
                return one.process
        return self._start(name, waits=waits)

    def add(self, process: FuserProcess, volume: VolumeConfig) -> None:
        """Put a map's process into the pool: its kernels are compiled, and its map is empty."""
        self._spares.append(_Spare(process, volume))
        self._spares[-1].is_warm = True

    def has_for(self, volume: VolumeConfig) -> bool:
        return any(one.fits(volume) for one in self._spares)

    def step(self, volume: VolumeConfig, *, may_start: bool) -> None:
        """Start processes up to the wanted number, for these map settings. After `close` do nothing.

        Args:
            may_start: True if no map needs the processor time of a start now.
        """
        if self._is_closed:
            return
        for one in self._spares:
            one.receive()
            if one.is_warm:
                self._failures = 0
        for one in [one for one in self._spares if one.process.status is not None or one.volume != volume]:
            self._spares.remove(one)
            if not one.is_warm and one.volume == volume:
                self._on_failure(one.problem or f"it ended with status {one.process.status}")
            one.process.close(wait=False)
        count, are_warm = len(self._spares), all(one.is_warm for one in self._spares)
        is_time = may_start and time.monotonic() >= self._start_at
        if are_warm and is_time and count < self._server.spare_fusers:
            try:
                self._spares.append(_Spare(self._start(""), volume))
            except OSError as error:
                self._on_failure(str(error))
        is_full = bool(count) and are_warm and count >= self._server.spare_fusers
        if is_full and not self._was_full:
            log.info("%s ready", count_of(count, "spare fuser is", "spare fusers are"))
        self._was_full = is_full

    def _on_failure(self, why: str) -> None:
        """Log a failed start of a spare process, and delay the next try: it costs a second of CPU time."""
        pause = min(2.0**self._failures, _LONGEST_PAUSE)
        self._failures += 1
        self._start_at = time.monotonic() + pause
        log.warning("a spare fuser cannot be started: %s; it is tried again in %.0f s", why, pause)

    def close(self) -> None:
        """End all spare processes. Later calls of `step` start none: the server is ending."""
        self._is_closed = True
        for one in self._spares:
            one.process.close()
        self._spares.clear()
