# SPDX-License-Identifier: MIT
"""Keep a server's metrics for Prometheus, and its health checks.

The gateway's thread writes (`observe`, `health`), another thread serves them. Neither waits for the other.
"""

import platform
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeAlias

from prometheus_client import CollectorRegistry, Histogram, generate_latest
from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from tsfusion.core.config import ServerConfig
from tsfusion.core.logs import printable
from tsfusion.core.process import version_of
from tsfusion.gateway.health import metrics_families
from tsfusion.wire.messages.health import Health
from tsfusion.wire.messages.messages import STAGES as LEDGER_STAGES

STAGES = (*LEDGER_STAGES, "total")
BUCKETS = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0)  # seconds
FRESH = 10.0  # seconds; a gateway renews its snapshot every second
FRESH_START = 60.0  # seconds; at the start a slow disk may delay the report about a journal
_TEXT_FORMAT = "text/plain; version=0.0.4; charset=utf-8"
_PLAIN = "text/plain; charset=utf-8"
HttpAnswer: TypeAlias = tuple[int, str | bytes, str]  # status, body, type; text gets a line break at its end
_MAX_MAPS = 256  # maps with a label of their own; further maps share `metrics_families.OTHERS`


class Metrics(Collector):
    """Metrics and health of one server, for a thread that serves them over HTTP.

    Args:
        server: None leaves out the limits and the free space of the disk.
    """

    def __init__(
        self, server: ServerConfig | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._server = server
        self._clock = clock
        self._seen: tuple[Health, float] | None = None
        self._starting = ("the gateway is starting", clock())  # long work outside its loop, and its time
        self._maps: set[str] = set()
        self._registry = CollectorRegistry()
        self._delay = Histogram(
            "tsfusion_keyframe_delay_seconds",
            "How long a keyframe took from one stamp to the next; total = captured to fused.",
            ("map", "stage"),
            buckets=BUCKETS,
            registry=self._registry,
        )
        self._question_delay = Histogram(
            "tsfusion_question_delay_seconds",
            "How long an answer to a question about the map took, in the server.",
            ("map",),
            buckets=BUCKETS,
            registry=self._registry,
        )
        self._registry.register(self)

    def observe(self, map_name: str, stage: str, seconds: float) -> None:
        """Add to the histogram of a map: the seconds that a keyframe took for a stage of `STAGES`."""
        self._delay.labels(self._label(map_name), stage).observe(max(seconds, 0.0))

    def observe_question(self, map_name: str, seconds: float) -> None:
        """Add to the histogram of a map: the seconds that the answer to a question took."""
        self._question_delay.labels(self._label(map_name)).observe(max(seconds, 0.0))

    def _label(self, map_name: str) -> str:
        if map_name not in self._maps:
            if len(self._maps) >= _MAX_MAPS:
                return metrics_families.OTHERS
            self._maps.add(map_name)
        return map_name

    @property
    def health(self) -> Health | None:
        """Last health snapshot of the gateway; None before the first."""
        return self._seen[0] if self._seen else None

    @health.setter
    def health(self, snapshot: Health) -> None:
        self._seen = (snapshot, self._clock())

    def report_start(self, progress: str) -> None:
        """Record that the gateway is alive, although long work such as recovery (`progress`) blocks it."""
        self._starting = (progress, self._clock())

    @property
    def pages(self) -> dict[str, Callable[[], HttpAnswer]]:
        """The metrics and the health checks: path → function that makes the page, for any thread."""
        return {"/metrics": self._figures, "/livez": self._alive, "/readyz": self._ready}

    # --- pages ---

    def _figures(self) -> HttpAnswer:
        return 200, generate_latest(self._registry), _TEXT_FORMAT

    def _alive(self) -> HttpAnswer:
        _, progress, silence = self._look()
        if silence:
            return 503, silence, _PLAIN
        return 200, f"alive: {progress}" if progress else "alive", _PLAIN

    def _ready(self) -> HttpAnswer:
        health, progress, silence = self._look()
        if health is None:
            return 503, progress or silence, _PLAIN
        if health.ready:
            return 200, "ready", _PLAIN
        opening = [name for name, one in health.maps.items() if one.state == "opening"]
        lines = [*health.problems, *(f"map {name} is being opened" for name in opening)]
        return 503, "\n".join(map(printable, lines)) or "not ready", _PLAIN

    def _look(self) -> tuple[Health | None, str, str]:
        """Return the last snapshot, the long work in progress, and the reason why the gateway seems dead.

        Two of the three are empty.
        """
        now, (progress, told) = self._clock(), self._starting
        if self._seen is None or self._seen[1] < told:
            age, most = now - told, FRESH_START
        else:
            age, most, progress = now - self._seen[1], FRESH, ""
        if age > most:
            return None, "", f"the gateway has done nothing for {age:.0f} s"
        return (None if progress else self._seen and self._seen[0]), progress, ""

    # --- figures ---

    def describe(self) -> list[Metric]:
        """Return an empty list, for Prometheus's registry: the metrics depend on the snapshot."""
        return []

    def collect(self) -> Iterator[Metric]:
        """Yield all metrics of the last snapshot, except the histograms, which the registry has."""
        build = GaugeMetricFamily("tsfusion_build_info", "Versions.", labels=("version", "python"))
        build.add_metric((version_of("tsfusion"), platform.python_version()), 1)
        yield build
        seen = self._seen
        age = self._clock() - seen[1] if seen else None
        up = age is not None and age <= FRESH
        yield GaugeMetricFamily("tsfusion_up", "Whether the gateway does its rounds.", value=up)
        ready = up and seen is not None and seen[0].ready
        yield GaugeMetricFamily("tsfusion_ready", "Whether keyframes are taken and fused.", value=ready)
        if self._server is not None:
            yield from metrics_families.of_disk(Path(self._server.state), self._server)
        if seen is not None and age is not None:
            yield from metrics_families.of_health(seen[0], age)
