# SPDX-License-Identifier: MIT
"""One live run from its beginning to its end: processes, limits, and what is kept of it."""

import hashlib
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from bad_network import Proxy

from lab.paper import paper_events
from lab.paper.paper_again import fresh_hash
from lab.paper.paper_events import Story
from lab.paper.paper_frontend import CORRECTED, MAP, OUTDOORS, FrontEndPlan
from lab.paper.paper_limits import Death, MemoryWatch, death_of, share_of_time
from lab.paper.paper_outcome import (
    DELAY,
    MEMORY,
    POSES,
    Outcome,
    error_of,
    error_until,
    memory_rows,
    of_story,
    write,
    write_memory,
)
from lab.paper.paper_runs import Limits, Run
from lab.paper.paper_worlds import planned_keyframes, stamps_ns
from tsfusion.core import process
from tsfusion.core.config import DEFAULT_MAP, ServerConfig
from tsfusion.core.errors import TsfusionError
from tsfusion.datasets import Dataset
from tsfusion.datasets.dataset import pose_of
from tsfusion.pipelines.report import latency_ledger
from tsfusion.pipelines.runs import map_growth, target_server
from tsfusion.pipelines.runs.map_growth import GrowthRow

FRONT_END = Path(__file__).with_name("paper_frontend.py")
STATE = "state"
_START_S = 300.0  # for a front end to get ready: cold kernels on a busy machine
_POLL_S = 0.1
Tell = Callable[[str], None]


def fingerprint(run: Run, limits: Limits) -> str:
    """A digest of a run's settings: a run with another one is another run."""
    settings = msgspec.structs.replace(run.world, cache="")
    told = msgspec.json.encode([msgspec.structs.replace(run, world=settings), limits])
    return hashlib.sha256(told).hexdigest()[:16]


