# SPDX-License-Identifier: MIT
"""A health snapshot as Prometheus figures.

A figure that can fall (a fuser that restarts goes back to its checkpoint, a session is forgotten) is a
gauge. Labels are names of maps and clients, or reasons from the server's own lists, never a random session or
a word that a peer chose: their number is bounded.
"""

import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import TypeAlias, get_args

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from tsfusion.core.config import ServerConfig
from tsfusion.wire.health import ClientHealth, Health, MapHealth, MapState
from tsfusion.wire.messages import SKIP_REASONS

NAMELESS = "-"  # clients without keys; no name looks like this
OTHERS = "+"  # the label that all names beyond a limit share
MAX_CLIENTS = 100
RECENT = 30.0  # seconds; older figures of a session do not count: its client may have ended

Rows: TypeAlias = Iterable[tuple[tuple[str, ...], float]]

_OF_MAPS: tuple[tuple[str, str, Callable[[MapHealth], float]], ...] = (
    ("keyframes_durable", "Keyframes that were journaled.", lambda one: one.keyframes_durable),
    ("keyframes_fused", "Keyframes in the map.", lambda one: one.keyframes_fused),
    ("keyframes_waiting", "Keyframes journaled and not yet fused.", lambda one: one.waiting),
    (
        "corrections_waiting",
        "Keyframes not yet at their new pose.",
        lambda one: one.corrections_waiting,
    ),
    (
        "corrections_unavailable",
        "Keyframes that a correction cannot move any more.",
        lambda one: one.corrections_unavailable,
    ),
    ("keyframes_forgotten", "Keyframes taken out of the map for good.", lambda one: one.keyframes_forgotten),
    ("keyframes_quarantined", "Keyframes kept aside for inspection.", lambda one: one.quarantined),
    ("sessions", "Sessions that sent keyframes.", lambda one: one.sessions),
    ("journal_bytes", "Bytes of the journal.", lambda one: one.journal_bytes),
    ("journal_damaged", "Records of the journal that could not be read.", lambda one: one.journal_damaged),
    ("journal_missing", "Segments of the journal that are gone.", lambda one: one.journal_missing),
    ("map_blocks", "Blocks of 8³ voxels.", lambda one: one.blocks),
    ("map_bytes", "Bytes of the map's blocks.", lambda one: one.map_bytes),
    ("map_problem", "Whether something keeps it from taking or fusing.", lambda one: bool(one.problem)),
    ("delay_bound_seconds", "The total delays are right to within ±.", lambda one: one.delay_bound_ms / 1e3),
)
_OF_CLIENTS: tuple[tuple[str, str, Callable[[list[ClientHealth]], float]], ...] = (
    ("sessions", "Sessions that were connected since the start.", len),
    ("connected_sessions", "Sessions that are connected now.", lambda own: len(_recent(own))),
    (
        "waiting_keyframes",
        "Keyframes in the client's spools, as last reported.",
        lambda own: sum(s.waiting for s in _recent(own)),
    ),
    ("received_bytes", "Bytes of keyframes received.", lambda own: sum(s.received_bytes for s in own)),
    (
        "held_sessions",
        "Sessions whose keyframes are turned away now.",
        lambda own: sum(bool(s.held) for s in _recent(own)),
    ),
)


def of_health(health: Health, age: float) -> Iterator[Metric]:
    """The figures of a snapshot that is `age` seconds old."""
    yield _gauge("snapshot_age_seconds", "Seconds since these figures were taken.", (), [((), age)])
    yield _gauge("uptime_seconds", "Seconds since the server started.", (), [((), health.uptime_s + age)])
    yield _gauge("problems", "Problems that need a person.", (), [((), len(health.problems))])
    yield _gauge("gateway_resident_bytes", "Memory of the gateway.", (), [((), health.rss_bytes)])
    yield _counter("messages_refused", "Messages never journaled.", ("reason",), _counts(health.refused))
    yield _counter("duplicates", "Keyframes that were received again.", (), [((), health.duplicates)])
    yield from _of_maps(health.maps, age)
    yield from _of_clients(health.clients, age)


