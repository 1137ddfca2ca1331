# SPDX-License-Identifier: MIT
"""Keyframes without end into a room that ends: memory, files and threads of every process on the way."""

import os
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from statistics import median

import msgspec
from hostile_watch import rss_bytes
from keyframes_and_servers import Server, connected, serving
from msgspec import Struct
from scanner_process import Report, plan_in, save_room
from supervisors import SCANNER

from tsfusion import VolumeConfig
from tsfusion.core.config import ClientConfig
from tsfusion.wire import sockets
from tsfusion.wire.queries import fetch_health, fetch_status

VIEWS = 60  # of the room; after them the map has every block it will ever have
WIDTH = 80  # pixels
_INTERVAL = 0.1  # seconds between samples
_PATIENCE = 600.0  # seconds without a keyframe
_SETTLED = 0.3  # of the keyframes: what comes before is not judged
TOLERANCE_MB = 16.0  # of RSS, from a third of the way to the end


class Process(Struct, frozen=True):
    """Memory, files and threads of a process at one moment."""

    rss_mb: float
    files: int
    threads: int


class Sample(Struct, frozen=True):
    seconds: float
    fused: int
    blocks: int
    processes: dict[str, Process]


class Outcome(Struct, kw_only=True):
    """`problems` is empty when nothing grew."""

    problems: list[str]
    keyframes: int
    seconds: float
    per_second: float
    blocks: int
    rise_mb: dict[str, float]  # from the settled part's beginning to its end
    samples: list[Sample]


def run(folder: Path, keyframes: int, *, tolerance_mb: float = TOLERANCE_MB) -> Outcome:
    """Send keyframes as fast as the map takes them, beside a viewer and somebody who asks for the status."""
    room = folder / "room.npz"
    save_room(room, VIEWS, WIDTH)
    settings = {"checkpoint_every": 200, "segment_bytes": 4 << 20, "quota_keyframes": 1e6}
    volume = VolumeConfig(voxel_size=0.05, threads=1)
    with serving(folder / "state", volume, **settings) as server:
        samples = list(_samples(folder, server, room, keyframes))
        status = fetch_status(server.address)
        stopped = server.terminate()
    report = msgspec.json.decode((folder / "report.json").read_bytes(), type=Report)
    problems = _problems(samples, keyframes, tolerance_mb)
    if (report.fused, status.keyframes_fused) != (keyframes, keyframes) or status.keyframes_rejected:
        rejected = status.keyframes_rejected
        problems.append(f"{status.keyframes_fused} of {keyframes} are fused, {rejected} rejected")
    if stopped or status.fuser_restarts:
        restarts = status.fuser_restarts
        problems.append(f"the server ended with status {stopped}, its fuser was restarted {restarts} times")
    return Outcome(
        problems=problems,
        keyframes=keyframes,
        seconds=round(report.seconds, 1),
        per_second=round(keyframes / report.seconds, 1),
        blocks=status.blocks,
        rise_mb=_rises(samples, keyframes),
        samples=samples,
    )


def _samples(folder: Path, server: Server, room: Path, keyframes: int) -> Iterator[Sample]:
    client = ClientConfig(policy="block", backlog=16)
    plan = plan_in(folder, server.address, count=keyframes, room=str(room), patience=_PATIENCE, client=client)
    with ExitStack() as stack:
        scanner = subprocess.Popen([sys.executable, str(SCANNER), msgspec.json.encode(plan).decode()])
        stack.callback(scanner.kill)
        viewer = stack.enter_context(connected(sockets.subscriber, server.publish))
        pids = {"gateway": server.process.pid, "fuser": server.fuser_pid(), "client": scanner.pid}
        started = moved = time.monotonic()
        fused = -1
        while scanner.poll() is None:
            while viewer.poll(0):
                viewer.recv_multipart()
            time.sleep(_INTERVAL)
            one = _sample(server, pids, time.monotonic() - started)
            if one.fused != fused:
                fused, moved = one.fused, time.monotonic()
            assert time.monotonic() - moved < _PATIENCE, "nothing moves"
            if all(process.rss_mb for process in one.processes.values()):
                yield one
        assert scanner.returncode == 0, "the scanner has failed"


def _sample(server: Server, pids: dict[str, int], seconds: float) -> Sample:
    health = fetch_health(server.address).maps["default"]
    found = {name: _process(pid) for name, pid in pids.items()}
    return Sample(round(seconds, 2), health.keyframes_fused, health.blocks, found)


def _process(pid: int) -> Process:
    with suppress(OSError):
        files, threads = (len(os.listdir(f"/proc/{pid}/{kind}")) for kind in ("fd", "task"))
        return Process(round(rss_bytes(pid) / 1e6, 2), files, threads)
    return Process(0.0, 0, 0)


def _windows(samples: list[Sample], keyframes: int) -> tuple[list[Sample], list[Sample]]:
    """The first and the last third of what is judged."""
    settled = [one for one in samples if one.fused >= _SETTLED * keyframes]
    third = max(len(settled) // 3, 1)
    return settled[:third], settled[-third:]


def _rises(samples: list[Sample], keyframes: int) -> dict[str, float]:
    early, late = _windows(samples, keyframes)
    if not early:
        return {}
    rises = {}
    for name in early[0].processes:
        before, after = (median(one.processes[name].rss_mb for one in part) for part in (early, late))
        rises[name] = round(after - before, 2)
    return rises


def _problems(samples: list[Sample], keyframes: int, tolerance_mb: float) -> list[str]:
    early, late = _windows(samples, keyframes)
    if len(early) < 3:
        return [f"only {len(samples)} samples were taken: more keyframes are needed"]
    problems = []
    if early[0].blocks != late[-1].blocks:
        problems.append(f"the map still grew: {early[0].blocks} → {late[-1].blocks} blocks")
    for name, rise in _rises(samples, keyframes).items():
        if rise > tolerance_mb:
            problems.append(f"{name}: RSS rose by {rise} MB")
        for kind in ("files", "threads"):
            # The lowest: a file that is open for a moment (a segment, a checkpoint) does not count.
            before, after = (
                min(getattr(one.processes[name], kind) for one in part) for part in (early, late)
            )
            if after > before:
                problems.append(f"{name}: {kind} rose from {before} to {after}")
    return problems


def table(outcome: Outcome, rows: int = 12) -> str:
    """Table for people: every so many samples."""
    lines = [
        f"{'s':>7}{'fused':>8}{'blocks':>8}"
        + "".join(f"{name:>10} MB  fd thr" for name in ("gateway", "fuser", "client"))
    ]
    step = max(len(outcome.samples) // rows, 1)
    for one in outcome.samples[::step]:
        cells = "".join(f"{p.rss_mb:13.1f}{p.files:4d}{p.threads:4d}" for p in one.processes.values())
        lines.append(f"{one.seconds:7.1f}{one.fused:8d}{one.blocks:8d}{cells}")
    lines.append(f"{outcome.per_second} keyframes/s; RSS rose by {outcome.rise_mb} MB once settled")
    return "\n".join(lines)
