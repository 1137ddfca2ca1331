# SPDX-License-Identifier: MIT
"""The gateway's end of the fuser: start it, feed it journal positions, notice when it dies or hangs."""

import logging
import shutil
import signal
import struct
import subprocess
import sys
import tempfile
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import zmq

from tsfusion import errors, logs, process
from tsfusion.config import ServerConfig, VolumeConfig
from tsfusion.errors import MapError, TsfusionError
from tsfusion.transport import sockets, work

log = logging.getLogger(__name__)

COMMAND = (sys.executable, "-m", "tsfusion.fuser")
_AHEAD = 4  # positions handed out before their answers: hides the gateway's disk waits
_MAX_STARTS = 3  # in a row, without getting ready, before the map counts as failed
_LONGEST_PAUSE = 60.0  # seconds between one start and the next
_END_DEADLINE = 5.0
# A keyframe is given up when the deaths put down to it weigh so much: two of its own making, or as many
# kills from outside as no chance can aim at one keyframe.
_ENOUGH, _OWN_DEATH, _KILLED = 6, 3, 1
_PATIENCE = 10  # times as long, when it is no keyframe that takes so long: a mesh, a checkpoint


class FuserLink:
    """One fuser process after another, all at work on the same map.

    Attributes:
        socket: poll it for `receive`.
        ready: the process has opened the map and compiled the kernels.
        in_flight: the keyframes it has not answered, oldest first.
        restarts: how often a new process had to take over.
        failed: why it cannot be kept alive; empty = it can. It is still tried again, ever more rarely.
    """

    def __init__(
        self, context: "zmq.Context[Any]", folder: Path, server: ServerConfig, volume: VolumeConfig
    ) -> None:
        self._context = context
        self._scratch = Path(tempfile.mkdtemp(prefix="tsfusion-"))  # a socket's path has to be short
        self._begin = work.Begin(
            str(folder),
            volume,
            server.mesh_interval,
            server.checkpoint_every,
            str(self._scratch / work.WORKING_FILE),
            server.journal_bytes is not None,
            server.fuser_memory_bytes or process.physical_memory_bytes() * 3 // 4,
        )
        self._map = folder.name
        self._logs = (server.log_format, server.log_level, self._map)
        self._timeout = server.fuser_timeout
        self._ended_early = 0  # processes in a row that got nothing done
        self._blame: dict[int, int] = {}
        self._finishing = self._finish_sent = False
        self.restarts = 0
        self.failed = ""
        self._was_ready = False
        self._start()

    def _start(self) -> None:
        self.ready = False
        self._restart_at = 0.0
        self._heard = time.monotonic()
        self._oom_kills = process.oom_kills()
        self.in_flight: deque[int] = deque()
        Path(self._begin.working).write_bytes(struct.pack("<q", work.NOT_WORKING))
        endpoint = f"ipc://{self._scratch}/{self.restarts}"
        self.socket = sockets.pair(self._context)
        self.socket.bind(endpoint)
        self._process = subprocess.Popen(
            [*COMMAND, endpoint, *self._logs],
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

    def fuse(self, order: work.Fuse) -> bool:
        """Hand out a keyframe; False when it has to be tried again."""
        if self._blame.get(order.index, 0) >= _ENOUGH:
            order = work.Fuse(order.index, order.position, order.session, order.seq, order.client, "crash")
        if not self.send(order):
            return False
        if not self.in_flight:
            self._heard = time.monotonic()
        self.in_flight.append(order.index)
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
        self._heard = time.monotonic()
        message = work.to_gateway.decode(head.buffer)
        if isinstance(message, work.Failed) and self._was_ready:
            log.error("the fuser cannot open the map: %s", message.message)
        elif isinstance(message, work.Failed):
            kind = getattr(errors, message.error, TsfusionError)
            raise kind(message.message)
        if isinstance(message, work.Started):
            self.send(self._begin)
        elif isinstance(message, work.Ready):
            self.ready = self._was_ready = True
        elif isinstance(message, work.Done):
            self.in_flight.popleft()
            if self._blame.get(message.index, 0) < _ENOUGH:  # a verdict stays: it may come again
                self._blame.pop(message.index, None)
            self._ended_early = 0
            self.failed = ""
        return message, frames

    def ended(self) -> bool:
        """Whether the process is gone; one that hangs is ended here."""
        if self._process.poll() is not None:
            return True
        busy = bool(self.in_flight) or self._finish_sent
        patience = self._timeout * (1 if self._working() != work.NOT_WORKING else _PATIENCE)
        if busy and self.ready and time.monotonic() - self._heard > patience:
            subject = logs.about(map=self._map)
            log.error("the fuser process has been silent for %.0f s: it is killed", patience, extra=subject)
            self._put_down(_OWN_DEATH)
            self._process.kill()
            self._process.wait()
            return True
        return False

    def restart(self) -> None:
        """Put a new process in the place of one that died: at once, or after a pause when that happens again
        and again. It begins at the last checkpoint. Call it until `ended` is no longer true.

        Raises:
            MapError: when the first of all died before it was ready.
        """
        if not self._restart_at:
            self._bury()
        if time.monotonic() >= self._restart_at:
            self._release()
            self.restarts += 1
            self._start()

    def _bury(self) -> None:
        status = self._process.returncode
        self.in_flight.clear()
        killed = status == -signal.SIGKILL and process.oom_kills() == self._oom_kills
        if not self.ready and self.restarts == 0 and not killed:
            raise MapError(f"the fuser process ended with status {status} before it was ready")
        self._put_down(_KILLED if killed else _OWN_DEATH)
        if self._ended_early >= _MAX_STARTS:
            self.failed = f"its fuser process ended {self._ended_early} times, last with status {status}"
        pause = min(2.0**self._ended_early - 1, _LONGEST_PAUSE)
        self._ended_early += 1
        self._restart_at = time.monotonic() + pause
        self.ready = False
        log.error(
            "the fuser process ended with status %s; another takes over from the checkpoint%s",
            status,
            f" in {pause:.0f} s" if pause else "",
            extra=logs.about(map=self._map),
        )

    def _put_down(self, weight: int) -> None:
        """A death to the keyframe it happened at, if it was at one."""
        index = self._working()
        if index != work.NOT_WORKING:
            self._blame[index] = self._blame.get(index, 0) + weight
            with suppress(OSError):
                Path(self._begin.working).write_bytes(struct.pack("<q", work.NOT_WORKING))

    def _working(self) -> int:
        try:
            (index,) = struct.unpack("<q", Path(self._begin.working).read_bytes())
        except (OSError, struct.error):
            return work.NOT_WORKING
        return int(index)

    def finish(self) -> None:
        """Ask for a checkpoint and the end of the process. Call it until `ended`: there may be no room."""
        if not self._finish_sent:
            self._finish_sent = self.send(work.Finish())
            self._heard = time.monotonic()
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
        shutil.rmtree(self._scratch, ignore_errors=True)

    def _release(self) -> None:
        assert self._process.stdin is not None
        self._process.stdin.close()
        self.socket.close()
