# SPDX-License-Identifier: MIT
"""Let connections into a web server: those that its guard accepts, and not too many at once."""

import asyncio
import logging
from collections import Counter
from http import HTTPStatus
from typing import TYPE_CHECKING, Any

from tsfusion.viewer.page.page_guard import PageGuard, Refusal, is_websocket

if TYPE_CHECKING:
    from websockets.asyncio.server import Server, ServerConnection
    from websockets.http11 import Request, Response

BROWSERS = 32  # at once
KNOCKING = 64  # connections at once that are not open yet; a new one closes the oldest
_MAX_MESSAGE = 16 << 20  # bytes: a browser sends a picture of its page
_OPEN_SECONDS = 10.0  # for a request and its answer
_CLOSE_SECONDS = 1.0
_FULL = f"{BROWSERS} browsers show this page already: close one"

log = logging.getLogger(__name__)


class PageDoor:
    """Door of a server that `websockets.asyncio.server.serve` runs. For the thread of its loop.

    Attributes:
        refused: number of refused requests, by reason: host, origin, token, full, message.
    """

    def __init__(self, guard: PageGuard) -> None:
        self._guard = guard
        self.refused: Counter[str] = Counter()
        self.is_closing = False

    def close(self, running: "Server") -> None:
        """End all connections at once, and take no more."""
        self.is_closing = True
        for connection in running.handlers:
            connection.transport.abort()

    def connection(self) -> "type[ServerConnection]":
        """Return a class of connections. Beyond `KNOCKING`, a new one closes the oldest that is not open."""
        from websockets.asyncio.server import ServerConnection

        door = self

        class Knocking(ServerConnection):
            def connection_made(self, transport: asyncio.BaseTransport) -> None:
                super().connection_made(transport)
                links = [one for one in self.server.handlers if not one.transport.is_closing()]
                waiting = [one for one in links if one.state.name != "OPEN"]
                if door.is_closing:
                    self.transport.abort()
                elif len(waiting) > KNOCKING:
                    waiting[0].transport.abort()

        return Knocking

    def options(self, connection: "type[ServerConnection]") -> dict[str, Any]:
        """Return `serve` options that guard a server, with a class of connections made of `connection`."""
        return {
            "process_request": self.refusal,
            "create_connection": connection,
            "server_header": None,
            "max_size": _MAX_MESSAGE,
            "open_timeout": _OPEN_SECONDS,
            "close_timeout": _CLOSE_SECONDS,
            "logger": _quiet_logger(),
        }

    def refusal(self, connection: "ServerConnection", request: "Request") -> "Response | None":
        """Return the answer to a refused request, or None if it is accepted."""
        refusal = self._guard.refusal(request.path, request.headers)
        opens = is_websocket(request.headers)
        if refusal is None and opens and len(connection.server.connections) >= BROWSERS:
            refusal = Refusal("full", HTTPStatus.SERVICE_UNAVAILABLE, _FULL)
        if refusal is None:
            return None
        self.note_refused(connection, refusal.reason, refusal.text)
        return connection.respond(refusal.status, f"{refusal.text}\n")

    def note_refused(self, connection: "ServerConnection", reason: str, text: str) -> None:
        """Count and log what is refused."""
        self.refused[reason] += 1
        peer = connection.remote_address or ("somewhere",)
        log.warning("a browser at %s is turned away (%s): %s", peer[0], reason, text)


def _quiet_logger() -> logging.Logger:
    """Return a logger that ignores broken connections: any number of them is normal."""
    made = logging.Logger(f"{__name__}.connections")
    made.addHandler(logging.NullHandler())
    made.addFilter(lambda record: record.getMessage() == "connection handler failed")
    return made
