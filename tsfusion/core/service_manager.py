# SPDX-License-Identifier: MIT
"""What a service manager is told: ready, alive, stopping (systemd's sd_notify protocol).

Nothing is done where no service manager listens, and nothing is ever waited for.
"""

import logging
import os
import socket
import time
from collections.abc import Callable, Mapping

from tsfusion.core.logs import printable

_STATUS_CHARACTERS = 200

log = logging.getLogger(__name__)


class Watchdog:
    """The link to the service manager that started this process, if one did.

    Attributes:
        interval: seconds within which `pet` has to be called (WatchdogSec); None = nobody watches.
    """

    def __init__(
        self, environment: Mapping[str, str] = os.environ, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._clock = clock
        self._socket: socket.socket | None = None
        self._status = ""
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

    def ready(self, status: str = "") -> None:
        """Keyframes are welcome: the start is over."""
        self._status = status
        self._tell("READY=1", _line(status))

    def pet(self, status: str = "") -> None:
        """The loop is alive. Call it as often as you like: one message each half of the interval.

        A new status is told at once.
        """
        if status and status != self._status:
            self._status = status
            self._tell(_line(status))
        if self.interval is not None and self._clock() >= self._next_pet:
            self._next_pet = self._clock() + self.interval / 2
            self._tell("WATCHDOG=1")

    def stopping(self, status: str = "") -> None:
        """The end has begun: keyframes are fused that wait, and the map is saved."""
        self._tell("STOPPING=1", _line(status))

    def close(self) -> None:
        """Say no more."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _tell(self, *lines: str) -> None:
        if self._socket is None:
            return
        message = "\n".join(line for line in lines if line)
        try:
            self._socket.sendto(message.encode(errors="replace"), self._address)
        except OSError as error:  # full or gone: what is told next says the same, and fusing goes on
            log.warning("the service manager cannot be told %s: %s", message.partition("\n")[0], error)


def _interval(environment: Mapping[str, str]) -> float | None:
    """Seconds, if it is this process that is watched."""
    if environment.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
        return None
    microseconds = environment.get("WATCHDOG_USEC", "")
    return int(microseconds) / 1e6 if microseconds.isdecimal() and int(microseconds) else None


def _line(status: str) -> str:
    return f"STATUS={printable(status, _STATUS_CHARACTERS)}" if status else ""
