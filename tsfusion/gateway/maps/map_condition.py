# SPDX-License-Identifier: MIT
"""Describe the condition of a map and of a server: as a state, as problems in words, and as numbers."""

import logging
import time
from collections.abc import Callable, Iterator

from tsfusion.core import logs, process
from tsfusion.core.readable_numbers import count_of
from tsfusion.gateway.clients.client_routes import ABANDONED_AFTER, ClientRoutes
from tsfusion.gateway.health.metrics import Metrics
from tsfusion.gateway.health.problems import Problem, ProblemTimes
from tsfusion.gateway.maps.hosted_map import HostedMap
from tsfusion.gateway.maps.map_registry import MapRegistry
from tsfusion.gateway.ports.access_control import AccessControl
from tsfusion.wire.keys.key_folder import ALL_MAPS, AllowedMaps
from tsfusion.wire.messages.health import ClientHealth, Health, MapHealth, MapState, headline
from tsfusion.wire.messages.messages import SKIP_REASONS

_FOR_GONE = "what no checkpoint holds of them is lost, unless they are put back"
_INTERVAL = 1.0  # seconds between two checks
_CLIENT_PROBLEMS = 10  # lines about single clients
_STALLED_AFTER = 10.0  # seconds in which keyframes wait and none is fused
log = logging.getLogger(__name__)
_SUMMARY_INTERVAL = 60.0  # seconds between two summaries


def state_of(hosted: HostedMap) -> MapState:
    if hosted.fuser.failed:
        return "failed"
    if not hosted.warm or hosted.fuser.waits:
        return "opening"
    if not hosted.fuser.ready:
        return "restarting"
    return "idle" if hosted.drained else "busy"


def problem_of(hosted: HostedMap) -> str:
    """Return why keyframes are not accepted or not fused, and what to do; empty without a problem."""
    if problem := hosted.records.disk.problem or hosted.fuser.problem:
        return problem
    backlog = hosted.backlog
    since = 0.0 if backlog.is_empty else time.monotonic() - backlog.last_progress
    stalled = hosted.warm and since > _STALLED_AFTER
    if stalled and hosted.fuser.ready:
        return "keyframes wait and none is fused: its fuser makes a mesh or a checkpoint, or it hangs"
    return "keyframes wait, and its fuser is still starting again: read the log" if stalled else ""


def notices_of(hosted: HostedMap) -> list[str]:
    """Return problems of a map that a person should know, but that stop no keyframe."""
    journal = hosted.records.journal
    damaged, put_back = journal.damaged, journal.put_back
    lost = count_of(damaged, "keyframe of its journal is", "keyframes of its journal are")
    notices = [f"{lost} damaged and lost"] if damaged else []
    if absent := journal.absent:
        gone = count_of(absent, "segment of its journal was", "segments of its journal were")
        notices.append(f"{gone} not there at the start: {_FOR_GONE}")
    if missing := journal.missing:
        first = f"{missing[0]:06d}.mcap"
        gone = count_of(len(missing), "segment of its journal is", "segments of its journal are")
        notices.append(f"{gone} gone, first {first}: {_FOR_GONE}")
    if put_back:
        notices.append(
            f"its journal was taken away while it was written to, {count_of(put_back, 'time')}, and was "
            "put back with every keyframe: find out who deletes or moves files there"
        )
    if hosted.checkpoints.problem:
        notices.append(f"no checkpoint can be written: {hosted.checkpoints.problem}")
    if state_of(hosted) == "restarting" and not problem_of(hosted):
        notices.append("its fuser ended, and another one takes over: the log says why")
    notices += filter(None, (hosted.records.quarantine.problem, hosted.records.loss))
    return [*notices, *hosted.outcomes.notices.values()]


