# SPDX-License-Identifier: MIT
"""Every ZeroMQ socket is made here, so that limits (and keys, once there are any) are set in one place.

No ZeroMQ heartbeats: a full PULL stops reading them and drops live connections (libzmq #3937). Nothing
lingers: what must survive is in the spool.
"""

import re
import socket
from ipaddress import ip_address
from typing import Any

import zmq
from msgspec import Struct

from tsfusion.errors import InvalidConfig, TransportError

CONTROL_MAX_BYTES = 64 << 10
# XPUB keeps a subscription at some fifty times its size; a greeting with keys needs about 330 bytes.
TOPIC_MAX_BYTES = 512
MESH_TOPIC = b"mesh"
_TCP_OPTIONS: dict[int, int] = {zmq.RECONNECT_IVL: 100, zmq.RECONNECT_IVL_MAX: 1000, zmq.TCP_KEEPALIVE: 1}
_RANDOM_PORT_TRIES = 32
LAST_PORT = 65535
_ADDRESS = re.compile(r"tcp://((?P<host>[\w.*-]+)|\[(?P<host6>[\w:.%]+)\]):(?P<port>[0-9]{1,5}|\*)", re.ASCII)

AnySocket = zmq.Socket[Any]


class Addresses(Struct, frozen=True):
    """Where a server listens, with the real port numbers."""

    data: str
    control: str
    publish: str  # mesh updates


def push(context: "zmq.Context[Any]") -> AnySocket:
    """The scanner's data socket. IMMEDIATE: nothing is queued for a server that is not there."""
    return _make(context, zmq.PUSH, {**_TCP_OPTIONS, zmq.SNDHWM: 10, zmq.IMMEDIATE: 1})


def pull(context: "zmq.Context[Any]", max_frame_bytes: int) -> AnySocket:
    """The server's data socket; a larger frame is dropped with its connection before it is in memory."""
    return _make(context, zmq.PULL, {zmq.RCVHWM: 16, zmq.MAXMSGSIZE: max_frame_bytes})


def dealer(context: "zmq.Context[Any]") -> AnySocket:
    """The scanner's control socket. IMMEDIATE: greetings do not pile up for a server that is not there."""
    return _make(context, zmq.DEALER, {**_TCP_OPTIONS, zmq.SNDHWM: 100, zmq.RCVHWM: 1000, zmq.IMMEDIATE: 1})


def router(context: "zmq.Context[Any]") -> AnySocket:
    """The server's control socket."""
    return _make(context, zmq.ROUTER, {zmq.SNDHWM: 1000, zmq.RCVHWM: 100, zmq.MAXMSGSIZE: CONTROL_MAX_BYTES})


def publisher(context: "zmq.Context[Any]") -> AnySocket:
    """The server's mesh updates; a slow viewer loses the oldest, never holds the server up."""
    return _make(context, zmq.XPUB, {zmq.SNDHWM: 16, zmq.MAXMSGSIZE: TOPIC_MAX_BYTES})


def subscriber(context: "zmq.Context[Any]") -> AnySocket:
    """A viewer's socket for mesh updates: topic, `work.Meshed`, cells (n, 3) int32, then a mesh's frames.

    The triangles replace all earlier ones in these cells (blocks of 8³ voxels).
    """
    made = _make(context, zmq.SUB, {**_TCP_OPTIONS, zmq.RCVHWM: 16})
    made.setsockopt(zmq.SUBSCRIBE, MESH_TOPIC)
    return made


def pair(context: "zmq.Context[Any]") -> AnySocket:
    """Gateway and fuser, over a file only this user can open."""
    return _make(context, zmq.PAIR, {zmq.SNDHWM: 64, zmq.RCVHWM: 64})


def _make(context: "zmq.Context[Any]", kind: int, options: dict[int, int]) -> AnySocket:
    made: AnySocket = context.socket(kind)
    made.setsockopt(zmq.LINGER, 0)
    for option, value in options.items():
        made.setsockopt(option, value)
    return made


def split(address: str) -> tuple[str, int]:
    """Host and port of `tcp://host:port` (port `*` or 0 = random).

    Raises:
        InvalidConfig: for anything else.
    """
    match = _ADDRESS.fullmatch(address)
    if match is not None:
        port = int(match["port"].replace("*", "0"))
        if port <= LAST_PORT:
            return match["host"] or match["host6"], port
    raise InvalidConfig(f"an address looks like tcp://127.0.0.1:5555, got {address!r}")


def join(host: str, port: int) -> str:
    """`tcp://host:port`."""
    return f"tcp://[{host}]:{port}" if ":" in host else f"tcp://{host}:{port}"


def control_address(address: str, control: str | None = None) -> str:
    """The control socket that belongs to a data address: the next port, unless given."""
    if control is not None:
        return join(*split(control))
    return _following(address, "control")


def _following(address: str, purpose: str) -> str:
    host, port = split(address)
    if port == LAST_PORT:
        raise InvalidConfig(f"{address} has no next port for {purpose}: choose a lower one")
    return join(host, port + 1)


def target(address: str) -> str:
    """An address to connect to, in its plain form. Raises InvalidConfig."""
    host, port = split(address)
    if port == 0:
        raise InvalidConfig(f"connecting needs a port, got {address}")
    return join(host, port)


def check_loopback(address: str) -> None:
    """Raise InvalidConfig unless only this machine can reach the address."""
    host, _ = split(address)
    try:
        local = host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        local = False
    if not local:
        raise InvalidConfig(
            "connections carry no keys, so the server listens on tcp://127.0.0.1 only, got "
            f"{address}; reach it from elsewhere by `ssh -L 5555:127.0.0.1:5555 -L 5556:127.0.0.1:5556 host`"
        )


def check_free(address: str) -> None:
    """Raise TransportError when a server could not listen here. Opens no port to anyone."""
    host, port = split(address)
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            raise TransportError(f"cannot listen on {address}: {error.strerror}") from error


def bind(data: AnySocket, control: AnySocket, publish: AnySocket, listen: str, to: str | None) -> Addresses:
    """Bind a server's three sockets: `listen`, `to` (default: the next port), and the one after that.

    Raises:
        TransportError: when a port is taken (a random one is drawn again until its neighbours are free).
    """
    host, port = split(listen)
    tries = _RANDOM_PORT_TRIES if port == 0 else 1
    for last in reversed(range(tries)):
        bound: list[tuple[AnySocket, str]] = []
        try:
            bound.append((data, _bind(data, join(host, port))))
            bound.append((control, _bind(control, control_address(bound[0][1], to))))
            bound.append((publish, _bind(publish, _following(bound[1][1], "mesh updates"))))
            return Addresses(*(address for _, address in bound))
        except (TransportError, InvalidConfig):
            for made, address in bound:
                made.unbind(address)
            if not last:
                raise
    raise AssertionError("the last try returns or raises")


def _bind(made: AnySocket, address: str) -> str:
    host, port = split(address)
    try:
        made.bind(join(host, port) if port else join(host, 0).replace(":0", ":*"))
    except zmq.ZMQError as error:
        raise TransportError(f"cannot listen on {address}: {error.strerror}") from error
    return made.getsockopt_string(zmq.LAST_ENDPOINT)
