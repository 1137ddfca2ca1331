# SPDX-License-Identifier: MIT
"""Behaviour of each policy when the sensor is faster than the server, and the link is down for a while.

    python lab/bench/backpressure.py                                   a slow map, and ten seconds without it
    python lab/bench/backpressure.py --server 12.5 --seconds 30 --outage 2 --outages 2          two restarts
    python lab/bench/backpressure.py --server 12.5 --seconds 600 --outage 60       a minute without the link
    python lab/bench/backpressure.py --seconds 3600 --outages 0                        an hour of a slow map

The client's own code on a clock of its own; the server journals at once and fuses one keyframe after the
other. `fused`: share of the captured keyframes that are in the map in the end. `delay`: captured to fused.
`hole`: the longest time without a keyframe in the map. `behind`: the most keyframes that the map lacked.
"""

import argparse
import json
import logging
import time
from collections import deque
from dataclasses import asdict, dataclass
from typing import get_args

import numpy as np

from tsfusion.core.config import ClientConfig, Policy
from tsfusion.delivery.backpressure import Backpressure
from tsfusion.delivery.outbox import LinkState, Outbox
from tsfusion.delivery.spool import Spool
from tsfusion.geometry.keyframe import Keyframe

_TICK_MS = 10
_WINDOW = 8, 16 << 20  # a server's default credit
_POINTS = np.zeros((1, 3), np.float32)


@dataclass(frozen=True)
class Outcome:
    """One policy's figures."""

    policy: str
    catch_up: float
    backlog: int
    fused_percent: float
    delay_p50_s: float
    delay_max_s: float
    hole_s: float
    behind: int


class Run:
    """Sensor, client and server on one clock, in milliseconds."""

    def __init__(self, config: ClientConfig, rate: float, server: float, outages_ms: list[range]) -> None:
        self._config = config
        self._now = 0
        self._outbox = Outbox(Spool(None, 64 << 20), clock=lambda: self._now / 1000)
        self._outbox.change_link_state(LinkState("connected"))
        self._pressure = Backpressure(self._outbox, config)
        self._period_ms = 1000 / rate
        self._fuse_ms = 1000 / server
        self._outages_ms = outages_ms
        self._sensed = 0.0
        self._journal: deque[int] = deque()
        self._fused = 0
        self._free_at = 0.0
        self.behind = 0
        self.captured: dict[int, int] = {}
        self.fused: dict[int, int] = {}

    def sense(self, now: int) -> bool:
        """A keyframe, when it is time for one; False = nothing came, or `send` still waits with one."""
        self._now = now
        if now < self._sensed or self._pressure.must_wait:
            return False
        self._sensed = max(self._sensed + self._period_ms, now)
        seq = self._pressure.put(Keyframe(points=_POINTS, T_world_camera=np.eye(4)))
        if seq is not None:
            self.captured[seq] = now
        return True

    def serve(self, now: int) -> None:
        """Let link and server do what they do at this moment."""
        self._now = now
        if now >= self._free_at and self._journal:
            self._fused = self._journal.popleft()
            self.fused[self._fused] = now
            self._free_at = now + self._fuse_ms
        is_down = any(now in outage for outage in self._outages_ms)
        box = self._outbox
        if is_down and box.link_state.is_connected:
            box.change_link_state(LinkState("silent"))
        elif not is_down:
            if not box.link_state.is_connected:
                box.change_link_state(LinkState("connected"))
            self._deliver(box)
        self.behind = max(self.behind, box.behind)

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
        """True if everything that was kept is in the map."""
        return not self._outbox.behind

    def close(self) -> None:
        """Remove the spool."""
        self._outbox.close()


def simulate(
    config: ClientConfig, *, seconds: float, rate: float, server: float, outage: float, outages: int
) -> Outcome:
    """Run one policy; the outages are spread evenly."""
    end = int(1000 * seconds)
    middles = [end * (i + 1) // (outages + 1) for i in range(outages)]
    half = int(500 * outage)
    run = Run(config, rate, server, [range(middle - half, middle + half) for middle in middles])
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
        policy=config.policy,
        catch_up=config.catch_up,
        backlog=config.backlog,
        fused_percent=round(100 * len(run.fused) / (seconds * rate), 1),
        delay_p50_s=round(float(np.median(delays)), 2),
        delay_max_s=round(float(delays.max()), 2),
        hole_s=round(float(np.diff(kept).max()), 2),
        behind=run.behind,
    )


def main() -> None:
    """Print a table, or a line of JSON a case."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seconds", type=float, default=300.0)
    parser.add_argument("--rate", type=float, default=10.0, help="keyframes a second that the sensor gives")
    parser.add_argument("--server", type=float, default=6.25, help="keyframes a second that the map takes")
    parser.add_argument("--outage", type=float, default=10.0, help="seconds without a link")
    parser.add_argument("--outages", type=int, default=1, help="so many times")
    parser.add_argument("--backlog", type=int, default=ClientConfig().backlog)
    parser.add_argument("--catch-up", type=float, nargs="+", default=[ClientConfig().catch_up])
    parser.add_argument("--policy", nargs="+", choices=get_args(Policy), default=get_args(Policy))
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    logging.getLogger("tsfusion").setLevel(logging.ERROR)
    started = time.monotonic()
    for policy in given.policy:
        for catch_up in given.catch_up if policy == "thin" else given.catch_up[:1]:
            outcome = simulate(
                ClientConfig(policy=policy, backlog=given.backlog, catch_up=catch_up, min_free_bytes=0),
                seconds=given.seconds,
                rate=given.rate,
                server=given.server,
                outage=given.outage,
                outages=given.outages,
            )
            limit = f"catch_up {catch_up:g}" if policy == "thin" else f"backlog {given.backlog}"
            if given.json:
                print(json.dumps(asdict(outcome)))
            else:
                print(
                    f"{policy:12} {'' if policy == 'spool_all' else limit:13} "
                    f"fused {outcome.fused_percent:5.1f} %  "
                    f"delay p50 {outcome.delay_p50_s:6.2f} max {outcome.delay_max_s:6.2f} s  "
                    f"hole {outcome.hole_s:5.2f} s  behind {outcome.behind:5}"
                )
    if not given.json:
        print(f"simulated in {time.monotonic() - started:.0f} s")


if __name__ == "__main__":
    main()
