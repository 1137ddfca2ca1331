# SPDX-License-Identifier: MIT
"""A server under attack, one kind after the other, and what a well-behaved scanner notices of it."""

import contextlib
import os
import resource
import subprocess
import sys
import threading
import time
from pathlib import Path

import msgspec
from attacks import ATTACKS
from keyframes_and_servers import UNSECURED, Secured, Server, secured, serving, until
from msgspec import Struct
from scanner_process import Plan, Report, plan_in
from supervisors import PATIENCE, SCANNER

from tsfusion.core.config import ClientConfig, override
from tsfusion.pipelines import latency_ledger
from tsfusion.wire import keyframe_times
from tsfusion.wire.keyframe_times import KeyframeTimes, Spread

RATE = 8.0  # keyframes a second of the well-behaved one
MEMORY_BYTES = 192 << 20  # the bound on the gateway
# What may come over it: a tick's worth of input before the gateway looks, and what the allocator keeps.
MEMORY_SLACK = 128 << 20
_ATTACK = Path(__file__).with_name("attacks.py")
_FILES = 8192
_MORE_FILES = 30  # of maps that were opened meanwhile


class Phase(Struct, kw_only=True):
    """An attack (or none) and its effect on the others."""

    attack: str
    hostile: int  # messages, connections or bytes of it
    seconds: float
    durable_ms: Spread  # captured → on the server's disk, of the well-behaved scanner's keyframes
    fused_ms: Spread
    gateway_mb: float  # highest RSS
    fuser_mb: float


class Outcome(Struct, kw_only=True):
    """`problems` is empty when the server held."""

    problems: list[str]
    phases: list[Phase]
    keyframes: int
    refused: dict[str, int]
    rejected: dict[str, int]


class Rss:
    """The highest RSS of server and largest fuser since last asked, looked at all the time."""

    def __init__(self, server: Server) -> None:
        self._server = server
        self._over = threading.Event()
        self._highest = [0, 0]
        self._thread = threading.Thread(target=self._look)
        self._thread.start()

    def _look(self) -> None:
        while not self._over.wait(0.02):
            with contextlib.suppress(OSError):
                held = [[self._server.process.pid], self._server.children()]
                for at, pids in enumerate(held):
                    self._highest[at] = max(self._highest[at], *map(rss_bytes, pids), 0)

    def highest(self) -> list[int]:
        """Highest RSS of gateway and fuser since the last call, bytes."""
        found, self._highest = self._highest, [0, 0]
        return found

    def close(self) -> None:
        self._over.set()
        self._thread.join()


def rss_bytes(pid: int) -> int:
    """RSS of a process; 0 when it has ended."""
    with contextlib.suppress(OSError):
        for line in Path(f"/proc/{pid}/status").read_text().splitlines():
            if line.startswith("VmRSS:"):
                return int(line.split()[1]) * 1024
    return 0


def run(
    folder: Path, seconds: float, attacks: tuple[str, ...] = tuple(ATTACKS), *, keys: bool = False
) -> Outcome:
    """`seconds` of peace, so many of each attack, and the same of peace again.

    Args:
        keys: the server asks for them, and the attackers have none.
    """
    given = secured(folder / "keys") if keys else UNSECURED
    names = ("", *attacks, "")
    _raise_file_limit()
    with contextlib.ExitStack() as stack:
        server = stack.enter_context(serving(folder / "state", memory_bytes=MEMORY_BYTES, **given.server))
        plan = _plan(folder, server, given)
        scanner = subprocess.Popen([sys.executable, str(SCANNER), msgspec.json.encode(plan).decode()])
        stack.callback(scanner.kill)
        rss = Rss(server)
        stack.callback(rss.close)
        until(lambda: len(list((folder / "spool").glob("*.mcap"))) > 0)  # it sends
        files = _files(server)
        public = given.keys.server if given.keys else ""
        spans = [_attack(server, public, name, seconds, rss) for name in names]
        (folder / "enough").touch()
        problems = []
        if scanner.wait(PATIENCE):
            problems.append("the well-behaved scanner did not see everything fused")
        if server.process.poll() is not None:
            problems.append(f"the server died: {server.stderr_text()[-1000:]}")
            return Outcome(problems=problems, phases=[], keyframes=0, refused={}, rejected={})
        with contextlib.suppress(AssertionError):  # who never greets is cut off after five seconds
            until(lambda: _files(server) <= files + _MORE_FILES, 15.0)
        if (left := _files(server)) > files + _MORE_FILES:
            problems.append(f"{left - files} connections were left behind")
        return _outcome(folder, server, spans, problems, given)


