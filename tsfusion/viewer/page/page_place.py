# SPDX-License-Identifier: MIT
"""The place where a page is served, and whether one can be; told without loading a web server."""

import socket
from importlib.util import find_spec

from tsfusion.core.errors import InvalidConfig, MissingDependency, TransportError
from tsfusion.viewer import LISTEN
from tsfusion.wire.sockets import sockets

_INSTALL = "the live page needs viser; install it with: pip install '.[viewer]' in your clone of tsfusion"


def check_installed() -> None:
    """Raise MissingDependency where viser is not installed, without loading it."""
    if find_spec("viser") is None:
        raise MissingDependency(_INSTALL)


def parse_place(text: str) -> tuple[str, int]:
    """Host and port of `HOST:PORT`; an IPv6 address stands in brackets.

    Raises:
        InvalidConfig: for anything else.
    """
    try:
        host, port = sockets.parse_address(f"tcp://{text}")
    except InvalidConfig:
        raise InvalidConfig(
            f"a page listens at HOST:PORT, such as {LISTEN}, of IPv6 [::1]:5558, port 0 = a free one; "
            f"got {text!r}"
        ) from None
    return host.replace("*", "0.0.0.0"), port


def listen(host: str, port: int) -> socket.socket:
    """A socket that listens there; port 0 = a free one.

    Raises:
        TransportError: when the port is taken, or there is no such address here.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    both = host == "::" and socket.has_dualstack_ipv6()
    try:
        return socket.create_server((host, port), family=family, dualstack_ipv6=both)
    except OSError as error:
        place = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
        why = (error.strerror or str(error)).partition(" (while")[0]
        raise TransportError(
            f"cannot show a page at {place}: {why}; choose another place, such as "
            "127.0.0.1:0 (a free port), or end what has it"
        ) from error
