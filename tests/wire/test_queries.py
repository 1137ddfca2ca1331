# SPDX-License-Identifier: MIT
"""Questions to a server that does not answer."""

import socket

import pytest

from tsfusion.core.errors import ServerUnreachable
from tsfusion.wire.messages import Command
from tsfusion.wire.queries import request


def test_a_dead_server_is_one_clear_error() -> None:
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{unused.getsockname()[1]}"
        with pytest.raises(ServerUnreachable, match=f"no server answered at {address} within 0.2 s"):
            request(address, Command(name="status"), timeout=0.2)
