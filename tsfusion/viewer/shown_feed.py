# SPDX-License-Identifier: MIT
"""Follow a feed's map for those who see it: its tiles, scanners, up direction, and the server's health."""

import sys
import threading
import time
from abc import ABC, abstractmethod

import numpy as np

from tsfusion.core import process
from tsfusion.viewer.map.map_tiles import CellKey, MapTiles
from tsfusion.viewer.map.map_views import MapUp
from tsfusion.viewer.map.scanner_tracks import ScannerTracks
from tsfusion.viewer.map_feed import MapFeed
from tsfusion.wire.asking.followed_map import (
    Cleared,
    HealthSeen,
    LinkSeen,
    MapEvent,
    PathsFound,
    ScannerSeen,
    SurfaceUpdate,
)
from tsfusion.wire.messages.health import Health

_WAIT = 0.1  # seconds to wait for an event
_SHARE = 0.008  # share of a core for putting updates into tiles: many at once cost little more than one
_TOGETHER = (0.25, 0.5)  # least and most seconds of updates that are applied together
_MOST_UPDATES = 64  # waiting updates


class ShownFeed(ABC):
    """Map of a feed, as it is shown now; a subclass shows it.

    Args:
        feed: feed of the map, which the caller closes.
        marks: scanners of the map.
    """

    def __init__(self, feed: MapFeed, marks: ScannerTracks) -> None:
        self._feed, self._marks = feed, marks
        self._began = time.monotonic()
        self.map_name, self.voxel_size = "", 0.02
        self._health: Health | None = None
        self._problem = ""  # of the link to the server
        self._up, self._tiles = MapUp(), MapTiles()
        self._updates: list[SurfaceUpdate] = []  # not applied yet
        self._next_apply = -np.inf

    @property
    @abstractmethod
    def is_watched(self) -> bool:
        """True if anybody is connected: then updates are applied soon."""

    @abstractmethod
    def tell_end(self, sentence: str) -> None:
        """Tell all who are connected `sentence`, the reason why nothing more comes; wait until it is sent."""

    @abstractmethod
    def _changed(self, keys: set[CellKey]) -> None:
        """Show tiles that have changed."""

    @abstractmethod
    def _cleared(self, *, is_other: bool) -> None:
        """Show nothing any more; `is_other`: of another map than before."""

    @abstractmethod
    def _told(self) -> None:
        """Take note of a new health, or of a new state of the link."""

    @abstractmethod
    def _step(self, now: float) -> None:
        """Show what has changed since the last call."""

    def run(self, stop: threading.Event, *, memory_bytes: int = sys.maxsize) -> None:
        """Show the feed's map and its changes until `stop` is set.

        Raises MemoryError if this process takes more than `memory_bytes`, or a TsfusionError of the feed.
        """
        while not stop.is_set():
            for event in self._feed.events(_WAIT):
                self._take(event)
            now = time.monotonic()
            if self._updates and now >= self._next_apply:
                self._apply(now)
            self._step(now)
            if process.rss_bytes() > memory_bytes:
                raise MemoryError(
                    f"the page's process may take {memory_bytes >> 20} MB of memory, and it takes more"
                )

    def _take(self, event: MapEvent) -> None:
        match event:
            case Cleared():
                self._clear(event)
            case SurfaceUpdate():
                self._up.note_given(event.mesh.known_up)
                self._updates.append(event)
                if len(self._updates) >= _MOST_UPDATES:
                    self._apply(time.monotonic())
            case ScannerSeen():
                self._up.note_scanner(event)
                self._marks.note_seen(event)
            case PathsFound():
                self._up.note_paths(event)
                self._marks.note_paths(event)
            case HealthSeen():
                self._health = event.health
                self._told()
            case LinkSeen():
                self._problem = event.problem
                self._told()

    def _apply(self, now: float) -> None:
        began = time.thread_time()
        keys = self._tiles.apply(self._updates, now - self._began)
        pause = rest(began, _SHARE, _TOGETHER) if self.is_watched else _TOGETHER[1]
        self._updates, self._next_apply = [], now + pause
        self._changed(keys)

    def _clear(self, event: Cleared) -> None:
        self._updates.clear()
        self._tiles.clear()
        self._marks.clear()
        is_other = event.map != self.map_name
        if is_other:
            self._up = MapUp()
        self.map_name, self.voxel_size = event.map, event.voxel_size
        self._marks.voxel_size = event.voxel_size
        self._cleared(is_other=is_other)


def rest(began: float, share: float, bounds: tuple[float, float]) -> float:
    """Return the rest in seconds, after work since `began` (`time.thread_time`), for a `share` of a core."""
    return min(max((time.thread_time() - began) / share, bounds[0]), bounds[1])
