# SPDX-License-Identifier: MIT
"""A server whose maps open at once: its fusers take every keyframe and fuse none."""

import sys
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

from keyframes_and_servers import Server

_FUSER = """
import select, signal, sys, zmq
from tsfusion.core import process
from tsfusion.fuser import fuser_messages
from tsfusion.wire.sockets import sockets

process.on_parent_end(signal.SIGKILL)
if select.select([sys.stdin], [], [], 0)[0]:
    sys.exit()  # the gateway ended before that
link = sockets.pair(zmq.Context())
link.connect(sys.argv[1])
link.send(fuser_messages.encode(fuser_messages.Started()))
while True:
    message = fuser_messages.to_fuser.decode(link.recv())
    if isinstance(message, fuser_messages.Begin):
        link.send(fuser_messages.encode(fuser_messages.Ready({})))
    elif isinstance(message, fuser_messages.Fuse):
        link.send(fuser_messages.encode(fuser_messages.Done(message.index, 1, 2, message.skip)))
    elif isinstance(message, fuser_messages.Save):
        link.send(fuser_messages.encode(fuser_messages.Saved(False)))
    elif isinstance(message, fuser_messages.FuserQuestion) and message.command.name == "status":
        link.send(fuser_messages.encode(fuser_messages.FuserAnswer(message.number, error="it has no map")))
    elif isinstance(message, fuser_messages.Warm | fuser_messages.ReadAhead):
        link.send(fuser_messages.encode(fuser_messages.Prepared()))
    elif isinstance(message, fuser_messages.Finish):
        sys.exit(0)
"""
COMMAND = (sys.executable, "-c", _FUSER)
_CODE = f"""
from tsfusion.gateway.fusers import fuser_process
fuser_process.COMMAND = {COMMAND!r}
"""


@contextmanager
def keeping(state: Path, *, code: str = "", **settings: object) -> Iterator[Server]:
    """Start a server that journals and fuses nothing, and end it afterwards whatever happens.

    Args:
        code: run before it, in its process.
    """
    with closing(Server(state, code=code + _CODE, **{"max_maps": 32, **settings})) as server:  # type: ignore[arg-type]
        if not server.address:
            raise RuntimeError(server.stderr_text())
        yield server
