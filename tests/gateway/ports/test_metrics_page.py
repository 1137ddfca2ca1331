# SPDX-License-Identifier: MIT
"""The page of figures and health checks, met by peers good and bad."""

import gc
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, suppress

import pytest
from command_processes import eventually
from health_snapshots import client, health, map_health
from http_requests import connection, get, raw
from keyframes_and_servers import at_once

from tsfusion.core.errors import InvalidConfig, TransportError
from tsfusion.gateway.health.metrics import Metrics
from tsfusion.gateway.ports import metrics_page
from tsfusion.gateway.ports.metrics_page import MetricsPage


@pytest.fixture
def metrics() -> Metrics:
    return Metrics()


@pytest.fixture
def page(metrics: Metrics) -> Iterator[MetricsPage]:
    with closing(MetricsPage("127.0.0.1:0", metrics.pages)) as made:
        yield made


@pytest.fixture
def address(page: MetricsPage) -> str:
    return page.address


def test_writing_and_reading_do_not_mind_each_other(metrics: Metrics, address: str) -> None:
    failed: list[Exception] = []
    end = threading.Event()

    def write() -> None:
        i = 0
        while not end.is_set():
            i += 1
            metrics.observe(f"map{i % 5}", "fuse", 0.01)
            metrics.health = health(client(f"robot{i % 7}"), maps={f"map{i % 5}": map_health()})

    def check(path: str) -> Callable[[], None]:
        def ask() -> None:
            try:
                for _ in range(20):
                    assert get(address, path)[0] in (200, 503)
            except Exception as error:  # noqa: BLE001  told to the test's own thread
                failed.append(error)

        return ask

    writer = threading.Thread(target=write)
    writer.start()
    at_once(*(check(path) for path in ("/metrics", "/readyz") * 2))
    end.set()
    writer.join()
    assert not failed


def test_other_paths_and_methods(address: str) -> None:
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
def test_a_page_of_somebody_else_cannot_read_it(
    metrics: Metrics, address: str, host: str, status: int
) -> None:
    metrics.health = health()
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
def test_rubbish_is_refused(address: str, sent: bytes) -> None:
    assert re.match(rb"HTTP/1\.1 40[0-9] ", raw(address, sent))
    assert get(address, "/livez")[0] == 200


def test_a_check_without_a_host_header_is_answered(metrics: Metrics, address: str) -> None:
    metrics.health = health()
    assert raw(address, b"GET /readyz HTTP/1.0\r\n\r\n").endswith(b"\r\n\r\nready\n")


def test_an_endless_head_is_cut_off(address: str) -> None:
    with suppress(BrokenPipeError, ConnectionResetError):
        assert raw(address, b"GET /metrics HTTP/1.1\r\n" + b"x" * (16 * metrics_page.HEAD_BYTES)) == b""
    assert get(address, "/livez")[0] == 200


def test_idle_connections_keep_nobody_out(metrics: Metrics, address: str) -> None:
    metrics.health = health()
    threads = threading.active_count()
    with ExitStack() as stack:
        idle = [stack.enter_context(connection(address)) for _ in range(200)]
        idle[-1].sendall(b"GET /metr")
        assert get(address, "/readyz")[:2] == (200, "ready\n")
        assert threading.active_count() == threads
        assert get(address, "/metrics")[0] == 200
        for link in idle[: 200 - metrics_page.CONNECTIONS]:
            with suppress(ConnectionResetError):
                assert link.recv(1) == b"", "the oldest made room"


def test_slow_requests_are_cut_off(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics_page, "DEADLINE", 0.5)
    with connection(address) as slow:
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
    assert get(address, "/livez")[0] == 200


def test_who_does_not_read_is_cut_off(
    metrics: Metrics, page: MetricsPage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(metrics_page, "DEADLINE", 0.5)
    metrics.health = health(refused={f"r{i}": 1 for i in range(200_000)})  # more than a socket's buffers
    with connection(page.address) as deaf:
        deaf.sendall(b"GET /metrics HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert eventually(lambda: len(page._open) == 1)
        assert eventually(lambda: not page._open)
    metrics.health = health()  # as a gateway renews it every second
    assert get(page.address, "/livez")[0] == 200


def test_a_page_that_fails_is_a_500(metrics: Metrics, address: str, caplog: pytest.LogCaptureFixture) -> None:
    metrics.health = health(maps={"default": map_health(rejected=None)})
    assert get(address, "/metrics")[0] == 500
    assert "/metrics cannot be shown" in caplog.text
    assert get(address, "/readyz")[0] == 200


@pytest.mark.parametrize(
    "address",
    ["0.0.0.0:9464", "9464", "", ":9464", "[::]:9464", "10.0.0.1:9464", "example.com:80", "127.0.0.1",
     "127.0.0.1:x", "127.0.0.1:65536", "127.0.0.1:-1", "tcp://127.0.0.1:9464", "127.0.0.1:²"],
)  # fmt: skip
def test_only_this_machine_is_served(address: str) -> None:
    with pytest.raises(InvalidConfig, match=r"must be HOST:PORT on this machine.*reverse proxy.*ssh -L"):
        MetricsPage(address, {})


@pytest.mark.parametrize("address", ["localhost:0", "127.0.0.1:0", "[::1]:0", "[::ffff:127.0.0.1]:0"])
def test_a_random_port_is_told(address: str) -> None:
    if "::" in address and not socket.has_dualstack_ipv6():
        pytest.skip("no IPv6 here")
    with closing(MetricsPage(address, Metrics().pages)) as made:
        assert int(made.address.rpartition(":")[2]) > 0
        assert get(made.address, "/livez", headers={"Host": made.address})[0] == 200


def test_a_taken_port_is_one_line() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(TransportError, match=f"cannot serve metrics on {address}: .*in use.*choose"):
            MetricsPage(address, {})


def test_closing_ends_the_thread_and_frees_the_port() -> None:
    def threads() -> int:  # of others, some may end meanwhile
        return sum(thread.name == "metrics" for thread in threading.enumerate())

    before = threads()
    page = MetricsPage("127.0.3.54:0", {})  # where nobody else is given the port that is freed
    assert threads() == before + 1
    with connection(page.address) as idle:
        idle.sendall(b"GET ")
        page.close()
        page.close()
        assert threads() == before
        with suppress(ConnectionResetError):
            assert idle.recv(1) == b""
    with closing(MetricsPage(page.address, {})) as again:
        assert again.address == page.address
    gc.collect()  # what was left open would be a warning, and a failure
