# SPDX-License-Identifier: MIT
"""The page that figures and health checks are on, met by peers good and bad."""

import gc
import re
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress

import pytest
from command_processes import eventually
from health_snapshots import health, map_health
from http_requests import DEADLINE, get, raw

from tsfusion.core.errors import InvalidConfig, TransportError
from tsfusion.gateway import metrics_http
from tsfusion.gateway.metrics import Metrics


@pytest.fixture
def metrics() -> Iterator[Metrics]:
    made = Metrics()
    yield made
    made.close()


def test_other_paths_and_methods(metrics: Metrics) -> None:
    address = metrics.serve("127.0.0.1:0")
    assert get(address, "/")[:2] == (404, "there is /metrics, /livez, /readyz\n")
    assert get(address, "/../etc/passwd")[0] == 404
    status, body, headers = get(address, "/metrics", method="HEAD")
    assert (status, body) == (200, "")
    assert int(headers["Content-Length"]) > 100
    for method in ("POST", "PUT", "DELETE", "OPTIONS", "TRACE"):
        status, _, headers = get(address, "/metrics", method=method)
        assert (status, headers["Allow"]) == (405, "GET, HEAD")


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("localhost", 200), ("LOCALHOST:1234", 200), ("127.0.0.1", 200), ("127.0.0.2:80", 200),
        ("[::1]:9464", 200), ("evil.example", 403), ("127.0.0.1.evil.example", 403),
        ("localhost.evil.example:80", 403), ("localhost@evil.example", 403), ("", 403), ("10.0.0.1", 403),
    ],
)  # fmt: skip
def test_a_page_of_somebody_else_cannot_read_it(metrics: Metrics, host: str, status: int) -> None:
    metrics.health = health()
    address = metrics.serve("127.0.0.1:0")
    found, body, headers = get(address, "/readyz", headers={"Host": host})
    assert found == status
    assert "Access-Control-Allow-Origin" not in headers
    if status == 403:
        assert "tsfusion" not in body


@pytest.mark.parametrize(
    "sent",
    [
        b"\r\n\r\n", b"GET\r\n\r\n", b"GET /livez\r\n\r\n", b"GET /livez HTTP/1.1\r\n\r\n",
        b"GET /livez HTTP/2.0\r\nHost: localhost\r\n\r\n", b"\x16\x03\x01\x02\x00\x01\x00\r\n\r\n",
        b"GET /livez HTTP/1.1\r\nHost: localhost\r\nHost: evil.example\r\n\r\n",
        b"GET http://evil.example/ HTTP/1.1\r\nHost: localhost\r\n\r\n",
        b"get /livez HTTP/1.1\r\nHost: localhost\r\n\r\n", b"GET  /livez HTTP/1.1\r\nHost: localhost\r\n\r\n",
        "GET /ü HTTP/1.1\r\nHost: löcalhost\r\n\r\n".encode(),
    ],
)  # fmt: skip
def test_rubbish_is_refused(metrics: Metrics, sent: bytes) -> None:
    address = metrics.serve("127.0.0.1:0")
    assert re.match(rb"HTTP/1\.1 40[0-9] ", raw(address, sent))
    assert get(address, "/livez")[0] == 503


def test_a_check_without_a_host_header_is_answered(metrics: Metrics) -> None:
    metrics.health = health()
    assert raw(metrics.serve("127.0.0.1:0"), b"GET /readyz HTTP/1.0\r\n\r\n").endswith(b"\r\n\r\nready\n")


def test_an_endless_head_is_cut_off(metrics: Metrics) -> None:
    address = metrics.serve("127.0.0.1:0")
    with suppress(BrokenPipeError, ConnectionResetError):
        assert raw(address, b"GET /metrics HTTP/1.1\r\n" + b"x" * (16 * metrics_http.HEAD_BYTES)) == b""
    assert get(address, "/livez")[0] == 503


