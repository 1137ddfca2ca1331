# SPDX-License-Identifier: MIT
"""A server of one verb: a gateway in a child process, at a free port of this machine, with the verb's maps.

It takes no keyframes, and ends with the verb. It works in a state folder, or in a scratch folder with links
to the files of maps, which it removes. Other users of this machine cannot connect: its keys are drawn anew.
"""

import logging
import os
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from functools import partial
from pathlib import Path
from typing import ClassVar, TypeVar

import msgspec
from msgspec import Struct
from msgspec.structs import replace

from tsfusion import journal
from tsfusion.core import logs, process
from tsfusion.core.config import LogLevel, ServerConfig, VolumeConfig
from tsfusion.core.errors import CheckpointError, JournalError, MapError, TsfusionError, refusals_as
from tsfusion.core.folder_lock import lock_folder, owner_of
from tsfusion.core.readable_numbers import OnProgress
from tsfusion.fuser.fuser_messages import Failed
from tsfusion.gateway.loop import GatewayLoop
from tsfusion.gateway.maps.map_condition import problem_of
from tsfusion.journal import state_folder
from tsfusion.server import make_loop
from tsfusion.tsdf.files import checkpoint
from tsfusion.wire.asking.queries import CommandRefused, forget
from tsfusion.wire.keys import key_folder
from tsfusion.wire.messages.forget_messages import Forgotten, Selection
from tsfusion.wire.sockets.curve import SERVER, ClientKeys
from tsfusion.wire.sockets.sockets import Addresses

Fetched = TypeVar("Fetched")
_COMMAND = (sys.executable, "-m", "tsfusion.pipelines.maps.private_server")
_POLL_S = 0.1
_END_S = 10.0  # for the child's fusers to end
_PATIENCE_S = 60.0  # for a journal that cannot be read or written, as on a disk that is away
_SAVE = b"save\n"
_FOR_EVER = 1e6  # seconds
_COMPILES_S = 600.0  # kernels of a keyframe, on a slow machine that has none compiled
_DISK_BYTES = 1 << 50  # as many as there is room for


class PrivateMap(Struct, frozen=True):
    """A saved map: its name on the server, its file and settings, and its journal's folder, if it has one."""

    name: str
    file: str
    volume: VolumeConfig
    journal: str | None = None


class ServedMaps(Struct):
    """Maps of a private server; the first line to it.

    Attributes:
        state: state folder to work in; None = the files of the maps stay as they are.
        memory_bytes: of a map's blocks in memory, the others are in files; None = all are in memory.
        forgets: let the verb ask for keyframes to forget.
    """

    maps: list[PrivateMap]
    state: str | None = None
    memory_bytes: int | None = None
    forgets: bool = False


class _Settling(Struct, tag=True):
    """Line of the child: so many keyframes wait to be fused or moved."""

    waiting: int


class _SettledState(Struct, tag=True):
    """Line of the child: the maps are saved in this state folder, without keyframes rejected for a reason."""

    state: str
    is_complete: bool
    rejected: dict[str, int]


class _Listening(Struct, tag=True):
    """Line of the child: the maps are open, for whoever has these keys."""

    addresses: Addresses
    keys: ClientKeys
    scratch: str


class _PrivateConfig(ServerConfig, frozen=True):
    is_private: ClassVar[bool] = True


