# SPDX-License-Identifier: MIT
"""A server under attack, one kind after the other, and what a well-behaved scanner notices of it."""

import contextlib
import os
import resource
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
from keyframes_and_servers import (
    NUMBERED_NS,
    UNSECURED,
    Secured,
    Server,
    map_hash,
    secured,
    serving,
    until,
    wall,
)
from msgspec import Struct

from lab.reliability.attack_target import Access, Target
from lab.reliability.attacks import ATTACKS
from lab.reliability.hostile_watch import Seen, Watch
from lab.reliability.scanner_process import Plan, Report, journals, plan_in
from lab.reliability.supervisors import PATIENCE, SCANNER
from tsfusion import journal
from tsfusion.core.config import ClientConfig, ServerConfig, override
from tsfusion.pipelines.report import latency_ledger
from tsfusion.wire.asking.queries import fetch_status
from tsfusion.wire.keys import key_folder
from tsfusion.wire.messages import health
from tsfusion.wire.messages.health import Spread
from tsfusion.wire.messages.messages import KeyframeTimes
from tsfusion.wire.records.record_header import unpack_keyframe
from tsfusion.wire.sockets.curve import client_keys

RATE = 8.0  # keyframes a second of the well-behaved one
MEMORY_BYTES = ServerConfig().memory_bytes  # the bound on the gateway
FUSER_MEMORY_BYTES = 2 << 30
_LOGS = 'from tsfusion.core import logs\nlogs.configure("text", "warning")\n'  # cut short, as `serve` does
_ATTACKS = Path(__file__).with_name("attacks.py")
_FILES = 8192
_MORE_FILES = 30  # of maps that were opened meanwhile
_PEACE_S = 2.0
_HANGS_S = 120.0  # after an attack; a server that is not well by then stays as it is


class Bounds(Struct, frozen=True, kw_only=True):
    """Limits on what others may notice.

    Attributes:
        delay_s: 99 of 100 keyframes are fused so soon after they were captured.
        control_s: the longest wait for an answer of the control port.
        slack_bytes: of the gateway's memory above `MEMORY_BYTES`.
    """

    delay_s: float = 1.0
    control_s: float = 1.0
    slack_bytes: int = 0


class Phase(Struct, kw_only=True):
    """An attack (or none) and its effect on the others, until everything is as before."""

    attack: str
    hostile: int  # messages, connections or bytes of it
    seconds: float
    recovered_s: float  # from its end until everything is as before
    durable_ms: Spread  # captured → on the server's disk, of the well-behaved scanner's keyframes
    fused_ms: Spread
    seen: Seen


class Outcome(Struct, kw_only=True):
    """`problems` is empty when the server held."""

    problems: list[str]
    phases: list[Phase]
    keyframes: int = 0
    map_hash: str = ""
    refused: dict[str, int] = {}
    rejected: dict[str, int] = {}


class _Span(Struct):
    attack: str
    hostile: int
    started: float
    ended: float
    well: float  # again
    seen: Seen


