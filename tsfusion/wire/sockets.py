# SPDX-License-Identifier: MIT
"""ZeroMQ sockets with their limits and keys: every socket of the package is made here.

No ZeroMQ heartbeats: a full PULL stops reading them and drops live connections (libzmq #3937). No
socket lingers: keyframes that must survive are in the spool.
"""

import re
import socket
from ipaddress import ip_address
from typing import Any

import zmq
from msgspec import Struct

from tsfusion.core.config import DEFAULT_MAP, MAP_NAME
from tsfusion.core.errors import InvalidConfig, TransportError
from tsfusion.wire.curve import ClientKeys, ServerKeys

CONTROL_MAX_BYTES = 64 << 10
# XPUB keeps a subscription at some fifty times its size; a greeting with keys needs about 330 bytes.
TOPIC_MAX_BYTES = 512
_MESH_TOPIC = b"mesh/"
_ANY: dict[int, int] = {zmq.HANDSHAKE_IVL: 5000}  # ms; then a connection that is not made is closed
_RECONNECTING: dict[int, int] = {zmq.RECONNECT_IVL: 100, zmq.RECONNECT_IVL_MAX: 1000}  # ms
_CONNECTING = {**_ANY, **_RECONNECTING, zmq.TCP_KEEPALIVE: 1, zmq.IMMEDIATE: 1}
_RANDOM_PORT_TRIES = 32
LAST_PORT = 65535
_MAPS_TOPIC = re.compile(rf"mesh/({MAP_NAME}/?)?".encode())  # or its beginning
_ADDRESS = re.compile(r"tcp://((?P<host>[\w.*-]+)|\[(?P<host6>[\w:.%]+)\]):(?P<port>[0-9]{1,5}|\*)", re.ASCII)

AnySocket = zmq.Socket[Any]


class Addresses(Struct, frozen=True):
    """Addresses on which a server listens, with the real port numbers."""

    data: str
    control: str
    publish: str  # mesh updates


def push(context: "zmq.Context[Any]", keys: ClientKeys | None = None) -> AnySocket:
    """The scanner's data socket. IMMEDIATE: nothing is queued for a server that is not there."""
    return _make(context, zmq.PUSH, {**_CONNECTING, zmq.SNDHWM: 10}, keys)


def pull(context: "zmq.Context[Any]", max_frame_bytes: int, keys: ServerKeys | None = None) -> AnySocket:
    """The server's data socket; a larger frame is dropped with its connection before it is in memory."""
    return _make(context, zmq.PULL, {**_ANY, zmq.RCVHWM: 16, zmq.MAXMSGSIZE: max_frame_bytes}, keys)


def dealer(context: "zmq.Context[Any]", keys: ClientKeys | None = None) -> AnySocket:
    """The scanner's control socket. IMMEDIATE: greetings do not pile up for a server that is not there."""
    return _make(context, zmq.DEALER, {**_CONNECTING, zmq.SNDHWM: 100, zmq.RCVHWM: 1000}, keys)


def router(context: "zmq.Context[Any]", keys: ServerKeys | None = None) -> AnySocket:
    """The server's control socket."""
    limits: dict[int, int] = {zmq.SNDHWM: 1000, zmq.RCVHWM: 100, zmq.MAXMSGSIZE: CONTROL_MAX_BYTES}
    return _make(context, zmq.ROUTER, {**_ANY, **limits}, keys)


def publisher(context: "zmq.Context[Any]", keys: ServerKeys | None = None) -> AnySocket:
    """The server's mesh updates; a slow viewer misses some, never holds the server up."""
    limits: dict[int, int] = {zmq.SNDHWM: 16, zmq.MAXMSGSIZE: TOPIC_MAX_BYTES}
    return _make(context, zmq.XPUB, {**_ANY, **limits}, keys)


def mesh_topic(map_name: str) -> bytes:
    """Topic of a map's mesh updates. No map's topic is the beginning of another map's."""
    return _MESH_TOPIC + map_name.encode() + b"/"


def is_mesh_topic(topic: bytes) -> bool:
    """Whether a subscription is for the updates of one map or of all maps; no other is allowed."""
    return _MESH_TOPIC.startswith(topic) or _MAPS_TOPIC.fullmatch(topic) is not None


def subscriber(
    context: "zmq.Context[Any]", keys: ClientKeys | None = None, *, map_name: str = DEFAULT_MAP
) -> AnySocket:
    """A viewer's socket for a map's updates: topic, `Meshed`, cells (n, 3) int32, then a mesh's frames.

    The triangles replace all earlier ones in these cells (blocks of 8³ voxels).
    """
    made = _make(context, zmq.SUB, {**_CONNECTING, zmq.IMMEDIATE: 0, zmq.RCVHWM: 16}, keys)
    made.setsockopt(zmq.SUBSCRIBE, mesh_topic(map_name))
    return made


def pose_feed(context: "zmq.Context[Any]", max_frame_bytes: int) -> AnySocket:
    """A scanner's socket for the poses of another process; a flood of them fills its queue and no more."""
    limits: dict[int, int] = {zmq.IMMEDIATE: 0, zmq.RCVHWM: 256, zmq.MAXMSGSIZE: max_frame_bytes}
    made = _make(context, zmq.SUB, {**_CONNECTING, **limits})
    made.setsockopt(zmq.SUBSCRIBE, b"")
    return made


