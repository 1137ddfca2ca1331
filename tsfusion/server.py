# SPDX-License-Identifier: MIT
"""The server: a gateway that journals and acknowledges keyframes, and the fuser it keeps at work."""

import signal
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import FrameType
from typing import Any

import zmq

from tsfusion.config import ServerConfig, VolumeConfig
from tsfusion.fuser_link import FuserLink
from tsfusion.gateway import Gateway
from tsfusion.journal import Journal
from tsfusion.ports import Ports
from tsfusion.spool import lock_folder
from tsfusion.transport import Addresses, sockets

JOURNAL_FOLDER = "journal"
_SECOND_SIGNAL = 1.0  # seconds after the first


def run(
    server: ServerConfig, volume: VolumeConfig, on_ready: Callable[[Addresses], None] | None = None
) -> int:
    """Serve until SIGTERM or SIGINT, then drain the journal into the map and write a checkpoint.

    A second signal, a second or more after the first, skips the drain: the next start makes up for it.
    Call it from the main thread.

    Args:
        server: `listen` with port 0 draws a random one.
        on_ready: called once with the real addresses, when keyframes are accepted and kernels are warm.

    Returns:
        The exit status: 0, or 1 when the checkpoint was not written.

    Raises:
        TsfusionError: when it cannot start (port taken, state folder unwritable or in use, a map of other
            settings, an address that others can reach) or the fuser cannot be kept alive.
    """
    _check_addresses(server)
    with ExitStack() as stack:
        signals = stack.enter_context(_signals())
        gateway = _open(stack, server, volume)
        while not gateway.warm:
            gateway.step()
            if signals:
                return 0
        addresses = gateway.ports.bind(server)
        if on_ready is not None:
            on_ready(addresses)
        return _serve(gateway, signals)


def _open(stack: ExitStack, server: ServerConfig, volume: VolumeConfig) -> Gateway:
    state = Path(server.state)
    stack.enter_context(lock_folder(state, "state", "server"))
    journal = Journal(state / JOURNAL_FOLDER, server.segment_bytes)
    stack.callback(journal.close)
    context: zmq.Context[Any] = zmq.Context()
    stack.callback(context.term)
    ports = Ports(context, server)
    stack.callback(ports.close)
    fuser = FuserLink(context, server, volume)
    stack.callback(fuser.close)
    return Gateway(server, ports, journal, fuser)


def _serve(gateway: Gateway, signals: list[int]) -> int:
    while not signals:
        gateway.step()
    gateway.stop_accepting()
    while not gateway.drained and len(signals) == 1:
        gateway.step()
    if not gateway.drained:
        return 1
    gateway.fuser.finish()
    while not gateway.fuser.ended() and len(signals) == 1:
        gateway.step()
        gateway.fuser.finish()
    return 0 if gateway.fuser.finished_well else 1


@contextmanager
def _signals() -> Iterator[list[int]]:
    """The signals to stop that have come, as they come."""
    came: list[int] = []

    last = 0.0

    def note(number: int, _frame: FrameType | None) -> None:
        nonlocal last
        # `timeout` and some supervisors signal a process and then its group: one request, not two
        if not came or time.monotonic() - last > _SECOND_SIGNAL:
            came.append(number)
            last = time.monotonic()

    before = {number: signal.signal(number, note) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield came
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _check_addresses(server: ServerConfig) -> None:
    """Fail now, not after the kernels are compiled."""
    sockets.check_reachable(server.listen, has_keys=False)
    sockets.check_free(server.listen)
    if server.control is not None:
        sockets.check_reachable(server.control, has_keys=False)
        sockets.check_free(server.control)
    elif sockets.split(server.listen)[1]:
        sockets.check_free(sockets.control_address(server.listen))
