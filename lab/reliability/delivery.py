# SPDX-License-Identifier: MIT
"""How long a keyframe takes until it is safe, and what keys cost: a JSON line without, one with, one of both.

    python lab/reliability/delivery.py                         300 keyframes of each kind at 10 a second
    python lab/reliability/delivery.py --keyframes 1000 --rate 30

The keyframes are recorded ones (640×480 depth and colour, from TSFUSION_DATA, default ../shared/data) or,
where these are missing, rendered ones of that size. Two servers run, one with keys and one without, and the
scanner turns from one to the other every few seconds, so that what else the machine does meets both.

`durable_ms`: from the call of `send` until the scanner knows that the keyframe is on the server's disk.
`cpu_ms`: processor time of the scanner's process for a keyframe, encoding and all threads included.
`delay_ms`: captured → fused, as the server publishes it, right to within `delay_bound_ms`.
"""

import argparse
import dataclasses
import json
import os
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "support"))
sys.path.append(str(Path(__file__).parents[2]))  # lab is not installed
from keyframes_and_servers import UNSECURED, Server, secured, serving

from lab.bench.peers import DATA, surroundings
from tsfusion import Client, Keyframe, VolumeConfig
from tsfusion.core.config import ClientConfig, override
from tsfusion.datasets import open_dataset
from tsfusion.wire.asking.queries import fetch_health

BLOCK = 30  # keyframes to one server before it is the other's turn
DISTINCT = 60  # keyframes; then they come again
TARGETS = {"durable_p50_ms": 20.0, "durable_p99_ms": 60.0, "keys_cpu_ms": 1.0}
PATIENCE = 60.0


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--keyframes", type=int, default=300, help="with keys, and so many without")
    parser.add_argument("--rate", type=float, default=10.0, help="a second")
    options = parser.parse_args()
    keyframes, source = _keyframes()
    with tempfile.TemporaryDirectory(prefix="tsfusion-delivery-") as scratch, ExitStack() as stack:
        folder = Path(scratch)
        sides = [
            _Side(stack, folder / name, with_keys) for name, with_keys in (("plain", False), ("keys", True))
        ]
        for side in sides:
            side.run(keyframes[:5], options.rate)  # not counted
            side.forget()
        while len(sides[-1].durable_ms) < options.keyframes:
            for side in sides:
                at = len(side.durable_ms)
                block = [
                    keyframes[(at + i) % len(keyframes)] for i in range(min(BLOCK, options.keyframes - at))
                ]
                side.run(block, options.rate)
        common = {"source": source, "rate": options.rate, **surroundings(os.cpu_count() or 1)}
        results = [side.result() for side in sides]
    for result in results:
        print(json.dumps({**result, **common}), flush=True)
    plain, secured = results
    cost = round(secured["cpu_ms"] - plain["cpu_ms"], 3)
    worst = max(results, key=lambda one: one["durable_ms"]["p99"])
    met = (
        max(one["durable_ms"]["p50"] for one in results) <= TARGETS["durable_p50_ms"]
        and worst["durable_ms"]["p99"] <= TARGETS["durable_p99_ms"]
        and cost <= TARGETS["keys_cpu_ms"]
    )
    print(json.dumps({"keys_cpu_ms": cost, "targets": TARGETS, "met": met}))
    return 0 if met else 1


def _keyframes() -> tuple[list[Keyframe], str]:
    recorded = DATA / "7scenes" / "redkitchen"
    if recorded.exists():
        dataset = open_dataset(recorded)
        return [dataset[i] for i in range(min(DISTINCT, len(dataset)))], "7scenes"
    from tsfusion.datasets.worlds.synthetic import Synthetic

    return list(Synthetic("room", count=DISTINCT, width=640)), "room"


class _Side:
    """A server, with or without keys, and what was measured with it."""

    def __init__(self, stack: ExitStack, folder: Path, with_keys: bool) -> None:
        self.with_keys = with_keys
        folder.mkdir()
        self.keys = secured(folder) if with_keys else UNSECURED
        self.config = override(ClientConfig(policy="spool_all"), **self.keys.client)
        self.server: Server = stack.enter_context(
            serving(folder / "state", VolumeConfig(), **self.keys.server)
        )
        self.spool = folder / "spool"
        self.forget()

    def forget(self) -> None:
        """Begin to measure."""
        self.durable_ms: list[float] = []
        self.cpu_seconds = 0.0

    def run(self, keyframes: list[Keyframe], rate: float) -> None:
        """Send these, one every 1/rate seconds, each as soon as the one before is known to be safe."""
        with Client(self.server.address, spool=self.spool, config=self.config) as client:
            client.connect(PATIENCE)
            time.sleep(0.5)  # until the clocks are compared
            began, due = time.process_time(), time.monotonic()
            for keyframe in keyframes:
                time.sleep(max(due - time.monotonic(), 0))
                due = max(due + 1 / rate, time.monotonic())
                started = time.monotonic_ns()
                client.send(dataclasses.replace(keyframe, captured_ns=started))
                client.flush(PATIENCE)
                self.durable_ms.append((time.monotonic_ns() - started) / 1e6)
            self.cpu_seconds += time.process_time() - began
            client.wait_fused(PATIENCE)

    def result(self) -> dict[str, Any]:
        """Figures over all keyframes sent."""
        health = fetch_health(self.server.address, keys=self.keys.keys).maps["default"]
        p50, p95, p99 = np.percentile(self.durable_ms, (50, 95, 99))
        return {
            "keys": self.with_keys,
            "n": len(self.durable_ms),
            "durable_ms": {"p50": round(p50, 2), "p95": round(p95, 2), "p99": round(p99, 2)},
            "cpu_ms": round(1000 * self.cpu_seconds / len(self.durable_ms), 3),
            "delay_ms": {"p50": round(health.delay_ms.p50, 2), "p99": round(health.delay_ms.p99, 2)},
            "delay_bound_ms": round(health.delay_bound_ms, 3),
            "keyframe_kb": round(health.journal_bytes / max(health.keyframes_durable, 1) / 1000, 1),
        }


if __name__ == "__main__":
    sys.exit(main())
