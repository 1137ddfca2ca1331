# SPDX-License-Identifier: MIT
"""One fuser process: its socket, and the file that says which keyframe it is at."""

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
    """A process that is started at once. Call `close` when it has ended, or to end it.

    Args:
        name: of the map, for the log lines.

    Raises:
        OSError, zmq.ZMQError: when the system cannot start it.
    """

    def __init__(
        self, context: "zmq.Context[Any]", name: str, log_format: LogFormat, log_level: LogLevel
    ) -> None:
        self._scratch = Path(tempfile.mkdtemp(prefix="tsfusion-"))  # a socket's path has to be short
        self.working_file = self._scratch / fuser_messages.WORKING_FILE  # see `fuser.messages.Begin`
        self.socket = sockets.pair(context)  # the gateway's end
        try:
            self.clear_current_keyframe()
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
    def status(self) -> int | None:
        """The exit status; None = it runs."""
        return self._process.poll()

    @property
    def current_keyframe(self) -> int:
        """The index of the keyframe that it is at, or `fuser.messages.NOT_WORKING`."""
        try:
            (index,) = struct.unpack("<q", self.working_file.read_bytes())
        except (OSError, struct.error):
            return fuser_messages.NOT_WORKING
        return int(index)

    def clear_current_keyframe(self) -> None:
        """Write that it is at no keyframe."""
        self.working_file.write_bytes(struct.pack("<q", fuser_messages.NOT_WORKING))

    def kill(self) -> None:
        """Kill the process, and wait until it has ended."""
        self._process.kill()
        self._process.wait()

    def close(self, timeout: float = 0.0) -> None:
        """End the process and clear up. It may end by itself within so many seconds; then it is killed."""
        assert self._process.stdin is not None
        with suppress(OSError):
            self._process.stdin.close()  # it ends when it sees that
        try:
            self._process.wait(timeout)
        except subprocess.TimeoutExpired:
            self.kill()
        self.socket.close()
        shutil.rmtree(self._scratch, ignore_errors=True)
