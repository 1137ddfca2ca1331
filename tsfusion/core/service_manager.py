# SPDX-License-Identifier: MIT
"""Report to the service manager: ready, alive, stopping (systemd's sd_notify protocol).

Without a service manager nothing is sent; sending never waits.
"""

import logging
import os
import socket
import time
from collections.abc import Callable, Mapping

from tsfusion.core.logs import printable

_STATUS_CHARACTERS = 200
_START_EXTENSION_US = 120_000_000  # microseconds until the next report at a start

log = logging.getLogger(__name__)


class Watchdog:
    """The link to the service manager (systemd) that started this process, if any."""

    def __init__(
        self, environment: Mapping[str, str] = os.environ, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._clock = clock
        self._socket: socket.socket | None = None
        self._status = ""
        # Seconds within which `pet` has to be called (WatchdogSec); None = no watchdog
        self.interval: float | None = None
        path = environment.get("NOTIFY_SOCKET", "")
        if not path.startswith(("/", "@")):
            return
        # "@" stands for the zero byte of an abstract address
        self._address = "\0" + path[1:] if path.startswith("@") else path
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        self._socket.setblocking(False)
        self.interval = _interval(environment)
        self._next_pet = clock()

    def starting(self, status: str) -> None:
        """Report the progress of a long start, which may then take longer than TimeoutStartSec."""
        self._status = status
        self._send(f"EXTEND_TIMEOUT_USEC={_START_EXTENSION_US}", _line(status))

    def ready(self, status: str = "") -> None:
        """Report that the start is complete and keyframes are accepted."""
        self._status = status
        self._send("READY=1", _line(status))

    def pet(self, status: str = "") -> None:
        """Report that the server's main loop is alive; call it as often as you like.

        A message is sent once in each half of the watchdog's interval, and at once for a new status.
        """
        if status and status != self._status:
            self._status = status
            self._send(_line(status))
        if self.interval is not None and self._clock() >= self._next_pet:
            self._next_pet = self._clock() + self.interval / 2
            self._send("WATCHDOG=1")

    def stopping(self, status: str = "") -> None:
        """Report that the server is stopping: it fuses waiting keyframes and saves the map."""
        self._send("STOPPING=1", _line(status))

    def close(self) -> None:
        """Close the link; later reports are not sent."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, *lines: str) -> None:
        if self._socket is None:
            return
        message = "\n".join(line for line in lines if line)
        try:
            self._socket.sendto(message.encode(errors="replace"), self._address)
        except OSError as error:  # full or closed: the next report repeats this one
            log.warning("cannot send %s to the service manager: %s", message.partition("\n")[0], error)


def _interval(environment: Mapping[str, str]) -> float | None:
    """Return the seconds within which the watchdog expects a report; None without one for this process."""
    if environment.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
        return None
    microseconds = environment.get("WATCHDOG_USEC", "")
    return int(microseconds) / 1e6 if microseconds.isdecimal() and int(microseconds) else None


def _line(status: str) -> str:
    return f"STATUS={printable(status, _STATUS_CHARACTERS)}" if status else ""
