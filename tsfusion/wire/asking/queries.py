# SPDX-License-Identifier: MIT
"""Commands to a running server: its health, the status of a map, the mesh of a map, forgetting, moving."""

import math
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager, suppress
from typing import Any, TypeVar

import numpy as np
import zmq
from numpy.typing import NDArray

from tsfusion.core.config import DEFAULT_MAP
from tsfusion.core.errors import (
    AnswerLate,
    DecodeError,
    InvalidConfig,
    NotAllowed,
    ServerUnreachable,
    TransportError,
)
from tsfusion.geometry.mesh import Mesh
from tsfusion.wire.messages import messages
from tsfusion.wire.messages.forget_messages import Forgotten, Selection
from tsfusion.wire.messages.health import Health, MeshLayout, Status
from tsfusion.wire.messages.messages import Command, Reply
from tsfusion.wire.messages.migration_messages import Moved
from tsfusion.wire.sockets import sockets
from tsfusion.wire.sockets.connection import MOST_HOPS, ServerLink, Whereabouts
from tsfusion.wire.sockets.curve import ClientKeys
from tsfusion.wire.sockets.sockets import control_address

Replied = TypeVar("Replied")
_AGAIN_INTERVAL = 0.25  # seconds
_PING_TIMEOUT = 5.0  # seconds; the gateway is never busy: after so long without an answer it is not there


class CommandRefused(TransportError):
    """Answer of the server that it cannot do what a command asks."""

    def __init__(self, address: str, reason: str, *, retry: bool = False) -> None:
        super().__init__(f"the server at {address}: {reason}")
        self.reason = reason  # the server's words, without its address
        self.retry = retry  # True if the same command may succeed soon


def fetch_health(
    address: str,
    *,
    control: str | None = None,
    map_name: str | None = None,
    timeout: float = 10.0,
    keys: ClientKeys | None = None,
) -> Health:
    """Ask the server at a data address for its health. It answers at once, even while its fusers are busy.

    Args:
        map_name: map whose server is asked, also after the map moved; None asks the server at `address`.
        keys: result of `curve.client_keys`, for a server with keys.

    Raises:
        NotAllowed: when the server refuses the connection.
        ServerUnreachable: when nobody answers in `timeout` seconds.
    """
    command = Command(name="health", map=map_name or DEFAULT_MAP)
    reply, _ = request(
        address, command, control=control, timeout=timeout, keys=keys, follow=map_name is not None
    )
    return _given(reply.health, "its health", address)


def fetch_status(
    address: str,
    *,
    control: str | None = None,
    map_name: str = DEFAULT_MAP,
    timeout: float = 10.0,
    keys: ClientKeys | None = None,
) -> Status:
    """Ask the server at a data address for the status of a map. See `fetch_health`.

    Raises:
        TransportError: when the server cannot give the status.
    """
    command = Command(name="status", map=map_name, timeout_s=timeout)
    reply, _ = request(address, command, control=control, timeout=timeout, keys=keys)
    return _given(reply.status, "a status", address)


def fetch_new_map(
    address: str,
    like: str = DEFAULT_MAP,
    *,
    control: str | None = None,
    timeout: float = 10.0,
    keys: ClientKeys | None = None,
) -> str:
    """Ask the server at a data address for a name that no map has: the first free of NAME, NAME-2, NAME-3, …

    The server gives this name to nobody else for some minutes. See `fetch_health`.

    Raises:
        TransportError: when the server has no room for another map.
    """
    command = Command(name="new_map", map=like)
    reply, _ = request(address, command, control=control, timeout=timeout, keys=keys)
    return _given(reply.map, "the name of a map", address)


