# SPDX-License-Identifier: MIT
"""The gateway's end of the fuser: start it, feed it journal positions, notice when it dies."""

import logging
import shutil
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import zmq

from tsfusion import errors
from tsfusion.config import ServerConfig, VolumeConfig
from tsfusion.errors import MapError, TsfusionError
from tsfusion.journal import Position
from tsfusion.transport import sockets, work

log = logging.getLogger(__name__)

COMMAND = (sys.executable, "-m", "tsfusion.fuser")
_AHEAD = 4  # positions handed out before their answers: hides the gateway's disk waits
_MAX_STARTS = 3  # in a row, without getting ready
_MAX_CRASHES = 2  # on one keyframe, before it is skipped
_END_DEADLINE = 5.0


class FuserLink:
    """One fuser process after another, all working through the same journal.

    Attributes:
        socket: poll it for `receive`.
        ready: the process has opened the map and compiled the kernels.
        next_index: the first keyframe not handed to it yet.
        in_flight: those it has not answered, oldest first.
        restarts: how often a new process had to take over.
    """

    def __init__(self, context: "zmq.Context[Any]", server: ServerConfig, volume: VolumeConfig) -> None:
        self._context = context
        self._begin = work.Begin(server.state, volume, server.mesh_interval, server.checkpoint_every)
        self._folder = Path(tempfile.mkdtemp(prefix="tsfusion-"))  # a socket's path has to be short
        self._failed_starts = 0
        self._crashes: dict[int, int] = {}
        self._finishing = self._finish_sent = False
        self.restarts = 0
        self._start()

    def _start(self) -> None:
        self.ready = False
        self.next_index = 0
        self.in_flight: deque[int] = deque()
        endpoint = f"ipc://{self._folder}/{self.restarts}"
        self.socket = sockets.pair(self._context)
        self.socket.bind(endpoint)
        self._process = subprocess.Popen(
            [*COMMAND, endpoint],
            stdin=subprocess.PIPE,  # closes when the gateway dies, however it dies
            stdout=subprocess.DEVNULL,
            start_new_session=True,  # a Ctrl-C is for the gateway
        )

    @property
    def pid(self) -> int:
        """The process that is running now."""
        return self._process.pid

    @property
    def idle(self) -> bool:
        """Ready, and every keyframe handed out is answered."""
        return self.ready and not self.in_flight

    @property
    def wants_work(self) -> bool:
        """Whether another position may be handed out."""
        return self.ready and not self._finishing and len(self.in_flight) < _AHEAD

    def send(self, message: work.ToFuser) -> bool:
        """Hand over a message; False when there is no room for it now. A dead fuser's are lost with it."""
        try:
            self.socket.send(work.encode(message), zmq.NOBLOCK)
        except zmq.Again:
            return False
        return True

    def fuse(self, position: Position) -> bool:
        """Hand out the keyframe `next_index`, which lies there; False when it has to be tried again."""
        index = self.next_index
        skip = "crash" if self._crashes.get(index, 0) >= _MAX_CRASHES else None
        if not self.send(work.Fuse(index, position, skip)):
            return False
        self.in_flight.append(index)
        self.next_index += 1
        return True

    def receive(self) -> tuple[work.ToGateway, Sequence[zmq.Frame]] | None:
        """The next message and its frames, or None.

        Raises:
            TsfusionError: when the fuser says it cannot open the map.
        """
        try:
            head, *frames = self.socket.recv_multipart(zmq.NOBLOCK, copy=False)
        except zmq.Again:
            return None
        message = work.to_gateway.decode(head.buffer)
        if isinstance(message, work.Failed):
            kind = getattr(errors, message.error, TsfusionError)
            raise kind(message.message)
        if isinstance(message, work.Started):
            self.send(self._begin)
        elif isinstance(message, work.Ready):
            self.ready = True
            self._failed_starts = 0
        elif isinstance(message, work.Done):
            self.in_flight.popleft()
        return message, frames

    def ended(self) -> bool:
        """Whether the process is gone."""
        return self._process.poll() is not None

    def restart(self) -> None:
        """Put a new process in the place of one that died. It begins at the last checkpoint.

        Raises:
            MapError: when one after another died before it was ready.
        """
        status = self._process.returncode
        if self.in_flight:
            suspect = self.in_flight[0]
            self._crashes[suspect] = self._crashes.get(suspect, 0) + 1
        if not self.ready:
            self._failed_starts += 1
            if self._failed_starts >= _MAX_STARTS or self.restarts == 0:
                raise MapError(f"the fuser process ended with status {status} before it was ready")
        log.error("the fuser process ended with status %s; another takes over from the checkpoint", status)
        self._release()
        self.restarts += 1
        self._start()

    def finish(self) -> None:
        """Ask for a checkpoint and the end of the process. Call it until `ended`: there may be no room."""
        if not self._finish_sent:
            self._finish_sent = self.send(work.Finish())
        self._finishing = True

    @property
    def finished_well(self) -> bool:
        """Whether the process has ended with its checkpoint on the disk."""
        return self._finishing and self._process.returncode == 0

    @property
    def finishing(self) -> bool:
        """Whether `finish` was called."""
        return self._finishing

    def close(self) -> None:
        """End the process, at once if need be. The journal makes up for what it had not saved."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        deadline = time.monotonic() + (_END_DEADLINE if self.ready else 0.0)
        try:
            self._process.wait(max(deadline - time.monotonic(), 0.0))
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._release()
        shutil.rmtree(self._folder, ignore_errors=True)

    def _release(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self.socket.close()
