# SPDX-License-Identifier: MIT
"""Feed a page with a saved map: a file, a run's folder, or a state folder at any time of its journal."""

import os
import socket
import subprocess
import sys
import threading
from collections import deque
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.core import process
from tsfusion.core.errors import MapError, TsfusionError
from tsfusion.journal import state_folder
from tsfusion.viewer.map_feed import TimeLine
from tsfusion.wire.asking.map_events import LinkSeen, MapEvent

_ANSWER_S = 5.0  # longest wait of `weights`: a large map may still be loading
_END_S = 3.0
_COMMAND = (sys.executable, "-m", "tsfusion.pipelines.shown.view_process")
_GONE = "the process that reads the map has ended: was there memory enough? Start the page again"


@dataclass(frozen=True)
class Open:
    """Show a map. `number`: repeated in all messages about it. `name`: the map in a state folder."""

    number: int
    path: Path
    name: str | None


@dataclass(frozen=True)
class Seek:
    """Show the map after this many keyframes."""

    keyframes: int


@dataclass(frozen=True, eq=False)
class Weigh:
    """Ask for the weights at (n, 3) points."""

    number: int
    points: NDArray[np.float32]


@dataclass(frozen=True)
class Took:
    """This many bytes of triangles were taken by the page."""

    nbytes: int


@dataclass(frozen=True)
class Opened:
    """A map with this name is shown."""

    number: int
    name: str
    time_line: TimeLine | None


@dataclass(frozen=True)
class ViewFailed:
    """A map cannot be shown."""

    number: int
    error: TsfusionError


@dataclass(frozen=True, eq=False)
class Told:
    """Events of a map, and the bytes of their triangles."""

    number: int
    events: list[MapEvent]
    nbytes: int


@dataclass(frozen=True, eq=False)
class Weighed:
    """The answer to `Weigh`."""

    number: int
    weights: NDArray[np.float32] | None


def open_feed(path: Path, *, map_name: str | None = None) -> "SavedMapFeed":
    """Return the feed of a saved map.

    Args:
        path: `MAP.tsf`, the folder of a run, a state folder, or the folder of one of its maps.
        map_name: name of the map, where the state folder has several. None = `default`, or the first map if
            `default` was not saved.

    Raises:
        CheckpointError, JournalError: when there is no such map, or it cannot be read.
    """
    return SavedMapFeed(Path(path), map_name)


class SavedMapFeed:
    """A `MapFeed` of a saved map, read by another process. Any thread may call it, except `events`."""

    def __init__(self, path: Path, map_name: str | None) -> None:
        self._path = path
        self._changed = threading.Condition()
        self._messages: deque[Opened | Told | ViewFailed] = deque()
        self._awaited = set[int]()  # numbers of questions
        self._weights: dict[int, NDArray[np.float32] | None] = {}
        self._asked = self._number = 0
        self._has_ended = False
        self._sending = threading.Lock()
        self._socket, self._process = _start()
        self._link: Connection[object, Any] = Connection(os.dup(self._socket.fileno()))
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        self.title = ""
        self.time_line: TimeLine | None = None
        try:
            self._send(Open(0, path, map_name))
            self._note_first()
        except BaseException:
            self.close()
            raise

    def _note_first(self) -> None:
        with self._changed:
            self._changed.wait_for(lambda: self._messages)
            message = self._messages.popleft()
        if isinstance(message, ViewFailed):
            raise message.error
        assert isinstance(message, Opened)
        self._note(message)

    def _note(self, message: Opened) -> None:
        self.title = self._path.absolute().name
        if state_folder.is_state_folder(self._path):
            self.title += f", map {message.name}"
        self.time_line = message.time_line

    def maps(self) -> list[str]:
        """See `MapFeed`."""
        if state_folder.is_state_folder(self._path):
            return state_folder.map_names(self._path)
        return [self._path.absolute().stem]

    def choose(self, map_name: str) -> None:
        """See `MapFeed`. Raise JournalError if the state folder has no such map."""
        if state_folder.is_state_folder(self._path):
            state_folder.resolve_map(self._path, map_name)
            with self._changed:
                self._number += 1
                number = self._number
            self._send(Open(number, self._path, map_name))

    def seek(self, keyframes: int) -> None:
        """See `MapFeed`."""
        self._send(Seek(keyframes))

    def events(self, timeout: float) -> list[MapEvent]:
        """See `MapFeed`."""
        with self._changed:
            self._changed.wait_for(lambda: self._messages, max(timeout, 0.0))
            messages, self._messages = self._messages, deque()
            number = self._number
        found: list[MapEvent] = []
        for message in messages:
            if isinstance(message, Told):
                self._send(Took(message.nbytes))
            if message.number != number:
                continue  # of a map that was shown before
            if isinstance(message, Told):
                found += message.events
            elif isinstance(message, Opened):
                self._note(message)
            else:
                found.append(LinkSeen(str(message.error)))
        return found

    def weights(self, points: NDArray[np.float32]) -> NDArray[np.float32] | None:
        """See `MapFeed`. Wait at most some seconds."""
        with self._changed:
            self._asked += 1
            number = self._asked
            self._awaited.add(number)
        self._send(Weigh(number, np.ascontiguousarray(points, np.float32)))
        with self._changed:
            self._changed.wait_for(lambda: number in self._weights or self._has_ended, _ANSWER_S)
            self._awaited.discard(number)
            return self._weights.pop(number, None)

    def close(self) -> None:
        """See `MapFeed`."""
        with suppress(OSError):  # it may have ended
            self._socket.shutdown(socket.SHUT_RDWR)
        try:
            self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._reader.join()
        self._link.close()
        self._socket.close()

    def _send(self, message: object) -> None:
        with self._sending, suppress(OSError):  # if the process has ended, an event says so once
            self._link.send(message)

    def _read(self) -> None:
        """Take the messages of the process, in a thread. So the process never waits for the page."""
        try:
            while True:
                message = self._link.recv()
                with self._changed:
                    if not isinstance(message, Weighed):
                        self._messages.append(message)
                    elif message.number in self._awaited:
                        self._weights[message.number] = message.weights
                    self._changed.notify_all()
        except (EOFError, OSError):
            with self._changed:
                self._has_ended = True
                self._messages.append(ViewFailed(self._number, MapError(_GONE)))
                self._changed.notify_all()


def _start() -> tuple[socket.socket, "subprocess.Popen[bytes]"]:
    """Return this end of the connection, and the process."""
    ours, theirs = socket.socketpair()
    with theirs:
        try:
            started = subprocess.Popen(
                [*_COMMAND, str(theirs.fileno())],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                pass_fds=[theirs.fileno()],
                **process.OWN_GROUP,
            )
        except BaseException:
            ours.close()
            raise
    return ours, started
