# SPDX-License-Identifier: MIT
"""Open the server that a run sends its keyframes to: start it for this run, or connect to it."""

import json
import logging
import os
import re
import select
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from tsfusion.client import Client
from tsfusion.core import config, process
from tsfusion.core.config import (
    DEFAULT_MAP,
    ClientConfig,
    Config,
    Policy,
    ServerConfig,
    VolumeConfig,
    override,
)
from tsfusion.core.durable_files import replacing
from tsfusion.core.errors import (
    CheckpointError,
    InvalidConfig,
    JournalError,
    TransportError,
    TsfusionError,
    refusals_as,
)
from tsfusion.core.folder_lock import owner_of
from tsfusion.delivery import left_spools
from tsfusion.gateway.maps import moved_maps
from tsfusion.geometry.mesh import Mesh
from tsfusion.journal import state_folder
from tsfusion.wire.asking.queries import fetch_health, fetch_mesh, fetch_new_map, fetch_status
from tsfusion.wire.messages.health import Health, Status
from tsfusion.wire.sockets.curve import ClientKeys, client_keys

START_DEADLINE = 180.0  # seconds; a cold kernel compilation on a slow machine
STOP_DEADLINE = 60.0  # seconds; draining and the checkpoint
_ROUTINE = re.compile("tsfusion: (DEBUG|INFO|WARNING): ")  # log lines of a server that are no error
_WARNING = re.compile("tsfusion(?: fuser)?: WARNING: (.*)")
_ERROR = re.compile("tsfusion(?: fuser)?: ERROR: (.*)|(Fatal Python error: .*)")
_ERRORS_TOLD = 3
_NAME_TIMEOUT = 1.0  # seconds for a server to name a free map: a sensor waits
NEW_MAP = "auto"  # as a map's name: the next free name
log = logging.getLogger(__name__)
THROWN_AWAY = ""  # as a state folder: a temporary one in the run's scratch folder
MAPS = 16  # open maps of a run's own server: the default one, and one for each submap


class ServerChild:
    """A child process `tsfusion serve` that is ready for keyframes."""

    def __init__(self, process: subprocess.Popen[str], log: Path) -> None:
        self._process = process
        self._log = log
        self.listen = ""
        self.control = ""
        self.start_seconds = 0.0  # from its start until it was ready

    @property
    def pid(self) -> int:
        """Process id of the server."""
        return self._process.pid

    def wait_ready(self) -> None:
        """Wait for the line that says the server is ready. Warnings that the server printed go into this log.

        Raises:
            TransportError: when the server ends or stays silent.
        """
        started = time.monotonic()
        stdout = self._process.stdout
        assert stdout is not None
        if not select.select([stdout], [], [], START_DEADLINE)[0]:
            raise TransportError(
                f"the server was not ready within {START_DEADLINE:.0f} s: is this machine very busy?"
            )
        line = stdout.readline()
        if not line:
            self._process.wait(STOP_DEADLINE)
            self.check()
        ready = json.loads(line)
        self.listen, self.control = ready["listen"], ready["control"]
        self.start_seconds = time.monotonic() - started
        for line in self._log.read_text(encoding="utf-8", errors="replace").splitlines():
            if found := _WARNING.match(line):
                log.warning("%s", found[1])  # a missing device, a damaged journal

    def check(self) -> None:
        """Raise TransportError, with the server's own error message, if the server has ended."""
        if self._process.poll() is not None:
            lines = self._log.read_text(encoding="utf-8", errors="replace").splitlines()
            errors = [line for line in lines if line.startswith("tsfusion: ") and not _ROUTINE.match(line)]
            if not errors and "Traceback (most recent call last):" in lines:
                errors = [f"tsfusion: {lines[-1]}"]
            reason = errors[-1].removeprefix("tsfusion") if errors else "; was it killed?"
            raise TransportError(f"the server ended with status {self._process.returncode}{reason}")

    def tell_errors(self) -> None:
        """Copy the last errors in the server's log into this process's log: they say why it failed."""
        found = map(_ERROR.match, self._log.read_text(encoding="utf-8", errors="replace").splitlines())
        for error in [one[1] or one[2] for one in found if one][-_ERRORS_TOLD:]:
            log.error("the server says: %s", error)

    def stop(self) -> None:
        """Let the server fuse what it has journaled and save its map. Kill it if that takes too long."""
        self._process.terminate()
        try:
            self._process.wait(STOP_DEADLINE)
        except subprocess.TimeoutExpired:
            self.kill()
        with self._process:  # closes its pipes
            pass

    @property
    def status(self) -> int | None:
        """Exit status of the server; None while it runs."""
        return self._process.returncode

    def kill(self) -> None:
        """Kill the server and its fuser, if they run; for a server whose state is thrown away."""
        with self._process, suppress(ProcessLookupError):  # closes its pipes and waits for it
            os.killpg(self._process.pid, signal.SIGKILL)


