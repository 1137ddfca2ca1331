# SPDX-License-Identifier: MIT
"""A feed of a real map that grows in the same process: a page shows what is fused meanwhile."""

import math
import queue
from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion import Keyframe, Volume
from tsfusion.tsdf.store.block_store import cells_of
from tsfusion.viewer.map_feed import TimeLine
from tsfusion.wire.asking.followed_map import (
    Cleared,
    HealthSeen,
    LinkSeen,
    MapEvent,
    PathsFound,
    ScannerSeen,
    SurfaceUpdate,
)
from tsfusion.wire.messages.health import ClientHealth, Health, MapHealth, Spread

SESSION = bytes(range(16))


def surface_update(
    volume: Volume, cells: NDArray[np.int32], surface: str | None, **fields: object
) -> SurfaceUpdate:
    """The triangles of cells as a server sends them."""
    found = volume.surface.mesh_cells(cells, surface)
    is_refined = np.full(len(found.cells), surface is None)
    return SurfaceUpdate(found.cells, found.first_face, found.mesh, is_refined, **fields)


class GrowingMap:
    """A `MapFeed` of keyframes that a test has fused, one after the other.

    Args:
        keyframes: what is fused, in this order.
    """

    time_line: TimeLine | None = None

    def __init__(self, volume: Volume, keyframes: Iterable[Keyframe], *, map_name: str = "room") -> None:
        self.volume, self.title = volume, "a growing map"
        self._keyframes, self._name = iter(keyframes), map_name
        self._told: queue.Queue[list[MapEvent]] = queue.Queue()
        self.tell(Cleared(map_name, volume.config.voxel_size), LinkSeen(""))
        self.poses: list[NDArray[np.float64]] = []
        self.is_whole = False
        self._unrefined = np.zeros((0, 3), np.int32)

    def maps(self) -> list[str]:
        return [self._name]

    def choose(self, map_name: str) -> None:
        raise AssertionError(map_name)

    def seek(self, keyframes: int) -> None:
        raise AssertionError(keyframes)

    def weights(self, points: NDArray[np.float32]) -> NDArray[np.float32] | None:
        return None

    def close(self) -> None:
        pass

    def events(self, timeout: float) -> list[MapEvent]:
        try:
            return self._told.get(timeout=timeout)
        except queue.Empty:
            return []

    def tell(self, *events: MapEvent) -> None:
        """Let these be what has happened."""
        self._told.put(list(events))

    def grow(self) -> list[MapEvent]:
        """Fuse a keyframe, or refine what was fused, and tell it. For one thread, as Taichi wants it."""
        keyframe = next(self._keyframes, None)
        events = self._refine() if keyframe is None else self._fuse(keyframe)
        self.tell(*events)
        return events

    def _fuse(self, keyframe: Keyframe) -> list[MapEvent]:
        self.volume.integrate(keyframe)
        blocks = self.volume.take_dirty()
        waiting = np.concatenate((self._unrefined, self.volume.cells_to_mesh(blocks)))
        self._unrefined = np.unique(waiting, axis=0)
        self.poses.append(keyframe.T_world_camera)
        cells = np.unique(cells_of(blocks), axis=0)
        who = {"clients": (SESSION,), "client": np.zeros(len(cells), np.int32)}
        return [
            surface_update(self.volume, cells, "raw", **who),
            seen(len(self.poses), keyframe),
            HealthSeen(self.health()),
        ]

    def _refine(self) -> list[MapEvent]:
        cells, self._unrefined = self._unrefined[:256], self._unrefined[256:]
        if len(cells):
            who = {"clients": (SESSION,), "client": np.zeros(len(cells), np.int32)}
            return [surface_update(self.volume, cells, None, **who)]
        if not self.is_whole:
            self.is_whole = True
            return [PathsFound({SESSION: (np.arange(1, len(self.poses) + 1), np.array(self.poses))})]
        return []

    def health(self, problems: tuple[str, ...] = ()) -> Health:
        """Of a server that would have this map."""
        fused, stats = len(self.poses), self.volume.stats()
        delays = Spread(
            count=fused, mean=80, p50=70 + 5 * math.sin(fused), p95=120 + 9 * math.cos(fused), max=200
        )
        one = MapHealth(
            state="busy", problem="", keyframes_durable=fused + 2, keyframes_fused=fused, waiting=2,
            rejected={}, quarantined=0, sessions=1, journal_bytes=10**6, journal_damaged=0,
            fuser_restarts=0, blocks=stats.blocks, map_bytes=stats.bytes, last_keyframe_s=0.1,
            delay_ms=delays, delay_bound_ms=1.0,
        )  # fmt: skip
        client = ClientHealth(
            client="", session=SESSION.hex()[:8], map=self._name, heard_s=0.1, durable=fused + 2,
            fused=fused, received_bytes=10**6, waiting=1, skipped={}, held="",
        )  # fmt: skip
        return Health(
            ready=True, problems=problems, epoch="e", uptime_s=10.0, rss_bytes=90 * 10**6, refused={},
            duplicates=0, maps={self._name: one}, clients=(client,),
        )  # fmt: skip


def seen(seq: int, keyframe: Keyframe) -> ScannerSeen:
    """A keyframe as those who watch hear of it."""
    picture = None
    if keyframe.color is not None:
        picture = bytes(cv2.imencode(".jpg", keyframe.color)[1].tobytes())
    return ScannerSeen(
        SESSION, seq, keyframe.T_world_camera, keyframe.intrinsics, keyframe.shape[:2], picture
    )
