# SPDX-License-Identifier: MIT
"""A server of one's own: `tsfusion serve` as a child process, for as long as a block runs."""

import json
import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO

from tsfusion import config_toml
from tsfusion.config import ClientConfig, Config, ServerConfig, VolumeConfig, override
from tsfusion.errors import TransportError

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
    settings.write_text(config_toml.dumps(Config(server=server, volume=volume)), encoding="utf-8")
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
