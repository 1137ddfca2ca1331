# SPDX-License-Identifier: MIT
"""Steps that replay and scan share: the pace of sending, the wait for the map, and progress.

A replay knows its poses and sends every keyframe. A scan finds poses and chooses among frames. The later
steps are the same. Both hand keyframes to the clients of one `Target`. They ask this engine when the next
keyframe may go, and when all of them are in the map.
"""

import logging
import time
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Protocol

from tsfusion.client import Client, ClientStats
from tsfusion.core.errors import FlushTimeout, KeyframeRefused, TransportError
from tsfusion.pipelines.runs.target_server import Target
from tsfusion.scanner.scanner import ScanState

AHEAD = 3  # keyframes of a recording that are sent and not yet fused
# Seconds without progress before a run that needs the map gives up: a server restarts a stuck fuser after 60.
STALL_TIMEOUT = 120.0
_PATIENCE = 5.0  # seconds without progress before the reason is logged
LINGER = 10.0  # seconds without progress until keyframes for a distant server are left in the spool
_STAMPS_TIMEOUT = 5.0  # seconds for a distant server to send its last stamps: for the figures only
_POLL = 0.01  # seconds

log = logging.getLogger(__name__)

STARTING = "starting a server (the first start compiles kernels)"


class Progress(Protocol):
    """Shows the user the progress of a run."""

    def stage(self, text: str) -> None:
        """Announce the next stage of the run."""

    def update(
        self, total: int | None, stats: ClientStats, *, link: str = "", scan: ScanState | None = None
    ) -> None:
        """Show the counts. The method is called often.

        Args:
            total: number of frames of the source, or of keyframes without `scan`; None if it is unknown.
            stats: sums over all clients.
            link: why the server takes no keyframes at the moment; empty if it does.
            scan: state of the sensor and its frames, for a scan.
        """


class Engine:
    """Waits, on behalf of a run, for keyframes on their way into the maps of a target.

    Args:
        target: server that they go to.
        observe: shows the progress of the run, and returns the sums of counts over its clients.
        problem: returns why the server takes nothing at the moment; an empty text if it does.
    """

    def __init__(
        self, target: Target, observe: Callable[[], ClientStats], problem: Callable[[], str] = str
    ) -> None:
        self._target, self._observe, self._problem = target, observe, problem

    def check(self) -> ClientStats:
        """Show the progress and return the counts. Raise TransportError if the run's own server has ended."""
        self._target.check()
        return self._observe()

    def wait_turn(self, ahead: int = AHEAD) -> None:
        """Wait until fewer than `ahead` keyframes sent are unfused. Raise TransportError without progress."""
        self._wait_map(lambda stats: stats.sent - stats.settled < ahead)

    def wait_fused(self) -> None:
        """Wait until each sent keyframe is in the map or rejected. Raise TransportError if progress stops."""
        self._wait_map(lambda stats: not stats.waiting and stats.settled >= stats.sent)

    def wait_settled(self, clients: Iterable[Client]) -> None:
        """Wait until each keyframe is in the map at its newest pose; TransportError if progress stops."""
        for client in clients:
            self._wait_map(lambda _, client=client: client.is_settled)  # type: ignore[misc]

    def wait_meshed(self, clients: Iterable[Client]) -> None:
        """Wait until meshes show every keyframe (last stamp of the latency ledger), or until a timeout."""
        for client in clients:
            with suppress(FlushTimeout):
                client.wait_meshed()

    def wait_acknowledged(self, clients: Iterable[Client]) -> None:
        """Wait until the server has every keyframe on its disk, or takes no more."""
        clients = [client for client in clients if not client.is_of_other_world]
        if self._wait(lambda _: not any(client.stats.waiting for client in clients), LINGER):
            for client in clients:
                # Corrections and stamps are no reason to lose a scan; what was refused is counted.
                with suppress(FlushTimeout, KeyframeRefused):
                    client.flush()
                    client.wait_fused(_STAMPS_TIMEOUT)

    def _wait_map(self, reached: Callable[[ClientStats], bool]) -> None:
        if not self._wait(reached, STALL_TIMEOUT):
            raise TransportError(
                f"the server has fused nothing for {STALL_TIMEOUT:.0f} s, and keyframes wait: "
                + (self._problem() or "`tsfusion status` shows the state of a server")
            )

    def _wait(self, reached: Callable[[ClientStats], bool], timeout: float) -> bool:
        """Wait until `reached` is True of the counts. Return False if none changed for `timeout` seconds."""
        last, moved, logged = (-1, -1, -1), time.monotonic(), False
        while True:
            stats = self.check()
            if reached(stats):
                return True
            now = (stats.waiting, stats.durable + stats.settled, stats.corrections_waiting)
            if now != last:
                last, moved, logged = now, time.monotonic(), False
            elif time.monotonic() - moved > timeout:
                return False
            elif not logged and time.monotonic() - moved > _PATIENCE and (why := self._problem()):
                log.warning("nothing moves: %s; waiting for at most %.0f s", why, timeout)
                logged = True
            time.sleep(_POLL)