def run(
    folder: Path,
    seconds: float,
    attacks: tuple[str, ...] = tuple(ATTACKS),
    *,
    access: Access = "open",
    bounds: Bounds = Bounds(),  # noqa: B008  frozen
) -> Outcome:
    """A little peace, `seconds` of each attack, and a little peace again, at one server."""
    given, target = _secured(folder / "keys", access)
    names = ("", *attacks, "")
    _raise_file_limit()
    limits: dict[str, Any] = {"memory_bytes": MEMORY_BYTES, "fuser_memory_bytes": FUSER_MEMORY_BYTES}
    with contextlib.ExitStack() as stack:
        server = stack.enter_context(serving(folder / "state", code=_LOGS, **{**limits, **given.server}))
        target = msgspec.structs.replace(target, data=server.address, control=server.control)
        plan = _plan(folder, server, given)
        scanner = subprocess.Popen([sys.executable, str(SCANNER), msgspec.json.encode(plan).decode()])
        stack.callback(scanner.kill)
        until(lambda: len(list((folder / "spool").glob("*.mcap"))) > 0)  # it sends
        files = _files(server)
        watch = Watch(server, given)
        stack.callback(watch.close)
        attacker = stack.enter_context(_attacker(target))
        spans = [_attack(server, attacker, name, seconds, watch) for name in names]
        watch.close()
        (folder / "enough").touch()
        problems = []
        if scanner.wait(PATIENCE + 30):
            problems.append("the well-behaved scanner did not see everything fused")
        if server.process.poll() is not None:
            problems.append(f"the server died: {server.stderr_text()[-1000:]}")
            return Outcome(problems=problems, phases=[])
        with contextlib.suppress(AssertionError):  # who never greets is cut off after five seconds
            until(lambda: _files(server) <= files + _MORE_FILES, 15.0)
        if (left := _files(server)) > files + _MORE_FILES:
            problems.append(f"{left - files} connections were left behind")
        found = _outcome(folder, server, spans, problems, given=given, bounds=bounds)
    if found.map_hash:
        found.problems += _inexact(folder / "state", found.keyframes, found.map_hash, access)
    return found


def _secured(folder: Path, access: Access) -> tuple[Secured, Target]:
    """The keys of the server and its scanner, and what an attacker has of that."""
    if access == "open":
        return UNSECURED, Target()
    given = secured(folder)
    assert given.keys is not None
    if access == "stranger":
        return given, Target(server_key=given.keys.server)
    public = key_folder.create_pair(folder / "attacker", "attacker").public
    key_folder.allow(folder / "server", "attacker", public)
    own = client_keys(str(folder / "attacker" / "attacker.key_secret"), given.keys.server)
    assert own is not None
    return given, Target(server_key=own.server, public=own.public, secret=own.secret)


@contextlib.contextmanager
def _attacker(target: Target) -> Iterator["subprocess.Popen[str]"]:
    command = [sys.executable, str(_ATTACKS), msgspec.json.encode(target).decode()]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


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


def _attack(
    server: Server, attacker: "subprocess.Popen[str]", name: str, seconds: float, watch: Watch
) -> _Span:
    hostile = 0
    if name:
        assert attacker.stdin is not None
        assert attacker.stdout is not None
        attacker.stdin.write(f"{seconds} {name}\n")
        attacker.stdin.flush()
        attacker.stdout.readline()
        started = watch.begin()
        if not (count := attacker.stdout.readline()):
            raise RuntimeError(f"the attack {name!r} failed")
        hostile = int(count)
    else:
        started = watch.begin()
        time.sleep(min(seconds, _PEACE_S))
    ended = time.monotonic()
    with contextlib.suppress(AssertionError):
        until(lambda: watch.well(ended) or server.process.poll() is not None, _HANGS_S)
    well = time.monotonic()
    return _Span(name or "none", hostile, started, ended, well, watch.seen(started, well))


def _outcome(
    folder: Path, server: Server, spans: list[_Span], problems: list[str], *, given: Secured, bounds: Bounds
) -> Outcome:
    report = _report(folder)
    phases = [_phase(span, report.times if report else [], bounds) for span in spans]
    problems += [problem for phase in phases for problem in _exceeded(phase, bounds)]
    if report is None:
        return Outcome(problems=problems, phases=phases)
    status = fetch_status(server.address, keys=given.keys, timeout=PATIENCE)
    if (report.durable, report.fused, report.refused, report.rejected) != (report.sent, report.sent, {}, {}):
        lost = {**report.refused, **report.rejected}
        problems.append(f"of {report.sent} keyframes {report.fused} are in the map: {lost}")
    return Outcome(
        problems=problems,
        phases=phases,
        keyframes=report.sent,
        map_hash=status.map_hash,
        refused=status.messages_refused,
        rejected=status.keyframes_rejected,
    )