@contextmanager
def serving(server: ServerConfig, volume: VolumeConfig, scratch: Path) -> Iterator[ServerChild]:
    """Run a server during the block. At its end the server fuses all and saves; after an error it is killed.

    Args:
        scratch: an existing folder for its configuration and log.

    Raises:
        TransportError: when the server does not get ready.
    """
    settings = scratch / "server.toml"
    settings.write_text(config.to_toml(Config(server=server, volume=volume)), encoding="utf-8")
    log = scratch / "server.log"
    with log.open("w", encoding="utf-8") as stderr, refusals_as(TransportError, "no server can be started"):
        child = ServerChild(_start(settings, stderr), log)
    try:
        child.wait_ready()
        yield child
        child.stop()
    except BaseException as error:
        try:
            if isinstance(error, TransportError):
                child.check()  # a server that has ended says more than the link to it
        finally:
            child.kill()
            if isinstance(error, TsfusionError):
                child.tell_errors()
        raise


def _start(settings: Path, stderr: IO[str]) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "tsfusion", "serve", "--config", str(settings), "--json", "--until-eof"]
    return subprocess.Popen(
        command,
        stdin=subprocess.PIPE,  # closes when this process dies in any way; then the server stops by itself
        stdout=subprocess.PIPE,
        stderr=stderr,
        text=True,
        env=process.without_flags(),  # they would override the configuration that was asked for
        **process.OWN_GROUP,  # Ctrl-C is ours to handle
    )


@dataclass(frozen=True)
class Target:
    """The server that a run sends its keyframes to, in a child process or elsewhere."""

    link: ClientConfig  # addresses of the server, and the map to scan into
    keys: ClientKeys | None  # keys of the connection, if it has any
    spools: Path  # folder with a spool for each map
    child: ServerChild | None  # the server started for this run; None if it runs elsewhere
    _clients: ExitStack
    _kept: dict[str, Path]  # maps of the server started for this run, and the files that they become
    _unkept: list[str] = field(default_factory=list)  # why some maps were not kept

    @property
    def unkept(self) -> str:
        """Reason why maps could not be saved to files; empty if all were, or while the server runs."""
        return "; ".join(self._unkept)

    def client(
        self, map_name: str, *, policy: Policy | None = None, world: str = "", same_frame: bool = False
    ) -> Client:
        """Return a client for a map, with an empty spool. It is closed with the target.

        Args:
            policy: treatment of keyframes that come too fast for the server; None for that of the settings.
            world, same_frame: see `Client`.
        """
        while True:
            folder = left_spools.free_folder(self.spools, map_name)
            try:
                return self._open(folder, map_name, policy=policy, world=world, same_frame=same_frame)
            except JournalError:
                if owner_of(folder) is None:  # else another scan was quicker: the next folder
                    raise

    def client_of_left(self, left: left_spools.LeftSpool, world: str) -> Client:
        """Return a client that sends what an earlier scan left in a spool. It is closed with the target."""
        return self._open(left.folder, left.map, policy="spool_all", world=world)

    def _open(self, folder: Path, map_name: str, *, policy: Policy | None, **labels: Any) -> Client:
        link = override(self.link, map=map_name, policy=policy)
        client = Client(link.address, spool=folder, control=link.control, config=link, **labels)
        client.logs_refusal = False
        self._clients.callback(client.close)
        return client

    def keep_map(self, map_name: str, path: Path) -> None:
        """Copy a map to a file once this run's own server has stopped. Ignore maps of other servers."""
        if self.child is not None:
            self._kept[map_name] = path

    def free_map_name(self) -> str | None:
        """Return an unused map name like that of the map to scan into, or None if the server is slow."""
        link = self.link
        with suppress(TransportError):
            return fetch_new_map(
                link.address, link.map, control=link.control, timeout=_NAME_TIMEOUT, keys=self.keys
            )
        return None

    def check(self) -> None:
        """Raise TransportError if the server of this run has ended."""
        if self.child is not None:
            self.child.check()

    def has_map(self, map_name: str) -> bool:
        """True if a map is open on the server. A new map is made only for its first record."""
        address, control, keys = self.link.address, self.link.control, self.keys
        return map_name in fetch_health(address, control=control, keys=keys).maps

    def status(self, map_name: str, *, timeout: float = 10.0) -> Status:
        """Return the status of a map; see `fetch_status`."""
        address, control, keys = self.link.address, self.link.control, self.keys
        return fetch_status(address, control=control, map_name=map_name, timeout=timeout, keys=keys)

    def health(self, *, timeout: float = 10.0) -> Health:
        """Return the server's health; see `fetch_health`."""
        return fetch_health(self.link.address, control=self.link.control, timeout=timeout, keys=self.keys)

    def mesh(self, map_name: str, *, min_weight: float | None) -> Mesh:
        """Return the present mesh of a map; see `fetch_mesh`."""
        address, control, keys = self.link.address, self.link.control, self.keys
        return fetch_mesh(address, control=control, map_name=map_name, min_weight=min_weight, keys=keys)


