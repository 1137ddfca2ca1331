# SPDX-License-Identifier: MIT
"""One fuser process: its socket, and the word of memory that says which keyframe it is at."""

import shutil
import struct
import subprocess
import sys
import tempfile
from contextlib import suppress
from pathlib import Path
from typing import Any

import zmq

from tsfusion.core.config import LogFormat, LogLevel
from tsfusion.fuser import messages as fuser_messages
from tsfusion.wire import sockets

COMMAND = (sys.executable, "-m", "tsfusion.fuser")


class FuserProcess:
    """Started at once; `close` it when it has ended, or to end it.

    Args:
        name: the map's, for its log lines.

    Raises:
        OSError, zmq.ZMQError: when the system has no room for it.
    """

    def __init__(
        self, context: "zmq.Context[Any]", name: str, log_format: LogFormat, log_level: LogLevel
    ) -> None:
        self._scratch = Path(tempfile.mkdtemp(prefix="tsfusion-"))  # a socket's path has to be short
        self.working_file = self._scratch / fuser_messages.WORKING_FILE
        self.socket = sockets.pair(context)
        try:
            self.at_nothing()
            endpoint = f"ipc://{self._scratch}/0"
            self.socket.bind(endpoint)
            self._process = subprocess.Popen(
                [*COMMAND, endpoint, log_format, log_level, name],
                stdin=subprocess.PIPE,  # closes when the gateway dies, however it dies
                stdout=subprocess.DEVNULL,
                start_new_session=True,  # a Ctrl-C is for the gateway
            )
        except BaseException:
            self.socket.close()
            shutil.rmtree(self._scratch, ignore_errors=True)
            raise

    @property
    def pid(self) -> int:
        """The process."""
        return self._process.pid

    @property
    def status(self) -> int | None:
        """How it ended; None = it runs."""
        return self._process.poll()

    @property
    def at(self) -> int:
        """The keyframe that it is at, or `work.NOT_WORKING`."""
        try:
            (index,) = struct.unpack("<q", self.working_file.read_bytes())
        except (OSError, struct.error):
            return fuser_messages.NOT_WORKING
        return int(index)

    def at_nothing(self) -> None:
        """What it was at is known."""
        self.working_file.write_bytes(struct.pack("<q", fuser_messages.NOT_WORKING))

    def kill(self) -> None:
        """End it at once."""
        self._process.kill()
        self._process.wait()

    def close(self, patience: float = 0.0) -> None:
        """End it: at once, or when it has not ended by itself after so many seconds."""
        assert self._process.stdin is not None
        with suppress(OSError):
            self._process.stdin.close()  # it ends when it sees that
        try:
            self._process.wait(patience)
        except subprocess.TimeoutExpired:
            self.kill()
        self.socket.close()
        shutil.rmtree(self._scratch, ignore_errors=True)
