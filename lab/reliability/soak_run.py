# SPDX-License-Identifier: MIT
"""Keyframes of three scanners for a long time, kills and a full disk among them; what grows, what is lost."""

import contextlib
import functools
import os
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import small_disks
from keyframes_and_servers import lasting_address, map_hash, until
from msgspec import Struct

from lab.reliability.hostile_watch import rss_bytes
from lab.reliability.scanner_process import plan_in, save_room, source
from lab.reliability.supervisors import Daemon, Scanner
from tsfusion import VolumeConfig
from tsfusion.core.config import ClientConfig
from tsfusion.core.errors import TsfusionError
from tsfusion.wire.asking.map_watcher import MapWatcher
from tsfusion.wire.asking.queries import fetch_health, fetch_status
from tsfusion.wire.messages.health import Status

SCANNERS = 3
VIEWS = 60  # of the room; after them the map has every block it will ever have
WIDTH = 80  # pixels
VOLUME = VolumeConfig(voxel_size=0.05, threads=1)
TOLERANCE_MB = 16.0  # growth of a process, and of the files, in the calm part
_JOURNAL_BYTES = 16 << 20
_SEGMENT_BYTES = 1 << 20
_DISK_MIB = 128
_SETTINGS = {
    "checkpoint_every": 200,
    "segment_bytes": _SEGMENT_BYTES,
    "journal_bytes": _JOURNAL_BYTES,
    "min_free_bytes": 1 << 20,
    "quota_keyframes": 1e6,
}
_KILLS_UNTIL, _CALM_FROM = 0.5, 0.6  # of the keyframes
_FIRST_USE = 16  # files or threads that a fuser opens when it first needs them; a leak goes on
_FULL_AT = 0.3  # then the disk is full for a while
_FULL_S = 1.0
_INTERVAL = 0.1  # seconds between samples
_PATIENCE = 600.0  # seconds without a keyframe


class Process(Struct, frozen=True):
    """Memory, files and threads of a process at one moment; of scanners, the most that one of them has."""

    rss_mb: float
    files: int
    threads: int


class Sample(Struct, frozen=True):
    seconds: float
    durable: int  # keyframes
    blocks: int
    disk_mb: float  # of the server's files
    processes: dict[str, Process]


class Event(Struct, frozen=True):
    seconds: float
    what: str


class Outcome(Struct, kw_only=True):
    """`problems` is empty when nothing was lost or altered, and nothing grew."""

    problems: list[str]
    keyframes: int
    seconds: float
    per_second: float
    blocks: int
    kills: int
    disk_filled: bool  # False = no small file system could be mounted
    rise_mb: dict[str, float]  # by least squares, from the calm part's beginning to its end
    events: list[Event]
    samples: list[Sample]


def run(folder: Path, keyframes: int, *, kills: int = 3, tolerance_mb: float = TOLERANCE_MB) -> Outcome:
    """Three scanners send as fast as the map takes it, somebody views the mesh and asks for the health.

    Args:
        keyframes: of all scanners together.
        kills: of server, fuser and a scanner in turn, in the first half; the second half is calm.
    """
    room, disk = folder / "room.npz", folder / "disk"
    save_room(room, VIEWS, WIDTH)
    unfillable = small_disks.mount(disk, _DISK_MIB)
    started = time.monotonic()
    with contextlib.ExitStack() as stack:
        stack.callback(small_disks.unmount, disk)
        address = lasting_address()
        daemon = Daemon(disk / "state", None, volume=VOLUME, listen=address, **_SETTINGS)
        stack.callback(daemon.close)
        until(lambda: daemon.ready)
        scanners = [_scanner(folder, disk / "state", address, first, keyframes) for first in range(SCANNERS)]
        for scanner in scanners:
            stack.callback(scanner.close)
        trouble = _Trouble(daemon, scanners, None if unfillable else disk / "filler", started)
        worker = threading.Thread(target=trouble.work, args=(keyframes, kills), daemon=True)
        worker.start()
        samples = list(_samples(daemon, scanners, trouble, started))
        if not any(scanner.problem for scanner in scanners):
            worker.join()
        seconds = time.monotonic() - started
        problems = [scanner.problem for scanner in scanners if scanner.problem] + trouble.problems
        status = fetch_status(address, timeout=60.0)
        if stopped := daemon.stop():
            problems.append(f"the server ended with status {stopped}")
        problems += [f"the server ended by itself: {words}" for words in daemon.exits]
    calm = _calm(samples, keyframes, trouble.events)
    problems += _lost(status, scanners, keyframes, room) + _growth(calm, tolerance_mb)
    return Outcome(
        problems=problems,
        keyframes=keyframes,
        seconds=round(seconds, 1),
        per_second=round(keyframes / seconds, 1),
        blocks=status.blocks,
        kills=sum("killed" in event.what for event in trouble.events),
        disk_filled=not unfillable,
        rise_mb=_rises(calm),
        events=trouble.events,
        samples=samples,
    )


