# SPDX-License-Identifier: MIT
"""Access control by keys and allow-list, for each new connection and again for each message; its sender."""

import logging
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import zmq
from zmq.utils import z85

from tsfusion.core.errors import InvalidConfig
from tsfusion.wire.keys.key_folder import ALL_MAPS, AllowedMaps, AllowList
from tsfusion.wire.sockets import sockets
from tsfusion.wire.sockets.curve import DOMAIN, ServerKeys, server_keys

log = logging.getLogger(__name__)


KEPT_OUT = 60.0  # seconds before a client that was cut off can connect again
GUEST = "(guest)"  # no client in an allow-list can have this name
SERVER = "(server)"  # likewise; another server of the fleet, with the same pair of keys


class AccessControl:
    """The allow-list of one server. Without a folder of keys, everybody who reaches the server can connect.

    Args:
        folder: the folder that `tsfusion keys` made; None without keys.
        guest: public key with the right to watch every map, and to send nothing, while this server runs.

    Attributes:
        keys: the server's own pair, for its sockets; None without a folder.
        refused: count of refused connections and messages by reason.

    Raises:
        InvalidConfig: when the folder has no usable keys or allow-list.
    """

    def __init__(self, folder: str | None, *, guest: str | None = None) -> None:
        self._guest = guest
        self.keys: ServerKeys | None = None
        self.refused: Counter[str] = Counter()
        self._allowed: AllowList | None = None
        self._revoked = False
        self._kept_out: dict[str, float] = {}  # client → until when (`time.monotonic()`)
        if folder is not None:
            self.keys = server_keys(folder)
            self._allowed = AllowList(Path(folder))
            if self._allowed.problem:  # an error at the start; later, nobody is let in
                raise InvalidConfig(self._allowed.problem)

    @property
    def problem(self) -> str:
        """Reason why nobody can connect; empty while the allow-list can be read."""
        return "" if self._allowed is None else self._allowed.problem

    def take_revoked(self) -> bool:
        """True if a key was revoked or has other maps since the last call: all must connect again."""
        if self._allowed is not None:
            self._revoked |= self._allowed.refresh()
        revoked, self._revoked = self._revoked, False
        return revoked

    def client_of(self, key: str | None) -> str | None:
        """Return the name of a sender's key: empty for a server without keys, None if it is not allowed."""
        if self._allowed is None:
            return ""
        self._revoked |= self._allowed.refresh()  # the file may have changed since the last step
        return None if key is None else self.name_of(key)

    def keep_out(self, key: str | None) -> str:
        """Block new connections of a client for a while. Return its name, empty without keys."""
        client = self.client_of(key) or ""
        if client:
            self._kept_out[client] = time.monotonic() + KEPT_OUT
        return client

    def name_of(self, key: str) -> str | None:
        """Return the name of a public key's client, or None if it may not connect."""
        if key == self._guest:
            return GUEST
        if self.keys is not None and key == self.keys.public:
            return SERVER
        name = None if self._allowed is None else self._allowed.name_of(key)
        return None if time.monotonic() < self._kept_out.get(name or "", 0.0) else name

    def why_not(self, key: str) -> str:
        """Return one word for the reason why a key may not connect."""
        assert self._allowed is not None
        return _KEPT_OUT_WORD if self._allowed.name_of(key) else self._allowed.rejection_reason(key)

    def maps_of(self, client: str) -> AllowedMaps:
        """Return the maps that a client can use: without keys, every map."""
        return (
            ALL_MAPS if self._allowed is None or client in (GUEST, SERVER) else self._allowed.maps_of(client)
        )

    def denial_of_map(self, client: str, map_name: str, *, sends: bool = False) -> str:
        """Return the reason why a client may not use a map, and count it; empty if it may."""
        maps = self.maps_of(client)
        if map_name in maps and not (sends and client == GUEST):
            return ""
        self.refused["forbidden"] += 1
        return "this key may only watch" if client == GUEST else maps.denial(map_name)

    def may_forget_all(self, client: str) -> bool:
        """True if a client has the right to forget keyframes of others. Without keys, everybody has it."""
        return self._allowed is None or client == SERVER or self._allowed.may_forget_all(client)


