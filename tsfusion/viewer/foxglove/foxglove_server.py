# SPDX-License-Identifier: MIT
"""Serve topics to Foxglove over its WebSocket protocol: to each client the newest state, at its own pace.

The server in foxglove-sdk accepts every Origin, knows no token, and drops messages to a slow client without a
word, so that a part of the map would be missing. This one has the door of a page, and sends what a client
does not have yet. Protocol: https://github.com/foxglove/ws-protocol/blob/main/docs/spec.md
"""

import asyncio
import base64
import itertools
import logging
import socket
import struct
import threading
import time
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

import msgspec

from tsfusion.core.limits import Bucket
from tsfusion.viewer.page.page_door import PageDoor
from tsfusion.viewer.page.page_guard import PageGuard, check_installed, listen

if TYPE_CHECKING:
    from foxglove import Schema
    from websockets.asyncio.server import ServerConnection

APPS = ("https://app.foxglove.dev",)  # pages of others that may use the server
_SUBPROTOCOLS = ("foxglove.sdk.v1", "foxglove.websocket.v1")  # which differ in their names
_MESSAGE = struct.Struct("<BIQ")  # kind 1, subscription, time in ns
_MOST_SUBSCRIPTIONS = 1000  # of a client
_MAX_MESSAGE = 1 << 20  # bytes from a client
_BYTES_PER_SECOND = 32e6  # to a client: 700,000 triangles
_ROUND_S = 0.1  # between two looks for what is new
_SILENCE_S = 120.0  # without an answer, after which a client counts as gone

log = logging.getLogger(__name__)


@dataclass(eq=False)
class FoxgloveTopic:
    """A topic whose entries, by name, make up its present state.

    Attributes:
        gone: makes the message that takes away an entry, or all (None), for clients; None = none is sent.
        pause: least seconds between two versions of an entry to a client.
        entries: by name, the time of each entry in ns, and what makes its content.
    """

    name: str
    schema: "Schema"
    gone: Callable[[str | None, int], bytes] | None = None
    pause: float = 0.0
    entries: dict[str, tuple[int, Callable[[], bytes]]] = field(default_factory=dict)
    number: int = field(default_factory=itertools.count(1).__next__)

    def channel(self) -> dict[str, Any]:
        """Return the topic as the protocol describes it."""
        is_text = self.schema.encoding == "jsonschema"
        return {
            "id": self.number,
            "topic": self.name,
            "encoding": "json" if is_text else self.schema.encoding,
            "schemaName": self.schema.name,
            "schemaEncoding": self.schema.encoding,
            "schema": (self.schema.data if is_text else base64.b64encode(self.schema.data)).decode(),
        }


@dataclass
class _Subscription:
    """Entries of a topic that a client does not have yet. The name None is the order to drop all."""

    topic: FoxgloveTopic
    waiting: dict[str | None, None]
    sent_at: dict[str | None, float] = field(default_factory=dict)

    def take_due(self, now: float) -> tuple[int, Callable[[], bytes]] | None:
        """Return the time and the maker of the message that waits longest; None without one."""
        topic = self.topic
        for name in self.waiting:
            if now < self.sent_at.get(name, 0.0) + topic.pause:
                continue
            del self.waiting[name]
            entry = None if name is None else topic.entries.get(name)
            if entry is not None:
                self.sent_at[name] = now
                return entry
            self.sent_at.pop(name, None)
            time_ns = time.time_ns()
            return None if topic.gone is None else (time_ns, partial(topic.gone, name, time_ns))
        return None


@dataclass(eq=False)
class _FoxgloveClient:
    connection: "ServerConnection"
    news: list[dict[str, Any]]  # what it is told before anything else
    subscriptions: dict[int, _Subscription] = field(default_factory=dict)


class _Subscribed(msgspec.Struct):
    id: int
    channelId: int  # noqa: N815


class _Order(msgspec.Struct):
    op: str
    subscriptions: list[_Subscribed] = []
    subscriptionIds: list[int] = []  # noqa: N815


