# SPDX-License-Identifier: MIT
"""Convert a health snapshot into Prometheus metrics.

A figure that can fall is a gauge: a restarted fuser goes back to its checkpoint, and a session is forgotten.
Labels are names of maps and clients, or reasons from the server's own lists. They are never a random session
or a word that a peer chose, so their number is bounded.
"""

import os
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, TypeAlias, get_args, get_type_hints

from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from tsfusion.core.config import ServerConfig
from tsfusion.wire.messages.health import ClientHealth, Figure, Health, MapHealth, MapState
from tsfusion.wire.messages.messages import SKIP_REASONS

NAMELESS = "-"  # label of clients without keys; no name looks like this
OTHERS = "+"  # shared label of all names beyond a limit
MAX_CLIENTS = 100
RECENT = 30.0  # seconds; older figures of a session do not count: its client may have ended

LabelledRows: TypeAlias = Iterable[tuple[tuple[str, ...], float]]

_OF_MAPS: dict[str, Figure] = {
    field: figure
    for field, hint in get_type_hints(MapHealth, include_extras=True).items()
    for figure in getattr(hint, "__metadata__", ())
}
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
    """Yield the metrics of a health snapshot that is `age` seconds old."""
    yield _gauge("snapshot_age_seconds", "Seconds since these figures were taken.", (), [((), age)])
    yield _gauge("uptime_seconds", "Seconds since the server started.", (), [((), health.uptime_s + age)])
    yield _gauge("problems", "Problems that need a person.", (), [((), len(health.problems))])
    yield _gauge("gateway_resident_bytes", "Memory of the gateway.", (), [((), health.rss_bytes)])
    yield _counter("messages_refused", "Messages never journaled.", ("reason",), _counts(health.refused))
    yield _counter("duplicates", "Keyframes that were received again.", (), [((), health.duplicates)])
    yield from _of_maps(health.maps, age)
    yield from _of_clients(health.clients, age)


def of_disk(state: Path, server: ServerConfig) -> Iterator[Metric]:
    """Yield metrics of a server's disk: its limits and its free space."""
    if server.journal_bytes is not None:
        limit = [((), server.journal_bytes)]
        yield _gauge("journal_limit_bytes", "A journal with more loses its oldest segments.", (), limit)
    yield _gauge("disk_reserve_bytes", "With less free, keyframes wait.", (), [((), server.min_free_bytes)])
    try:
        found = os.statvfs(state)
    except OSError:  # without the folder, its figure is left out
        return
    yield _gauge("disk_free_bytes", "Free for the state folder.", (), [((), found.f_bavail * found.f_frsize)])


def _of_maps(maps: dict[str, MapHealth], age: float) -> Iterator[Metric]:
    for field, one in _OF_MAPS.items():
        family = _counter if one.grows else _gauge
        labels = ("map", one.by) if one.by else ("map",)
        rows = (row for key, health in maps.items() for row in _rows(key, getattr(health, field), one.unit))
        yield family(one.name or field, one.words, labels, rows)
    ages = (
        ((name,), one.last_keyframe_s + age) for name, one in maps.items() if one.last_keyframe_s is not None
    )
    yield _gauge("last_keyframe_age_seconds", "Seconds since a keyframe was journaled.", ("map",), ages)
    states = (
        ((name, state), one.state == state) for name, one in maps.items() for state in get_args(MapState)
    )
    yield _gauge("map_state", "1 for the state a map is in.", ("map", "state"), states)


def _rows(key: str, found: Any, unit: float) -> LabelledRows:
    """Return the rows of a map's metric: a count, 1 for a text that is not empty, or counts by reason."""
    if isinstance(found, dict):
        return [((key, reason), count) for reason, count in found.items()]
    return [((key,), (bool(found) if isinstance(found, str) else found) * unit)]


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
    """Return sessions by client, to limit labels: clients without keys, or beyond the limit, share one."""
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


def _counts(by_reason: dict[str, int]) -> LabelledRows:
    return (((reason,), count) for reason, count in by_reason.items())


def _gauge(name: str, help_: str, labels: tuple[str, ...], rows: LabelledRows) -> Metric:
    return _filled(GaugeMetricFamily(f"tsfusion_{name}", help_, labels=labels), rows)


def _counter(name: str, help_: str, labels: tuple[str, ...], rows: LabelledRows) -> Metric:
    return _filled(CounterMetricFamily(f"tsfusion_{name}", help_, labels=labels), rows)


def _filled(family: GaugeMetricFamily | CounterMetricFamily, rows: LabelledRows) -> Metric:
    for labels, value in rows:
        family.add_metric(labels, float(value))
    return family
