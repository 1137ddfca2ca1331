# SPDX-License-Identifier: MIT
"""Scanner, gateway and fuser killed at seeded moments over a bad network; and what must be true afterwards.

The plan depends on the seed alone. What meets what depends on the machine: that is the point.
"""

import contextlib
import functools
import os
import random
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any, Literal

import msgspec
from msgspec import Struct
from proxy import Proxy
from scanner import LOST, Plan, Report, journals
from wire import NUMBERED_NS, Server, until, wall

from tsfusion import codec, journal
from tsfusion.client import fetch_status
from tsfusion.config import ClientConfig
from tsfusion.errors import TransportError
from tsfusion.transport import Status

SCANNER = Path(__file__).with_name("scanner.py")
VOXEL_SIZE = 0.04  # as `wire.Server`'s map
PATIENCE = 180.0
Kind = Literal["server", "fuser", "scanner"]
KINDS: tuple[Kind, ...] = ("server", "fuser", "scanner")

# Small files and frequent checkpoints: more moments at which a kill can hurt.
SERVER = {"checkpoint_every": 20, "segment_bytes": 1 << 18}
CLIENT = ClientConfig(policy="spool_all", stall_timeout=0.5, segment_bytes=1 << 16)


class Event(Struct, frozen=True):
    """One thing that goes wrong: a process killed, or the link spoiled until it is well again."""

    at: float  # seconds from the start
    what: str  # a Kind, or a method of Proxy
    value: float | bool | None = None  # what the method is called with; None = nothing
    lasts: float = 0.0


class Kill(Struct, frozen=True):
    at: float
    kind: Kind
    ready: bool  # the server had been


class Result(Struct, kw_only=True):
    """One seed's outcome. `problems` is empty when every promise was kept."""

    seed: int
    problems: list[str]
    keyframes: int
    rate: float
    seconds: float
    kills: dict[str, int]
    before_ready: int  # kills of server or fuser while it started
    kill_times: list[Kill]
    link_faults: list[str]
    server_exits: list[str]  # of its own accord; it was started again
    sessions: int
    segments: int
    duplicates: int  # of the last server's life
    carried_per_journaled: float  # bytes over the link / bytes in the journal


def schedule(seed: int, kills: int, mean_gap: float) -> tuple[float, list[Event]]:
    """The rate of sending, and what goes wrong when."""
    rng = random.Random(seed)
    rate = rng.uniform(20, 40)
    kinds = [KINDS[i % len(KINDS)] for i in range(kills)]
    rng.shuffle(kinds)
    events, at = [], 0.3
    for kind in kinds:
        at += rng.uniform(0.1, 2 * mean_gap)
        events.append(Event(at, kind))
    end, at = at + mean_gap, 0.5
    while at < end:
        event = _fault(rng, at)
        events.append(event)
        at += event.lasts + rng.uniform(0.3, 2.0)
    return rate, sorted(events, key=lambda event: event.at)


def _fault(rng: random.Random, at: float) -> Event:
    what = rng.choice(["cut", "half_close", "refuse", "throttle", "delay", "freeze", "swallow"])
    value: float | bool | None = True
    if what in ("cut", "half_close"):
        return Event(at, what)
    if what == "throttle":
        value = rng.uniform(20e3, 80e3)
    elif what == "delay":
        value = rng.uniform(0.01, 0.08)
    return Event(at, what, value, rng.uniform(0.3, 2.0))


class Daemon:
    """Keeps a server running, as an init system would, and shows the proxy where it is."""

    def __init__(self, state: Path, proxy: Proxy, **settings: Any) -> None:
        self.exits: list[str] = []
        self.ready = False
        self._state, self._proxy, self._settings = state, proxy, settings
        self._ended = False
        self._killed = False
        self.server = self._start()
        self._thread = threading.Thread(target=self._keep)
        self._thread.start()

    def _start(self) -> Server:
        return Server(self._state, wait=False, **self._settings)

    def _keep(self) -> None:
        while True:
            if self.server.wait_ready():
                self._proxy.target(self.server.address, self.server.control)
                self.ready = True
                self.server.process.wait()
            self.ready = False
            self._proxy.target(None)
            if self._ended:
                return
            if not self._killed:
                self.exits.append(self.server.said()[-500:])
            self._killed = False
            self.server.close()
            self.server = self._start()

    def kill(self) -> None:
        """SIGKILL, ready or not. A fuser that still runs dies with it."""
        server = self.server
        self._killed = True
        server.process.kill()
        until(lambda: self.server is not server)

    def kill_fuser(self) -> None:
        """SIGKILL to the fuser, once there is one."""

        def killed() -> bool:
            with contextlib.suppress(OSError, AssertionError):
                os.kill(self.server.fuser_pid(), signal.SIGKILL)
                return True
            return False

        until(killed)

    def stop(self) -> int:
        """SIGTERM: drain, checkpoint, end. The exit status."""
        until(lambda: self.ready, PATIENCE)
        self._ended = True
        self.server.process.terminate()
        return self.server.process.wait(PATIENCE)

    def close(self) -> None:
        self._ended = True
        self.server.process.kill()
        self._thread.join()
        self.server.close()