def _inexact(state: Path, sent: int, told_hash: str, access: Access) -> list[str]:
    """Mistakes in the journal; and in the map, where no keyframe of an attacker could come into it."""
    (folder,) = [one for one in journals(state) if one.parent.name == "default"]
    sessions: dict[bytes, list[int]] = {}
    for number in journal.segments(folder):
        for record in journal.records(journal.segment_path(folder, number)):
            own = sessions.setdefault(record.session, [])
            if not record.is_correction:
                own.append(unpack_keyframe(record.frames[0]).timestamp_ns - NUMBERED_NS)
    if list(range(sent)) not in sessions.values():
        return [f"the journal has not the {sent} keyframes of the well-behaved scanner, each once"]
    if len(sessions) == 1 and told_hash != map_hash(map(wall, range(sent))):
        return ["the map is not that of the keyframes of the well-behaved scanner"]
    strangers = access == "stranger" and len(sessions) - 1
    return [f"{strangers} sessions of strangers are in the journal"] if strangers else []


def _report(folder: Path) -> Report | None:
    with contextlib.suppress(OSError):
        return msgspec.json.decode((folder / "report.json").read_bytes(), type=Report)
    return None


def _exceeded(phase: Phase, bounds: Bounds) -> list[str]:
    if phase.attack == "none":
        return []
    problems = []
    seen = phase.seen
    if phase.fused_ms.p99 > 1e3 * bounds.delay_s:
        problems.append(f"{phase.attack}: p99 of the delay is {phase.fused_ms.p99 / 1e3:.2f} s")
    if seen.control_s > bounds.control_s:
        problems.append(f"{phase.attack}: an answer of the control port took {seen.control_s:.2f} s")
    if seen.gateway_mb * 1e6 > MEMORY_BYTES + bounds.slack_bytes:
        problems.append(f"{phase.attack}: the gateway held {seen.gateway_mb} MB")
    if seen.restarts:
        problems.append(f"{phase.attack}: the fuser was restarted {seen.restarts} times")
    return problems


def _phase(span: _Span, times: list[KeyframeTimes], bounds: Bounds) -> Phase:
    sent = [one for one in times if span.started <= one.captured_ns / 1e9 < span.well]
    late = [one.fused_ns / 1e9 for one in sent if one.fused_ns - one.captured_ns > 1e9 * bounds.delay_s]
    return Phase(
        attack=span.attack,
        hostile=span.hostile,
        seconds=round(span.ended - span.started, 2),
        recovered_s=round(max(span.well, *late, 0.0) - span.ended, 2),
        durable_ms=health.spread(latency_ledger.durations_ms(sent, "captured_ns", "durable_ns")),
        fused_ms=health.spread(latency_ledger.durations_ms(sent, "captured_ns", "fused_ns")),
        seen=span.seen,
    )


def _line(name: str, *words: str) -> str:
    return f"{name:20}" + "".join(f"{word:>11}" for word in words)


_DELAYS = ("p50 ms", "p99 ms", "longest ms")
_OTHERS = ("control ms", "gateway MB", "fuser MB", "restarts", "well s")
HEADING = _line("attack", "hostile", *_DELAYS, *_OTHERS)


def row(one: Phase) -> str:
    """A line of the table for people, with the problems that the server itself told."""
    seen, delay = one.seen, one.fused_ms
    figures = (delay.p50, delay.p99, delay.max, 1e3 * seen.control_s, seen.gateway_mb, seen.fuser_mb)
    words = (*(f"{figure:.0f}" for figure in figures), str(seen.restarts), f"{one.recovered_s:.1f}")
    return _line(one.attack, str(one.hostile), *words) + "".join(f"  {said}" for said in seen.problems)


def markdown_row(one: Phase) -> str:
    """The same as a row of docs/delivery.md, in seconds and MB."""
    seen = one.seen
    seconds = (one.fused_ms.p99 / 1e3, seen.control_s, one.recovered_s)
    delay, answer, well = (f"{second:.2f}" if second < 10 else f"{second:.0f}" for second in seconds)
    return f"| {one.attack} | {delay} / {answer} s | {seen.gateway_mb:.0f} MB | {well} s |"


def table(outcome: Outcome) -> str:
    """Table for people, one line an attack."""
    return "\n".join((HEADING, *map(row, outcome.phases)))