def fetch_mesh(
    address: str,
    *,
    control: str | None = None,
    map_name: str = DEFAULT_MAP,
    min_weight: float | None = None,
    timeout: float = 60.0,
    keys: ClientKeys | None = None,
) -> Mesh:
    """Ask the server at a data address for the present mesh of a map. See `fetch_health`.

    A server makes one mesh at a time, and none while keyframes wait to be fused; until then this asks again.

    Raises:
        ServerUnreachable: when no server answers (known after a few seconds), or the mesh takes longer than
            `timeout` seconds.
        TransportError: when the server cannot make the mesh, or not within `timeout` seconds.
    """
    command = Command(name="mesh", map=map_name, min_weight=min_weight, timeout_s=timeout)
    deadline = time.monotonic() + timeout
    refused: CommandRefused | None = None
    with closing(Exchange(address, control, keys)) as server:
        while True:
            try:
                reply, frames = server.ask(command, timeout=max(deadline - time.monotonic(), 0.0))
                break
            except CommandRefused as error:
                if not error.retry or time.monotonic() + 2 * _AGAIN_INTERVAL > deadline:
                    raise
                refused = error
            except ServerUnreachable as error:
                if refused is None:
                    raise
                raise refused from error  # the server is there, and said why it has no mesh
            time.sleep(_AGAIN_INTERVAL)
    return mesh_of(_given(reply.mesh, "a mesh", address), frames)


def forget(
    address: str,
    selection: Selection,
    *,
    erase: bool = False,
    dry_run: bool = False,
    control: str | None = None,
    map_name: str = DEFAULT_MAP,
    timeout: float = 600.0,
    keys: ClientKeys | None = None,
) -> Forgotten:
    """Tell the server at a data address to forget keyframes of a map. See `fetch_health`.

    Args:
        erase: also delete the keyframes from the journal. The server answers when that is done.
        dry_run: only ask which keyframes would be forgotten.
        timeout: seconds; a server that does not answer in time may still forget the keyframes.

    Raises:
        ServerUnreachable: when no server answers in `timeout` seconds.
        TransportError: when the server cannot forget them, or this client has no right to ask.
    """
    command = Command(
        name="forget", map=map_name, selection=selection, erase=erase, dry_run=dry_run, timeout_s=timeout
    )
    reply, _ = request(address, command, control=control, timeout=timeout, keys=keys)
    return _given(reply.forgotten, "a list of forgotten keyframes", address)


def move_map(
    name: str, source: str, to: str, *, timeout: float = 3600.0, keys: ClientKeys | None = None
) -> Moved:
    """Tell the server at data address `to` to take over a map from the server `source`. See `fetch_health`.

    Raises:
        ServerUnreachable: when no server answers in `timeout` seconds; the move may still go on.
        TransportError: when the server cannot move the map, or this client has no right to ask. The map then
            stays at `source`.
    """
    command = Command(name="move", map=name, source=sockets.connect_address(source))
    reply, _ = request(to, command, timeout=timeout, keys=keys)
    return _given(reply.moved, "how the move went", to)


def _given(part: Replied | None, what: str, address: str) -> Replied:
    """Return a part of a reply. Raise TransportError without it."""
    if part is None:
        raise TransportError(f"the server at {address} answered without {what}")
    return part


def mesh_of(layout: MeshLayout, frames: list[memoryview]) -> Mesh:
    """Build a mesh from its frames (see `MeshLayout`).

    Raises:
        TransportError: when the sizes of the frames differ from the layout.
    """
    wanted: list[tuple[int, type]] = [(layout.vertices, np.float32), (layout.faces, np.int32)]
    wanted.append((layout.vertices, np.float32))
    if layout.colors:
        wanted.append((layout.vertices, np.uint8))
    sizes = [rows * 3 * np.dtype(dtype).itemsize for rows, dtype in wanted]
    if sizes != [frame.nbytes for frame in frames]:
        raise TransportError(f"a mesh of {sizes} bytes was announced, got {[f.nbytes for f in frames]}")
    arrays: list[NDArray[Any]] = [
        np.frombuffer(frame, dtype).reshape(-1, 3) for frame, (_, dtype) in zip(frames, wanted, strict=True)
    ]
    return Mesh(*arrays, known_up=layout.up)


