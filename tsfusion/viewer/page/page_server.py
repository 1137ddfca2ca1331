# SPDX-License-Identifier: MIT
"""Run viser's web server for a page, and accept or refuse each connection first.

viser's own server accepts every Origin, takes another port if one is in use, and prints. So viser gets our
replacement of `websockets.asyncio.server.serve` while it starts. If viser does not use it, nothing is served.
"""

import asyncio
import gzip
import logging
import socket
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import AsyncExitStack, ExitStack, asynccontextmanager
from functools import lru_cache, partial
from http import HTTPStatus
from importlib import resources
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

from msgspec import MsgspecError

from tsfusion.core.errors import TransportError
from tsfusion.viewer.page import page_messages
from tsfusion.viewer.page.page_door import PageDoor
from tsfusion.viewer.page.page_guard import PageGuard, check_installed, listen

if TYPE_CHECKING:
    import viser
    from websockets.asyncio.server import Server, ServerConnection
    from websockets.http11 import Request, Response

_PAUSE = 0.005  # seconds between two messages of a browser: viser's page sends 50 a second at most
_START = threading.Lock()
_MISFITS = (TypeError, ValueError, LookupError, AttributeError, OSError, RuntimeError)

log = logging.getLogger(__name__)


class PageServer:
    """Running web server of viser with an empty page and a guard.

    Args:
        host: its address; by default only this machine can reach it.
        port: 0 = a free port.
        token: needed to open the page; None = no token on this machine, else a random token.

    Attributes:
        server: viser's server, to fill the page with.
        url: address to open the page with.
        port, token: the real values; the token is None if none is needed.
        refused: number of refused requests, by reason: host, origin, token, full, message.

    Raises:
        MissingDependency: viser is not installed.
        InvalidConfig: the token is bad.
        TransportError: the port is taken, or viser cannot be guarded.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = 0, *, token: str | None = None) -> None:
        check_installed()
        self._running: Server | None = None
        self._problem = "it starts in another way"
        with ExitStack() as failed:
            listener = failed.enter_context(listen(host, port))
            self.port = listener.getsockname()[1]
            self._guard = PageGuard(host, self.port, token)
            self._door = PageDoor(self._guard)
            self.refused = self._door.refused
            self.url, self.token = self._guard.url, self._guard.token
            self.server = self._start(listener)
            failed.pop_all()
        self.server.gui.configure_theme(show_logo=False, show_share_button=False)

    def close(self) -> None:
        if not self._door.is_closing:
            assert self._running is not None
            self._door.is_closing = True
            self.server.get_event_loop().call_soon_threadsafe(self._door.close, self._running)
            self.server.stop()

    def _start(self, listener: socket.socket) -> "viser.ViserServer":
        import rich
        import viser
        import websockets.asyncio.server as module

        rich.reconfigure(quiet=True)  # viser prints through it, but stdout belongs to the command
        with _START:
            usual = module.serve
            module.serve = partial(self._serve, usual, listener)  # type: ignore[assignment, misc]
            try:
                server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
            finally:
                module.serve = usual  # type: ignore[misc]
        if self._running is None:
            server.stop()
            raise TransportError(
                f"this version of viser cannot be guarded, so nothing is shown: {self._problem}"
            )
        return server

    @asynccontextmanager
    async def _serve(
        self, usual: Any, listener: socket.socket, handler: Any, host: str, port: int, **options: Any
    ) -> AsyncIterator[Any]:
        """Replace `websockets.asyncio.server.serve`, with a guard. Always yields: viser waits for that."""
        asyncio.get_running_loop().set_exception_handler(_note_failure)
        async with AsyncExitStack() as stack:
            try:
                guarded = options | self._guarded(options["process_request"])
                running = await stack.enter_async_context(usual(handler, sock=listener, **guarded))
                self._running = running
            except _MISFITS as error:  # another version of viser or websockets; `_start` reports
                self._problem = repr(error)
                running = SimpleNamespace(server=SimpleNamespace(sockets=()))
            yield running

    def _guarded(self, answer: "Callable[[ServerConnection, Request], Response | None]") -> dict[str, Any]:
        """Return `serve` options that guard the server. `answer` is viser's own answer to a request."""
        from websockets.frames import CloseCode

        page = self

        class Visit(self._door.connection()):  # type: ignore[misc]
            """A connection that passes only messages of our page to viser."""

            async def recv(self, decode: bool | None = None) -> Any:
                while True:
                    await asyncio.sleep(_PAUSE)
                    message = await super().recv(decode)
                    try:
                        found = page_messages.checked(message, page._control)
                    except (MsgspecError, RecursionError, TypeError) as error:
                        page._door.note_refused(self, "message", f"no page of ours sends this: {error}")
                        await self.close(CloseCode.POLICY_VIOLATION)
                    else:
                        if found is not None:
                            return found

        return {
            **self._door.options(Visit),
            "process_request": lambda one, request: self._door.refusal(one, request) or answer(one, request),
            "process_response": self._with_headers,
        }

    def _control(self, name: str) -> Any:
        """Return the control with this name, shared by browsers or of one browser; None without one."""
        panels = [self.server.gui, *(client.gui for client in self.server.get_clients().values())]
        found = [
            one._gui_input_handle_from_uuid[name] for one in panels if name in one._gui_input_handle_from_uuid
        ]
        return found[0] if found else None

    def _with_headers(self, connection: "ServerConnection", request: "Request", response: "Response") -> None:
        if response.status_code == HTTPStatus.OK:
            if response.headers.get("Content-Type", "").startswith("text/html"):
                response.body = _with_our_head(bytes(response.body))
                del response.headers["Content-Length"]
                response.headers["Content-Length"] = str(len(response.body))
            for name, value in self._guard.answer_headers(request.path, request.headers).items():
                response.headers[name] = value


@lru_cache(2)
def _with_our_head(html: bytes) -> bytes:
    """Return viser's HTML page, compressed or not, with control names, a title and more contrast."""
    is_packed = html.startswith(b"\x1f\x8b")
    html = gzip.decompress(html) if is_packed else html
    ours = resources.files(__package__).joinpath("page_head.html").read_bytes()
    html = html.replace(b"<title>Viser</title>", b"<title>tsfusion</title>" + ours, 1)
    return gzip.compress(html) if is_packed else html


def _note_failure(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    log.warning("the page had an error: %s", context.get("exception") or context.get("message"))


def calm(callback: Callable[..., object]) -> Callable[..., None]:
    """Wrap a callback so that its exceptions are logged in one line, not raised."""

    def call(*given: Any) -> None:
        try:
            callback(*given)
        except Exception as error:  # noqa: BLE001 - a browser may leave at any moment, in any call
            log.warning("a request of a browser failed: %s: %s", type(error).__name__, error)

    return call