def map_to_send_to(link: ClientConfig, name: str, like: str) -> str:
    """Return the map's name, or for `auto` the first of LIKE, LIKE-2, … that no map of the server has.

    Raises:
        TransportError: when the server does not answer.
    """
    if name != NEW_MAP:
        return name
    keys = client_keys(link.key, link.server_key)
    return fetch_new_map(link.address, like, control=link.control, keys=keys)


@contextmanager
def opened(
    connect: str | None,
    scratch: Path,
    *,
    volume: VolumeConfig,
    client: ClientConfig | None = None,
    server: ServerConfig | None = None,
    spools: Path | None = None,
) -> Iterator[Target]:
    """Open the target of a run. At the end of the block its clients close, and its own server stops.

    Args:
        connect: data address of a server that runs elsewhere; None starts one.
        client: settings of the connection. The map `auto` means a name that no map of the server has.
        scratch: a folder that does not exist yet, removed at the end of the block.
        volume: settings of the map, for a server started here.
        server: settings of the server started here; None for the defaults with a free port and `THROWN_AWAY`.
        spools: with `connect`, the folder of spools; None for a folder in `scratch`.

    Raises:
        TransportError: when the server does not start or answer.
        InvalidConfig: for unusable keys, or when the map has moved to another server.
    """
    link, child = client or ClientConfig(), None
    kept: dict[str, Path] = {}
    server = server or ServerConfig(listen="tcp://127.0.0.1:0", state=THROWN_AWAY, max_maps=MAPS)
    state = scratch / "state" if server.state == THROWN_AWAY else Path(server.state)
    if connect is None and state.is_dir() and (where := moved_maps.departed(state, link.map)) is not None:
        raise InvalidConfig(
            f"the map {link.map} of {state} has moved to {where.address}: give --connect {where.address} "
            "instead of --state, or choose another --map"
        )
    scratch.mkdir()
    with ExitStack() as stack:
        if connect is None:
            server = override(server, state=str(state))
            child = stack.enter_context(serving(server, volume, scratch))
            link, spools = override(link, address=child.listen, control=child.control), None
        else:
            link = override(link, address=connect)
        keys = client_keys(link.key, link.server_key)
        link = override(link, map=map_to_send_to(link, link.map, DEFAULT_MAP))
        target = Target(link, keys, spools or scratch / "spool", child, stack, kept)
        yield target
    if child is not None and child.status != 0 and kept:
        child.tell_errors()
    for name, path in kept.items():
        folder = state_folder.map_folder(state, name)
        if child is not None and child.status != 0 and not _is_saved(folder):  # it may have been another map
            left = "" if server.state == THROWN_AWAY else f"; its keyframes are in the journal in {folder}"
            target._unkept.append(f"the server could not save the map {name}: {path.name} is missing{left}")
            continue
        saved = folder / state_folder.MAP_FILE
        try:
            if server.state == THROWN_AWAY:
                shutil.move(saved, path)
            else:  # a file of its own: what a user does to it is nothing to the state
                with saved.open("rb") as old, replacing(path) as new:
                    shutil.copyfileobj(old, new)
        except OSError as error:
            path.unlink(missing_ok=True)
            target._unkept.append(f"the map could not be kept in {path.name}: {error.strerror}")
    shutil.rmtree(scratch)


def _is_saved(folder: Path) -> bool:
    """True if a map's last checkpoint has all records that its journal holds."""
    from tsfusion.pipelines.maps import saved_maps  # needs Taichi, which a scanner may lack

    try:
        found = saved_maps.summarise(saved_maps.find(folder))
    except (CheckpointError, JournalError):
        return False
    return not (found.keyframes_after or found.corrections_after or found.corrections_waiting)
