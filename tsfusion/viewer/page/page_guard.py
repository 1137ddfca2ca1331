# SPDX-License-Identifier: MIT
"""Guard a page: check the Host, Origin and token of each request; parse and open the page's address.

A foreign web page can make a browser send requests to this machine, and a foreign name can resolve to it. So
Host must name this server, and the Origin of a WebSocket must be that Host. If other machines can reach the
page, the first visit needs a token in its address; afterwards a cookie replaces the token.
"""

import hashlib
import hmac
import re
import secrets
import socket
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from importlib.util import find_spec
from ipaddress import ip_address
from typing import NamedTuple, Protocol
from urllib.parse import parse_qs

from tsfusion.core.errors import InvalidConfig, MissingDependency, TransportError
from tsfusion.viewer import LISTEN
from tsfusion.wire.sockets import sockets
from tsfusion.wire.sockets.sockets import is_loopback

_TOKEN = re.compile(r"[\w.~-]{8,128}", re.ASCII)  # as written in an address
_HOST = re.compile(r"(?:\[(?P<host6>[0-9A-Fa-f:.]+)\]|(?P<host>[\w.-]+))(?::[0-9]{1,5})?", re.ASCII)
_ANY = ("0.0.0.0", "::")
_FARAWAY = "192.0.2.1"  # an address of no machine (RFC 5737)
_NEEDS = {  # extra → what needs which packages
    "viewer": ("the live page", ("viser",)),
    "foxglove": ("Foxglove", ("foxglove", "websockets")),
}


class Headers(Protocol):
    def get_all(self, key: str) -> list[str]: ...


class Refusal(NamedTuple):
    """HTTP answer to a refused request, with the reason in one word."""

    reason: str
    status: HTTPStatus
    text: str


class PageGuard:
    """Check of each request to a web page: host, origin and token.

    Args:
        host: the page's address: a name or number.
        port: its real port.
        token: 8 to 128 letters, digits and . _ ~ -; None = a random token if other machines can reach the
            page, else no token.
        scheme: http, or ws for a server without pages.
        apps: origins of pages that are not of this server but may use it. So may programs, which have no
            Origin or one of another scheme, pages of this machine, and who has the token.

    Attributes:
        token: the required token; None = no token is needed.
        url: address to open the page with, token included.

    Raises InvalidConfig for a bad token.
    """

    def __init__(
        self,
        host: str,
        port: int,
        token: str | None = None,
        *,
        scheme: str = "http",
        apps: tuple[str, ...] = (),
    ) -> None:
        if token is not None and not _TOKEN.fullmatch(token):
            raise InvalidConfig("a token is 8 to 128 letters, digits and . _ ~ -")
        is_private = is_loopback(host)
        if token is None and not is_private:
            token = secrets.token_urlsafe(18)
        self.token = token
        self._secret = hashlib.sha256(f"tsfusion page {token}".encode()).hexdigest()
        self._cookie = f"tsfusion-{port}"  # browsers share cookies among the ports of a host
        self._is_any, self._apps = host in _ANY, apps
        self._names = {"localhost", host.lower()} | (set() if is_private else _own_names())
        shown = _own_address(host) if self._is_any else host
        place = f"[{shown}]:{port}" if ":" in shown else f"{shown}:{port}"
        self.url = f"{scheme}://{place}" + (f"/?token={token}" if token is not None else "")

    def refusal(self, path: str, headers: Headers) -> Refusal | None:
        """Return the refusal of a request, or None if it is accepted."""
        hosts, origins = headers.get_all("Host"), headers.get_all("Origin")
        if len(hosts) != 1 or not self._is_own(hosts[0]):
            return Refusal(
                "host",
                HTTPStatus.FORBIDDEN,
                "open this page at the address that `tsfusion view` has printed, or at localhost by `ssh -L`",
            )
        if not (self.is_given(path) and self._apps) and not self._may_use(origins, hosts[0], headers):
            return Refusal("origin", HTTPStatus.FORBIDDEN, "another page may not use this one")
        if self.token is not None and not (self.is_given(path) or self._has_cookie(headers)):
            return Refusal(
                "token",
                HTTPStatus.FORBIDDEN,
                "this page needs its token: open the address that `tsfusion view` has printed",
            )
        return None

    def is_given(self, path: str) -> bool:
        """Return True if the requested address contains the required token."""
        if self.token is None:
            return False
        given = parse_qs(path.partition("?")[2]).get("token", [""])[0]
        return hmac.compare_digest(given.encode(errors="surrogateescape"), self.token.encode())

    def answer_headers(self, path: str, headers: Headers) -> dict[str, str]:
        """Return HTTP headers for the answer to an accepted request; they forbid content from other hosts."""
        (host,) = headers.get_all("Host")
        policy = (
            "default-src 'self' data: blob: 'unsafe-inline' 'unsafe-eval'",
            f"connect-src 'self' data: blob: ws://{host} wss://{host}",
            *("object-src 'none'", "base-uri 'none'", "form-action 'none'", "frame-ancestors 'none'"),
        )
        found = {
            "Content-Security-Policy": "; ".join(policy),
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
            "Cache-Control": "no-store",
        }
        if self.is_given(path):
            found["Set-Cookie"] = f"{self._cookie}={self._secret}; Path=/; HttpOnly; SameSite=Strict"
        return found

    def _may_use(self, origins: list[str], host: str, headers: Headers) -> bool:
        """Return True if the program or page that sends the request may use this server."""
        if self._apps:
            return not origins or (len(origins) == 1 and _is_app(origins[0].lower(), self._apps))
        return not (origins or is_websocket(headers)) or _is_from(origins, host)

    def _is_own(self, host: str) -> bool:
        match = _HOST.fullmatch(host)
        if match is None:
            return False
        name = (match["host6"] or match["host"]).lower()
        if name in self._names:
            return True
        try:
            ip_address(name)
        except ValueError:  # an unknown name, which could belong to anybody
            return False
        return self._is_any or is_loopback(name)

    def _has_cookie(self, headers: Headers) -> bool:
        for line in headers.get_all("Cookie"):
            try:
                found = SimpleCookie(line).get(self._cookie)
            except CookieError:
                continue
            if found is not None and hmac.compare_digest(found.value.encode(), self._secret.encode()):
                return True
        return False


