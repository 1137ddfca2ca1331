# SPDX-License-Identifier: MIT
"""A server whose maps open at once: its fusers take every keyframe and fuse none."""

import itertools
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import zmq

from tsfusion.fuser import fuser_messages
from tsfusion.wire.sockets import sockets

if TYPE_CHECKING:
    from keyframes_and_servers import Server

COMMAND = (
    sys.executable, "-c",
    f"import sys; sys.path.insert(0, {str(Path(__file__).parent)!r}); import idle_fuser; idle_fuser.main()",
)  # fmt: skip


def main() -> None:
    """Be such a fuser's process."""
    import select
    import signal

    from tsfusion.core import process

    process.on_parent_end(signal.SIGKILL)
    if not select.select([sys.stdin], [], [], 0)[0]:  # else the gateway ended before that
        serve(sys.argv[1], threading.Event())


def serve(endpoint: str, over: threading.Event) -> None:
    """Answer the gateway until the end."""
    context: zmq.Context[Any] = zmq.Context()
    link = sockets.pair(context)
    link.connect(endpoint)
    link.send(fuser_messages.encode(fuser_messages.Started()))
    while not over.is_set():
        if not link.poll(20):
            continue
        message = fuser_messages.to_fuser.decode(link.recv())
        if isinstance(message, fuser_messages.Finish):
            break
        if (answer := _answer(message)) is not None:
            link.send(fuser_messages.encode(answer))
    link.close()
    context.term()


def _answer(message: fuser_messages.ToFuser) -> fuser_messages.ToGateway | None:
    match message:
        case fuser_messages.Begin():
            return fuser_messages.Ready({})
        case fuser_messages.Fuse():
            return fuser_messages.Done(message.index, 1, 2, message.skip)
        case fuser_messages.Save():
            return fuser_messages.Saved(False)
        case fuser_messages.FuserQuestion() if message.command.name == "status":
            return fuser_messages.FuserAnswer(message.number, error="it has no map")
        case fuser_messages.Warm() | fuser_messages.ReadAhead():
            return fuser_messages.Prepared()
    return None


class FuserThread:
    """As much of `subprocess.Popen` as the gateway uses: such a fuser in a thread, which is there at once."""

    _NUMBERS = itertools.count(1 << 23)  # process ids that no process has

    def __init__(self, command: list[str], **_: object) -> None:
        self.pid = next(self._NUMBERS)
        self.stdin = self
        self.command, self.endpoint, self.over = command, command[len(COMMAND)], threading.Event()
        self.returncode: int | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        self.returncode = self.work()

    def work(self) -> int:
        """Be the fuser; its exit status."""
        serve(self.endpoint, self.over)
        return 0

    def kill(self) -> None:
        self.over.set()

    def close(self) -> None:
        """Close its stdin, whereupon it ends."""
        self.kill()

    def poll(self) -> int | None:
        return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        self._thread.join(timeout)
        if self._thread.is_alive():
            raise subprocess.TimeoutExpired("a fuser", timeout or 0.0)
        return self.returncode or 0


def starting(thread: type[FuserThread]) -> SimpleNamespace:
    """As much of `subprocess` as the gateway uses to start its fusers, which are such threads."""
    names = {name: getattr(subprocess, name) for name in ("PIPE", "DEVNULL", "TimeoutExpired")}
    return SimpleNamespace(Popen=thread, **names)


@contextmanager
def keeping(state: Path, *, code: str = "", **settings: object) -> Iterator["Server"]:
    """Start a server that journals and fuses nothing, and end it afterwards whatever happens.

    Args:
        code: run before it, in its process.
    """
    from keyframes_and_servers import Server

    with closing(Server(state, code=code, fuser=COMMAND, **{"max_maps": 32, **settings})) as server:  # type: ignore[arg-type]
        if not server.address:
            raise RuntimeError(server.stderr_text())
        yield server
