# SPDX-License-Identifier: MIT
"""A small HTTP server for programs on this machine, in one thread.

A foreign web page can make a browser on this machine send requests. So a request must name this machine as
its host, and no request changes anything. A connection that is slow or idle, or sends too much, is cut off.
"""

import asyncio
import logging
import re
import socket
import threading
from collections.abc import Callable, Mapping
from contextlib import suppress
from http import HTTPStatus

from tsfusion.core.errors import InvalidConfig, TransportError
from tsfusion.gateway.health.metrics import HttpAnswer
from tsfusion.wire.sockets.sockets import is_loopback

DEADLINE = 5.0  # seconds for a request and its answer
CONNECTIONS = 32  # at once; the oldest makes room for a new one
HEAD_BYTES = 8192
_REQUEST = re.compile(r"(?P<method>[A-Z]+) (?P<path>/[^\s?]*)(?:\?\S*)? HTTP/1\.(?P<minor>[01])")
_OWN_HOST = re.compile(r"(?:localhost|127(?:\.\d{1,3}){3}|\[::1\])(?::\d{1,5})?", re.ASCII | re.IGNORECASE)
_LAST_PORT = 65535
_PLAIN = "text/plain; charset=utf-8"

log = logging.getLogger(__name__)


class MetricsPage:
    """An HTTP server in a thread, for GET and HEAD of a few pages, until `close`.

    Args:
        address: HOST:PORT on this machine; port 0 draws a random one.
        pages: path → function that makes its answer, called in the thread.

    Raises:
        InvalidConfig: when other machines could reach the address.
        TransportError: when the port is taken.
    """

    def __init__(self, address: str, pages: Mapping[str, Callable[[], HttpAnswer]]) -> None:
        self._pages = pages
        self._listener = _listen(address)
        self.address = _text(*self._listener.getsockname()[:2])  # HOST:PORT with the real port
        self._open: dict[asyncio.Task[None], asyncio.StreamWriter] = {}  # the oldest first
        self._loop = asyncio.new_event_loop()
        self._ending = asyncio.Event()
        self._thread = threading.Thread(target=self._run, name="metrics", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the thread and every connection."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._ending.set)
            self._thread.join()

    def _run(self) -> None:
        try:
            self._loop.run_until_complete(self._serve())
        finally:
            self._loop.close()

    async def _serve(self) -> None:
        server = await asyncio.start_server(self._connected, sock=self._listener, limit=HEAD_BYTES)
        await self._ending.wait()
        # asyncio leaves a connection open that is being accepted while the server closes.
        self._loop.remove_reader(self._listener.fileno())
        for _ in range(5):
            await asyncio.sleep(0)
        server.close()
        tasks = list(self._open)
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        for _ in range(3):  # the transports close their sockets
            await asyncio.sleep(0)

    def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if len(self._open) >= CONNECTIONS:
            oldest = next(iter(self._open))
            oldest.cancel()
            self._ended(oldest)
        task = self._loop.create_task(self._converse(reader, writer))
        self._open[task] = writer
        task.add_done_callback(self._ended)

    def _ended(self, task: "asyncio.Task[None]") -> None:
        writer = self._open.pop(task, None)
        if writer is not None:
            writer.transport.abort()  # by now all bytes are sent, or the peer does not read

    async def _converse(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        # These errors are the peer's own fault: it gets no answer.
        with suppress(OSError, EOFError, asyncio.TimeoutError, asyncio.LimitOverrunError):
            await asyncio.wait_for(self._exchange(reader, writer), DEADLINE)

    async def _exchange(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        head = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1")
        status, page, kind = self._answer(head)
        body = page if isinstance(page, bytes) else f"{page}\n".encode()
        lines = (
            f"HTTP/1.1 {status} {HTTPStatus(status).phrase}",
            f"Content-Type: {kind}",
            f"Content-Length: {len(body)}",
            "Cache-Control: no-store",
            "X-Content-Type-Options: nosniff",
            "Connection: close",
            *(["Allow: GET, HEAD"] if status == HTTPStatus.METHOD_NOT_ALLOWED else []),
        )
        writer.transport.set_write_buffer_limits(0)  # so that `drain` means sent
        writer.write("\r\n".join((*lines, "", "")).encode() + (b"" if head.startswith("HEAD ") else body))
        await writer.drain()

    def _answer(self, head: str) -> HttpAnswer:
        first, *rest = head.split("\r\n")
        request = _REQUEST.fullmatch(first)
        hosts = [line.partition(":")[2].strip() for line in rest if line[:5].lower() == "host:"]
        if request is None or len(hosts) > 1 or (not hosts and request["minor"] == "1"):
            return 400, "this is not HTTP as it is spoken here", _PLAIN
        if hosts and not _OWN_HOST.fullmatch(hosts[0]):
            return 403, "ask for this page at localhost or 127.0.0.1; a proxy has to set Host so, too", _PLAIN
        if request["method"] not in ("GET", "HEAD"):
            return 405, "only GET and HEAD", _PLAIN
        page = self._pages.get(request["path"])
        if page is None:
            return 404, f"there is {', '.join(self._pages)}", _PLAIN
        try:
            return page()
        except Exception:  # the next request may succeed; the thread must not end
            log.exception("%s cannot be shown", request["path"])
            return 500, "this page failed; the server's log says why", _PLAIN


def _listen(address: str) -> socket.socket:
    host, _, digits = address.rpartition(":")
    host = host.removeprefix("[").removesuffix("]")
    port = int(digits) if digits.isascii() and digits.isdigit() else _LAST_PORT + 1
    if not is_loopback(host) or port > _LAST_PORT:
        raise InvalidConfig(
            f"metrics must be HOST:PORT on this machine, such as 127.0.0.1:9464, got {address!r}; "
            "let others in by a reverse proxy that asks who they are, or by `ssh -L`"
        )
    host = "127.0.0.1" if host == "localhost" else host.removeprefix("::ffff:")
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family)
    except OSError as error:
        why = error.strerror or error
        raise TransportError(f"cannot serve metrics on {address}: {why}; choose another port") from error


def _text(host: str, port: int) -> str:
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