def pair(context: "zmq.Context[Any]") -> AnySocket:
    """The socket between gateway and fuser, over a file that only this user can open."""
    return _make(context, zmq.PAIR, {zmq.SNDHWM: 64, zmq.RCVHWM: 64})


def _make(
    context: "zmq.Context[Any]",
    kind: int,
    options: dict[int, int],
    keys: ServerKeys | ClientKeys | None = None,
) -> AnySocket:
    made: AnySocket = context.socket(kind)
    made.setsockopt(zmq.LINGER, 0)
    for option, value in options.items():
        made.setsockopt(option, value)
    if keys is not None:
        keys.secure(made)
    return made


def peer_address(frame: zmq.Frame) -> str:
    """Address of the machine that sent a frame; empty where ZeroMQ does not know it."""
    try:
        return str(frame.get("Peer-Address"))
    except zmq.ZMQError:
        return ""


def file_of(frame: zmq.Frame) -> int | None:
    """File number of the connection over which a frame came; None where ZeroMQ does not know it."""
    try:
        return int(frame.get(zmq.SRCFD))
    except (zmq.ZMQError, ValueError):
        return None


def parse_address(address: str) -> tuple[str, int]:
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


def format_address(host: str, port: int) -> str:
    """`tcp://host:port`."""
    return f"tcp://[{host}]:{port}" if ":" in host else f"tcp://{host}:{port}"


def control_address(address: str, control: str | None = None) -> str:
    """The control address of a server: `control` if given, else the port after that of the data address."""
    if control is not None:
        return format_address(*parse_address(control))
    return _next_port(address, "control")


def _next_port(address: str, purpose: str) -> str:
    host, port = parse_address(address)
    if port == LAST_PORT:
        raise InvalidConfig(f"{address} has no next port for {purpose}: choose a lower one")
    return format_address(host, port + 1)


def connect_address(address: str) -> str:
    """Check an address to connect to; returns its plain form. Raises InvalidConfig."""
    host, port = parse_address(address)
    if port == 0:
        raise InvalidConfig(f"connecting needs a port, got {address}")
    return format_address(host, port)


def check_reachable(address: str, *, has_keys: bool) -> None:
    """Raise InvalidConfig when other machines can reach the address and there are no keys."""
    if has_keys or is_loopback(parse_address(address)[0]):
        return
    raise InvalidConfig(
        f"without keys the server listens on tcp://127.0.0.1 only, got {address}; run `tsfusion keys new "
        "server` here and `tsfusion keys new NAME` on the scanner, let that in by `tsfusion keys allow NAME "
        "NAME.key`, and serve with `--keys tsfusion-keys`; or have scanners come through "
        "`ssh -L 5555:127.0.0.1:5555 -L 5556:127.0.0.1:5556 host`"
    )


def check_own_machine(address: str) -> None:
    """Raise InvalidConfig when other machines can reach the address."""
    if not is_loopback(parse_address(address)[0]):
        raise InvalidConfig(
            f"there are no keys here, so that only tcp://127.0.0.1 can be bound, got {address}; let the "
            "sender bind, or come through an ssh tunnel"
        )


def is_loopback(host: str) -> bool:
    """Whether a host, name or number, is this machine."""
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False


def check_free(address: str) -> None:
    """Raise TransportError when a server could not listen on an address; no port is opened for that."""
    host, port = parse_address(address)
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host.replace("*", ""), port))
        except OSError as error:
            raise TransportError(
                f"cannot listen on {address}: {error.strerror}; choose another address (--listen), or end "
                "what has it"
            ) from error


def bind(data: AnySocket, control: AnySocket, publish: AnySocket, listen: str, to: str | None) -> Addresses:
    """Bind a server's three sockets: `listen`, `to` (default: the next port), and the one after that.

    Raises:
        TransportError: when a port is taken (a random one is drawn again until its neighbours are free).
    """
    host, port = parse_address(listen)
    tries = _RANDOM_PORT_TRIES if port == 0 else 1
    for last in reversed(range(tries)):
        bound: list[tuple[AnySocket, str]] = []
        try:
            bound.append((data, bind_socket(data, format_address(host, port))))
            bound.append((control, bind_socket(control, control_address(bound[0][1], to))))
            bound.append((publish, bind_socket(publish, _next_port(bound[1][1], "mesh updates"))))
            return Addresses(*(address for _, address in bound))
        except (TransportError, InvalidConfig):
            for made, address in bound:
                made.unbind(address)
            if not last:
                raise
    raise AssertionError("the last try returns or raises")


def bind_socket(made: AnySocket, address: str) -> str:
    """Bind a socket; returns its address with the real port number. Raises TransportError."""
    host, port = parse_address(address)
    try:
        made.bind(format_address(host, port) if port else format_address(host, 0).replace(":0", ":*"))
    except zmq.ZMQError as error:
        raise TransportError(
            f"cannot listen on {address}: {error.strerror}; choose another address (--listen), or end "
            "what has it"
        ) from error
    return made.getsockopt_string(zmq.LAST_ENDPOINT)
