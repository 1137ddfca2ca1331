# SPDX-License-Identifier: MIT
"""Compute values (weights, measures) at the vertices of tiles with given functions, on a separate thread."""

import logging
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.viewer.map.map_tiles import CellKey, Tile

Function = Callable[[NDArray[np.float32]], "NDArray[np.floating[Any]] | None"]
_AGAIN = 3.0  # seconds until a function without an answer is called again

log = logging.getLogger(__name__)


class VertexValues:
    """Values at vertices, of one quantity at a time, computed on a thread.

    `functions`, by name: (n, 3) float32 points in metres → (n,) values, NaN = no value; None = no answer now.
    """

    def __init__(self, functions: Mapping[str, Function]) -> None:
        self._functions = dict(functions)
        self._name = ""
        self._wanted: dict[CellKey, Tile] = {}
        self._known: dict[CellKey, tuple[Tile, NDArray[np.float32]]] = {}
        self._ready: set[CellKey] = set()
        self._change = threading.Condition()
        self._ended = False
        self._thread: threading.Thread | None = None
        self.is_unknown = False  # the last call had no answer

    @property
    def names(self) -> list[str]:
        return list(self._functions)

    def choose(self, name: str) -> None:
        """Compute another quantity from now on; an unknown name stops the computation."""
        with self._change:
            self._name = name if name in self._functions else ""
            self._wanted.clear()
            self._known.clear()
            self._ready.clear()
            self.is_unknown = False

    def ask(self, tiles: Mapping[CellKey, Tile]) -> None:
        """Request the values of tiles; only the newest version of each tile counts."""
        with self._change:
            if not self._name:
                return
            for key, tile in tiles.items():
                if key not in self._known or self._known[key][0] is not tile:
                    self._wanted[key] = tile
            if self._thread is None:
                self._thread = threading.Thread(target=self._work, name="vertex values", daemon=True)
                self._thread.start()
            self._change.notify()

    def of(self, key: CellKey, tile: Tile) -> NDArray[np.float32] | None:
        """Return the (n,) values at a tile's vertices, or None if they are not known (yet)."""
        known = self._known.get(key)
        return known[1] if known is not None and known[0] is tile else None

    def known(self) -> list[NDArray[np.float32]]:
        """Return the known values of all tiles."""
        return [values for _, values in list(self._known.values())]

    def take_ready(self) -> set[CellKey]:
        """Return the tiles whose values came since the last call."""
        with self._change:
            ready, self._ready = self._ready, set()
        return ready

    def close(self) -> None:
        """End the thread; a running call ends by itself."""
        with self._change:
            self._ended = True
            self._change.notify()

    def _work(self) -> None:
        while True:
            with self._change:
                while not self._wanted and not self._ended:
                    self._change.wait()
                if self._ended:
                    return
                key = next(iter(self._wanted))
                tile, name = self._wanted.pop(key), self._name
            values = self._values(name, tile)
            with self._change:
                if name != self._name:
                    continue
                self.is_unknown = values is None
                if values is None:
                    self._wanted.setdefault(key, tile)
                    self._change.wait(_AGAIN)
                else:
                    self._known[key] = (tile, values)
                    self._ready.add(key)

    def _values(self, name: str, tile: Tile) -> NDArray[np.float32] | None:
        started = time.monotonic()
        try:
            values = self._functions[name](tile.mesh.vertices)
        except Exception as error:  # noqa: BLE001 - a measure is anybody's function
            log.warning("no %s: %s", name, error)
            return None
        log.debug("%s of %d points: %.3f s", name, len(tile.cell), time.monotonic() - started)
        if values is None or np.shape(values) != (len(tile.mesh.vertices),):
            return None
        return np.asarray(values, np.float32)
