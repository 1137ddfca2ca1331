# SPDX-License-Identifier: MIT
"""A CurveZMQ client by hand (ZeroMQ RFC 26), for lies that libzmq's own client does not tell."""

import ctypes
import ctypes.util
import os
import socket
import struct
from pathlib import Path

import pytest
import zmq
from zmq.utils import z85

from tsfusion.wire.sockets.curve import ClientKeys
from tsfusion.wire.sockets.sockets import parse_address

_TIMEOUT = 10.0
_MAC, _KEY, _COOKIE = 16, 32, 96
_GREETING = b"\xff" + bytes(7) + b"\x01\x7f\x03\x00" + b"CURVE".ljust(20, b"\0") + bytes(32)


def _sodium() -> ctypes.CDLL:
    """The library that pyzmq's wheel brings, or the system's."""
    bundled = sorted(Path(zmq.__file__).parents[1].glob("pyzmq.libs/libsodium*"))
    name = str(bundled[0]) if bundled else ctypes.util.find_library("sodium")
    if name is None:
        pytest.skip("no libsodium beside pyzmq or in the system")
    return ctypes.CDLL(name)


def _shut(text: bytes, nonce: bytes, public: bytes, secret: bytes) -> bytes:
    """`crypto_box`."""
    box = ctypes.create_string_buffer(len(text) + _MAC)
    assert _sodium().crypto_box_easy(box, text, ctypes.c_ulonglong(len(text)), nonce, public, secret) == 0
    return box.raw


def _opened(box: bytes, nonce: bytes, public: bytes, secret: bytes) -> bytes:
    text = ctypes.create_string_buffer(len(box) - _MAC)
    done = _sodium().crypto_box_open_easy(text, box, ctypes.c_ulonglong(len(box)), nonce, public, secret)
    assert done == 0, "the box was shut with other keys"
    return text.raw


def property_of(name: bytes, value: bytes) -> bytes:
    return bytes([len(name)]) + name + struct.pack(">I", len(value)) + value


class Peer:
    """A connection as a PUSH socket's, up to where the server takes it; then `send`.

    Args:
        keys: whose keys.
        claims: properties to add to the handshake's metadata.
        poses_as: another's public key to show, which our own secret key vouches for.
    """

    def __init__(
        self, address: str, keys: ClientKeys, claims: dict[bytes, bytes], poses_as: str | None = None
    ) -> None:
        self._socket = socket.create_connection(parse_address(address), _TIMEOUT)
        self._number = 0
        secret, server = z85.decode(keys.secret), z85.decode(keys.server)
        shown = z85.decode(poses_as or keys.public)
        public_once, secret_once = map(z85.decode, zmq.curve_keypair())
        self._socket.sendall(_GREETING)
        self._receive(len(_GREETING))

        number = self._next()
        box = _shut(bytes(64), b"CurveZMQHELLO---" + number, server, secret_once)
        self._command(b"\x05HELLO\x01\x00" + bytes(72) + public_once + number + box)

        welcome = self._answer(b"\x07WELCOME")
        opened = _opened(welcome[16:], b"WELCOME-" + welcome[:16], server, secret_once)
        self._server_once, cookie = opened[:_KEY], opened[_KEY:]
        self._secret_once = secret_once

        salt, number = os.urandom(16), self._next()
        vouch = salt + _shut(public_once + server, b"VOUCH---" + salt, self._server_once, secret)
        properties = {b"Socket-Type": b"PUSH", b"Identity": b"", **claims}
        metadata = b"".join(property_of(*one) for one in properties.items())
        nonce = b"CurveZMQINITIATE" + number
        box = _shut(shown + vouch + metadata, nonce, self._server_once, secret_once)
        self._command(b"\x08INITIATE" + cookie + number + box)
        self.answered = self._receive(2)  # flags and size of READY or ERROR; empty = the server hung up

    @property
    def taken(self) -> bool:
        """Finish the handshake; False unless the server answers READY."""
        if not self.answered:
            return False
        return self._receive(self.answered[1])[1:6] == b"READY"

    def send(self, text: bytes) -> None:
        """Send a message of one frame."""
        number = self._next()
        box = _shut(b"\0" + text, b"CurveZMQMESSAGEC" + number, self._server_once, self._secret_once)
        self._socket.sendall(b"\x00" + bytes([16 + len(box)]) + b"\x07MESSAGE" + number + box)

    def close(self) -> None:
        self._socket.close()

    def _next(self) -> bytes:
        self._number += 1
        return struct.pack(">Q", self._number)

    def _command(self, body: bytes) -> None:
        size = bytes([4, len(body)]) if len(body) < 256 else b"\x06" + struct.pack(">Q", len(body))
        self._socket.sendall(size + body)

    def _answer(self, name: bytes) -> bytes:
        flags, size = self._receive(2)
        assert flags == 4
        body = self._receive(size)
        assert body.startswith(name)
        return body[len(name) :]

    def _receive(self, count: int) -> bytes:
        """So many bytes; fewer when the server hangs up."""
        got = b""
        while len(got) < count:
            try:
                part = self._socket.recv(count - len(got))
            except ConnectionResetError:
                return b""
            if not part:
                return b""
            got += part
        return got
