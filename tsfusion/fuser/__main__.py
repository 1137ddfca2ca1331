# SPDX-License-Identifier: MIT
"""Run the fuser process, `python -m tsfusion.fuser`: a loop over chores and the gateway's messages."""

import logging
import select
import signal
import sys
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, cast

import zmq

from tsfusion.core import logs, process
from tsfusion.core.config import LogFormat, LogLevel
from tsfusion.core.errors import MapError, TsfusionError
from tsfusion.core.folder_lock import lock_folder
from tsfusion.fuser import fuser_messages, map_checkpoints
from tsfusion.fuser.fuser import LOCK, Fuser
from tsfusion.fuser.map_checkpoints import OpenedMap
from tsfusion.fuser.question_answers import Inbox
from tsfusion.wire.sockets import sockets

_LOCK_WAIT_S = 60.0  # for another fuser to end: it may be reading a large map
_held = ExitStack()  # the lock of the map's folder


def run(endpoint: str) -> int:
    """Serve the gateway at socket `endpoint` until it orders the end or ends; return the exit status."""
    context: zmq.Context[Any] = zmq.Context()
    link = sockets.pair(context)
    try:
        link.connect(endpoint)
        link.send(fuser_messages.encode(fuser_messages.Started()))
        return _serve(link)
    finally:
        link.close(linger=1000)
        context.term()
        if select.select([sys.stdin], [], [], 0)[0]:
            _remove_scratch_folder(endpoint)


def _remove_scratch_folder(endpoint: str) -> None:
    """Remove the socket's folder if the gateway was killed before `Started`; else the gateway did it."""
    socket_file = Path(endpoint.removeprefix("ipc://"))
    with suppress(OSError):
        socket_file.unlink(missing_ok=True)
        socket_file.parent.rmdir()


def _serve(link: sockets.AnySocket) -> int:
    """Answer questions, do chores and handle messages of the gateway, in this order (`Fuser.chores`)."""
    poller = zmq.Poller()
    poller.register(link, zmq.POLLIN)
    poller.register(sys.stdin.fileno(), zmq.POLLIN)
    fuser: Fuser | None = None
    inbox, ahead = Inbox(link), _Ahead(link)
    while fuser is None or fuser.exit_status is None:
        if fuser is not None:
            fuser.answer()
        idle = not inbox.orders and not poller.poll(fuser.idle_after_ms if fuser is not None else 0)
        wait = None if fuser is None else fuser.do_chore(idle=idle)
        if wait == 0:
            continue
        if not inbox.orders:
            process.on_parent_end(signal.SIGCONT)  # a stopped process would not notice the gateway's end
            events = dict(poller.poll(None if wait is None else round(1000 * wait) + 1))
            if sys.stdin.fileno() in events:  # nothing is ever written there: the gateway has ended
                return 1
            if fuser is not None:
                process.on_parent_end(signal.SIGKILL)
            inbox.read()
        if not inbox.orders:
            continue
        message = inbox.orders.popleft()
        if isinstance(message, fuser_messages.Warm | fuser_messages.ReadAhead):
            fuser = None  # its map was empty and does not need this process
            if not ahead.do(message):
                return 1
        elif isinstance(message, fuser_messages.Begin):
            logs.name_map(Path(message.folder).name)
            fuser = _open_map(link, message, inbox, ahead.opened)
            if fuser is None:
                return 1
        elif fuser is not None:
            process.on_parent_end(signal.SIGKILL)
            fuser.handle(message)
    return fuser.exit_status


class _Ahead:
    """Preparations of a process without a map: kernels that are compiled, a map that is read ahead."""

    def __init__(self, link: sockets.AnySocket) -> None:
        self._link = link
        self.opened: OpenedMap | None = None

    def do(self, message: fuser_messages.Warm | fuser_messages.ReadAhead) -> bool:
        """Do the ordered preparation, and report it. Return False if the map cannot be opened."""
        try:
            if isinstance(message, fuser_messages.Warm):
                map_checkpoints.warm(message.volume)
            else:
                _lock(message.begin)
                self.opened = OpenedMap(message.begin)
                for _ in self.opened.warming:
                    pass
        except (TsfusionError, OSError, MemoryError) as error:
            _say_failed(self._link, error)
            return False
        self._link.send(fuser_messages.encode(fuser_messages.Prepared()))
        return True


def _open_map(
    link: sockets.AnySocket,
    message: fuser_messages.Begin,
    inbox: Inbox | None = None,
    opened: OpenedMap | None = None,
) -> Fuser | None:
    """Open the map and report the result; return None if the map cannot be opened."""
    try:
        if opened is None:
            _lock(message)
        fuser = Fuser(link, message, inbox, opened)
    except (TsfusionError, OSError, MemoryError) as error:
        _say_failed(link, error)
        return None
    link.send(fuser_messages.encode(fuser.ready()))
    return fuser


def _lock(begin: fuser_messages.Begin) -> None:
    """Lock the map's folder until this process ends or gets another map."""
    process.end_first()
    _held.close()
    _held.push(lock_folder(
        Path(begin.folder), "map", "fuser", name=LOCK, wait=_LOCK_WAIT_S, error_type=MapError,
        make=False,  # a folder that is missing for now must not be replaced by a new one
    ))  # fmt: skip


def _say_failed(link: sockets.AnySocket, error: Exception) -> None:
    if isinstance(error, MemoryError):
        known: TsfusionError = MapError(f"no memory to open the map: {error}; raise fuser_memory_bytes")
    elif isinstance(error, TsfusionError):
        known = error
    else:
        known = MapError(f"the map cannot be opened: {error}")
    link.send(fuser_messages.encode(fuser_messages.Failed.of(known)))


def main() -> int:
    """Run the fuser process with the arguments that the gateway gives it: ENDPOINT FORMAT LEVEL MAP."""
    endpoint, format_, level, map_name = sys.argv[1:]
    logs.configure(cast("LogFormat", format_), cast("LogLevel", level), "fuser", map=map_name or None)
    logging.getLogger("tsfusion.tsdf.volume").disabled = True  # the gateway warns, and names the client
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # a terminal signals all processes; the gateway decides
    signal.signal(signal.SIGTTOU, signal.SIG_IGN)  # a line of the log does not stop it (`stty tostop`)
    process.keep_freed_memory()
    return run(endpoint)


if __name__ == "__main__":
    sys.exit(main())