_POLL_S = 0.2  # seconds
_MAX_TIMEOUT_S = 1e6  # seconds; a poll takes no more than 2³¹ ms


def request(
    address: str,
    command: Command,
    *,
    timeout: float,
    control: str | None = None,
    keys: ClientKeys | None = None,
    follow: bool = True,
) -> tuple[Reply, list[memoryview]]:
    """Send a command to the server at a data address. Return the reply, and the raw frames after it.

    Raises as `Exchange`, and `Exchange.ask`.
    """
    with closing(Exchange(address, control, keys)) as server:
        return server.ask(command, timeout=timeout, follow=follow)


def open_connection(context: "zmq.Context[Any]", address: str, keys: ClientKeys | None) -> ServerLink:
    """Connect to a server's control address. Raise TransportError without a socket."""
    with refused_sockets():
        return ServerLink(context, sockets.dealer, address, keys)


@contextmanager
def refused_sockets() -> Iterator[None]:
    """Raise TransportError if the block can open no socket."""
    try:
        yield
    except zmq.ZMQError as error:
        raise TransportError(f"cannot open a socket: {error.strerror}") from error


def _encoded(command: Command) -> bytes:
    """Encode a command. Raise InvalidConfig for one that a server would drop, such as for a map "a/b"."""
    try:
        encoded = messages.encode_sealed(command)
        messages.decode_to_server(encoded)
    except (DecodeError, OverflowError, UnicodeEncodeError) as error:
        raise InvalidConfig(
            f"the command {command.name} cannot be sent: {error.__cause__ or error}"
        ) from error
    return encoded