class FoxgloveServer:
    """Running server of topics, for Foxglove and what else speaks its protocol.

    Args:
        host, port, token: as of a page; see `PageServer`.

    Attributes:
        url: address to open in Foxglove, token included.
        port, token: the real values; the token is None if none is needed.

    Raises:
        MissingDependency: foxglove-sdk or websockets is not installed.
        InvalidConfig: the token is bad.
        TransportError: the port is taken.
    """

    def __init__(self, host: str = "127.0.0.1", port: int = 0, *, token: str | None = None) -> None:
        check_installed("foxglove")
        self._session = str(time.time_ns())  # by which clients see a restart
        self._lock = threading.Lock()  # guards all topics and what waits for clients
        self._topics: dict[str, FoxgloveTopic] = {}
        self._clients: set[_FoxgloveClient] = set()
        with ExitStack() as failed:
            listener = failed.enter_context(listen(host, port))
            self.port = listener.getsockname()[1]
            guard = PageGuard(host, self.port, token, scheme="ws", apps=APPS)
            self._door = PageDoor(guard)
            self.url, self.token = guard.url, guard.token
            running: Future[Callable[[], object]] = Future()
            self._thread = threading.Thread(
                target=lambda: asyncio.run(self._serve(listener, running)), name="foxglove", daemon=True
            )
            self._thread.start()
            self._end = running.result()
            failed.pop_all()

    @property
    def has_clients(self) -> bool:
        return bool(self._clients)

    def close(self) -> None:
        """End all connections, and wait for the end of the server's thread."""
        if self._thread.is_alive():
            self._end()
            self._thread.join()

    def open(self, topic: FoxgloveTopic) -> None:
        """Offer a topic to all clients."""
        with self._lock:
            self._topics[topic.name] = topic
            self._tell(op="advertise", channels=[topic.channel()])

    def withdraw(self, name: str) -> None:
        """Offer a topic no more."""
        with self._lock:
            topic = self._topics.pop(name)
            for client in self._clients:
                each = client.subscriptions.items()
                client.subscriptions = {number: one for number, one in each if one.topic is not topic}
            self._tell(op="unadvertise", channelIds=[topic.number])

    def put(self, topic: str, name: str, make: Callable[[], bytes]) -> None:
        """Set an entry of a topic; its content is made by `make` on another thread, for each client."""
        with self._lock:
            self._topics[topic].entries[name] = time.time_ns(), make
            for one in self._subscriptions(topic):
                one.waiting.setdefault(name)

    def drop(self, topic: str, name: str) -> None:
        """Take an entry away from a topic."""
        with self._lock:
            if self._topics[topic].entries.pop(name, None) is not None:
                for one in self._subscriptions(topic):
                    one.waiting.setdefault(name)

    def clear(self, topic: str) -> None:
        """Take all entries away from a topic."""
        with self._lock:
            self._topics[topic].entries.clear()
            for one in self._subscriptions(topic):
                one.waiting = {None: None}

    def _subscriptions(self, topic: str) -> list[_Subscription]:
        all_of = (one for client in self._clients for one in client.subscriptions.values())
        return [one for one in all_of if one.topic.name == topic]

    def _tell(self, **message: Any) -> None:
        for client in self._clients:
            client.news.append(message)

    # --- in the server's thread ---

    async def _serve(self, listener: socket.socket, running: "Future[Any]") -> None:
        from websockets.asyncio.server import serve
        from websockets.typing import Subprotocol

        try:
            options = self._door.options(self._door.connection()) | {
                "subprotocols": [Subprotocol(one) for one in _SUBPROTOCOLS],
                "compression": None,
                "max_size": _MAX_MESSAGE,
                "ping_timeout": _SILENCE_S,
            }
            async with serve(self._meet, sock=listener, **options) as server:
                end = asyncio.Event()
                running.set_result(partial(asyncio.get_running_loop().call_soon_threadsafe, end.set))
                await end.wait()
                self._door.close(server)
        except BaseException as error:
            if running.done():
                raise
            running.set_exception(error)

    async def _meet(self, connection: "ServerConnection") -> None:
        """Serve a client until it leaves."""
        from websockets.exceptions import ConnectionClosed

        hello = {"op": "serverInfo", "name": "tsfusion", "capabilities": [], "sessionId": self._session}
        with self._lock:
            offers = [topic.channel() for topic in self._topics.values()]
            client = _FoxgloveClient(connection, [hello, {"op": "advertise", "channels": offers}])
            self._clients.add(client)
        tasks = [asyncio.create_task(work) for work in (self._listen_to(client), self._send_to(client))]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            with self._lock:
                self._clients.discard(client)
            for task in tasks:
                task.cancel()
        for error in await asyncio.gather(*tasks, return_exceptions=True):
            if isinstance(error, Exception) and not isinstance(error, ConnectionClosed):
                log.warning("a client of Foxglove had an error: %s: %s", type(error).__name__, error)

    async def _listen_to(self, client: _FoxgloveClient) -> None:
        from websockets.frames import CloseCode

        async for message in client.connection:
            try:
                with self._lock:
                    self._obey(client, message)
            except (msgspec.MsgspecError, RecursionError) as error:
                self._door.note_refused(client.connection, "message", f"it is none of Foxglove: {error}")
                await client.connection.close(CloseCode.POLICY_VIOLATION)
                return

    def _obey(self, client: _FoxgloveClient, message: str | bytes) -> None:
        order = msgspec.json.decode(message, type=_Order)
        if order.op == "unsubscribe":
            for number in order.subscriptionIds:
                client.subscriptions.pop(number, None)
        elif order.op == "subscribe":
            topics = {topic.number: topic for topic in self._topics.values()}
            for one in order.subscriptions:
                topic = topics.get(one.channelId)
                if topic is not None and 0 <= one.id < 1 << 32:  # else it was withdrawn meanwhile
                    waiting: dict[str | None, None] = {None: None, **dict.fromkeys(topic.entries)}
                    client.subscriptions[one.id] = _Subscription(topic, waiting)
            if len(client.subscriptions) > _MOST_SUBSCRIPTIONS:
                raise msgspec.ValidationError(f"more than {_MOST_SUBSCRIPTIONS} subscriptions")

    async def _send_to(self, client: _FoxgloveClient) -> None:
        """Send a client one message of each subscription in turn; wait while it does not take them."""
        send, bucket = client.connection.send, Bucket(_BYTES_PER_SECOND, time.monotonic(), burst=1.0)
        while True:
            while client.news:
                await send(msgspec.json.encode(client.news.pop(0)).decode())
            is_idle = True
            for number, one in list(client.subscriptions.items()):
                with self._lock:
                    found = one.take_due(time.monotonic())
                if found is not None:
                    is_idle, content = False, _MESSAGE.pack(1, number, found[0]) + found[1]()
                    await asyncio.sleep(bucket.wait(len(content), time.monotonic()))
                    bucket.spend(len(content))
                    await send(content)
            if is_idle:
                await asyncio.sleep(_ROUND_S)