class Scanner:
    """Starts a scanner again and again until one has seen everything fused."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.problem = ""
        self._done = threading.Event()
        self._ended = self._killed = False
        self._process = self._start()
        self._thread = threading.Thread(target=self._keep)
        self._thread.start()

    def _start(self) -> "subprocess.Popen[str]":
        command = [sys.executable, str(SCANNER), msgspec.json.encode(self.plan).decode()]
        return subprocess.Popen(command, stderr=subprocess.PIPE, text=True)

    def _keep(self) -> None:
        while True:
            _, words = self._process.communicate()
            if self._process.returncode == 0 or self._ended:
                break
            if not self._killed or self._process.returncode == LOST:
                self.problem = f"the scanner ended with status {self._process.returncode}: {words[-1000:]}"
                break
            self._killed = False
            self._process = self._start()
        self._done.set()

    def kill(self) -> None:
        """SIGKILL; it is started again. One that has finished cannot be killed."""
        process = self._process
        self._killed = True
        process.kill()
        until(lambda: self._process is not process or self._done.is_set())

    @property
    def finished(self) -> bool:
        """Whether there will be no more of it."""
        return self._done.is_set()

    def wait(self) -> None:
        """Until everything is fused, or something is wrong."""
        if not self._done.wait(PATIENCE):
            self.problem = f"not everything was fused in {PATIENCE:.0f} s"

    def report(self) -> Report:
        """Of the life that saw the end."""
        assert self.plan.report is not None
        return msgspec.json.decode(Path(self.plan.report).read_bytes(), type=Report)

    def close(self) -> None:
        self._ended = True
        self._process.kill()
        self._thread.join()


def run(seed: int, folder: Path, *, keyframes: int = 300, kills: int = 12, mean_gap: float = 1.1) -> Result:
    """One seed in an empty folder."""
    rate, events = schedule(seed, kills, mean_gap)
    started = time.monotonic()
    state = folder / "state"
    killed: list[Kill] = []
    with contextlib.ExitStack() as stack:
        proxy = stack.enter_context(Proxy())
        daemon = Daemon(state, proxy, **SERVER)
        stack.callback(daemon.close)
        scanner = Scanner(_plan(folder, proxy.address, keyframes, rate))
        stack.callback(scanner.close)
        for event in _unfolded(events):
            time.sleep(max(started + event.at - time.monotonic(), 0))
            ready, at = daemon.ready, round(time.monotonic() - started, 2)
            if _do(event, proxy, daemon, scanner):
                killed.append(Kill(at, event.what, ready))  # type: ignore[arg-type]
        proxy.heal()
        scanner.wait()
        problems = [scanner.problem] if scanner.problem else []
        status = _status(daemon)
        problems += [] if status else ["the server says nothing of itself"]
        if not problems and (code := daemon.stop()):
            problems.append(f"the server ended with status {code} when told to")
    seconds = time.monotonic() - started
    if status and not problems:
        problems += _server_problems(status, keyframes) + _client_problems(scanner.report())
        problems += verify(state, keyframes, status.map_hash)
    written = sum(path.stat().st_size for journal in journals(state) for path in journal.glob("*.mcap"))
    return Result(
        seed=seed,
        problems=problems,
        keyframes=keyframes,
        rate=round(rate, 1),
        seconds=round(seconds, 1),
        kills={kind: sum(kill.kind == kind for kill in killed) for kind in KINDS},
        before_ready=sum(not kill.ready and kill.kind != "scanner" for kill in killed),
        kill_times=killed,
        link_faults=[event.what for event in events if event.what not in KINDS],
        server_exits=daemon.exits,
        sessions=status.sessions if status else 0,
        segments=sum(len(journal.segments(one)) for one in journals(state)),
        duplicates=status.duplicates if status else 0,
        carried_per_journaled=round(proxy.carried / max(written, 1), 2),
    )


def _plan(folder: Path, address: str, keyframes: int, rate: float) -> Plan:
    return Plan(
        address=address,
        spool=str(folder / "spool"),
        state=str(folder / "state"),
        count=keyframes,
        rate=rate,
        log=str(folder / "taken"),
        report=str(folder / "report.json"),
        patience=PATIENCE,
        client=CLIENT,
    )


def _unfolded(events: list[Event]) -> list[Event]:
    """With the end of each fault as an event of its own."""
    ends = [
        Event(event.at + event.lasts, event.what, None if event.what == "throttle" else 0)
        for event in events
        if event.lasts
    ]
    return sorted([*events, *ends], key=lambda event: event.at)


def _do(event: Event, proxy: Proxy, daemon: Daemon, scanner: Scanner) -> bool:
    """Whether somebody was killed."""
    if event.what == "server":
        daemon.kill()
    elif event.what == "fuser":
        daemon.kill_fuser()
    elif event.what == "scanner":
        if scanner.finished:
            return False
        scanner.kill()
    else:
        method = getattr(proxy, event.what)
        method(*([event.value] if event.what not in ("cut", "half_close") else []))
        return False
    return True


def _status(daemon: Daemon) -> Status | None:
    found: list[Status] = []

    def answered() -> bool:
        with contextlib.suppress(TransportError):
            found.append(fetch_status(daemon.server.address, timeout=5.0))
        return bool(found)

    with contextlib.suppress(AssertionError):
        until(lambda: daemon.ready and answered())
    return found[0] if found else None


def _server_problems(status: Status, keyframes: int) -> list[str]:
    problems = []
    counted = (status.keyframes_durable, status.keyframes_fused)
    if counted != (keyframes, keyframes):
        problems.append(f"durable and fused are {counted}, not {keyframes}")
    if status.keyframes_rejected or set(status.messages_refused) - {"gap"}:
        problems.append(f"rejected {status.keyframes_rejected}, refused {status.messages_refused}")
    if status.journal_damaged:
        problems.append(f"{status.journal_damaged} records are damaged")
    return problems


def _client_problems(report: Report) -> list[str]:
    lost = {**report.refused, **report.rejected, **report.skipped}
    return [f"the scanner counts lost keyframes: {lost}"] if lost else []


def verify(state: Path, keyframes: int, map_hash: str) -> list[str]:
    """What is wrong with the files and the map that a stopped server left; empty = nothing."""
    problems = []
    last: dict[bytes, tuple[int, int]] = {}
    found = []
    for folder in journals(state):
        for number in journal.segments(folder):
            path = journal.segment_path(folder, number)
            if damaged := journal.scan(path)[1]:
                problems.append(f"{damaged} damaged records in {path.name}")
            for record in journal.records(path):
                i = codec.unpack(record.frames[0]).timestamp_ns - NUMBERED_NS
                if (record.seq, i) <= last.get(record.session, (0, -1)) or i < last.get(record.session, (0, -1))[1]:
                    problems.append(f"keyframe {i} (seq {record.seq}) comes after {last[record.session]}")
                last[record.session] = (record.seq, i)
                found.append(i)
    if sorted(found) != list(range(keyframes)):
        missing = sorted(set(range(keyframes)) - set(found))
        twice = sorted({i for i in found if found.count(i) > 1})
        problems.append(f"the journal has {len(found)} keyframes: missing {missing}, twice {twice}")
    return problems + _map_problems(state, keyframes, map_hash)


def _map_problems(state: Path, keyframes: int, map_hash: str) -> list[str]:
    from tsfusion import Volume

    (path,) = [*state.glob("maps/*/map.tsf"), *state.glob("map.tsf")]
    hashes = {
        "undisturbed": undisturbed_hash(keyframes),
        "told": map_hash,
        "saved": Volume.load(path).map_hash(),
    }
    return [] if len(set(hashes.values())) == 1 else [f"the map's hashes differ: {hashes}"]


@functools.cache
def undisturbed_hash(keyframes: int) -> str:
    """Of the map that nothing happened to."""
    from tsfusion import Volume

    volume = Volume(voxel_size=VOXEL_SIZE, threads=1)
    for i in range(keyframes):
        volume.integrate(wall(i))
    return volume.map_hash()
