# SPDX-License-Identifier: MIT
"""ZeroMQ sockets with their limits and keys: all sockets of the package are made here.

No socket uses ZeroMQ heartbeats: a full PULL stops reading them and drops live connections (libzmq #3937). No
socket lingers: keyframes that must survive are in the spool.
"""

import os
import re
import socket
from contextlib import ExitStack
from ipaddress import IPv4Address, IPv6Address, ip_address
from typing import Any

import zmq
from msgspec import Struct

from tsfusion.core.errors import InvalidConfig, TransportError, refusals_as
from tsfusion.wire.sockets.curve import ClientKeys, ServerKeys

CONTROL_MAX_BYTES = 64 << 10
# HANDSHAKE_IVL (ms): a connection without a handshake is closed after it. The other options end a connection
# whose other end has disappeared. An idle one is probed after KEEPALIVE_IDLE, then each KEEPALIVE_INTVL
# (seconds); it ends after KEEPALIVE_CNT lost probes. TCP_MAXRT (ms): sent bytes stay so long unanswered.
_LISTENING: dict[int, int] = {
    zmq.HANDSHAKE_IVL: 5000,
    zmq.TCP_MAXRT: 30_000,
    zmq.TCP_KEEPALIVE: 1,
    zmq.TCP_KEEPALIVE_IDLE: 10,
    zmq.TCP_KEEPALIVE_INTVL: 5,
    zmq.TCP_KEEPALIVE_CNT: 3,
}
_CONNECTING: dict[int, int] = {
    zmq.IMMEDIATE: 1,
    zmq.RECONNECT_IVL: 100,
    zmq.RECONNECT_IVL_MAX: 1000,  # ms
    zmq.CONNECT_TIMEOUT: 3000,
    zmq.HANDSHAKE_IVL: 3000,
    zmq.TCP_MAXRT: 5000,
    zmq.TCP_KEEPALIVE: 1,
    zmq.TCP_KEEPALIVE_IDLE: 2,
    zmq.TCP_KEEPALIVE_INTVL: 1,
    zmq.TCP_KEEPALIVE_CNT: 3,
}
_CONTEXT_FILES = 8  # files that libzmq opens for a context, and a few more
_RANDOM_PORT_TRIES = 32
LAST_PORT = 65535
_HOST6 = r"[0-9A-Fa-f]*:[0-9A-Fa-f:.]*(%[\w.-]+)?"
_PORT = r"[0-9]{1,5}|\*"
_ADDRESS = re.compile(rf"tcp://((?P<host>[\w.*-]+)|\[(?P<host6>{_HOST6})\]):(?P<port>{_PORT})", re.ASCII)
MAPPED = "::ffff:"  # in front of an IPv4 address, where a socket takes both

AnySocket = zmq.Socket[Any]


class Addresses(Struct, frozen=True):
    """Addresses on which a server listens, with the real port numbers."""

    data: str
    control: str


def check_context() -> None:
    """Raise OSError if too few files can be opened for a context: libzmq would end this process."""
    with ExitStack() as tried:
        for _ in range(_CONTEXT_FILES):
            tried.enter_context(open(os.devnull))


def open_context() -> "zmq.Context[Any]":
    """Open a context for a few sockets.

    Raises:
        TransportError: when too few files can be opened for it.
    """
    with refusals_as(TransportError, "cannot open a socket"):
        check_context()
        return zmq.Context()


def push(context: "zmq.Context[Any]", keys: ClientKeys | None = None) -> AnySocket:
    """Make the scanner's data socket. IMMEDIATE: nothing is queued for a server that is not there."""
    return _make(context, zmq.PUSH, {**_CONNECTING, zmq.SNDHWM: 10}, keys)


def pull(context: "zmq.Context[Any]", max_frame_bytes: int, keys: ServerKeys | None = None) -> AnySocket:
    """Make the server's data socket. A frame over the limit drops its connection before it is in memory."""
    return _make(context, zmq.PULL, {**_LISTENING, zmq.RCVHWM: 16, zmq.MAXMSGSIZE: max_frame_bytes}, keys)


def dealer(context: "zmq.Context[Any]", keys: ClientKeys | None = None) -> AnySocket:
    """Make the scanner's control socket. IMMEDIATE: no greetings pile up for a server that is not there."""
    return _make(context, zmq.DEALER, {**_CONNECTING, zmq.SNDHWM: 100, zmq.RCVHWM: 1000}, keys)


def router(context: "zmq.Context[Any]", keys: ServerKeys | None = None) -> AnySocket:
    """Make the server's control socket."""
    limits: dict[int, int] = {zmq.SNDHWM: 1000, zmq.RCVHWM: 100, zmq.MAXMSGSIZE: CONTROL_MAX_BYTES}
    return _make(context, zmq.ROUTER, {**_LISTENING, **limits}, keys)


def pose_feed(context: "zmq.Context[Any]", max_frame_bytes: int) -> AnySocket:
    """Make a scanner's socket for the poses of another process. A flood of poses fills only its queue."""
    limits: dict[int, int] = {zmq.IMMEDIATE: 0, zmq.RCVHWM: 256, zmq.MAXMSGSIZE: max_frame_bytes}
    made = _make(context, zmq.SUB, {**_CONNECTING, **limits})
    made.setsockopt(zmq.SUBSCRIBE, b"")
    return made


def pair(context: "zmq.Context[Any]") -> AnySocket:
    """Make the socket between gateway and fuser, over a file that only this user can open."""
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


def has_message(made: AnySocket) -> bool:
    """True if a message can be read at once. This check costs a tenth of an exception."""
    waiting: Any = made.getsockopt(zmq.EVENTS)
    return bool(waiting & zmq.POLLIN)