class PrivateServer:
    """A running private server of some maps.

    Attributes:
        addresses: where it listens.
        keys: keys with which it lets the verb in, and nobody else.
        is_changed: True if keyframes were forgotten.

    Raises:
        TsfusionError: when the server cannot open a map.
    """

    def __init__(self, wanted: ServedMaps) -> None:
        self.is_changed, self._scratch = False, ""
        self._map = wanted.maps[0].name
        with refusals_as(MapError, "no server can be started for the map"):
            self._process = subprocess.Popen(
                _COMMAND,
                stdin=subprocess.PIPE,  # closes when this process dies in any way; that ends the server
                stdout=subprocess.PIPE,
                **process.OWN_GROUP,  # a Ctrl-C is for the verb
            )
        try:
            self._tell(msgspec.json.encode(wanted) + b"\n")
            opened = self._answer()
            assert isinstance(opened, _Listening)
            self.addresses, self.keys, self._scratch = opened.addresses, opened.keys, opened.scratch
        except BaseException:
            self.close()
            raise

    @property
    def has_ended(self) -> bool:
        return self._process.poll() is not None

    def _tell(self, line: bytes) -> None:
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):  # `_answer` finds out why
            self._process.stdin.write(line)
            self._process.stdin.flush()

    def _answer(self) -> _Listening | _Settling | _SettledState:
        """Return the child's next line. Raise its error, or MapError if it has ended without one."""
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            status = self._process.wait()
            raise MapError(f"the map's server has ended with status {status}: was there memory enough?")
        answer = msgspec.json.decode(line, type=_Listening | _Settling | _SettledState | Failed)
        if isinstance(answer, Failed):
            raise answer.error()
        return answer

    def forget(self, selection: Selection, *, erase: bool = False, dry_run: bool = False) -> Forgotten:
        """Remove keyframes from the first map, and with `erase` from its journal.

        Args:
            dry_run: only return which keyframes would be removed.

        Raises:
            JournalError: when the removal fails; the message says what was done.
        """
        self.is_changed |= not dry_run
        link = {"control": self.addresses.control, "keys": self.keys, "timeout": _FOR_EVER}
        ask = partial(forget, self.addresses.data, selection, map_name=self._map, **link)  # type: ignore[arg-type]
        try:
            return self._ask(partial(ask, erase=erase, dry_run=dry_run))
        except CommandRefused as error:
            raise JournalError(error.reason) from error

    def _ask(self, call: Callable[[], Fetched]) -> Fetched:
        """Return the result of a call that asks the server, or raise as soon as the server has ended."""
        found: list[Fetched | TsfusionError] = []

        def ask() -> None:
            try:
                found.append(call())
            except TsfusionError as error:
                found.append(error)

        asking = threading.Thread(target=ask, daemon=True)  # it would wait for another server to come
        asking.start()
        while asking.is_alive():
            asking.join(_POLL_S)
            if asking.is_alive() and self.has_ended:
                self._answer()
        if isinstance(found[0], TsfusionError):
            raise found[0]
        return found[0]

    def save(self, watch: OnProgress = lambda _done, _all: None) -> tuple[Path, Counter[str]]:
        """Settle the maps and write their checkpoints. After that, the server can only be closed.

        Args:
            watch: gets the number of keyframes whose fusing or move has begun, and of all.

        Returns:
            The state folder with the maps, valid until `close`, and a count of the keyframes that they do not
            have, by reason.

        Raises:
            MapError: when a checkpoint cannot be written.
        """
        self._tell(_SAVE)
        total = begun = 0
        while not isinstance(answer := self._answer(), _SettledState):
            assert isinstance(answer, _Settling)
            total = max(total, answer.waiting)
            if (now := min(total - answer.waiting + 1, total)) > begun:
                begun = now
                watch(begun, total)
        if not answer.is_complete:
            if self.is_changed:
                raise MapError("the map cannot be saved; the next server leaves out what was forgotten, too")
            raise MapError(f"the map cannot be brought up to date in {tempfile.gettempdir()}: is it full?")
        return Path(answer.state), Counter(answer.rejected)

    def close(self) -> None:
        """End the server at once."""
        with suppress(BrokenPipeError), self._process:  # closes its pipes
            assert self._process.stdin is not None
            self._process.stdin.close()
            try:
                self._process.wait(_END_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
        if self._process.returncode and self._scratch:  # a killed server could not remove it
            shutil.rmtree(self._scratch, ignore_errors=True)


@contextmanager
def open_state(path: Path, name: str | None = None, *, changes: bool = True) -> Iterator[PrivateServer]:
    """Yield a server of a map in a state folder that no other server uses. What it changes is saved.

    Args:
        path: a state folder, or the folder of a map in it.
        name: name of the map, where the state folder has several.
        changes: False = write nothing in the state folder.

    Raises:
        JournalError: when the map does not exist, or a server uses it.
        CheckpointError: when no server has saved it yet: its settings are not known.
    """
    folder = state_folder.resolve_map(path, name).absolute()
    state = folder.parent.parent
    if not path.is_dir() or not state_folder.is_state_folder(state) or folder.parent.parent != state:
        raise JournalError(f"{path} is no state folder of a server, nor the folder of a map in one")
    if (pid := owner_of(state)) is not None:
        raise JournalError(
            f"the state folder {state} is in use by another server (pid {pid}): end that first, or give the "
            "address of that server, such as tcp://127.0.0.1:5555"
        )
    wanted = ServedMaps([_map_of(folder)], str(state) if changes else None, forgets=True)
    with closing(PrivateServer(wanted)) as opened:
        yield opened
        if opened.is_changed:
            opened.save()


def _map_of(folder: Path) -> PrivateMap:
    """Return the saved map in a map's folder."""
    file, records = folder / state_folder.MAP_FILE, folder / state_folder.JOURNAL_FOLDER
    try:
        with checkpoint.reading(file) as (header, _):
            journaled = str(records) if records.is_dir() else None
            return PrivateMap(folder.name, str(file), header.config, journaled)
    except CheckpointError as error:
        if not error.missing:
            raise
        raise CheckpointError(
            f"{folder} has no saved map, so its settings are not known: start its server and give the address"
        ) from error


# --- the child ---


def _drawn_keys(folder: Path, *, forgets: bool) -> tuple[ClientKeys, str | None]:
    """Draw the server's keys in a folder. Return the verb's, and its public key if it forgets nothing."""
    keys = ClientKeys.drawn(key_folder.create_pair(folder, SERVER).public)
    if not forgets:
        return keys, keys.public
    key_folder.allow(folder, "verb", keys.public, forget=True)
    return keys, None


def _link(maps: list[PrivateMap], scratch: Path) -> None:
    """Make a state folder with links to the files of maps."""
    for one in maps:
        folder = state_folder.map_folder(scratch, one.name)
        links = folder / state_folder.JOURNAL_FOLDER
        links.mkdir(parents=True)
        (folder / state_folder.MAP_FILE).symlink_to(one.file)
        if one.journal is not None:
            recorded = Path(one.journal)
            for number in journal.segments(recorded):
                journal.segment_path(links, number).symlink_to(journal.segment_path(recorded, number))


def _serve(loop: GatewayLoop, wanted: ServedMaps, scratch: Path, state: Path, keys: ClientKeys) -> None:
    maps, is_open, well = loop.gateway.maps, False, time.monotonic()
    maps.open_at_start({one.name: one.volume for one in wanted.maps})
    while True:
        loop.step()
        if not is_open and maps.warm:
            is_open = True
            _say(_Listening(loop.ports.bind(), keys, str(scratch)))
        problem = next(filter(None, map(problem_of, maps)), "")
        well = well if problem else time.monotonic()
        if problem and time.monotonic() - well > _PATIENCE_S:
            raise MapError(problem)
        if select.select([sys.stdin], [], [], 0)[0]:
            if sys.stdin.buffer.readline() == _SAVE:
                _save(loop, state)
                sys.stdin.buffer.read()
            return


def _save(loop: GatewayLoop, state: Path) -> None:
    maps = loop.gateway.maps
    while not maps.ended:
        loop.step()
        _say(_Settling(sum(one.backlog.keyframes + one.corrections_waiting for one in maps)))
    is_drained = maps.drained
    while not maps.finish():
        loop.step()
    rejected = sum((one.outcomes.rejected for one in maps), Counter[str]())
    _say(_SettledState(str(state), is_drained and maps.finished_well, rejected))


def _say(answer: _Listening | _Settling | _SettledState | Failed) -> None:
    sys.stdout.buffer.write(msgspec.json.encode(answer) + b"\n")
    sys.stdout.buffer.flush()


def _settings(wanted: ServedMaps, scratch: Path, state: Path, level: LogLevel) -> ServerConfig:
    server = _PrivateConfig(
        listen="tcp://127.0.0.1:0", state=str(state), keys=str(scratch / "keys"), log_level=level,
        checkpoint_every=0, min_free_bytes=0, quota_map=1.0, fuser_timeout=_COMPILES_S,
    )  # fmt: skip
    if wanted.memory_bytes is None:
        return server
    folder = os.environ.get("TMPDIR") or "/var/tmp"  # as of a `Volume`
    memory_bytes = max(wanted.memory_bytes, 1 << 28)
    return replace(server, fuser_memory_bytes=memory_bytes, fuser_disk_bytes=_DISK_BYTES, cache=folder)


def main() -> int:
    """Serve the maps that the first line of the standard input names, until the input ends."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)  # the verb decides when this process ends
    wanted = msgspec.json.decode(sys.stdin.buffer.readline(), type=ServedMaps)
    level: LogLevel = "error" if wanted.state is None else "warning"
    logs.configure("text", level)
    if wanted.state is None:  # the verb tells of damage, and names the file itself
        logging.getLogger("tsfusion.journal").setLevel(logging.CRITICAL)
    try:
        with ExitStack() as stack:
            scratch = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="tsfusion-")))
            state = scratch / "state" if wanted.state is None else Path(wanted.state)
            if wanted.state is None:
                _link(wanted.maps, state)
            keys, guest = _drawn_keys(scratch / "keys", forgets=wanted.forgets)
            stack.enter_context(lock_folder(state, "state", "server", make=False))
            loop, _ = make_loop(stack, _settings(wanted, scratch, state, level), guest=guest)
            _serve(loop, wanted, scratch, state, keys)
    except BrokenPipeError:  # the verb has ended
        return 1
    except TsfusionError as error:
        _say(Failed.of(error))
        return 1
    except OSError as error:
        where = error.filename or tempfile.gettempdir()
        _say(Failed.of(MapError(f"the map's server cannot work in {where}: {error.strerror}")))
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