def _scanner(folder: Path, state: Path, address: str, first: int, keyframes: int) -> Scanner:
    own = {name: str(folder / f"{name}-{first}") for name in ("spool", "log", "report")}
    client = ClientConfig(policy="block", backlog=16)
    return Scanner(
        plan_in(
            folder, address, state=str(state), count=keyframes, first=first, step=SCANNERS, trimmed=True,
            room=str(folder / "room.npz"), patience=_PATIENCE, client=client, **own,
        )
    )  # fmt: skip


class _Trouble:
    """Kills processes and fills the disk, each at its share of the keyframes."""

    def __init__(self, daemon: Daemon, scanners: list[Scanner], filler: Path | None, started: float) -> None:
        self.durable = 0  # keyframes, to be kept up to date
        self.events: list[Event] = []
        self.problems: list[str] = []
        self._daemon, self._scanners, self._filler, self._started = daemon, scanners, filler, started

    def _has_durable(self, keyframes: float) -> bool:
        return self.durable >= keyframes

    def work(self, keyframes: int, kills: int) -> None:
        """Do it all; blocks."""
        shares = np.linspace(0.0, _KILLS_UNTIL, kills + 1)[1:]
        due: list[tuple[float, Callable[[], None]]] = []
        for number, share in enumerate(shares):
            kind = (self._kill_server, self._kill_fuser, self._kill_scanner)[number % 3]
            due.append((share, functools.partial(kind, number)))
        if self._filler is not None:
            due.append((_FULL_AT, self._fill_disk))
        try:
            for share, act in sorted(due, key=lambda one: one[0]):
                until(functools.partial(self._has_durable, share * keyframes), 10 * _PATIENCE)
                act()
        except AssertionError:
            self.problems.append(f"after {self.events} nothing more could be done")

    def _note(self, what: str) -> None:
        self.events.append(Event(round(time.monotonic() - self._started, 1), what))

    def _kill_server(self, _: int) -> None:
        self._note("server killed")
        self._daemon.kill()

    def _kill_fuser(self, _: int) -> None:
        self._note("fuser killed")
        self._daemon.kill_fuser()

    def _kill_scanner(self, number: int) -> None:
        self._note("scanner killed")
        self._scanners[number // 3 % SCANNERS].kill()

    def _fill_disk(self) -> None:
        assert self._filler is not None
        until(lambda: self._daemon.ready)
        self._note("disk full")
        small_disks.fill(self._filler)
        until(lambda: "must stay so" in self._said())
        time.sleep(_FULL_S)
        self._filler.unlink()
        self._note("room again")
        until(lambda: not self._said())

    def _said(self) -> str:
        with contextlib.suppress(TsfusionError):
            return " ".join(fetch_health(self._daemon.server.address, timeout=5.0).problems)
        return ""


def _samples(daemon: Daemon, scanners: list[Scanner], trouble: _Trouble, started: float) -> Iterator[Sample]:
    moved, durable = time.monotonic(), -1
    with contextlib.closing(MapWatcher(daemon.server.address)) as viewer:
        while not all(scanner.finished for scanner in scanners):
            due = time.monotonic() + _INTERVAL
            while time.monotonic() < due:
                viewer.events(min(max(due - time.monotonic(), 0.0), 1.0))
            one = _sample(daemon, scanners, time.monotonic() - started)
            if one is not None and one.durable != durable:
                trouble.durable = durable = one.durable
                moved = time.monotonic()
            assert time.monotonic() - moved < _PATIENCE, "nothing moves"
            if one is not None and all(process.rss_mb for process in one.processes.values()):
                yield one


def _sample(daemon: Daemon, scanners: list[Scanner], seconds: float) -> Sample | None:
    """Figures of now; None while a process is not there."""
    server = daemon.server
    try:
        health = fetch_health(server.address, timeout=2.0).maps["default"]
        pids = [server.process.pid, server.fuser_pid()]
    except (TsfusionError, OSError, AssertionError, KeyError):
        return None
    if not daemon.ready or health.state not in ("idle", "busy") or any(one.finished for one in scanners):
        return None
    gateway, fuser, *own = map(_process, [*pids, *(scanner.pid for scanner in scanners)])
    largest = Process(*(max(values) for values in zip(*map(_figures, own), strict=True)))
    processes = {"gateway": gateway, "fuser": fuser, "scanner": largest}
    return Sample(
        round(seconds, 2), health.keyframes_durable, health.blocks, _folder_mb(daemon.state), processes
    )


def _figures(process: Process) -> tuple[float, int, int]:
    return process.rss_mb, process.files, process.threads


def _process(pid: int) -> Process:
    with contextlib.suppress(OSError):
        files, threads = (len(os.listdir(f"/proc/{pid}/{kind}")) for kind in ("fd", "task"))
        return Process(round(rss_bytes(pid) / 1e6, 2), files, threads)
    return Process(0.0, 0, 0)


def _folder_mb(folder: Path) -> float:
    found = 0
    for path in folder.rglob("*"):
        with contextlib.suppress(OSError):  # deleted meanwhile
            found += path.stat().st_size
    return round(found / 1e6, 2)


# --- what is wrong ---


def _lost(status: Status, scanners: list[Scanner], keyframes: int, room: Path) -> list[str]:
    """Keyframes that are not in the map exactly once."""
    problems = []
    counts = (status.keyframes_durable, status.keyframes_fused, sum(status.keyframes_rejected.values()))
    if counts != (keyframes, keyframes, 0):
        problems.append(f"of {keyframes} keyframes (durable, fused, rejected) are {counts}")
    for scanner in scanners:
        if scanner.problem:
            continue
        report = scanner.report()
        if lost := {**report.refused, **report.rejected, **report.skipped}:
            problems.append(f"a scanner counts lost keyframes: {lost}")
    if status.map_hash != map_hash(map(source(str(room)), range(keyframes)), VOLUME):
        problems.append("the map differs from that of the same keyframes, fused alone")
    return problems


def _calm(samples: list[Sample], keyframes: int, events: list[Event]) -> list[Sample]:
    """The samples of the calm part: behind the last kill, whose fuser has its map again."""
    last = max((event.seconds for event in events), default=0.0)
    since = [one for one in samples if one.durable >= _CALM_FROM * keyframes and one.seconds > last]
    return [one for one in since if one.blocks]


def _rises(calm: list[Sample]) -> dict[str, float]:
    """Growth in the calm part, MB: the slope over the keyframes, times the keyframes of that part."""
    if len(calm) < 3:
        return {}
    at = np.array([one.durable for one in calm], dtype=float)
    held = {name: [one.processes[name].rss_mb for one in calm] for name in calm[0].processes}
    held["files on the disk"] = [one.disk_mb for one in calm]
    slopes = {name: float(np.polyfit(at, values, 1)[0]) for name, values in held.items()}
    return {name: round(slope * float(np.ptp(at)), 2) for name, slope in slopes.items()}


def _growth(calm: list[Sample], tolerance_mb: float) -> list[str]:
    third = len(calm) // 3
    if third < 2:
        return [f"only {len(calm)} samples were taken: more keyframes are needed"]
    early, late = calm[third : 2 * third], calm[-third:]
    problems = []
    if calm[0].blocks != late[-1].blocks:
        problems.append(f"the map still grew: {calm[0].blocks} → {late[-1].blocks} blocks")
    for name, rise in _rises(calm).items():
        if rise > tolerance_mb:
            problems.append(f"{name}: {rise} MB more in the end")
    for name in calm[0].processes:
        for kind in ("files", "threads"):
            # The lowest: a file that is open for a moment (a segment, a checkpoint) does not count.
            before, after = (
                min(getattr(one.processes[name], kind) for one in part) for part in (early, late)
            )
            if after > before + _FIRST_USE:
                problems.append(f"{name}: {kind} rose from {before} to {after}")
    return problems


def table(outcome: Outcome, rows: int = 12) -> str:
    """Table for people: every so many samples."""
    names = ("gateway", "fuser", "scanner")
    lines = [
        f"{'s':>7}{'durable':>9}{'blocks':>8}{'disk MB':>9}"
        + "".join(f"{name:>10} MB  fd thr" for name in names)
    ]
    for one in outcome.samples[:: max(len(outcome.samples) // rows, 1)]:
        cells = "".join(f"{p.rss_mb:13.1f}{p.files:4d}{p.threads:4d}" for p in one.processes.values())
        lines.append(f"{one.seconds:7.1f}{one.durable:9d}{one.blocks:8d}{one.disk_mb:9.1f}{cells}")
    lines.append(f"{outcome.per_second} keyframes/s; growth in the calm part, MB: {outcome.rise_mb}")
    return "\n".join(lines)