def health_of(hosted: HostedMap) -> MapHealth:
    """Return the health of a map, from what is known without asking the fuser."""
    now, outcomes, records = time.monotonic(), hosted.outcomes, hosted.records
    return MapHealth(
        state=state_of(hosted),
        problem=problem_of(hosted),
        keyframes_durable=hosted.keyframes_durable,
        keyframes_fused=outcomes.fused,
        waiting=hosted.backlog.keyframes,
        rejected=dict(outcomes.rejected),
        quarantined=len(records.quarantine),
        sessions=records.sessions.of_clients,
        journal_bytes=records.journal.nbytes,
        journal_damaged=records.journal.damaged,
        fuser_restarts=hosted.fuser.restarts,
        blocks=outcomes.blocks,
        map_bytes=outcomes.map_bytes,
        last_keyframe_s=None if records.last_keyframe is None else max(now - records.last_keyframe, 0.0),
        delay_ms=outcomes.delays.summary(),
        delay_bound_ms=outcomes.delays.bound_ms,
        corrections=records.corrections,
        corrections_waiting=hosted.corrections_waiting,
        corrections_unavailable=outcomes.moves.unavailable,
        keyframes_moved=outcomes.moves.moved,
        moving_s=outcomes.moves.seconds,
        keyframes_forgotten=outcomes.moves.forgotten,
        checkpoints=hosted.checkpoints.written,
        journal_missing=records.journal.absent + len(records.journal.missing),
        journal_put_back=records.journal.put_back,
        fusing_s=hosted.fuser.seconds_at_work,
        questions=dict(hosted.questions.by_outcome),
        question_ms=hosted.questions.delay_ms,
    )


def all_blocked(maps: dict[str, MapHealth]) -> bool:
    """True if no map takes and fuses keyframes. One good map is a reason to keep sending to this server."""
    return bool(maps) and all(one.problem for one in maps.values())


class ServerCondition:
    """Health of a server, from its maps and clients. The log and the metrics get it about once a second.

    Attributes:
        closed: why no connection is accepted; empty if they are.
    """

    def __init__(
        self,
        access: AccessControl,
        maps: MapRegistry,
        routes: ClientRoutes,
        metrics: Metrics,
        *,
        on_health: Callable[[Health], None],
    ) -> None:
        self._access, self._maps, self._routes = access, maps, routes
        self._metrics, self._on_health = metrics, on_health
        self._activity, self._problems = ActivityLog(), ProblemTimes()
        self._started = time.monotonic()
        self.next_look = 0.0
        self.closed = ""

    def step(self, health: Callable[[], Health]) -> None:
        """Give the health to the log and the metrics, about once a second."""
        now = time.monotonic()
        if now < self.next_look:
            return
        self.next_look = now + _INTERVAL
        logs.log_left_out()
        self._problems.note(self._find_problems())
        self._metrics.health = found = health()
        self._activity.note(found)
        self._on_health(found)

    def health(
        self,
        shown: AllowedMaps,
        *,
        is_accepting: bool,
        epoch: str,
        refused: dict[str, int],
        duplicates: int,
    ) -> Health:
        """Return the health of the server; see `Gateway.health`."""
        now = time.monotonic()
        maps = {hosted.name: health_of(hosted) for hosted in self._maps}
        blocked = self.closed or self._access.problem or all_blocked(maps)
        return Health(
            ready=is_accepting and not blocked,
            problems=self._problems.lines(self._find_problems(shown)),
            epoch=epoch,
            uptime_s=now - self._started,
            rss_bytes=process.rss_bytes(),
            refused=refused,
            duplicates=duplicates,
            maps={name: one for name, one in maps.items() if name in shown},
            clients=tuple(
                route.health(now, self._maps.session(route.map, route.session))
                for route in self._routes
                if route.map in shown
            ),
        )

    def _find_problems(self, shown: AllowedMaps = ALL_MAPS) -> list[Problem]:
        """Return present problems: of the server first, then of its maps, then of clients."""
        found = [Problem(self.closed, is_logged=True)] if self.closed else []
        if self._access.problem:
            found.append(Problem(f"nobody may connect: {self._access.problem}", is_logged=True))
        found += (one for one in self._of_maps() if one.map in shown)
        of_clients = [one for route in self._routes if route.map in shown and (one := route.problem)]
        if len(of_clients) > _CLIENT_PROBLEMS:
            rest = count_of(len(of_clients) - _CLIENT_PROBLEMS, "more client has", "more clients have")
            of_clients[_CLIENT_PROBLEMS:] = [Problem(f"{rest} problems of this kind")]
        return found + of_clients

    def _of_maps(self) -> Iterator[Problem]:
        """Yield the maps' problems, first those that keep a map from accepting or fusing keyframes."""
        for hosted in self._maps:
            if problem := problem_of(hosted):
                yield Problem(problem, hosted.name, is_logged=bool(hosted.records.disk.problem))
        yield from (Problem(notice, hosted.name) for hosted in self._maps for notice in notices_of(hosted))
        yield from (Problem(f"cannot be opened: {why}", name) for name, why in self._maps.unopened())


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
        if self._clock() - self._counted_at >= _SUMMARY_INTERVAL:
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
