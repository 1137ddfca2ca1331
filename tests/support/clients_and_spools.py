# SPDX-License-Identifier: MIT
"""Clients without a server, and spools they fill."""

from keyframes_and_servers import wall
from scripted_server import ScriptedServer

from tsfusion import Client
from tsfusion.core.config import ClientConfig

NOBODY = "tcp://127.0.0.1:1"
QUICK = ClientConfig(stall_timeout=0.5)


def joined(server: ScriptedServer, **settings: object) -> Client:
    return Client(server.address, control=server.control, **{"config": QUICK, **settings})  # type: ignore[arg-type]


def send_all(client: Client, numbers: range) -> list[int]:
    """Which of them were taken."""
    return [i for i in numbers if client.send(wall(i)) is not None]