def parse_address(address: str) -> tuple[str, int]:
    """Return host and port of `tcp://host:port` (port `*` or 0 = random). An IPv6 address is in brackets.

    Raises:
        InvalidConfig: for anything else.
    """
    match = _ADDRESS.fullmatch(address)
    port = LAST_PORT + 1 if match is None else int(match["port"].replace("*", "0"))
    if match is None or port > LAST_PORT or (match["host6"] and _ip(match["host6"]) is None):
        raise InvalidConfig(
            f"an address looks like tcp://127.0.0.1:5555, of IPv6 tcp://[::1]:5555, got {address!r}"
        )
    host = match["host"] or match["host6"]
    if (found := _ip(host)) is not None and found.version == 6 and found.is_link_local and "%" not in host:
        raise InvalidConfig(
            f"a link-local address names its interface, as in tcp://[fe80::1%eth0]:5555, got {address!r}"
        )
    return host, port


def _ip(host: str) -> IPv4Address | IPv6Address | None:
    """Return the address if a host is a number, else None. An IPv4 address in IPv6 form becomes IPv4."""
    try:
        found = ip_address(host)
    except ValueError:
        return None
    return getattr(found, "ipv4_mapped", None) or found


def is_name(address: str) -> bool:
    """True if the host of an address is a name, which may stand for an IPv4 and an IPv6 address."""
    return _ip(parse_address(address)[0]) is None


def connect(made: AnySocket, address: str, *, named_ipv6: bool = False) -> None:
    """Connect a socket.

    Args:
        named_ipv6: for a host name, take the IPv6 address; libzmq tries only one of the two.
    """
    host, port = parse_address(address)
    if named_ipv6 and host == "localhost":
        host = "::1"  # also where the system's list of names lacks it
    made.setsockopt(zmq.IPV6, ":" in host or (named_ipv6 and _ip(host) is None))
    made.connect(format_address(host, port))


def format_address(host: str, port: int) -> str:
    """`tcp://host:port`."""
    return f"tcp://[{host}]:{port}" if ":" in host else f"tcp://{host}:{port}"


def control_address(address: str, control: str | None = None) -> str:
    """Return the control address of a server: `control`, or the port after the data address."""
    if control is not None:
        return format_address(*parse_address(control))
    host, port = parse_address(address)
    if port == LAST_PORT:
        raise InvalidConfig(f"{address} has no next port for control: choose a lower one")
    return format_address(host, port + 1)


def connect_address(address: str) -> str:
    """Check an address to connect to. Return it in plain form. Raise InvalidConfig."""
    host, port = parse_address(address)
    if port == 0:
        raise InvalidConfig(f"connecting needs a port, got {address}")
    return format_address(host, port)


def check_reachable(address: str, *, has_keys: bool) -> None:
    """Raise InvalidConfig if other machines can reach the address, and there are no keys."""
    if has_keys or is_loopback(parse_address(address)[0]):
        return
    raise InvalidConfig(
        f"without keys the server listens on tcp://127.0.0.1 only, got {address}; run `tsfusion keys new "
        "server` here and `tsfusion keys new NAME` on the scanner, let that in by `tsfusion keys allow NAME "
        "NAME.key`, and serve with `--keys tsfusion-keys`; or have scanners come through "
        "`ssh -L 5555:127.0.0.1:5555 -L 5556:127.0.0.1:5556 host`"
    )


def check_own_machine(address: str) -> None:
    """Raise InvalidConfig if other machines can reach the address."""
    if not is_loopback(parse_address(address)[0]):
        raise InvalidConfig(
            f"there are no keys here, so that only tcp://127.0.0.1 can be bound, got {address}; let the "
            "sender bind, or come through an ssh tunnel"
        )


def is_loopback(host: str) -> bool:
    """True if a host, name or number, is this machine."""
    found = _ip(host)
    return host == "localhost" if found is None else found.is_loopback


def check_free(address: str) -> None:
    """Raise TransportError if a server cannot listen on an address. The port is only tried, not kept."""
    host, port = parse_address(address)
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            place = socket.getaddrinfo(host.replace("*", "0.0.0.0"), port, family)[0][-1]
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(place)
    except OSError as error:
        raise TransportError(
            f"cannot listen on {address}: {error.strerror}; choose another address (--listen), or end "
            "what has it"
        ) from error


def bind(data: AnySocket, control: AnySocket, listen: str, to: str | None) -> Addresses:
    """Bind a server's two sockets: `listen`, and `to` (default: the next port).

    Raises:
        TransportError: when a port is taken. A random port is drawn again until its neighbour is free.
    """
    host, port = parse_address(listen)
    tries = _RANDOM_PORT_TRIES if port == 0 else 1
    for last in reversed(range(tries)):
        bound = ""
        try:
            bound = bind_socket(data, format_address(host, port))
            return Addresses(bound, bind_socket(control, control_address(bound, to)))
        except (TransportError, InvalidConfig):
            if bound:
                data.unbind(bound)
            if not last:
                raise
    raise AssertionError("the last try returns or raises")


def bind_socket(made: AnySocket, address: str) -> str:
    """Bind a socket. Return its address with the real port number. Raise TransportError.

    `[::]` takes connections over IPv6 and IPv4, `*` and `0.0.0.0` over IPv4 alone.
    """
    host, port = parse_address(address)
    try:
        made.setsockopt(zmq.IPV6, ":" in host)
        made.bind(format_address(host, port) if port else format_address(host, 0).replace(":0", ":*"))
    except zmq.ZMQError as error:
        raise TransportError(
            f"cannot listen on {address}: {error.strerror}; choose another address (--listen), or end "
            "what has it"
        ) from error
    return made.getsockopt_string(zmq.LAST_ENDPOINT)
