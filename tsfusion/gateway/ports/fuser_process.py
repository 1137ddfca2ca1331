# SPDX-License-Identifier: MIT
"""Run one fuser process: its messages, and a file that tells which keyframe the process works at."""

import os
import shutil
import struct
import subprocess
import sys
import tempfile
import threading
from collections.abc import Sequence
from contextlib import ExitStack, closing, suppress
from pathlib import Path
from typing import Any

import zmq

from tsfusion.core import process
from tsfusion.core.config import ServerConfig
from tsfusion.fuser import fuser_messages
from tsfusion.wire.sockets import sockets

_KILL_DEADLINE = 5.0  # seconds
_SOCKET = "0"  # name of the socket's file
COMMAND = (sys.executable, "-m", "tsfusion.fuser")


class FuserProcess:
    """Fuser process, started at once, or with `waits` by `start`. Call `close` also after its end.

    Args:
        name: name of the map for log lines; empty takes the name in a later `Begin`.

    Attributes:
        has_started: True once the process has reported its start, and takes messages.

    Raises:
        OSError: when the system cannot start the process.
    """

    def __init__(
        self,
        context: "zmq.Context[Any]",
        server: ServerConfig,
        name: str,
        *,
        waits: bool = False,
    ) -> None:
        self.has_started = False
        self._process: subprocess.Popen[bytes] | None = None
        with ExitStack() as undo:
            self._working = undo.enter_context(tempfile.TemporaryFile(buffering=0))  # has no name
            self._scratch = _socket_folder()
            undo.callback(self.remove_socket_file)
            endpoint = f"ipc://{self._scratch}/{_SOCKET}"
            try:
                self.socket = undo.enter_context(closing(sockets.pair(context)))  # the gateway's end
                self.socket.bind(endpoint)
            except zmq.ZMQError as error:
                raise OSError(error.errno, error.strerror) from error
            self.clear_current_keyframe()
            self._command = [*COMMAND, endpoint, server.log_format, server.log_level, name]
            if not waits:
                self.start()
            undo.pop_all()

    def start(self) -> None:
        """Start the process. Raise OSError if the system cannot."""
        self._process = subprocess.Popen(
            self._command,
            stdin=subprocess.PIPE,  # closes when the gateway dies, however it dies
            stdout=subprocess.DEVNULL,
            pass_fds=[self._working.fileno()],
            **process.OWN_GROUP,  # a Ctrl-C is for the gateway
        )

    def send(self, message: fuser_messages.ToFuser, frames: Sequence[Any] = ()) -> bool:
        """Send the process a message. Return False if its queue is full. A dead process loses unread ones."""
        try:
            self.socket.send_multipart([fuser_messages.encode(message), *frames], zmq.NOBLOCK)
        except zmq.Again:
            return False
        return True

    def receive(self) -> tuple[fuser_messages.ToGateway, Sequence[zmq.Frame]] | None:
        """Return the next message of the process and its frames, or None."""
        try:
            head, *frames = self.socket.recv_multipart(zmq.NOBLOCK, copy=False)
        except zmq.Again:
            return None
        return fuser_messages.to_gateway.decode(head.buffer), frames

    @property
    def working_file(self) -> str:
        """Path under which the process opens the file of its current keyframe (`fuser_messages.Begin`)."""
        return f"/dev/fd/{self._working.fileno()}"

    @property
    def pid(self) -> int:
        """Process id; 0 before the start."""
        return self._process.pid if self._process else 0

    @property
    def status(self) -> int | None:
        """Exit status; None while the process runs, and before its start."""
        return self._process.poll() if self._process else None

    @property
    def state(self) -> str:
        """State of the process as the system shows it: `D` waits for a disk, `T` is stopped."""
        return process.state(self.pid)

    @property
    def current_keyframe(self) -> int:
        """Index of the keyframe that the process is fusing, or `fuser.fuser_messages.NOT_WORKING`."""
        try:
            (index,) = struct.unpack("<q", os.pread(self._working.fileno(), 8, 0))
        except (OSError, struct.error):
            return fuser_messages.NOT_WORKING
        return int(index)

    def clear_current_keyframe(self) -> None:
        """Write `NOT_WORKING` to the file of the current keyframe."""
        os.pwrite(self._working.fileno(), struct.pack("<q", fuser_messages.NOT_WORKING), 0)

    def note_start(self) -> None:
        """Record that the process has connected. Remove its socket file: a killed gateway would leave it."""
        self.has_started = True
        self.remove_socket_file()

    def remove_socket_file(self) -> None:
        shutil.rmtree(self._scratch, ignore_errors=True)

    def kill(self) -> None:
        """Kill the process. It ends at once, or, while it waits for a disk, once the disk answers."""
        if self._process:
            self._process.kill()

    def close(self, timeout: float = 0.0, *, wait: bool = True) -> None:
        """End the process and delete its files. After `timeout` seconds in which it may end, it is killed.

        Args:
            wait: wait some seconds for the end of a killed process. A thread reaps it in any case.
        """
        if self._process is None:
            self._clear_up()
            return
        assert self._process.stdin is not None
        with suppress(OSError):
            self._process.stdin.close()  # it ends when it sees that
        try:
            self._process.wait(timeout)
        except subprocess.TimeoutExpired:
            self.kill()
            reaper = threading.Thread(target=self._process.wait, daemon=True)
            reaper.start()
            reaper.join(_KILL_DEADLINE if wait else 0.0)
        self._clear_up()

    def _clear_up(self) -> None:
        self.socket.close()
        self._working.close()
        self.remove_socket_file()


def _socket_folder() -> Path:
    """Make a folder for this user alone, whose path is short enough for a socket's path."""
    folder = tempfile.mkdtemp(prefix="tsfusion-")
    if len(os.fsencode(f"{folder}/{_SOCKET}")) > zmq.IPC_PATH_MAX_LEN:
        os.rmdir(folder)
        folder = tempfile.mkdtemp(prefix="tsfusion-", dir="/tmp")
    return Path(folder)
