# SPDX-License-Identifier: MIT
"""Log a server's clients: who comes and goes, and one summary a minute while keyframes come."""

import logging
import time
from collections.abc import Callable

from tsfusion.core import logs
from tsfusion.core.readable_numbers import count_of
from tsfusion.gateway.clients.client_routes import ABANDONED_AFTER
from tsfusion.wire.messages.health import ClientHealth, Health, MapHealth, headline
from tsfusion.wire.messages.messages import SKIP_REASONS

log = logging.getLogger(__name__)

_INTERVAL = 60.0  # seconds between two summaries


class ActivityLog:
    """Comparison of health snapshots whose changes are logged. A server without activity logs nothing."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._clients: dict[tuple[str, str], ClientHealth] = {}  # by session and map, as last seen
        self._skipping: set[tuple[str, str]] = set()  # clients whose skipped keyframes were logged
        self._counted: dict[str, MapHealth] = {}  # at the last summary
        self._counted_at = clock()

    def note(self, health: Health) -> None:
        """Log the differences between this health snapshot and the last. Call it about once a second."""
        before, self._clients = self._clients, {(one.session, one.map): one for one in health.clients}
        self._skipping &= self._clients.keys()
        for key, one in self._clients.items():
            self._note_client(key, one, before.get(key))
        for name, found in health.maps.items():
            if found.state != "opening" or not found.keyframes_durable:  # else its counts are not known yet
                self._counted.setdefault(name, found)
        if self._clock() - self._counted_at >= _INTERVAL:
            self._summarise(health)

    def _note_client(self, key: tuple[str, str], one: ClientHealth, before: ClientHealth | None) -> None:
        subject = logs.about(map=one.map, session=one.session, client=one.client)
        was_there = before is not None and before.state != "gone"
        if not was_there and (one.state != "gone" or before is None):
            place = f" from {one.address}" if one.address else ""
            log.info("a client %s%s", "is connected" if before is None else "is back", place, extra=subject)
        if one.skipped and key not in self._skipping:
            self._skipping.add(key)
            why = "; ".join(SKIP_REASONS[reason] for reason in sorted(one.skipped) if reason in SKIP_REASONS)
            log.warning("a client leaves keyframes out: %s", why or _counted(one.skipped), extra=subject)
        if one.state == "gone" and (was_there or before is None):
            how = "left" if one.heard_s < ABANDONED_AFTER else f"was not heard for {one.heard_s:.0f} s"
            log.info("a client %s: %s", how, _balance(one), extra=subject)

    def _summarise(self, health: Health) -> None:
        now = self._clock()
        seconds, self._counted_at = now - self._counted_at, now
        before = self._counted
        self._counted = {name: one for name, one in health.maps.items() if name in before}
        lines = [_progress(name, one, before[name], seconds) for name, one in self._counted.items()]
        if any(lines):
            fused = sum(
                one.keyframes_fused - before[name].keyframes_fused for name, one in self._counted.items()
            )
            clients = sum(one.state == "connected" for one in health.clients)
            log.info(
                "%s; in %.0f s: %s; %s connected, gateway %.0f MB",
                headline(health, rate=fused / seconds).words,
                seconds,
                "; ".join(filter(None, lines)),
                count_of(clients, "client"),
                health.rss_bytes / 1e6,
            )


def _progress(name: str, one: MapHealth, before: MapHealth, seconds: float) -> str:
    """Return in words the keyframes that a map received and fused since `before`; empty without any."""
    received = one.keyframes_durable - before.keyframes_durable
    fused = max(one.keyframes_fused - before.keyframes_fused, 0)
    if received <= 0 and not fused:
        return ""
    delay = one.delay_ms
    took = f", delay p50 {delay.p50:.0f} ms, p95 {delay.p95:.0f} ms" if delay.count else ""
    saved = ", checkpoint written" if one.checkpoints > before.checkpoints else ""
    return (
        f"map {name}: {count_of(received, 'keyframe')} received, {fused} fused ({fused / seconds:.1f}/s)"
        f"{took}, {one.map_bytes / 1e6:.0f} MB{saved}"
    )


def _balance(one: ClientHealth) -> str:
    """Return in words how many keyframes of a client had each outcome (fused, rejected, waiting …)."""
    words = [f"{count_of(one.durable, 'keyframe')} received, {one.fused} of them in the map"]
    counts = {"rejected by it": one.rejected, "refused": one.refused, "still in its spool": one.waiting}
    words += [f"{count} {what}" for what, count in counts.items() if count]
    if one.skipped:
        words.append(f"left out by the client: {_counted(one.skipped)}")
    return ", ".join(words)


def _counted(counts: dict[str, int]) -> str:
    """Return counts in words: {"thinned": 22} → 22 × thinned."""
    return ", ".join(f"{count} × {reason}" for reason, count in sorted(counts.items()))
