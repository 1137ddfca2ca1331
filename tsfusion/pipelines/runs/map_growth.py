# SPDX-License-Identifier: MIT
"""Record how a map and its server grow during a run; check that a first keyframe fits into memory."""

import csv
import io
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from tsfusion.core import process
from tsfusion.core.config import SensorModel, VolumeConfig
from tsfusion.core.errors import InvalidConfig, TsfusionError
from tsfusion.core.number_ranges import distinct
from tsfusion.geometry.keyframe import Keyframe, points_camera
from tsfusion.pipelines.runs.target_server import Target

_EVERY_S = 0.5
_TIMEOUT_S = 1.0
MOST_ROWS = 2000  # then every second row is removed
_BLOCK = 8  # voxels, edge of a block
_VOXEL_BYTES = 20  # sums and colour
_SIZES = tuple(digit * 10.0**power for power in range(-4, 1) for digit in (1, 2, 3, 5))  # metres


class GrowthRow(NamedTuple):
    """State of a map and its server at a moment. `server_bytes`: resident memory of the run's own server."""

    seconds: float
    fused: int
    waiting: int
    blocks: int
    map_bytes: int
    server_bytes: int


class MapGrowth:
    """Rows of a map's growth over time, recorded by a thread of its own."""

    def __init__(self, target: Target, map_name: str) -> None:
        self._target, self._map = target, map_name
        self._begun, self._every = time.monotonic(), _EVERY_S
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="map growth", daemon=True)
        self.rows: list[GrowthRow] = []

    def start(self) -> None:
        """Begin to record rows."""
        self._thread.start()

    def stop(self) -> None:
        """Record no more rows. A second call does nothing."""
        self._ended.set()
        self._thread.join(2 * _TIMEOUT_S)

    def write_csv(self, path: Path) -> None:
        """Write the rows as CSV, below a line with the names of the columns."""
        text = io.StringIO()
        writer = csv.writer(text, lineterminator="\n")
        writer.writerow(GrowthRow._fields)
        writer.writerows(self.rows)
        path.write_text(text.getvalue(), encoding="utf-8")

    def add(self, row: GrowthRow) -> None:
        """Append a row. If there are too many, remove every second one."""
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
        self.add(
            GrowthRow(seconds, found.keyframes_fused, found.waiting, found.blocks, found.map_bytes, memory)
        )


@contextmanager
def watch(target: Target, map_name: str) -> Iterator[MapGrowth]:
    """Record the growth of a map during the block."""
    growth = MapGrowth(target, map_name)
    growth.start()
    try:
        yield growth
    finally:
        growth.stop()


def check_fits(keyframe: Keyframe, config: VolumeConfig) -> None:
    """Raise InvalidConfig if a keyframe alone needs more blocks than one keyframe may touch."""
    points, most = _within_range(keyframe, config), config.max_blocks_per_keyframe
    model = config.model(keyframe.sensor)
    blocks = _blocks(points, config.voxel_size, model)
    if blocks <= most:
        return
    fitting = next(
        (size for size in _SIZES if 4 * _blocks(points, size, model) <= most),
        _SIZES[-1],
    )
    gigabytes = blocks * _BLOCK**3 * _VOXEL_BYTES / 1e9
    raise InvalidConfig(
        f"voxel_size {config.voxel_size:g} m is too small here: the first keyframe alone would need "
        f"some {gigabytes:.1f} GB ({blocks} blocks, and max_blocks_per_keyframe is {most}); "
        f"use {fitting:g} or more"
    )


def _within_range(keyframe: Keyframe, config: VolumeConfig) -> NDArray[np.float64]:
    """Return the (n, 3) points within the sensor's range, metres in its frame."""
    model, points = config.model(keyframe.sensor), points_camera(keyframe)
    points = points[np.isfinite(points).all(axis=1)]
    ranges = np.linalg.norm(points, axis=1) if keyframe.kind == "points" else points[:, 2]
    return points[(ranges >= model.min_range) & (ranges <= model.max_range)]


def _blocks(points: NDArray[np.float64], voxel_size: float, model: SensorModel) -> int:
    """Estimate the number of blocks that points touch: those that hold points, and more as rays are thick."""
    if not len(points):
        return 0
    x, y, z = np.floor(points / (_BLOCK * voxel_size)).astype(np.int64).T
    support = min(max(3 * model.sigma_floor / voxel_size, model.min_support), model.max_support)
    return round(len(distinct((x << 42) ^ (y << 21) ^ z)) * (1 + 2 * support / _BLOCK))