def test_idle_connections_keep_nobody_out(metrics: Metrics) -> None:
    metrics.health = health()
    address = metrics.serve("127.0.0.1:0")
    host, _, port = address.rpartition(":")
    threads = threading.active_count()
    with ExitStack() as stack:
        idle = [
            stack.enter_context(socket.create_connection((host, int(port)), timeout=DEADLINE))
            for _ in range(200)
        ]
        idle[-1].sendall(b"GET /metr")
        assert get(address, "/readyz")[:2] == (200, "ready\n")
        assert threading.active_count() == threads
        assert get(address, "/metrics")[0] == 200
        for link in idle[: 200 - metrics_http.CONNECTIONS]:
            with suppress(ConnectionResetError):
                assert link.recv(1) == b"", "the oldest made room"


def test_slow_requests_are_cut_off(metrics: Metrics, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics_http, "DEADLINE", 0.5)
    address = metrics.serve("127.0.0.1:0")
    host, _, port = address.rpartition(":")
    with socket.create_connection((host, int(port)), timeout=DEADLINE) as slow:
        cut = threading.Event()

        def drip() -> None:
            with suppress(OSError):
                while not cut.is_set():
                    slow.sendall(b"X")
                    time.sleep(0.01)

        thread = threading.Thread(target=drip)
        thread.start()
        with suppress(ConnectionResetError):
            assert slow.recv(1) == b""
        cut.set()
        thread.join()
    assert get(address, "/livez")[0] == 503


def test_who_does_not_read_is_cut_off(metrics: Metrics, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics_http, "DEADLINE", 0.5)
    metrics.health = health(refused={f"r{i}": 1 for i in range(200_000)})  # more than a socket's buffers
    address = metrics.serve("127.0.0.1:0")
    host, _, port = address.rpartition(":")
    with socket.create_connection((host, int(port)), timeout=DEADLINE) as deaf:
        deaf.sendall(b"GET /metrics HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert eventually(lambda: metrics._page is not None and len(metrics._page._open) == 1)
        assert eventually(lambda: metrics._page is not None and not metrics._page._open)
    assert get(address, "/livez")[0] == 200


def test_a_page_that_fails_is_a_500(metrics: Metrics, caplog: pytest.LogCaptureFixture) -> None:
    metrics.health = health(maps={"default": map_health(rejected=None)})
    address = metrics.serve("127.0.0.1:0")
    assert get(address, "/metrics")[0] == 500
    assert "/metrics cannot be shown" in caplog.text
    assert get(address, "/readyz")[0] == 200


@pytest.mark.parametrize(
    "address",
    ["0.0.0.0:9464", "9464", "", ":9464", "[::]:9464", "10.0.0.1:9464", "example.com:80", "127.0.0.1",
     "127.0.0.1:x", "127.0.0.1:65536", "127.0.0.1:-1", "tcp://127.0.0.1:9464", "127.0.0.1:²"],
)  # fmt: skip
def test_only_this_machine_is_served(metrics: Metrics, address: str) -> None:
    with pytest.raises(InvalidConfig, match=r"must be HOST:PORT on this machine.*reverse proxy.*ssh -L"):
        metrics.serve(address)


@pytest.mark.parametrize("address", ["localhost:0", "127.0.0.1:0", "[::1]:0"])
def test_a_random_port_is_told(metrics: Metrics, address: str) -> None:
    if "::1" in address and not socket.has_dualstack_ipv6():
        pytest.skip("no IPv6 here")
    real = metrics.serve(address)
    assert int(real.rpartition(":")[2]) > 0
    assert get(real, "/livez", headers={"Host": real})[0] == 503


def test_a_taken_port_is_one_line(metrics: Metrics) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(TransportError, match=f"cannot serve metrics on {address}: .*in use.*choose"):
            metrics.serve(address)


def test_closing_ends_the_thread_and_frees_the_port(metrics: Metrics) -> None:
    threads = threading.active_count()
    address = metrics.serve("127.0.0.1:0")
    host, _, port = address.rpartition(":")
    assert threading.active_count() == threads + 1
    with socket.create_connection((host, int(port)), timeout=DEADLINE) as idle:
        idle.sendall(b"GET ")
        metrics.close()
        metrics.close()
        assert threading.active_count() == threads
        with suppress(ConnectionResetError):
            assert idle.recv(1) == b""
    assert metrics.serve(address) == address
    metrics.close()
    gc.collect()  # what was left open would be a warning, and a failure