class Exchange:
    """Commands to the server of a map, one after the other. A command is sent again on each new connection.

    A ping goes out before the first command on each connection, and after a command without a quick answer.

    Args:
        control: control address of the server; None takes the port after that of `address`.
        keys: result of `curve.client_keys`; None connects without keys.

    Attributes:
        is_there: True if the server has answered a ping since `ask` began. It is never too busy for that.

    Raises:
        InvalidConfig: for a malformed address.
        TransportError: when too few files can be opened.
    """

    def __init__(self, address: str, control: str | None = None, keys: ClientKeys | None = None) -> None:
        self.is_there = False
        address = sockets.connect_address(address)
        place = address, sockets.connect_address(control_address(address, control))
        self._where = Whereabouts(place, has_keys=keys is not None)
        self._context = sockets.open_context()
        try:
            self._connection = open_connection(self._context, place[1], keys)
        except TransportError:
            self._context.term()
            raise
        self._asked = self._greeted = 0  # connections on which the command was sent, and a ping answered
        self._ping_at = 0.0  # time.monotonic()
        self._why = ""  # reason why there is no connection

    def close(self) -> None:
        self._connection.close()
        self._context.term()

    @property
    def address(self) -> str:
        """Data address of the server that is asked now."""
        return self._where.place[0]

    @property
    def _name(self) -> str:
        data, control = self._where.place
        return f"{data} (control {control})"

    def ask(
        self, command: Command, frames: Sequence[Any] = (), *, timeout: float, follow: bool = True
    ) -> tuple[Reply, list[memoryview]]:
        """Send a command and its frames. Return the reply, and the raw frames after it.

        Args:
            follow: if the map has moved, ask its new server; False returns the first server's reply.

        Raises:
            InvalidConfig: when a server would drop the command, because a value is out of range.
            NotAllowed: as soon as the server refuses the connection.
            ServerUnreachable: when nobody answered within `timeout` seconds, or a ping within a few.
            AnswerLate: when the server says that the time of a question is over.
            CommandRefused: when the server answers that it cannot.
            TransportError: when the other end is no tsfusion server, or one of another version; when a map
                has moved to a server that this client may not follow it to.
        """
        deadline = time.monotonic() + min(timeout, _MAX_TIMEOUT_S)
        with refused_sockets():
            reply, found = self._ask_once(command, frames, deadline)
            self._where.let_in()
            while reply.elsewhere is not None and follow and self._where.hops < MOST_HOPS:
                place = self._where.follow(reply.elsewhere.address, reply.elsewhere.control)
                self._connection.connect_to(place[1])
                reply, found = self._ask_once(command, frames, deadline)
        if reply.late:
            raise AnswerLate(f"the map {command.map} at {self.address}: {reply.error}")
        if reply.error is not None:
            raise CommandRefused(self._name, reply.error, retry=reply.retry)
        return reply, found

    def _ask_once(
        self, command: Command, frames: Sequence[Any], deadline: float
    ) -> tuple[Reply, list[memoryview]]:
        began = time.monotonic()
        timeout = max(deadline - began, 0.0)
        self.is_there, self._asked, self._ping_at = False, 0, began + min(timeout / 2, _POLL_S)
        sent = [_encoded(command), *frames]
        while True:
            seconds = timeout if self.is_there else min(timeout, _PING_TIMEOUT)
            if (left := began + seconds - time.monotonic()) <= 0:
                if not self.is_there:
                    self._connection.reopen()  # an open connection may be dead without an event
                raise self._unreachable(command.name, seconds)
            if (message := self._step(sent, left)) is None:
                continue
            reply, found = self._read(message)
            if reply.number == command.number and (reply.name != "ping" or command.name == "ping"):
                return reply, found

    def _step(self, sent: list[Any], left: float) -> list[zmq.Frame] | None:
        """Send what is due, then wait a moment for a message. Return it, or None without one."""
        connection, now = self._connection, time.monotonic()
        link, is_new = connection.socket, connection.made > self._asked
        polled = [
            (link, zmq.POLLIN | (zmq.POLLOUT if is_new else 0)),
            (connection.monitor.socket, zmq.POLLIN),
        ]
        seconds = min(left, _POLL_S, max(self._ping_at - now, 0.0))
        events = dict(zmq.zmq_poll(polled, int(seconds * 1000) + 1)).get(link, 0)
        if events & zmq.POLLIN:
            return link.recv_multipart(copy=False)
        with suppress(zmq.Again):  # the connection has ended: all is sent on the next one
            if (events and connection.made > self._greeted) or time.monotonic() >= self._ping_at:
                self._ping_at = math.inf
                link.send(messages.encode_sealed(Command(name="ping")), zmq.NOBLOCK)
            if events & zmq.POLLOUT:
                self._asked = connection.made
                link.send_multipart(sent, zmq.NOBLOCK)
        news, _ = connection.check(time.monotonic())
        self._why = self._why if news is None else news
        if connection.monitor.gave_up:
            raise (NotAllowed if connection.monitor.refused else TransportError)(self._why)
        return None

    def _read(self, message: list[zmq.Frame]) -> tuple[Reply, list[memoryview]]:
        address, (head, *frames) = self._name, message
        try:
            reply = messages.decode_to_client(head.buffer)
        except DecodeError as error:
            raise TransportError(f"what answers at {address} is no tsfusion server: {error}") from error
        if not isinstance(reply, Reply):
            raise TransportError(f"the server at {address} answered a command with a {type(reply).__name__}")
        if reply.name == "ping":
            if other := messages.other_version(server=reply.version, client=messages.PROTOCOL_VERSION):
                raise TransportError(f"cannot ask {address}: {other}")
            self.is_there, self._greeted = True, self._asked
        return reply, [frame.buffer for frame in frames]

    def _unreachable(self, asked: str, seconds: float) -> ServerUnreachable:
        if self.is_there and seconds > _PING_TIMEOUT:
            late = f"has not answered the command {asked} within {round(seconds, 2):g} s; it may still do it"
            return ServerUnreachable(f"the server at {self._name} is there, but {late}")
        reason = f": {self._why}" if self._why else ""
        return ServerUnreachable(
            f"no server answered at {self._name} within {round(seconds, 2):g} s"
            f"{reason}; is `tsfusion serve` running there, and is the port right?"
        )