def of_disk(state: Path, server: ServerConfig) -> Iterator[Metric]:
    """The limits of a server's disk, and what is free on it."""
    if server.journal_bytes is not None:
        limit = [((), server.journal_bytes)]
        yield _gauge("journal_limit_bytes", "A journal with more loses its oldest segments.", (), limit)
    yield _gauge("disk_reserve_bytes", "With less free, keyframes wait.", (), [((), server.min_free_bytes)])
    try:
        found = os.statvfs(state)
    except OSError:  # the folder is not there: its figure is left out
        return
    yield _gauge("disk_free_bytes", "Free for the state folder.", (), [((), found.f_bavail * found.f_frsize)])


def _of_maps(maps: dict[str, MapHealth], age: float) -> Iterator[Metric]:
    for name, help_, value in _OF_MAPS:
        yield _gauge(name, help_, ("map",), (((key,), value(one)) for key, one in maps.items()))
    rejected = [(name, reason, n) for name, one in maps.items() for reason, n in one.rejected.items()]
    rows = (((name, reason), n) for name, reason, n in rejected)
    yield _gauge("keyframes_rejected", "Keyframes journaled, but not fusable.", ("map", "reason"), rows)
    asked = [(name, outcome, n) for name, one in maps.items() for outcome, n in one.questions.items()]
    rows = (((name, outcome), n) for name, outcome, n in asked)
    yield _counter("questions", "Questions to the map, by what became of them.", ("map", "outcome"), rows)
    restarts = (((name,), one.fuser_restarts) for name, one in maps.items())
    yield _counter("fuser_restarts", "Fusers that took over from a dead one.", ("map",), restarts)
    corrections = (((name,), one.corrections) for name, one in maps.items())
    yield _counter("corrections", "Corrections of keyframes' poses in the journal.", ("map",), corrections)
    ages = (
        ((name,), one.last_keyframe_s + age) for name, one in maps.items() if one.last_keyframe_s is not None
    )
    yield _gauge("last_keyframe_age_seconds", "Seconds since a keyframe was journaled.", ("map",), ages)
    states = (
        ((name, state), one.state == state) for name, one in maps.items() for state in get_args(MapState)
    )
    yield _gauge("map_state", "1 for the state a map is in.", ("map", "state"), states)


def _of_clients(clients: Iterable[ClientHealth], age: float) -> Iterator[Metric]:
    by_name = _grouped(clients)
    for name, help_, value in _OF_CLIENTS:
        rows = (((client,), value(own)) for client, own in by_name.items())
        yield _gauge(f"client_{name}", help_, ("client",), rows)
    heard = (((client,), min(s.heard_s for s in own) + age) for client, own in by_name.items())
    yield _gauge("client_silence_seconds", "Seconds since its last message.", ("client",), heard)
    skipped = (
        ((client, reason), n) for client, own in by_name.items() for reason, n in _skipped(own).items()
    )
    yield _gauge("client_skipped_keyframes", "Never sent, as reported.", ("client", "reason"), skipped)


def _grouped(clients: Iterable[ClientHealth]) -> dict[str, list[ClientHealth]]:
    """Sessions by client; clients without keys share one label, and so do those beyond the limit."""
    found: dict[str, list[ClientHealth]] = {}
    for session in sorted(clients, key=lambda one: one.client):
        name = session.client or NAMELESS
        if name not in found and len(found) >= MAX_CLIENTS:
            name = OTHERS
        found.setdefault(name, []).append(session)
    return found


def _recent(sessions: Iterable[ClientHealth]) -> list[ClientHealth]:
    return [one for one in sessions if one.heard_s <= RECENT and one.state != "gone"]


def _skipped(sessions: Iterable[ClientHealth]) -> Counter[str]:
    total: Counter[str] = Counter()
    for session in sessions:
        for reason, count in session.skipped.items():
            total[reason if reason in SKIP_REASONS else "other"] += count  # a client may invent more
    return total


def _counts(by_reason: dict[str, int]) -> Rows:
    return (((reason,), count) for reason, count in by_reason.items())


def _gauge(name: str, help_: str, labels: tuple[str, ...], rows: Rows) -> Metric:
    return _filled(GaugeMetricFamily(f"tsfusion_{name}", help_, labels=labels), rows)


def _counter(name: str, help_: str, labels: tuple[str, ...], rows: Rows) -> Metric:
    return _filled(CounterMetricFamily(f"tsfusion_{name}", help_, labels=labels), rows)


def _filled(family: GaugeMetricFamily | CounterMetricFamily, rows: Rows) -> Metric:
    for labels, value in rows:
        family.add_metric(labels, float(value))
    return family
