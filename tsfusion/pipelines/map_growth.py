# SPDX-License-Identifier: MIT
"""How a map and its server grow during a run: the gateway is asked twice a second, the fuser is not."""

import csv
import io
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from tsfusion.core import process
from tsfusion.core.errors import TsfusionError
from tsfusion.pipelines.target_server import Target

_EVERY_S = 0.5
_TIMEOUT_S = 1.0
MOST_ROWS = 2000  # of a long run every second one goes, again and again


class Row(NamedTuple):
    """A map and its server at a moment. `server_bytes`: resident memory of a run's own server's processes."""

    seconds: float
    fused: int
    waiting: int
    blocks: int
    map_bytes: int
    server_bytes: int


class MapGrowth:
    """Rows of a map's growth, taken by a thread of their own."""

    def __init__(self, target: Target, map_name: str) -> None:
        self._target, self._map = target, map_name
        self._begun, self._every = time.monotonic(), _EVERY_S
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="map growth", daemon=True)
        self.rows: list[Row] = []

    def start(self) -> None:
        """Begin to take rows."""
        self._thread.start()

    def stop(self) -> None:
        """Take no more rows; again does nothing."""
        self._ended.set()
        self._thread.join(2 * _TIMEOUT_S)

    def write_csv(self, path: Path) -> None:
        """Write a line a row, below the names of the columns."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(Row._fields)
        writer.writerows(self.rows)
        path.write_text(text.getvalue(), encoding="utf-8")

    def add(self, row: Row) -> None:
        """Append a row; of too many every second one goes."""
        self.rows.append(row)
        if len(self.rows) >= MOST_ROWS:
            self.rows = self.rows[::2]
            self._every *= 2

    def _run(self) -> None:
        while not self._ended.is_set():
            with suppress(TsfusionError):  # a server that is away or silent: the run itself says so
                self._take()
            self._ended.wait(self._every)

    def _take(self) -> None:
        found = self._target.health(timeout=_TIMEOUT_S).maps.get(self._map)
        if found is None:
            return
        child = self._target.child
        memory = 0 if child is None else process.tree_rss_bytes(child.pid)
        seconds = round(time.monotonic() - self._begun, 3)
        self.add(Row(seconds, found.keyframes_fused, found.waiting, found.blocks, found.map_bytes, memory))


@contextmanager
def watch(target: Target, map_name: str) -> Iterator[MapGrowth]:
    """The growth of a map during the block."""
    growth = MapGrowth(target, map_name)
    growth.start()
    try:
        yield growth
    finally:
        growth.stop()
