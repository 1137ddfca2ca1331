# SPDX-License-Identifier: MIT
"""Fuser processes that wait for a map: started, with their kernels compiled, so that it opens at once."""

import logging
from contextlib import suppress
from typing import Any

import zmq

from tsfusion.core.config import ServerConfig, VolumeConfig
from tsfusion.core.counts import count_of
from tsfusion.fuser import messages as fuser_messages
from tsfusion.gateway.fuser_process import FuserProcess

log = logging.getLogger(__name__)


class _Spare:
    """A process, and the settings that it is for."""

    def __init__(self, process: FuserProcess, volume: VolumeConfig) -> None:
        self.process, self.volume = process, volume
        self.is_warm = False

    def receive(self) -> None:
        """Take its messages."""
        with suppress(zmq.Again):
            while True:
                message = fuser_messages.to_gateway.decode(self.process.socket.recv(zmq.NOBLOCK))
                if isinstance(message, fuser_messages.Started):
                    self.process.note_start()
                    self.process.socket.send(fuser_messages.encode(fuser_messages.Warm(self.volume)))
                self.is_warm |= isinstance(message, fuser_messages.Prepared)


class SpareFusers:
    """Up to `spare_fusers` processes for maps with the same settings. Call `step` again and again."""

    def __init__(self, context: "zmq.Context[Any]", server: ServerConfig) -> None:
        self._context, self._server = context, server
        self._spares: list[_Spare] = []
        self._was_full = False

    def take(self, name: str, volume: VolumeConfig) -> FuserProcess:
        """A process for a map: a spare one, or another that begins now.

        Raises:
            OSError, zmq.ZMQError: when the system cannot start it.
        """
        for one in self._spares:
            if one.is_warm and one.volume == volume and one.process.status is None:
                self._spares.remove(one)
                return one.process
        return self._start(name)

    def step(self, volume: VolumeConfig, *, may_start: bool) -> None:
        """Have as many as there are to be, for these settings; one begins after the other.

        Args:
            may_start: nobody waits for the processor time that it takes.
        """
        for one in self._spares:
            one.receive()
        for one in [one for one in self._spares if one.process.status is not None or one.volume != volume]:
            self._spares.remove(one)
            one.process.close(wait=False)
        count, are_warm = len(self._spares), all(one.is_warm for one in self._spares)
        if are_warm and may_start and count < self._server.spare_fusers:
            try:
                self._spares.append(_Spare(self._start(""), volume))
            except (OSError, zmq.ZMQError) as error:
                log.warning("a spare fuser cannot be started: %s", error)
        is_full = bool(count) and are_warm and count >= self._server.spare_fusers
        if is_full and not self._was_full:
            log.info("%s ready", count_of(count, "spare fuser is", "spare fusers are"))
        self._was_full = is_full

    def _start(self, name: str) -> FuserProcess:
        return FuserProcess(self._context, name, self._server.log_format, self._server.log_level)

    def close(self) -> None:
        """End them."""
        for one in self._spares:
            one.process.close()
        self._spares.clear()
