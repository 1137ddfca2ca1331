# SPDX-License-Identifier: MIT
"""Asking the metrics page, as a program or by hand."""

import http.client
import socket
from contextlib import suppress

DEADLINE = 30.0


def get(
    address: str, path: str, *, method: str = "GET", headers: dict[str, str] | None = None
) -> tuple[int, str, http.client.HTTPMessage]:
    """Status, body and headers of an answer."""
    host, _, port = address.rpartition(":")
    connection = http.client.HTTPConnection(host.strip("[]"), int(port), timeout=DEADLINE)
    try:
        connection.request(method, path, headers=headers or {})
        answer = connection.getresponse()
        return answer.status, answer.read().decode(), answer.headers
    finally:
        connection.close()


def connection(address: str) -> socket.socket:
    host, _, port = address.rpartition(":")
    return socket.create_connection((host.strip("[]"), int(port)), timeout=DEADLINE)


def raw(address: str, sent: bytes) -> bytes:
    """Read until the other end closes."""
    with connection(address) as link:
        link.sendall(sent)
        answer = b""
        with suppress(ConnectionResetError):
            while piece := link.recv(65536):
                answer += piece
        return answer
