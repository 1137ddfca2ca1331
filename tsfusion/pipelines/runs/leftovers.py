# SPDX-License-Identifier: MIT
"""Keyframes that earlier scans left in their spools: sent along with a scan to their own maps, or named."""

import datetime
import logging
import time
from collections.abc import Callable

from tsfusion.client import Client
from tsfusion.core.errors import TsfusionError
from tsfusion.delivery import left_spools
from tsfusion.delivery.left_spools import LeftSpool
from tsfusion.pipelines.runs.target_server import Target

ANSWER_SECONDS = 2.0  # for a server to say whether it takes a client: a scan begins without knowing
_FIRST_SECONDS = 10.0  # for it to open a map and take the first keyframe
_LAST_SECONDS = 10.0  # after a scan for the rest; more of it goes with the next one
_SENDING = ("connected", "held", "opening")  # states in which the server takes keyframes, or will soon
_POLL = 0.01  # seconds

log = logging.getLogger(__name__)


class Leftovers:
    """The spools of earlier scans, each with a client that sends it.

    The server's word decides: a spool goes into its own map when that has its world or is new, and waits when
    the map has keyframes of another one.

    Args:
        given: poses of scans with this spool folder come from elsewhere, so that a spool which names no world
            is not taken for one of a scan that localised itself.
    """

    def __init__(self, target: Target, *, given: bool) -> None:
        self._target, self._given = target, given
        self._clients: list[tuple[LeftSpool, Client]] = []
        self._refused: set[LeftSpool] = set()
        self.maps: set[str] = set()  # for which keyframes wait

    def begin(self) -> None:
        """Open a client for each spool, oldest first, wait for the server's answer, and name it in a line.

        Of several that wait for one map the oldest has it, and all of them come before the scan itself: who
        is refused is refused now, and not in the middle of a scan.
        """
        for left in left_spools.find(self._target.spools):
            client = self._open(left)
            if client is not None:
                _wait_first(client)
                self._name(left, client)

    def finish(self) -> None:
        """Wait a moment for those that the server takes, and name those that still wait."""
        sent = [client for _, client in self._clients if client.link_state.kind in _SENDING]
        _wait(lambda: not any(client.stats.waiting for client in sent), _LAST_SECONDS)
        for left, client in self._clients:
            if client.stats.waiting and left not in self._refused:
                self._name(left, client, is_over=True)

    def _open(self, left: LeftSpool) -> Client | None:
        self.maps.add(left.map)
        if left.used_by is not None:
            log.warning("%s is in use by another scanner (pid %s)", left.folder, left.used_by)
            return None
        world = left.world if self._given else left.own_world
        try:
            client = self._target.client_of_left(left, world)
        except TsfusionError as error:
            log.warning("the keyframes waiting in %s are not sent: %s", left.folder, error)
            return None
        self._clients.append((left, client))
        return client

    def _name(self, left: LeftSpool, client: Client, *, is_over: bool = False) -> None:
        """Log a line: how many keyframes wait, for which map, since when, and what becomes of them."""
        count = client.stats.waiting + client.stats.durable
        what = f"{count} keyframes that a scan of {_clock(left.since_ns)} left for the map {left.map}"
        if client.is_of_other_world:
            self._refused.add(left)
            command = f"tsfusion spool send {left.folder.name} --spool {self._target.spools} --map NAME"
            why = f"that map has keyframes of another session; `{command}` sends them to another map"
            log.warning("%s wait in %s: %s", what, left.folder, why)
        elif is_over:
            why = client.problem or "the scan was over before they were sent"
            log.warning("%s wait in %s for the next scan: %s", what, left.folder, why)
        else:
            log.warning("%s are sent, too, as soon as the server takes them", what)


def _wait_first(client: Client) -> None:
    """Wait until a server that answers has the first keyframe, or has refused it."""
    client.wait_answer(ANSWER_SECONDS)
    if client.link_state.kind in _SENDING:
        _wait(lambda: client.stats.durable or client.is_of_other_world, _FIRST_SECONDS)


def _wait(reached: Callable[[], object], seconds: float) -> None:
    deadline = time.monotonic() + seconds
    while not reached() and time.monotonic() < deadline:
        time.sleep(_POLL)


def _clock(stamp_ns: int) -> str:
    moment = datetime.datetime.fromtimestamp(stamp_ns / 1e9).astimezone()
    return moment.strftime("%Y-%m-%d %H:%M")
