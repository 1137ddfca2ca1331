# SPDX-License-Identifier: MIT
"""Open the map of a state folder that no server uses, as a server does, to forget keyframes."""

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, cast

import zmq

from tsfusion.core.config import ServerConfig, VolumeConfig
from tsfusion.core.errors import CheckpointError, JournalError, MapError
from tsfusion.core.folder_lock import lock_folder
from tsfusion.gateway.clients.client_routes import ClientRoutes
from tsfusion.gateway.health.metrics import Metrics
from tsfusion.gateway.maps.forgetting import ForgetRequest
from tsfusion.gateway.maps.hosted_map import HostedMap
from tsfusion.gateway.maps.map_condition import problem_of
from tsfusion.gateway.ports.ports import Ports
from tsfusion.journal import state_folder
from tsfusion.tsdf.files import checkpoint
from tsfusion.wire.messages.forget_messages import Forgotten, Selection

_TICK_MS = 100
_PATIENCE_S = 60.0  # for a journal that cannot be read or written, as on a disk that is away


class StoredMap:
    """A map that was opened by `open_map`."""

    def __init__(self, hosted: HostedMap) -> None:
        self._hosted = hosted
        self._is_changed = False

    def forget(self, selection: Selection, *, erase: bool = False, dry_run: bool = False) -> Forgotten:
        """Remove keyframes from the map, and with `erase` from its journal.

        Args:
            dry_run: only return which keyframes would be removed.

        Raises:
            JournalError: when the removal fails; the message says what was done.
        """
        answers: list[Forgotten | str] = []
        self._hosted.forgetting.add(ForgetRequest(selection, answers.append, erase=erase, dry_run=dry_run))
        self._is_changed |= not dry_run
        self._step_until(lambda: bool(answers))
        if isinstance(answers[0], str):
            raise JournalError(answers[0])
        return answers[0]

    def save(self) -> None:
        """If anything was forgotten, wait until the map is settled and write its checkpoint.

        Raises:
            MapError: when the checkpoint cannot be written. The next server then removes the keyframes.
        """
        if not self._is_changed:
            return
        self._step_until(lambda: self._hosted.drained)
        self._hosted.fuser.finish()
        while not self._hosted.fuser.ended():
            self._hosted.fuser.finish()
            self._step()
        if not self._hosted.fuser.finished_well:
            raise MapError("the map cannot be saved; the next server leaves out what was forgotten, too")

    def open(self) -> None:
        """Wait until the map is open. Raise TsfusionError if it cannot be opened."""
        self._step_until(lambda: self._hosted.warm)

    def _step_until(self, reached: Callable[[], bool]) -> None:
        """Let the map work until `reached` is true. Raise MapError if it has a problem for a minute."""
        well = time.monotonic()
        while not reached():
            self._step()
            problem = problem_of(self._hosted)
            well = well if problem else time.monotonic()
            if problem and time.monotonic() - well > _PATIENCE_S:
                raise MapError(problem)

    def _step(self) -> None:
        zmq.zmq_poll([(self._hosted.fuser.socket, zmq.POLLIN)], _TICK_MS)
        self._hosted.step(lambda _message, _frames: None)


@contextmanager
def open_map(path: Path, name: str | None = None) -> Iterator[StoredMap]:
    """Open the map of a state folder that no server uses. It is saved when the block ends.

    Args:
        path: a state folder, or the folder of a map in it.
        name: name of the map, where the state folder has several.

    Raises:
        JournalError: when the map does not exist, or a server uses it.
        CheckpointError: when no server has saved it yet: its settings are not known.
    """
    folder = state_folder.resolve_map(path, name).absolute()
    state = folder.parent.parent
    if not path.is_dir() or not state_folder.is_state_folder(state) or folder.parent.parent != state:
        raise JournalError(f"{path} is no state folder of a server, nor the folder of a map in one")
    with ExitStack() as stack:
        try:
            stack.enter_context(lock_folder(state, "state", "server", make=False))
        except JournalError as error:
            raise JournalError(
                f"{error}, or give the address of that server, such as tcp://127.0.0.1:5555"
            ) from error
        context: zmq.Context[Any] = zmq.Context()
        stack.callback(context.destroy, 0)
        server = ServerConfig(state=str(state), log_level="warning")
        metrics = Metrics(server)
        stack.callback(metrics.close)
        nobody = ClientRoutes(cast("Ports", None))  # it has no client to send to
        hosted = HostedMap(context, folder.name, server, _settings(folder), routes=nobody, metrics=metrics)
        stack.callback(hosted.close)
        opened = StoredMap(hosted)
        opened.open()
        yield opened
        opened.save()


def _settings(folder: Path) -> VolumeConfig:
    """Return the settings of a saved map."""
    try:
        with checkpoint.reading(folder / state_folder.MAP_FILE) as (header, _):
            return header.config
    except CheckpointError as error:
        if not error.missing:
            raise
        raise CheckpointError(
            f"{folder} has no saved map, so its settings are not known: start its server and give the address"
        ) from error
