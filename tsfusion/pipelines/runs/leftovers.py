# SPDX-License-Identifier: MIT
"""Send the keyframes that earlier scans left in their spools, or log that they still wait."""

import datetime
import logging
import time
from collections.abc import Callable

from tsfusion.client import Client
from tsfusion.core.errors import TsfusionError
from tsfusion.delivery import left_spools
from tsfusion.delivery.left_spools import LeftSpool
from tsfusion.pipelines.runs.target_server import Target

ANSWER_SECONDS = 2.0  # wait for a server's answer to a client; then a scan begins without it
_FIRST_SECONDS = 10.0  # wait for a server to open a map and take the first keyframe
_LAST_SECONDS = 10.0  # wait after a scan; what is left then goes with the next scan
_SENDING = ("connected", "held", "opening")  # states in which the server takes keyframes, or will soon
_POLL = 0.01  # seconds

log = logging.getLogger(__name__)


class Leftovers:
    """The spools of earlier scans, each with a client that sends its records.

    The server decides: a spool goes into its own map if this map is new or has the spool's world. It waits if
    the map has keyframes of another world.

    Args:
        given: True if poses of scans in this spool folder come from elsewhere. Then a spool without a world
            is not taken for a scan that localised itself.
    """

    def __init__(self, target: Target, *, given: bool) -> None:
        self._target, self._given = target, given
        self._clients: list[tuple[LeftSpool, Client]] = []
        self._refused: set[LeftSpool] = set()
        self.maps: set[str] = set()  # maps that have keyframes waiting

    def begin(self) -> None:
        """Open a client for each spool, oldest first, wait for the server's answer, and log it.

        If several spools wait for one new map, the oldest gets it. All come before the scan itself, so that a
        refusal comes now and not during the scan.
        """
        for left in left_spools.find(self._target.spools):
            client = self._open(left)
            if client is not None:
                _wait_first(client)
                self._name(left, client)

    def finish(self) -> None:
        """Wait some seconds for spools that the server takes, and log those that still wait."""
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
        """Log how many keyframes of a spool wait, for which map, since when, and what becomes of them."""
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
    """Wait until the server has a client's first keyframe or has refused it, if the server answers."""
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
