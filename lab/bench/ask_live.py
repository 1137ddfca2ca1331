# SPDX-License-Identifier: MIT
"""How long a live map takes to answer, quiet and while keyframes come, and what the keyframes pay for it.

    python lab/bench/ask_live.py                                  keyframes at 2 cm, 8 a second, for 30 s
    python lab/bench/ask_live.py --rate 5 --voxel-size 0.05 --seconds 60 --ask-rate 50

The keyframes are recorded ones (640×480 depth and colour, from TSFUSION_DATA, default ../shared/data) or,
where these are missing, rendered ones. Two servers run, and a scanner, a process of its own, turns from one
to the other every few seconds: a planner asks the one, nobody asks the other. A JSON line for each kind of
question: `delay_ms` as the planner sees it over loopback, `waited_ms` of it until the map was free, `took_ms`
to answer. A recent view may be of a state that was the newest 0.2 s ago. The last line has the keyframes'
delay, captured → fused, with and without questions.
"""

import argparse
import dataclasses
import json
import os
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from contextlib import ExitStack, suppress
from itertools import cycle
from multiprocessing import Process, get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "support"))
sys.path.append(str(Path(__file__).parents[2]))  # lab is not installed
from keyframes_and_servers import serving

from lab.bench.peers import surroundings
from lab.reliability.delivery import PATIENCE, _keyframes
from tsfusion import Client, Keyframe, MapClient, TransportError, VolumeConfig
from tsfusion.core.config import ClientConfig
from tsfusion.wire.asking.map_client import Answered
from tsfusion.wire.asking.queries import fetch_health
from tsfusion.wire.messages.health import spread

TURN = 25  # keyframes to one server before it is the other's turn
FIRST = 30  # keyframes that are not counted: the map is new
QUIET = 100  # questions of each kind
TARGET_MS = 20.0  # p95 of the delay while keyframes come
Ask = Callable[[MapClient], Answered[Any]]


class Planner:
    """Asks one kind of question after the other, and keeps the delays."""

    def __init__(self, address: str, kinds: dict[str, Ask]) -> None:
        self._client = MapClient(address, timeout=2.0)
        self._kinds = kinds
        self.delays: dict[str, list[tuple[float, float, float]]] = defaultdict(list)  # seconds
        self.failed = 0

    def ask(self, state: str, stop: Callable[[], bool], rate: float) -> None:
        """Ask so many times a second until `stop`."""
        due = time.monotonic()
        for kind, ask in cycle(self._kinds.items()):
            if stop():
                return
            time.sleep(max(due - time.monotonic(), 0))
            due = max(due + 1 / rate, time.monotonic())
            try:
                found = ask(self._client)
            except TransportError as error:
                self.failed += 1
                print(error, file=sys.stderr)
            else:
                self.delays[f"{kind}, {state}"].append((found.delay_s, found.waited_s, found.took_s))

    def lines(self) -> list[dict[str, Any]]:
        """The figures of each kind."""
        found = []
        for name, delays in sorted(self.delays.items()):
            columns = 1e3 * np.array(delays).T
            spreads = dict(zip(("delay_ms", "waited_ms", "took_ms"), map(spread, columns), strict=True))
            found.append(
                {"question": name, **{key: msgspec.to_builtins(one) for key, one in spreads.items()}}
            )
        return found

    def close(self) -> None:
        self._client.close()


def kinds(keyframes: list[Keyframe], voxel_size: float) -> dict[str, Ask]:
    """The questions: points near the surface, a view, a slice and a box around the first sensor."""
    from tsfusion.geometry.keyframe import points_world

    clouds = [points_world(one)[::97] for one in keyframes]
    cloud = np.concatenate([one[np.isfinite(one).all(axis=1)] for one in clouds]).astype(np.float32)
    rng = np.random.default_rng(0)

    def some(n: int) -> Ask:
        return lambda client: client.sample(
            cloud[rng.integers(0, len(cloud), n)] + rng.normal(0, 0.03, (n, 3)).astype(np.float32)
        )

    first = keyframes[0]
    assert first.intrinsics is not None
    camera, pose, eye = first.intrinsics, first.T_world_camera, first.T_world_camera[:3, 3]
    return {
        "1 point": some(1),
        "100 points": some(100),
        "10000 points": some(10_000),
        "view of 640×480": lambda client: client.raycast(camera, pose, (480, 640)),
        "recent view of 640×480": lambda client: client.raycast(camera, pose, (480, 640), max_age=0.2),
        "recent depth of 640×480": lambda client: client.raycast(
            camera, pose, (480, 640), max_age=0.2, normals=False, colors=False
        ),
        "recent view of 320×240": lambda client: client.raycast(
            camera.scaled(0.5), pose, (240, 320), max_age=0.2
        ),
        "slice of 20×20 m at 5 cm": lambda client: client.distance_slice(
            eye[1] - 1, eye[1] + 0.5, up="y", box=(-10, -10, 10, 10), resolution=max(0.05, voxel_size)
        ),
        "field of 1×1×1 m": lambda client: client.distance_field(
            [*(eye - 0.5), *(eye + 0.5)], max_distance=0.5
        ),
    }


