# SPDX-License-Identifier: MIT
"""A server of one's own: `tsfusion serve` as a child process, for as long as a block runs."""

import json
import logging
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from tsfusion.client import Client
from tsfusion.core import config
from tsfusion.core.config import ClientConfig, Config, ServerConfig, VolumeConfig, override
from tsfusion.core.errors import TransportError, TsfusionError
from tsfusion.scanner.sources.source import Source
from tsfusion.wire.curve import client_keys
from tsfusion.wire.queries import fetch_status

START_DEADLINE = 180.0  # seconds; a cold kernel compilation on a slow machine
STOP_DEADLINE = 60.0  # seconds; draining and the checkpoint


class ServerChild:
    """A running `tsfusion serve`, ready for keyframes.

    Attributes:
        listen: its data address.
        control: its control address.
        start_seconds: from start to ready.
    """

    def __init__(self, process: subprocess.Popen[str], log: Path) -> None:
        self._process = process
        self._log = log
        self.listen = ""
        self.control = ""
        self.start_seconds = 0.0

    def wait_ready(self, deadline: float = START_DEADLINE) -> None:
        """Read the ready line; raises TransportError when the server ends or stays silent instead."""
        started = time.monotonic()
        line = _read_line(self._process, deadline)
        if not line:
            self.check()
            raise TransportError(f"the server was not ready after {deadline:.0f} s")
        ready = json.loads(line)
        self.listen, self.control = ready["listen"], ready["control"]
        self.start_seconds = time.monotonic() - started

    def check(self) -> None:
        """Raise TransportError, with the server's last words, unless it is running."""
        if self._process.poll() is not None:
            raise TransportError(self._last_words())

    def stop(self) -> None:
        """SIGTERM, and after a deadline SIGKILL to it and its fuser."""
        self._process.terminate()
        try:
            self._process.wait(STOP_DEADLINE)
        except subprocess.TimeoutExpired:
            self.kill()
        self._close()

    def kill(self) -> None:
        """End the server and its fuser at once; what they wrote is thrown away."""
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        self._close()

    def _close(self) -> None:
        for pipe in (self._process.stdin, self._process.stdout):
            if pipe is not None:
                pipe.close()

    def _last_words(self) -> str:
        lines = self._log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        said = lines[-1].removeprefix("tsfusion: ") if lines else "nothing"
        return f"the server ended with status {self._process.returncode}: {said}"


@contextmanager
def serving(server: ServerConfig, volume: VolumeConfig, scratch: Path) -> Iterator[ServerChild]:
    """Run a server; it drains and checkpoints when the block ends well, and is killed when it does not.

    Args:
        scratch: an existing folder for its configuration and log.

    Raises:
        TransportError: when it does not get ready.
    """
    settings = scratch / "server.toml"
    settings.write_text(config.to_toml(Config(server=server, volume=volume)), encoding="utf-8")
    log = scratch / "server.log"
    with log.open("w", encoding="utf-8") as stderr:
        child = ServerChild(_start(settings, stderr), log)
    try:
        child.wait_ready()
        yield child
        child.stop()
    except BaseException:
        child.kill()
        raise


def _start(settings: Path, stderr: IO[str]) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "tsfusion", "serve", "--config", str(settings), "--json", "--until-eof"]
    # Flags from the environment would override the configuration that was asked for.
    environment = {key: value for key, value in os.environ.items() if not key.startswith("TSFUSION_")}
    return subprocess.Popen(
        command,
        stdin=subprocess.PIPE,  # closes when we die, however we die: the server then stops by itself
        stdout=subprocess.PIPE,
        stderr=stderr,
        text=True,
        env=environment,
        start_new_session=True,  # Ctrl-C is ours to handle
    )


def _read_line(process: subprocess.Popen[str], seconds: float) -> str:
    """The first line of stdout; empty when the process ends or the time is over."""
    assert process.stdout is not None
    readable, _, _ = select.select([process.stdout], [], [], seconds)
    line = process.stdout.readline() if readable else ""
    if readable and not line:
        process.wait(STOP_DEADLINE)
    return line


@contextmanager
def own_server(
    client: ClientConfig, server: ServerConfig | None, volume: VolumeConfig, scratch: Path
) -> Iterator[tuple[ClientConfig, ServerChild | None]]:
    """Where to send, and the server that runs there for as long as the block."""
    server = server or ServerConfig(listen="tcp://127.0.0.1:0", state=str(scratch / "state"))
    with serving(server, volume, scratch) as child:
        yield override(client, address=child.listen, control=child.control), child


AHEAD = 3  # keyframes of a recording under way: fusing, waiting, travelling
MAPS = 16  # of an own server: its default one, and a submap each

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Destination:
    """The link's settings, the own server (None: it is elsewhere), and the folder of spools."""

    link: ClientConfig
    child: ServerChild | None
    spools: Path


def elsewhere(client: ClientConfig | None, connect: str, spool: Path) -> Destination:
    """A running server at a data address."""
    return Destination(override(client or ClientConfig(), address=connect), None, spool)


def of_its_own(
    stack: ExitStack,
    client: ClientConfig | None,
    server: ServerConfig | None,
    volume: VolumeConfig,
    scratch: Path,
) -> Destination:
    """A server that runs until the stack is closed, and keeps its files in `scratch`.

    Raises:
        TransportError: when it does not start.
    """
    scratch.mkdir()
    own = server or ServerConfig(listen="tcp://127.0.0.1:0", state=str(scratch / "state"))
    own = override(own, max_maps=max(own.max_maps, MAPS))
    link, child = stack.enter_context(own_server(client or ClientConfig(), own, volume, scratch))
    return Destination(link, child, scratch / "spool")


def _pace(source: Source, place: Destination) -> dict[str, Any]:
    """What waits leaves nothing out: a recording waits for a server of its own, and for no other."""
    if source.live:
        return {}
    return {"policy": "block", "backlog": AHEAD} if place.child else {"policy": "spool_all"}


def opener(stack: ExitStack, place: Destination, source: Source) -> tuple[set[str], Callable[[str], Client]]:
    """The maps that an earlier scan's keyframes wait for, and what opens a client and closes it in the end.

    Those keyframes are sent, too, but this scan begins no submap of their names.
    """

    pace = _pace(source, place)

    def connect(name: str) -> Client:
        link = override(place.link, map=name, **pace)
        client = Client(link.address, spool=place.spools / name, control=link.control, config=link)
        stack.callback(client.close)
        return client

    waiting = {path.parent.name for path in place.spools.glob("*/*.mcap")} - {place.link.map}
    for name in sorted(waiting):
        try:
            left = connect(name).stats.waiting
            if left:
                log.warning("an earlier scan left %d keyframes for the map %s: they go, too", left, name)
        except TsfusionError as error:
            log.warning("what waits in %s is not sent: %s", place.spools / name, error)
    return waiting, connect


def warn_of_another_world(place: Destination) -> None:
    """Say so when the map has keyframes already, or will have: this scan's world is not theirs."""
    link = place.link
    begins = "a scan that localises itself begins its own world; give it a map of its own (--map NAME)"
    if any((place.spools / link.map).glob("*.mcap")):
        log.warning("keyframes of an earlier scan wait for the map %s: %s", link.map, begins)
        return
    with suppress(TransportError):  # a server that is not there yet, or has no such map
        keys = client_keys(link.key, link.server_key)
        status = fetch_status(link.address, control=link.control, map_name=link.map, timeout=2.0, keys=keys)
        if status.keyframes_durable:
            log.warning("the map %s has %d keyframes already: %s", link.map, status.keyframes_durable, begins)
