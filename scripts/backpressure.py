# SPDX-License-Identifier: MIT
"""Behaviour of each policy when the sensor is faster than the server, and the link is down for a while.

    python scripts/backpressure.py --seconds 120 --rate 10 --server 6.25 --outage 10

The client's own code on a clock of its own; the server journals at once and fuses one keyframe after the
other. `fused`: share of the captured keyframes that are in the map in the end. `delay`: captured to fused.
`hole`: the longest time without a keyframe in the map. `spool`: the most keyframes that waited there.
"""

import argparse
import json
import time
from collections import deque
from dataclasses import asdict, dataclass
from typing import get_args

import numpy as np

from tsfusion.core.config import ClientConfig, Policy
from tsfusion.delivery.backpressure import Backpressure
from tsfusion.delivery.outbox import Outbox
from tsfusion.delivery.spool import Spool
from tsfusion.geometry.keyframe import Keyframe

_TICK_MS = 10
_WINDOW = 8, 16 << 20  # a server's default credit
_POINTS = np.zeros((1, 3), np.float32)


@dataclass(frozen=True)
class Outcome:
    """One policy's figures."""

    policy: str
    backlog: int
    fused_percent: float
    delay_p50_s: float
    delay_max_s: float
    hole_s: float
    spool: int


class Run:
    """Sensor, client and server on one clock, in milliseconds."""

    def __init__(self, config: ClientConfig, rate: float, server: float, outage_ms: range) -> None:
        self._config = config
        self._outbox = Outbox(Spool(None, 64 << 20))
        self._pressure = Backpressure(self._outbox, config)
        self._period_ms = 1000 / rate
        self._fuse_ms = 1000 / server
        self._outage_ms = outage_ms
        self._sensed = 0.0
        self._journal: deque[int] = deque()
        self._fused = 0
        self._free_at = 0.0
        self.spool = 0
        self.captured: dict[int, int] = {}
        self.fused: dict[int, int] = {}

    def sense(self, now: int) -> bool:
        """A keyframe, when it is time for one; False = nothing came, or `send` still waits with one."""
        if now < self._sensed or self._pressure.must_wait:
            return False
        self._sensed = max(self._sensed + self._period_ms, now)
        seq = self._pressure.put(Keyframe(points=_POINTS, T_world_camera=np.eye(4)))
        if seq is not None:
            self.captured[seq] = now
        return True

    def serve(self, now: int) -> None:
        """Let link and server do what they do at this moment."""
        if now >= self._free_at and self._journal:
            self._fused = self._journal.popleft()
            self.fused[self._fused] = now
            self._free_at = now + self._fuse_ms
        if now not in self._outage_ms:
            self._deliver(self._outbox)
        self.spool = max(self.spool, self._outbox.stats().waiting)

    def _deliver(self, box: Outbox) -> None:
        box.acknowledge(0, self._fused)
        ahead = self._config.backlog if self._config.policy == "drop_oldest" else None
        while (claimed := box.claim(*_WINDOW, ahead)) is not None:
            entry, _ = claimed
            box.sent(entry, 0)
            self._journal.append(entry.seq)
            box.acknowledge(entry.seq, self._fused)

    @property
    def done(self) -> bool:
        """Whether everything that was kept is in the map."""
        return not self._outbox.behind

    def close(self) -> None:
        """Remove the spool."""
        self._outbox.close()


def simulate(
    policy: Policy, *, backlog: int, seconds: float, rate: float, server: float, outage: float
) -> Outcome:
    """Run one policy; the outage is in the middle."""
    config = ClientConfig(policy=policy, backlog=backlog, min_free_bytes=0)
    middle, end = int(500 * seconds), int(1000 * seconds)
    run = Run(config, rate, server, range(middle - int(500 * outage), middle + int(500 * outage)))
    now = 0
    while now < end or not run.done:
        if now < end:
            run.sense(now)
        run.serve(now)
        now += _TICK_MS
    run.close()
    delays = np.array([fused - run.captured[seq] for seq, fused in run.fused.items()]) / 1000
    kept = np.sort([run.captured[seq] for seq in run.fused]) / 1000
    return Outcome(
        policy=policy,
        backlog=backlog,
        fused_percent=round(100 * len(run.fused) / (seconds * rate), 1),
        delay_p50_s=round(float(np.median(delays)), 2),
        delay_max_s=round(float(delays.max()), 2),
        hole_s=round(float(np.diff(kept).max()), 2),
        spool=run.spool,
    )


def main() -> None:
    """Print a table, or a line of JSON a case."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seconds", type=float, default=120.0)
    parser.add_argument("--rate", type=float, default=10.0, help="keyframes a second that the sensor gives")
    parser.add_argument("--server", type=float, default=6.25, help="keyframes a second that the map takes")
    parser.add_argument("--outage", type=float, default=10.0, help="seconds without a link, in the middle")
    parser.add_argument("--backlog", type=int, nargs="+", default=[ClientConfig().backlog])
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    started = time.monotonic()
    for backlog in given.backlog:
        for policy in get_args(Policy):
            outcome = simulate(
                policy,
                backlog=backlog,
                seconds=given.seconds,
                rate=given.rate,
                server=given.server,
                outage=given.outage,
            )
            if given.json:
                print(json.dumps(asdict(outcome)))
            else:
                print(
                    f"{policy:12} backlog {backlog:3}  fused {outcome.fused_percent:5.1f} %  "
                    f"delay p50 {outcome.delay_p50_s:5.2f} max {outcome.delay_max_s:5.2f} s  "
                    f"hole {outcome.hole_s:5.2f} s  spool {outcome.spool:4}"
                )
    if not given.json:
        print(f"simulated in {time.monotonic() - started:.0f} s")


if __name__ == "__main__":
    main()