def _files(server: Server) -> int:
    return len(os.listdir(f"/proc/{server.process.pid}/fd"))


def _raise_file_limit() -> None:
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = max(soft, min(_FILES, hard) if hard != resource.RLIM_INFINITY else _FILES)
    resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))


def _plan(folder: Path, server: Server, given: Secured) -> Plan:
    client = override(ClientConfig(policy="spool_all"), **given.client)
    enough = str(folder / "enough")
    return plan_in(
        folder, server.address, count=1_000_000, rate=RATE, until=enough, patience=PATIENCE, client=client
    )


class _Span(Struct):
    attack: str
    hostile: int
    started: float
    ended: float
    rss: list[int]


def _attack(server: Server, public: str, name: str, seconds: float, rss: Rss) -> _Span:
    hostile = 0
    if name:
        at = [server.address, server.control, server.publish, public]
        command = [sys.executable, str(_ATTACK), name, *at, str(seconds)]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            process.stdout.readline()
            started = time.monotonic()
            rss.highest()
            hostile = int(process.stdout.read() or 0)
        if process.returncode:
            raise RuntimeError(f"the attack {name!r} failed")
    else:
        started = time.monotonic()
        rss.highest()
        time.sleep(seconds)
    return _Span(name or "none", hostile, started, time.monotonic(), rss.highest())


def _outcome(
    folder: Path, server: Server, spans: list[_Span], problems: list[str], given: Secured
) -> Outcome:
    from tsfusion.wire.queries import fetch_status

    report = msgspec.json.decode((folder / "report.json").read_bytes(), type=Report)
    status = fetch_status(server.address, keys=given.keys)
    if (report.durable, report.fused, report.refused, report.rejected) != (report.sent, report.sent, {}, {}):
        problems.append(f"of {report.sent} keyframes {report.fused} are in the map")
    if given is not UNSECURED and status.keyframes_durable != report.sent:
        problems.append(f"{status.keyframes_durable - report.sent} keyframes of strangers are in the journal")
    if status.fuser_restarts:
        problems.append(f"the fuser was restarted {status.fuser_restarts} times")
    phases = [_phase(span, report.times) for span in spans]
    for phase in phases:
        if phase.gateway_mb * 1e6 > MEMORY_BYTES + MEMORY_SLACK:
            problems.append(f"{phase.attack}: the gateway held {phase.gateway_mb} MB")
    return Outcome(
        problems=problems,
        phases=phases,
        keyframes=report.sent,
        refused=status.messages_refused,
        rejected=status.keyframes_rejected,
    )


def _phase(span: _Span, times: list[KeyframeTimes]) -> Phase:
    sent = [one for one in times if span.started <= one.captured_ns / 1e9 < span.ended]
    gateway, fuser = (round(size / 1e6, 1) for size in span.rss)
    return Phase(
        attack=span.attack,
        hostile=span.hostile,
        seconds=round(span.ended - span.started, 2),
        durable_ms=keyframe_times.spread(latency_ledger.durations_ms(sent, "captured_ns", "durable_ns")),
        fused_ms=keyframe_times.spread(latency_ledger.durations_ms(sent, "captured_ns", "fused_ns")),
        gateway_mb=gateway,
        fuser_mb=fuser,
    )


def table(outcome: Outcome) -> str:
    """Table for people, one line an attack."""
    head = ("attack", "hostile", "durable p50", "p95 ms", "fused p50", "p95 ms", "gateway MB", "fuser MB")
    rows = [head]
    for one in outcome.phases:
        delays = (one.durable_ms.p50, one.durable_ms.p95, one.fused_ms.p50, one.fused_ms.p95)
        memory = (one.gateway_mb, one.fuser_mb)
        rows.append(
            (one.attack, str(one.hostile), *(f"{x:.1f}" for x in delays), *(f"{x:.0f}" for x in memory))
        )
    return "\n".join(f"{name:20}" + "".join(f"{word:>12}" for word in words) for name, *words in rows)
