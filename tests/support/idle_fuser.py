# SPDX-License-Identifier: MIT
"""A server whose maps open at once: its fusers take every keyframe and fuse none."""

import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
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
        serve(sys.argv[1])


def serve(endpoint: str) -> None:
    """Answer the gateway until the end."""
    context: zmq.Context[Any] = zmq.Context()
    link = sockets.pair(context)
    link.connect(endpoint)
    link.send(fuser_messages.encode(fuser_messages.Started()))
    while True:
        message = fuser_messages.to_fuser.decode(link.recv())
        if isinstance(message, fuser_messages.Finish):
            break
        if (answer := answer_of(message)) is not None:
            link.send(fuser_messages.encode(answer))
    link.close()
    context.term()


def answer_of(message: fuser_messages.ToFuser) -> fuser_messages.ToGateway | None:
    """Return what such a fuser says to a message, or None."""
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
