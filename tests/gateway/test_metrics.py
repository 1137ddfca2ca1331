# SPDX-License-Identifier: MIT
"""The figures, parsed as Prometheus does it, and the health checks."""

from pathlib import Path

import pytest
from health_snapshots import MIB, client, health, map_health
from prometheus_client.parser import text_string_to_metric_families

from tsfusion.core.config import ServerConfig
from tsfusion.gateway.health import metrics_families
from tsfusion.gateway.health.metrics import BUCKETS, FRESH, FRESH_START, STAGES, Metrics
from tsfusion.wire.messages.health import MapHealth

HOSTILE = 'x" } evil 1\n\\'
Figures = dict[tuple[str, ...], float]


@pytest.fixture
def metrics() -> Metrics:
    return Metrics()


class Clock:
    """A clock that stands until it is moved."""

    now = 1000.0

    def __call__(self) -> float:
        return self.now


def shown(metrics: Metrics, page: str) -> tuple[int, str, str]:
    """Status, body and type of a page."""
    status, body, kind = metrics.pages[page]()
    return status, body if isinstance(body, str) else body.decode(), kind


def figures(metrics: Metrics) -> Figures:
    """(name, label values in the order of their names) → value."""
    status, body, _ = shown(metrics, "/metrics")
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
    _, body, kind = shown(metrics, "/metrics")
    assert kind == "text/plain; version=0.0.4; charset=utf-8"
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
    assert shown(metrics, "/livez")[:2] == (200, "alive: the gateway is starting")
    assert shown(metrics, "/readyz")[:2] == (503, "the gateway is starting")
    for second in range(0, 300, 50):  # longer than a stuck gateway may be silent
        clock.now += 50
        metrics.report_start(f"reading for {second} s")
        assert shown(metrics, "/livez")[:2] == (200, f"alive: reading for {second} s")
        assert shown(metrics, "/readyz")[:2] == (503, f"reading for {second} s")
    clock.now += FRESH_START + 1
    stuck = f"the gateway has done nothing for {FRESH_START + 1:.0f} s"
    assert shown(metrics, "/livez")[:2] == shown(metrics, "/readyz")[:2] == (503, stuck)
    metrics.health = health(ready=False, maps={"yard": map_health(state="opening")})
    assert shown(metrics, "/readyz")[:2] == (503, "map yard is being opened")
    metrics.health = health(ready=False)
    assert shown(metrics, "/livez")[:2] == (200, "alive")
    assert shown(metrics, "/readyz")[:2] == (503, "not ready")
    metrics.health = health(ready=False, problems=("map yard: disk full", "map shed:\n\x1b[2J"))
    assert shown(metrics, "/readyz")[:2] == (503, "map yard: disk full\nmap shed:\\n\\x1b[2J")
    metrics.health = health(problems=("map shed cannot be opened",))
    assert shown(metrics, "/readyz")[:2] == (200, "ready")
    clock.now += FRESH + 1
    silent = f"the gateway has done nothing for {FRESH + 1:.0f} s"
    assert shown(metrics, "/livez")[:2] == (503, silent)
    assert shown(metrics, "/readyz")[:2] == (503, silent)


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
