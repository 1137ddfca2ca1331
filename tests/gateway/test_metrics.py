# SPDX-License-Identifier: MIT
"""The figures, parsed as Prometheus does it, and the health checks, on a page met by peers good and bad."""

import gc
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest
from command_processes import eventually
from health_snapshots import MIB, client, health, map_health
from http_requests import connection, get, raw
from keyframes_and_servers import at_once
from prometheus_client.parser import text_string_to_metric_families

from tsfusion.core.config import ServerConfig
from tsfusion.core.errors import InvalidConfig, TransportError
from tsfusion.gateway.health import metrics_families, metrics_http
from tsfusion.gateway.health.metrics import BUCKETS, FRESH, FRESH_START, STAGES, Metrics
from tsfusion.wire.messages.health import MapHealth

HOSTILE = 'x" } evil 1\n\\'
Figures = dict[tuple[str, ...], float]


@pytest.fixture
def metrics() -> Iterator[Metrics]:
    made = Metrics()
    yield made
    made.close()


class Clock:
    """A clock that stands until it is moved."""

    now = 1000.0

    def __call__(self) -> float:
        return self.now


def figures(metrics: Metrics) -> Figures:
    """(name, label values in the order of their names) → value, by way of the page."""
    status, body, _ = get(metrics.serve("127.0.0.1:0"), "/metrics")
    metrics.close()
    assert status == 200
    return {
        (sample.name, *(value for _, value in sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(body)
        for sample in family.samples
    }


def test_delays_become_histograms(metrics: Metrics) -> None:
    for seconds in (0.0005, 0.02, 0.02, 40.0, -1.0):
        metrics.observe("yard", "total", seconds)
    found = figures(metrics)
    name = "tsfusion_keyframe_delay_seconds"
    counts = [found[f"{name}_bucket", str(most), "yard", "total"] for most in BUCKETS]
    assert counts == [2.0] * 4 + [4.0] * 10
    assert found[f"{name}_bucket", "+Inf", "yard", "total"] == found[f"{name}_count", "yard", "total"] == 5
    assert found[f"{name}_sum", "yard", "total"] == pytest.approx(40.0405)
    assert STAGES == ("encode", "wire", "journal", "queue", "fuse", "mesh", "total")


def test_a_snapshot_becomes_figures() -> None:
    clock = Clock()
    metrics = Metrics(clock=clock)
    metrics.health = health(
        client("cart", waiting=2, skipped={"thinned": 3}, held="disk", heard_s=7.0),
        client("cart", waiting=1, skipped={"thinned": 1, "spool": 5}),
        client("drone"),
        client("drone", waiting=50, held="disk", heard_s=metrics_families.RECENT + 1),
        client("drone", waiting=7, state="gone"),
        refused={"header": 4}, duplicates=9, problems=("disk full",), ready=False,
        maps={
            "yard": map_health(
                state="busy", waiting=2, fuser_restarts=1, corrections=4, questions={"answered": 7, "late": 1}
            ),
            "shed": map_health(last_keyframe_s=None),
        },
    )  # fmt: skip
    clock.now += 3.0
    found = figures(metrics)
    wanted = {
        ("tsfusion_up",): 1, ("tsfusion_ready",): 0, ("tsfusion_problems",): 1,
        ("tsfusion_snapshot_age_seconds",): 3, ("tsfusion_uptime_seconds",): 3728,
        ("tsfusion_gateway_resident_bytes",): 60 * MIB,
        ("tsfusion_messages_refused_total", "header"): 4, ("tsfusion_duplicates_total",): 9,
        ("tsfusion_keyframes_durable", "yard"): 6, ("tsfusion_keyframes_fused", "yard"): 5,
        ("tsfusion_keyframes_waiting", "yard"): 2, ("tsfusion_keyframes_waiting", "shed"): 0,
        ("tsfusion_keyframes_rejected", "yard", "MapFull"): 1, ("tsfusion_keyframes_quarantined", "yard"): 1,
        ("tsfusion_journal_bytes", "yard"): 3 * MIB, ("tsfusion_map_bytes", "yard"): 10 * MIB,
        ("tsfusion_map_blocks", "yard"): 1234, ("tsfusion_corrections_total", "yard"): 4,
        ("tsfusion_fuser_restarts_total", "yard"): 1,
        ("tsfusion_questions_total", "yard", "answered"): 7, ("tsfusion_questions_total", "yard", "late"): 1,
        ("tsfusion_last_keyframe_age_seconds", "yard"): 5, ("tsfusion_delay_bound_seconds", "yard"): 0.0005,
        ("tsfusion_map_state", "yard", "busy"): 1, ("tsfusion_map_state", "yard", "idle"): 0,
        ("tsfusion_client_sessions", "cart"): 2, ("tsfusion_client_connected_sessions", "drone"): 1,
        ("tsfusion_client_waiting_keyframes", "cart"): 3,
        ("tsfusion_client_skipped_keyframes", "cart", "thinned"): 4,
        ("tsfusion_client_skipped_keyframes", "cart", "spool"): 5,
        ("tsfusion_client_waiting_keyframes", "drone"): 0,
        ("tsfusion_client_held_sessions", "cart"): 1, ("tsfusion_client_held_sessions", "drone"): 0,
        ("tsfusion_client_received_bytes", "cart"): 6 * MIB,
        ("tsfusion_client_silence_seconds", "cart"): 3.25,
    }  # fmt: skip
    assert {key: found.get(key) for key in wanted} == wanted
    assert ("tsfusion_last_keyframe_age_seconds", "shed") not in found
    assert [key for key in found if key[0] == "tsfusion_build_info"]


def test_every_figure_is_ours_and_explained(metrics: Metrics) -> None:
    metrics.observe("yard", "fuse", 0.1)
    metrics.health = health(client())
    _, body, headers = get(metrics.serve("127.0.0.1:0"), "/metrics")
    assert headers["Content-Type"] == "text/plain; version=0.0.4; charset=utf-8"
    for family in text_string_to_metric_families(body):
        assert family.name.startswith("tsfusion_")
        assert family.documentation
        assert family.type in ("gauge", "counter", "histogram")


def test_the_disk_shows_what_is_left_and_the_limits(tmp_path: Path) -> None:
    server = ServerConfig(state=str(tmp_path), journal_bytes=5 * MIB, min_free_bytes=7)
    found = figures(Metrics(server))
    assert found["tsfusion_journal_limit_bytes",] == 5 * MIB
    assert found["tsfusion_disk_reserve_bytes",] == 7
    assert found["tsfusion_disk_free_bytes",] > 0
    gone = figures(Metrics(ServerConfig(state=str(tmp_path / "gone"))))
    assert ("tsfusion_disk_free_bytes",) not in gone
    assert gone["tsfusion_up",] == 0


def test_labels_stay_few_whatever_peers_say(metrics: Metrics) -> None:
    sessions = [client("", session=f"{i:08x}", skipped={f"reason{i}": 1, "thinned": 1}) for i in range(500)]
    named = [client(f"robot{i:04}") for i in range(300)]
    metrics.health = health(*sessions, *named)
    for i in range(1000):
        metrics.observe(f"map{i}", "total", 0.1)
    found = figures(metrics)
    names = {key[1] for key in found if key[0] == "tsfusion_client_sessions"}
    assert len(names) == metrics_families.MAX_CLIENTS + 1
    assert found["tsfusion_client_sessions", metrics_families.NAMELESS] == 500
    assert found["tsfusion_client_sessions", metrics_families.OTHERS] == 300 - (
        metrics_families.MAX_CLIENTS - 1
    )
    skipped = {key[2]: value for key, value in found.items() if key[0] == "tsfusion_client_skipped_keyframes"}
    assert skipped == {"thinned": 500, "other": 500}
    counts = {key[1]: v for key, v in found.items() if key[0] == "tsfusion_keyframe_delay_seconds_count"}
    assert len(counts) == 257
    assert counts[metrics_families.OTHERS] == 1000 - 256


def test_nothing_in_a_label_breaks_the_page(metrics: Metrics) -> None:
    metrics.health = health(refused={HOSTILE: 1}, maps={"default": map_health(rejected={HOSTILE: 2})})
    found = figures(metrics)
    assert found["tsfusion_messages_refused_total", HOSTILE] == 1
    assert found["tsfusion_keyframes_rejected", "default", HOSTILE] == 2


def test_health_checks() -> None:
    clock = Clock()
    metrics = Metrics(clock=clock)
    address = metrics.serve("127.0.0.1:0")
    assert get(address, "/livez")[:2] == (200, "alive: the gateway is starting\n")
    assert get(address, "/readyz")[:2] == (503, "the gateway is starting\n")
    for second in range(0, 300, 50):  # longer than a stuck gateway may be silent
        clock.now += 50
        metrics.report_start(f"reading for {second} s")
        assert get(address, "/livez")[:2] == (200, f"alive: reading for {second} s\n")
        assert get(address, "/readyz")[:2] == (503, f"reading for {second} s\n")
    clock.now += FRESH_START + 1
    stuck = f"the gateway has done nothing for {FRESH_START + 1:.0f} s\n"
    assert get(address, "/livez")[:2] == get(address, "/readyz")[:2] == (503, stuck)
    metrics.health = health(ready=False, maps={"yard": map_health(state="opening")})
    assert get(address, "/readyz")[:2] == (503, "map yard is being opened\n")
    metrics.health = health(ready=False)
    assert get(address, "/livez")[:2] == (200, "alive\n")
    assert get(address, "/readyz")[:2] == (503, "not ready\n")
    metrics.health = health(ready=False, problems=("map yard: disk full", "map shed:\n\x1b[2J"))
    assert get(address, "/readyz")[:2] == (503, "map yard: disk full\nmap shed:\\n\\x1b[2J\n")
    metrics.health = health(problems=("map shed cannot be opened",))
    assert get(address, "/readyz?verbose")[:2] == (200, "ready\n")
    clock.now += FRESH + 1
    silent = f"the gateway has done nothing for {FRESH + 1:.0f} s\n"
    assert get(address, "/livez")[:2] == (503, silent)
    assert get(address, "/readyz")[:2] == (503, silent)
    metrics.close()


def test_writing_and_reading_do_not_mind_each_other(metrics: Metrics) -> None:
    address = metrics.serve("127.0.0.1:0")
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


# --- the page ---


@pytest.fixture
def address(metrics: Metrics) -> str:
    return metrics.serve("127.0.0.1:0")


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


def test_a_check_without_a_host_header_is_answered(metrics: Metrics) -> None:
    metrics.health = health()
    assert raw(metrics.serve("127.0.0.1:0"), b"GET /readyz HTTP/1.0\r\n\r\n").endswith(b"\r\n\r\nready\n")


def test_an_endless_head_is_cut_off(address: str) -> None:
    with suppress(BrokenPipeError, ConnectionResetError):
        assert raw(address, b"GET /metrics HTTP/1.1\r\n" + b"x" * (16 * metrics_http.HEAD_BYTES)) == b""
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
        for link in idle[: 200 - metrics_http.CONNECTIONS]:
            with suppress(ConnectionResetError):
                assert link.recv(1) == b"", "the oldest made room"


def test_slow_requests_are_cut_off(address: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics_http, "DEADLINE", 0.5)
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
    metrics: Metrics, address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(metrics_http, "DEADLINE", 0.5)
    metrics.health = health(refused={f"r{i}": 1 for i in range(200_000)})  # more than a socket's buffers
    with connection(address) as deaf:
        deaf.sendall(b"GET /metrics HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert eventually(lambda: metrics._page is not None and len(metrics._page._open) == 1)
        assert eventually(lambda: metrics._page is not None and not metrics._page._open)
    metrics.health = health()  # as a gateway renews it every second
    assert get(address, "/livez")[0] == 200


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
def test_only_this_machine_is_served(metrics: Metrics, address: str) -> None:
    with pytest.raises(InvalidConfig, match=r"must be HOST:PORT on this machine.*reverse proxy.*ssh -L"):
        metrics.serve(address)


@pytest.mark.parametrize("address", ["localhost:0", "127.0.0.1:0", "[::1]:0", "[::ffff:127.0.0.1]:0"])
def test_a_random_port_is_told(metrics: Metrics, address: str) -> None:
    if "::" in address and not socket.has_dualstack_ipv6():
        pytest.skip("no IPv6 here")
    real = metrics.serve(address)
    assert int(real.rpartition(":")[2]) > 0
    assert get(real, "/livez", headers={"Host": real})[0] == 200


def test_a_taken_port_is_one_line(metrics: Metrics) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        with pytest.raises(TransportError, match=f"cannot serve metrics on {address}: .*in use.*choose"):
            metrics.serve(address)


def test_closing_ends_the_thread_and_frees_the_port(metrics: Metrics) -> None:
    def threads() -> int:  # of others, some may end meanwhile
        return sum(thread.name == "metrics" for thread in threading.enumerate())

    before = threads()
    address = metrics.serve("127.0.3.54:0")  # where nobody else is given the port that is freed
    assert threads() == before + 1
    with connection(address) as idle:
        idle.sendall(b"GET ")
        metrics.close()
        metrics.close()
        assert threads() == before
        with suppress(ConnectionResetError):
            assert idle.recv(1) == b""
    assert metrics.serve(address) == address
    metrics.close()
    gc.collect()  # what was left open would be a warning, and a failure


def test_every_field_of_a_map_is_a_figure_or_has_a_reason() -> None:
    elsewhere = {
        "state": "a figure for each state",
        "last_keyframe_s": "with the age of the snapshot",
        "delay_ms": "a histogram, as each keyframe comes",
        "question_ms": "likewise",
        "keyframes_moved": "since a fuser began, which may be any time",
        "moving_s": "likewise",
        "checkpoints": "of no use for an alert: a failure is a problem",
        "journal_put_back": "a problem",
        "fusing_s": "a problem when it is long",
    }
    figures = set(metrics_families._OF_MAPS)
    assert figures.isdisjoint(elsewhere)
    assert figures | set(elsewhere) == set(MapHealth.__struct_fields__)