def conduct(run: Run, folder: Path, limits: Limits, tell: Tell) -> Outcome:
    """Make a live run, and leave its files in a folder."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    started = time.monotonic()
    if run.mode.startswith("traditional"):
        bounded = run.mode.endswith("-bounded")
        plan = _plan(run, folder, limits, bounded=bounded)
        watch, death = _front_end(plan, run, limits, tell)
        status: dict[str, Any] = {}
        grown: list[GrowthRow] = []
    else:
        watch, death, grown, status = _decentralised(run, folder, limits, tell)
    story = paper_events.read(folder / "events.jsonl")
    latency_ledger.write_csv(story.times, folder / DELAY)
    rows = memory_rows(story, watch.samples, grown)
    write_memory(rows, folder / MEMORY)
    dataset = run.world.open()
    _write_poses(story, dataset, folder / POSES)
    fields = of_story(story, rows, death)
    status.setdefault("map_hash", story.closing.get("map_hash", ""))
    outcome = Outcome(
        name=run.name, world=run.world.name, mode=run.mode, map=run.map, number=run.number,
        machine=run.machine.described, settings=fingerprint(run, limits),
        seconds=round(time.monotonic() - started, 1), planned=_planned(run, dataset),
        ate=error_until(folder / POSES), corrected=_corrected(folder, dataset), **{**fields, **status},
    )  # fmt: skip
    write(outcome, folder)
    return outcome


def _plan(run: Run, folder: Path, limits: Limits, **more: Any) -> FrontEndPlan:
    return FrontEndPlan(
        world=run.world, volume=run.volume, folder=str(folder), cores=run.machine.cores,
        drain_s=limits.drain_s, pace=limits.pace, loop_closure=run.mode == "loops", **more,
    )  # fmt: skip


def _front_end(plan: FrontEndPlan, run: Run, limits: Limits, tell: Tell) -> tuple[MemoryWatch, Death | None]:
    """Run a front end to its end, within the limits of its machine."""
    folder = Path(plan.folder)
    orders, said = folder / "plan.json", folder / "frontend.log"
    orders.write_bytes(msgspec.json.encode(plan))
    deadline = time.monotonic() + _START_S + run.seconds * limits.pace + limits.drain_s + 60
    with (
        said.open("wb") as stderr,
        subprocess.Popen(
            [sys.executable, str(FRONT_END), str(orders)], stderr=stderr, **process.OWN_GROUP
        ) as child,
    ):
        watch = MemoryWatch(child, run.machine.memory_bytes, process.tree_rss_bytes)
        try:
            with share_of_time(child.pid, run.machine.share):
                _wait(child, folder, deadline, tell)
        finally:
            code = child.poll()
            if code is None:
                child.kill()
            watch.stop()
    death = death_of(code, watch, said.read_text(encoding="utf-8", errors="replace"))
    if death is not None and death.of.startswith("status"):  # our mistake, and no finding
        raise ValueError(f"the front end failed: {death.words}; see {said}")
    return watch, death


def _wait(child: "subprocess.Popen[bytes]", folder: Path, deadline: float, tell: Tell) -> None:
    """Wait for a front end, and say how far it is."""
    events, lines, at = folder / "events.jsonl", 0, 0
    while child.poll() is None and time.monotonic() < deadline:
        time.sleep(_POLL_S)
        if events.exists():
            with events.open("rb") as file:
                file.seek(at)
                new = file.read()
            at += len(new)
            lines += new.count(b'"event":"frame"')
            tell(f"{lines} frames")


def _decentralised(
    run: Run, folder: Path, limits: Limits, tell: Tell
) -> tuple[MemoryWatch, Death | None, list[GrowthRow], dict[str, Any]]:
    server = ServerConfig(listen="tcp://127.0.0.1:0", state=str(folder / STATE))
    with ExitStack() as stack:
        with _on_cores(run.machine.cores):  # the server's processes inherit it
            target = stack.enter_context(
                target_server.opened(None, folder / ".scratch", volume=run.volume, server=server)
            )
        assert target.child is not None
        address = stack.enter_context(_link(run, limits, target.child.listen, target.child.control))
        begun = time.monotonic()
        growth = stack.enter_context(map_growth.watch(target, DEFAULT_MAP))
        share = limits.server_share if run.mode == "slow-server" else 1.0
        plan = _plan(run, folder, limits, address=address, control=None)
        with share_of_time(target.child.pid, share):
            watch, death = _front_end(plan, run, limits, tell)
        growth.stop()
        found: dict[str, Any] = {}
        with suppress(TsfusionError):
            status = target.status(DEFAULT_MAP, timeout=60.0)
            found = {"map_hash": status.map_hash}
            target.keep_map(DEFAULT_MAP, folder / MAP)
        tell("saving the map")
    if run.mode == "loops" and found:
        tell("fusing all keyframes anew at their corrected poses")
        found["expected_hash"] = fresh_hash(folder / STATE, run.volume)
    grown = [row._replace(seconds=row.seconds + begun) for row in growth.rows]
    return watch, death, grown, found


@contextmanager
def _on_cores(count: int | None) -> Iterator[None]:
    """Processes started during the block may use so many cores; None = all."""
    if count is None or not hasattr(os, "sched_setaffinity"):
        yield
        return
    every = os.sched_getaffinity(0)
    os.sched_setaffinity(0, sorted(every)[:count])
    try:
        yield
    finally:
        os.sched_setaffinity(0, every)


@contextmanager
def _link(run: Run, limits: Limits, data: str, control: str) -> Iterator[str]:
    """The address at which the server is reached: its own, or that of a slow link before it."""
    if run.mode != "slow-link":
        yield data
        return
    with Proxy() as proxy:
        proxy.target(data, control)
        proxy.throttle(limits.link_bytes_per_second)
        proxy.delay(limits.link_delay_s)
        yield proxy.address


def _planned(run: Run, dataset: Dataset) -> int:
    world = run.world
    return len(planned_keyframes(dataset, world.keyframes, outdoors=world.sensor in OUTDOORS))


def _write_poses(story: Story, dataset: Dataset, path: Path) -> None:
    """Keep the live poses beside the true ones; NaN where there is no true one."""
    indices, estimate = story.poses()
    truth = [_truth(dataset, int(index)) for index in indices]
    np.savez(path, indices=indices, poses=estimate, truth=np.array(truth).reshape(-1, 4, 4))


def _truth(dataset: Dataset, index: int) -> Any:
    T = pose_of(dataset, index)
    return np.full((4, 4), np.nan) if T is None else T


def _corrected(folder: Path, dataset: Dataset) -> Any:
    """ATE after loop closure; None = no loop was closed."""
    if not (folder / CORRECTED).is_file():
        return None
    with np.load(folder / CORRECTED, allow_pickle=False) as kept:
        stamps, poses = kept["stamps"], kept["poses"]
    indices = np.searchsorted(stamps_ns(dataset), stamps)
    truth = np.array([_truth(dataset, int(index)) for index in indices]).reshape(-1, 4, 4)
    known = np.isfinite(truth).all(axis=(1, 2))
    return error_of(poses[known], truth[known])
