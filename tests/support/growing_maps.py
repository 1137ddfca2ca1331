# SPDX-License-Identifier: MIT
"""A feed of a real map that grows in the same process: a page shows what is fused meanwhile."""

import time
from collections.abc import Iterable

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion import Keyframe, Volume
from tsfusion.geometry.mesh import Mesh
from tsfusion.tsdf.block_store import cells_of
from tsfusion.viewer.map_feed import TimeLine
from tsfusion.wire.health import ClientHealth, Health, MapHealth
from tsfusion.wire.keyframe_times import Spread
from tsfusion.wire.map_events import (
    Cleared,
    HealthSeen,
    LinkSeen,
    MapEvent,
    PathsFound,
    ScannerSeen,
    SurfaceUpdate,
)

SESSION = bytes(range(16))


def surface_update(
    volume: Volume, cells: NDArray[np.int32], surface: str | None, **fields: object
) -> SurfaceUpdate:
    """The triangles of cells as a server sends them."""
    mesh = volume.extract_mesh(blocks=cells, surface=surface)
    cells = np.unique(cells, axis=0).astype(np.int32)
    owner = owners(mesh, volume.config.voxel_size, cells)
    order = np.argsort(owner, kind="stable")
    mesh = Mesh(mesh.vertices, mesh.faces[order], mesh.normals, mesh.colors)
    first = np.searchsorted(owner[order], np.arange(len(cells) + 1)).astype(np.int32)
    return SurfaceUpdate(cells, first, mesh, is_refined=surface is None, **fields)  # type: ignore[arg-type]


def owners(mesh: Mesh, voxel_size: float, cells: NDArray[np.int32]) -> NDArray[np.int64]:
    """(m,) row of the cell that each face lies in: its middle is between the centres of the cell's voxels."""
    middle = mesh.vertices[mesh.faces].mean(axis=1).astype(np.float64)
    place = np.floor((middle / voxel_size - 0.5) / 8).astype(np.int64)
    rows = {tuple(cell): row for row, cell in enumerate(cells.tolist())}
    return np.array([rows[tuple(one)] for one in place.tolist()], np.int64).reshape(-1)


class GrowingMap:
    """A `MapFeed` that fuses a keyframe each time that somebody asks what has happened.

    Args:
        keyframes: what is fused, in this order.
        pause: seconds from one to the next.
    """

    time_line: TimeLine | None = None

    def __init__(
        self, volume: Volume, keyframes: Iterable[Keyframe], *, map_name: str = "room", pause: float = 0.0
    ) -> None:
        self.volume, self.title = volume, "a growing map"
        self._keyframes, self._name, self._pause = iter(keyframes), map_name, pause
        self._first: list[MapEvent] = [Cleared(map_name, volume.config.voxel_size), LinkSeen("")]
        self.poses: list[NDArray[np.float64]] = []
        self.is_whole = False
        self._next = 0.0
        self._unrefined = np.zeros((0, 3), np.int32)
        self.added: list[MapEvent] = []  # by a test, to be told next

    def maps(self) -> list[str]:
        return [self._name]

    def choose(self, map_name: str) -> None:
        raise AssertionError(map_name)

    def seek(self, keyframes: int) -> None:
        raise AssertionError(keyframes)

    def weights(self, points: NDArray[np.float32]) -> NDArray[np.float32] | None:
        return np.asarray(self.volume.sample(points).weight, np.float32)

    def close(self) -> None:
        pass

    def events(self, timeout: float) -> list[MapEvent]:
        if self._first or self.added:
            events, self._first, self.added = self._first + self.added, [], []
            return events
        if time.monotonic() < self._next:
            time.sleep(min(timeout, max(self._next - time.monotonic(), 0.0)))
            return []
        keyframe = next(self._keyframes, None)
        if keyframe is None:
            return self._refine(timeout)
        self._next = time.monotonic() + self._pause
        self.volume.integrate(keyframe)
        blocks = self.volume.take_dirty()
        self._unrefined = np.unique(
            np.concatenate((self._unrefined, self.volume.cells_to_mesh(blocks))), axis=0
        )
        self.poses.append(keyframe.T_world_camera)
        who = {"clients": (SESSION,), "client": np.zeros(len(np.unique(cells_of(blocks), axis=0)), np.int32)}
        return [
            surface_update(self.volume, cells_of(blocks), "raw", **who),
            seen(len(self.poses), keyframe),
            HealthSeen(self.health()),
        ]

    def _refine(self, timeout: float) -> list[MapEvent]:
        cells, self._unrefined = self._unrefined[:256], self._unrefined[256:]
        if len(cells):
            who = {"clients": (SESSION,), "client": np.zeros(len(cells), np.int32)}
            return [surface_update(self.volume, cells, None, **who)]
        if not self.is_whole:
            self.is_whole = True
            return [PathsFound({SESSION: (np.arange(1, len(self.poses) + 1), np.array(self.poses))})]
        time.sleep(timeout)
        return []

    def health(self, problems: tuple[str, ...] = ()) -> Health:
        """Of a server that would have this map."""
        fused, stats = len(self.poses), self.volume.stats()
        delays = Spread(
            count=fused, mean=80, p50=70 + 5 * np.sin(fused), p95=120 + 9 * np.cos(fused), max=200
        )
        one = MapHealth(
            state="busy", problem="", keyframes_durable=fused + 2, keyframes_fused=fused, waiting=2, rejected={},
            quarantined=0, sessions=1, journal_bytes=10**6, journal_damaged=0, fuser_restarts=0,
            blocks=stats.blocks, map_bytes=stats.bytes, last_keyframe_s=0.1, delay_ms=delays, delay_bound_ms=1.0,
        )  # fmt: skip
        client = ClientHealth(
            client="", session=SESSION.hex()[:8], map=self._name, heard_s=0.1, durable=fused + 2, fused=fused,
            received_bytes=10**6, waiting=1, skipped={}, held="",
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
