# SPDX-License-Identifier: MIT
"""Reasons why a client has no connection, in words for a person.

libzmq's `send` succeeds while the server refuses the connection, so this watches libzmq's events instead.
Measured with libzmq 4.3.5:

| case | events |
|---|---|
| the server does not know the key, or it was revoked | HANDSHAKE_FAILED_AUTH, and no further try, ever |
| only one side has keys | HANDSHAKE_FAILED_NO_DETAIL a few times, then .._PROTOCOL, and no further try |
| the server keeps this client out for a while | as another key, or a frozen server |
| another server key than the server's | HANDSHAKE_FAILED_NO_DETAIL, again and again |
| nobody listens at the far end of a tunnel | HANDSHAKE_FAILED_NO_DETAIL, again and again |
| a frozen server | HANDSHAKE_FAILED_NO_DETAIL after HANDSHAKE_IVL, again and again |
| the other end is no ZeroMQ | DISCONNECTED, no further try; or HANDSHAKE_FAILED_NO_DETAIL again and again |
| bytes that are no message, after the handshake | DISCONNECTED, and no further try |
| nobody listens | CONNECT_RETRIED alone |
"""

import itertools
import shlex
import struct
import time
from typing import Any

import zmq

from tsfusion.wire.sockets import sockets
from tsfusion.wire.sockets.curve import ClientKeys

_EVENTS = (
    zmq.EVENT_CONNECTED
    | zmq.EVENT_CONNECT_RETRIED
    | zmq.EVENT_DISCONNECTED
    | zmq.EVENT_HANDSHAKE_SUCCEEDED
    | zmq.EVENT_HANDSHAKE_FAILED_AUTH
    | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
    | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
)
_MISMATCH = 0x11000002  # ZMQ_PROTOCOL_ERROR_ZMTP_MECHANISM_MISMATCH
_REFUSAL_S = 1.0  # a server that closes the connection later than this has not refused it, but is stuck
_MIN_FAILURES = 2  # a single failure may be a server that is ending
_RETRY_S = 0.5  # libzmq reports at once when it is going to try again
_KEEPS_OUT = "it keeps this client out for a minute (its log says why)"
_numbers = itertools.count()


class ConnectionMonitor:
    """Monitor of one connecting socket. Make it before `connect`, and close it before the socket.

    Attributes:
        socket: becomes readable after an event; then call `problem`, and also from time to time.
        connected: True while the connection exists and its handshake is done.
        connected_since: time of that handshake (`time.monotonic()`).
        made: number of connections made so far. When it rises, messages on earlier connections may be lost:
            send them again then, not before.
        retrying: True if the last attempt to connect found nobody.
        lost: number of connections that were made and have ended.
        gave_up: True if libzmq will never try again: close the socket and make another.
        refused: True if the server has certainly refused this client.
    """

    def __init__(self, socket: "zmq.Socket[Any]", address: str, keys: ClientKeys | None = None) -> None:
        self.connected = False
        self.connected_since = 0.0
        self.made = 0
        self.retrying = False
        self.lost = 0
        self.gave_up = False
        self.refused = False
        self.address = address
        self._watched = socket
        self._key = keys.public if keys else ""
        self._connected_at = 0.0
        self._ended_at = 0.0  # 0 = connected, or about to be
        self._failures = 0
        # A name of its own: pyzmq names the endpoint by a file descriptor, which may be in use again.
        endpoint = f"inproc://tsfusion-monitor-{next(_numbers)}"
        socket.monitor(endpoint, _EVENTS)
        self.socket: zmq.Socket[Any] = socket.context.socket(zmq.PAIR)
        self.socket.setsockopt(zmq.LINGER, 0)
        self.socket.setsockopt(zmq.RCVHWM, 0)  # a full one would hold up all connections of the context
        self.socket.connect(endpoint)

    def close(self) -> None:
        if not self._watched.closed:
            self._watched.disable_monitor()
        self.socket.close()

    def problem(self) -> str | None:
        """Return the reason why there is no connection. It is "" once connected, None without news."""
        news: str | None = None
        while sockets.has_message(self.socket):
            head, _endpoint = self.socket.recv_multipart(zmq.NOBLOCK)
            event, value = struct.unpack("=HI", head)
            problem = self._handle_event(event, value)
            news = news if problem is None else problem
        if self._ended_at and not self.gave_up and time.monotonic() - self._ended_at > _RETRY_S:
            self.gave_up = True
            news = f"what answers at {self.address} is no tsfusion server, or was garbled on the way"
        return news

    def _handle_event(self, event: int, value: int) -> str | None:
        if event == zmq.EVENT_CONNECTED:
            self._connected_at, self._ended_at, self.retrying = time.monotonic(), 0.0, False
        elif event == zmq.EVENT_CONNECT_RETRIED:
            self._ended_at, self.retrying = 0.0, True
        elif event == zmq.EVENT_HANDSHAKE_SUCCEEDED:
            self.connected, self.refused, self._failures = True, False, 0
            self.connected_since = time.monotonic()
            self.made += 1
            return ""
        elif event == zmq.EVENT_DISCONNECTED:
            self.lost += self.connected
            self.connected = False
            self._ended_at = time.monotonic()
        elif event == zmq.EVENT_HANDSHAKE_FAILED_AUTH:
            self.refused = self.gave_up = True
            return self._unknown_key()
        elif event == zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL:
            self.gave_up = True
            self.refused = value == _MISMATCH
            if self.refused:
                return self._keys_on_one_side()
            return f"what answers at {self.address} is no tsfusion server"
        else:
            return self._handshake_failed()
        return None

    def _handshake_failed(self) -> str | None:
        if time.monotonic() - self._connected_at > _REFUSAL_S:
            stuck = f"the server at {self.address} takes the connection, but says nothing"
            return f"{stuck}: it is stuck, or {_KEEPS_OUT}" if self._key else stuck
        self._failures += 1
        if self._failures < _MIN_FAILURES:
            return None
        if self._key:
            return (
                f"{self.address} ends the connection before the keys are agreed on: the server's key is not "
                f"the one given (`tsfusion keys list` shows it there), {_KEEPS_OUT}, "
                "or nobody listens behind a tunnel"
            )
        return (
            f"{self.address} ends the connection at once: nobody listens behind a tunnel, or the server asks "
            "for keys and this client has none"
        )

    def _unknown_key(self) -> str:
        key = shlex.quote(self._key)
        key = f"-- {key}" if self._key.startswith("-") else key  # no option
        return (
            f"the server at {self.address} does not know this client's key {self._key} (or it was revoked): "
            f"on the server, run `tsfusion keys allow NAME {key}`"
        )

    def _keys_on_one_side(self) -> str:
        if self._key:
            return (
                f"this client has keys, but the server at {self.address} was started without: leave them out"
            )
        return (
            f"the server at {self.address} takes only connections with keys: make a pair by `tsfusion keys "
            "new NAME` and give both it and the server's public key (--key, --server-key)"
        )
