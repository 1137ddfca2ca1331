# SPDX-License-Identifier: MIT
"""The gateway's end of the fuser: start it, feed it journal positions, notice when it dies or hangs."""

import logging
import signal
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec
import zmq

from tsfusion.core import errors, logs, process
from tsfusion.core.config import ServerConfig, VolumeConfig
from tsfusion.core.errors import MapError, TsfusionError
from tsfusion.fuser import messages as fuser_messages
from tsfusion.gateway.fuser_process import FuserProcess
from tsfusion.wire import sockets

log = logging.getLogger(__name__)

_AHEAD = 4  # positions handed out before their answers: hides the gateway's disk waits
_MAX_STARTS = 3  # in a row, without getting ready, before the map counts as failed
_LONGEST_PAUSE = 60.0  # seconds between one start and the next
_END_DEADLINE = 5.0
# A keyframe is given up when the deaths put down to it weigh so much: two of its own making, or as many
# kills from outside as no chance can aim at one keyframe.
_ENOUGH, _OWN_DEATH, _KILLED = 6, 3, 1
_WELL = 60.0  # seconds after which a process that goes on fusing is no reason to pause
_PATIENCE = 10  # times as long, when it is no keyframe that takes so long: a mesh, a checkpoint


class FuserSupervisor:
    """One fuser process after another, all at work on the same map.

    Attributes:
        ready: the process has opened the map and compiled the kernels.
        in_flight: the keyframes it has not answered, oldest first.
        restarts: how often a new process had to take over.
        failed: why it cannot be kept alive; empty = it can. It is still tried again, ever more rarely.
    """

    def __init__(
        self, context: "zmq.Context[Any]", folder: Path, server: ServerConfig, volume: VolumeConfig
    ) -> None:
        self._context = context
        self._map = folder.name
        self._server = server
        self._begin = fuser_messages.Begin(
            str(folder),
            volume,
            server.mesh_interval,
            server.checkpoint_every,
            "",  # each process has its own
            server.journal_bytes is not None,
            server.fuser_memory_bytes or process.physical_memory_bytes() * 3 // 4,
        )
        self._ended_early = 0  # processes in a row that died of nothing that a keyframe did
        self._blame: dict[int, int] = {}
        self._finishing = self._finish_sent = False
        self.restarts = 0
        self.failed = ""
        self._was_ready = False
        try:
            self._start()
        except (OSError, zmq.ZMQError) as error:
            raise MapError(f"the fuser process of map {self._map} cannot be started: {error}") from error

    def _start(self) -> None:
        self._process = FuserProcess(
            self._context, self._map, self._server.log_format, self._server.log_level
        )
        self.ready = False
        self._restart_at = 0.0
        self._heard = self._ready_since = time.monotonic()
        self._oom_kills = process.oom_kills()
        self.in_flight: deque[int] = deque()

    @property
    def socket(self) -> sockets.AnySocket:
        """Poll it for `receive`."""
        return self._process.socket

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

    def send(self, message: fuser_messages.ToFuser) -> bool:
        """Hand over a message; False when there is no room for it now. A dead fuser's are lost with it."""
        try:
            self.socket.send(fuser_messages.encode(message), zmq.NOBLOCK)
        except zmq.Again:
            return False
        return True

    def fuse(self, order: fuser_messages.Fuse) -> bool:
        """Hand out a keyframe; False when it has to be tried again."""
        if self._blame.get(order.index, 0) >= _ENOUGH:
            order = msgspec.structs.replace(order, skip="crash")
        if not self.send(order):
            return False
        if not self.in_flight:
            self._heard = time.monotonic()
        self.in_flight.append(order.index)
        return True

    def receive(self) -> tuple[fuser_messages.ToGateway, Sequence[zmq.Frame]] | None:
        """The next message and its frames, or None.

        Raises:
            TsfusionError: when the fuser says it cannot open the map.
        """
        if self._restart_at:  # its process is dead and buried: what that did comes again
            return None
        try:
            head, *frames = self.socket.recv_multipart(zmq.NOBLOCK, copy=False)
        except zmq.Again:
            return None
        self._heard = time.monotonic()
        message = fuser_messages.to_gateway.decode(head.buffer)
        if isinstance(message, fuser_messages.Failed) and self._was_ready:
            log.error("the fuser cannot open the map: %s", message.message)
        elif isinstance(message, fuser_messages.Failed):
            kind = getattr(errors, message.error, TsfusionError)
            raise kind(message.message)
        if isinstance(message, fuser_messages.Started):
            self.send(msgspec.structs.replace(self._begin, working=str(self._process.working_file)))
        elif isinstance(message, fuser_messages.Ready):
            self.ready = self._was_ready = True
            self._ready_since = self._heard
        elif isinstance(message, fuser_messages.Done):
            self.in_flight.popleft()
            if self._blame.get(message.index, 0) < _ENOUGH:  # a verdict stays: it may come again
                self._blame.pop(message.index, None)
            self.failed = ""
            if self._heard - self._ready_since > _WELL:
                self._ended_early = 0
        elif isinstance(message, fuser_messages.Saved) and message.written:
            self._ended_early = 0
        return message, frames

    def ended(self) -> bool:
        """Whether the process is gone; one that hangs is ended here."""
        if self._process.status is not None:
            return True
        busy = bool(self.in_flight) or self._finish_sent
        patience = self._server.fuser_timeout
        if self._process.at == fuser_messages.NOT_WORKING:
            patience *= _PATIENCE
        if busy and self.ready and time.monotonic() - self._heard > patience:
            subject = logs.about(map=self._map)
            log.error("the fuser process has been silent for %.0f s: it is killed", patience, extra=subject)
            self._put_down(_OWN_DEATH)
            self._process.kill()
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
        if time.monotonic() < self._restart_at:
            return
        dead = self._process
        try:
            self._start()
        except (OSError, zmq.ZMQError) as error:
            self.failed = f"its fuser process cannot be started: {error}"
            self._restart_at = time.monotonic() + 1.0
            return
        dead.close()
        self.restarts += 1

    def _bury(self) -> None:
        status = self._process.status
        killed = status == -signal.SIGKILL and process.oom_kills() == self._oom_kills
        if not self.ready and self.restarts == 0 and not killed:
            raise MapError(f"the fuser process ended with status {status} before it was ready")
        blamed = self._put_down(_KILLED if killed else _OWN_DEATH)
        pause = 0.0
        if not blamed and not killed:
            if self._ended_early >= _MAX_STARTS:
                self.failed = f"its fuser process ended {self._ended_early} times, last with status {status}"
            pause = min(2.0**self._ended_early - 1, _LONGEST_PAUSE)
            self._ended_early += 1
        self.in_flight.clear()
        self.ready = False
        self._restart_at = time.monotonic() + pause
        log.error(
            "the fuser process ended with status %s; another takes over from the checkpoint%s",
            status,
            f" in {pause:.0f} s" if pause else "",
            extra=logs.about(map=self._map),
        )

    def _put_down(self, weight: int) -> bool:
        """A death to the keyframe it happened at; whether it was at one."""
        index = self._process.at
        if index == fuser_messages.NOT_WORKING:
            return False
        self._blame[index] = self._blame.get(index, 0) + weight
        with suppress(OSError):
            self._process.at_nothing()
        return True

    def finish(self) -> None:
        """Ask for a checkpoint and the end of the process. Call it until `ended`: there may be no room."""
        if not self._finish_sent:
            self._finish_sent = self.send(fuser_messages.Finish())
            self._heard = time.monotonic()
        self._finishing = True

    @property
    def finished_well(self) -> bool:
        """Whether the process has ended with its checkpoint on the disk."""
        return self._finishing and self._process.status == 0

    @property
    def finishing(self) -> bool:
        """Whether `finish` was called."""
        return self._finishing

    def close(self) -> None:
        """End the process, at once if need be. The journal makes up for what it had not saved."""
        self._process.close(_END_DEADLINE if self.ready else 0.0)