class Scanner:
    """A process that sends keyframes where it is told."""

    def __init__(self) -> None:
        context = get_context("spawn")
        self._pipe, other = context.Pipe()
        self._process: Process = context.Process(target=_scan, args=(other,))  # type: ignore[assignment]
        self._process.start()
        other.close()

    def send(self, address: str, count: int, rate: float) -> None:
        """Send so many, one every 1/rate seconds, and wait until the map has them."""
        self._pipe.send((address, count, rate))

    @property
    def is_done(self) -> bool:
        """True if the map has what was sent."""
        return self._pipe.poll()

    def wait(self) -> None:
        """Wait until it is done."""
        self._pipe.recv()

    def close(self) -> None:
        self._pipe.close()
        self._process.join()


def _scan(pipe: "Connection[Any, Any]") -> None:
    ring = cycle(_keyframes()[0])
    with suppress(EOFError):
        while True:
            address, count, rate = pipe.recv()
            _send(address, [next(ring) for _ in range(count)], rate)
            pipe.send(None)


def _send(address: str, keyframes: list[Keyframe], rate: float) -> None:
    with Client(address, config=ClientConfig(policy="spool_all")) as client:
        client.connect(PATIENCE)
        due = time.monotonic()
        for keyframe in keyframes:
            time.sleep(max(due - time.monotonic(), 0))
            due = max(due + 1 / rate, time.monotonic())
            client.send(dataclasses.replace(keyframe, captured_ns=time.monotonic_ns()))
        client.wait_fused(PATIENCE)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rate", type=float, default=8.0, help="keyframes a second")
    parser.add_argument("--ask-rate", type=float, default=20.0, help="questions a second")
    parser.add_argument("--seconds", type=float, default=30.0, help="of keyframes to each server")
    parser.add_argument("--kind", default="", help="only the questions whose names have this word")
    parser.add_argument("--voxel-size", type=float, default=0.02)
    options = parser.parse_args()
    keyframes, source = _keyframes()
    count = int(options.seconds * options.rate)
    with tempfile.TemporaryDirectory(prefix="tsfusion-ask-") as scratch, ExitStack() as stack:
        cores = len(os.sched_getaffinity(0))
        volume = VolumeConfig(voxel_size=options.voxel_size, threads=cores)
        asked, plain = (
            stack.enter_context(serving(Path(scratch) / name, volume)) for name in ("asked", "plain")
        )
        chosen = {
            name: ask for name, ask in kinds(keyframes, options.voxel_size).items() if options.kind in name
        }
        planner = Planner(asked.address, chosen)
        stack.callback(planner.close)
        scanner = Scanner()
        stack.callback(scanner.close)
        for server in (asked, plain):
            scanner.send(server.address, FIRST, options.rate)
            scanner.wait()
        for _ in range(0, count, TURN):
            scanner.send(asked.address, TURN, options.rate)
            planner.ask("while keyframes come", lambda: scanner.is_done, options.ask_rate)
            scanner.wait()
            scanner.send(plain.address, TURN, options.rate)
            scanner.wait()
        left = iter(range(QUIET * len(chosen)))
        planner.ask("quiet", lambda: next(left, None) is None, options.ask_rate)
        delays = {
            name: msgspec.to_builtins(fetch_health(server.address).maps["default"].delay_ms)
            for name, server in (("with_questions", asked), ("without", plain))
        }
    common = {"source": source, "voxel_size": options.voxel_size, **surroundings(cores)}
    for line in planner.lines():
        print(json.dumps({**line, **common}), flush=True)
    p95 = max((one["delay_ms"]["p95"] for one in planner.lines() if "come" in one["question"]), default=0)
    met = p95 <= TARGET_MS and not planner.failed
    last = {"worst_p95_ms": p95, "target_ms": TARGET_MS, "failed": planner.failed, "met": met}
    print(json.dumps({"keyframe_delay_ms": delays, "rate": options.rate, **last}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