def is_websocket(headers: Headers) -> bool:
    return any("websocket" in value.lower() for value in headers.get_all("Upgrade"))


def _is_from(origins: list[str], host: str) -> bool:
    """Return True if the browser says that a page of `host` sends the request."""
    if len(origins) != 1:
        return False
    scheme, _, place = origins[0].lower().partition("://")
    return scheme in ("http", "https") and place == host.lower()


def _is_app(origin: str, apps: tuple[str, ...]) -> bool:
    """Return True for a known page, a page of this machine, or a program that is no web browser."""
    scheme, _, place = origin.partition("://")
    match = _HOST.fullmatch(place)
    name = "" if match is None else (match["host6"] or match["host"])
    is_web = scheme in ("http", "https")
    return origin in apps or (is_loopback(name) if is_web else scheme not in ("", "null"))


def _own_names() -> set[str]:
    name = socket.gethostname().lower()
    return {name, f"{name.partition('.')[0]}.local"} if name else set()


def _own_address(host: str) -> str:
    """Return an address of this machine for other machines, without sending anything on the network."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
            probe.connect((_FARAWAY, 9))
            return str(probe.getsockname()[0])
    except OSError:  # no network
        return "127.0.0.1" if family == socket.AF_INET else "::1"


def check_installed(extra: str = "viewer") -> None:
    """Raise MissingDependency if packages of an extra, `viewer` or `foxglove`, are missing. It loads none."""
    what, packages = _NEEDS[extra]
    if missing := [one for one in packages if find_spec(one) is None]:
        raise MissingDependency(
            f"{what} needs {missing[0].replace('foxglove', 'foxglove-sdk')}; "
            f"install it with: pip install '.[{extra}]' in your clone of tsfusion"
        )


def parse_place(text: str) -> tuple[str, int]:
    """Return host and port from `HOST:PORT`; an IPv6 address is in brackets.

    Raises:
        InvalidConfig: for anything else.
    """
    try:
        host, port = sockets.parse_address(f"tcp://{text}")
    except InvalidConfig:
        raise InvalidConfig(
            f"a map is shown at HOST:PORT, such as {LISTEN}, of IPv6 [::1]:5558, port 0 = a free one; "
            f"got {text!r}"
        ) from None
    return host.replace("*", "0.0.0.0"), port


def listen(host: str, port: int) -> socket.socket:
    """Return a socket that listens at an address; port 0 = a free port.

    Raises:
        TransportError: the port is taken, or this machine has no such address.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    both = host == "::" and socket.has_dualstack_ipv6()
    try:
        return socket.create_server((host, port), family=family, dualstack_ipv6=both)
    except OSError as error:
        place = f"[{host}]:{port}" if ":" in host else f"{host}:{port}"
        why = (error.strerror or str(error)).partition(" (while")[0]
        raise TransportError(
            f"cannot show a map at {place}: {why}; choose another place, such as "
            "127.0.0.1:0 (a free port), or end what has it"
        ) from error