_ENDPOINT = "inproc://zeromq.zap.01"
_REQUESTS_A_STEP = 100
_LOG_EVERY = 60.0  # seconds in which each refusal is logged once, and only a few: keys cost nothing to make
_LOGGED_AT_MOST = 20
_KEY_BYTES = 32
_KEPT_OUT_WORD = "kept out"


class ZapHandler:
    """The authenticator of one ZeroMQ context (RFC 27, ZAP).

    Make it before the sockets with keys bind, and close it after them.

    Args:
        access: the allow-list, which also counts the refused connections.
    """

    def __init__(self, context: "zmq.Context[Any]", access: AccessControl) -> None:
        self._access = access
        self._logged: set[tuple[str, str]] = set()
        self._logged_since = 0.0
        self.socket: zmq.Socket[Any] = context.socket(zmq.ROUTER)
        self.socket.setsockopt(zmq.LINGER, 0)
        self.socket.bind(_ENDPOINT)

    def answer_all(self) -> None:
        """Answer a limited number of requests, so that other sockets get their turn. Never block."""
        for _ in range(_REQUESTS_A_STEP):
            try:
                frames = self.socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            self._answer(frames)

    def close(self) -> None:
        """Stop answering. Nobody can connect after that."""
        self.socket.close()

    def _answer(self, frames: Sequence[bytes]) -> None:
        """Answer a request: peer, "", version, number, domain, address, identity, mechanism, credentials."""
        if len(frames) < 4:  # nothing that an answer could refer to
            self._access.refused["malformed"] += 1
            return
        peer, delimiter, version, number, *request = frames
        if delimiter or version != b"1.0" or len(request) < 4:
            key, reason = "", "malformed"
        else:
            key, reason = self._judge(request)
        if reason:
            self._note(key, reason, request[1] if len(request) > 1 else b"")
        status = b"300" if reason == _KEPT_OUT_WORD else b"400"  # after 300, libzmq tries again
        verdict = [status, reason.encode(), b"", b""] if reason else [b"200", b"OK", key.encode(), b""]
        try:
            self.socket.send_multipart([peer, b"", b"1.0", number, *verdict], zmq.NOBLOCK)
        except zmq.ZMQError as error:  # the connection has ended meanwhile
            log.debug("an answer about a connection was not sent: %s", error)

    def _judge(self, request: Sequence[bytes]) -> tuple[str, str]:
        """Return a request's key, and the reason why it is refused; an empty reason allows it."""
        domain, _address, _identity, mechanism, *credentials = request
        if domain != DOMAIN:
            return "", "domain"
        if mechanism != b"CURVE":
            return "", "mechanism"
        if len(credentials) != 1 or len(credentials[0]) != _KEY_BYTES:
            return "", "malformed"
        key = z85.encode(credentials[0]).decode("ascii")
        return key, "" if self._access.name_of(key) is not None else self._access.why_not(key)

    def _note(self, key: str, reason: str, address: bytes) -> None:
        self._access.refused[reason] += 1
        now = time.monotonic()
        if now - self._logged_since > _LOG_EVERY:
            self._logged.clear()
            self._logged_since = now
        if (key, reason) not in self._logged and len(self._logged) < _LOGGED_AT_MOST:
            self._logged.add((key, reason))
            place = address[:64].decode("ascii", "replace")
            log.warning("a connection from %s is refused (%s): key %s", place, reason, key or "none")


def sender_of(frame: zmq.Frame) -> str | None:
    """Return the public key (40 characters) of the client that sent a frame, received with `copy=False`.

    Use it only for a socket with keys: a socket without keys believes any claim of the other side.
    """
    try:
        return str(frame.get("User-Id"))
    except (zmq.ZMQError, UnicodeDecodeError):
        return None


def peer_address(frame: zmq.Frame) -> str:
    """Return the address of the machine that sent a frame, or "" where ZeroMQ does not know it."""
    try:
        return str(frame.get("Peer-Address")).removeprefix(sockets.MAPPED)
    except zmq.ZMQError:
        return ""


def file_of(frame: zmq.Frame) -> int | None:
    """Return the file number of the connection that brought a frame, or None if ZeroMQ does not know it."""
    try:
        return int(frame.get(zmq.SRCFD))
    except (zmq.ZMQError, ValueError):
        return None
