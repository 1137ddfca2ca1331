# SPDX-License-Identifier: MIT
"""State of a viewer that follows a map: the cells it holds, and the next question to the server. No sockets.

The follower first asks for all cells with the raw surface. After that, numbered mesh updates bring each
change: first the raw surface, later the refined one. A follower that misses an update asks for the changes
since the last update that came. It asks for refined cells that no update brings once the map is idle.

Answers and updates overtake each other: the newest state of each cell counts (`held_cells`).
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry.mesh import Mesh
from tsfusion.wire.asking.held_cells import HeldCells, SurfacePart
from tsfusion.wire.asking.map_events import Cleared, MapEvent, SurfaceUpdate
from tsfusion.wire.asking.surface_parts import part_of_answer, part_of_update
from tsfusion.wire.messages.health import MapHealth
from tsfusion.wire.messages.mesh_updates import Meshed
from tsfusion.wire.messages.questions import Cells

_QUIET_S = 1.5  # an idle map without updates for so long is asked for its refined cells
_LOST_S = 2.0  # an update that the server sent so long ago, and that did not come, is lost


@dataclass
class _Sweep:
    """One pass over the cells of a map, by several questions.

    Attributes:
        is_raw: True if the pass asks for the raw surface.
        since: ask only for cells changed after this version; None asks for all cells.
        drops: `Volume.drops` at that version.
        first: next cell to ask for; None is the first cell.
        began: version and drops of the first answer; None before it.
    """

    is_raw: bool
    since: int | None = None
    drops: int = 0
    first: NDArray[np.int32] | None = None
    began: tuple[int, int] | None = None

    @property
    def is_first(self) -> bool:
        """True if the next answer is the first one about this map."""
        return self.is_raw and self.since is None and self.began is None


class FollowedMap:
    """The cells of a map that are known, and the next question about the map.

    Attributes:
        epoch: name of the fuser's process; empty while nothing is known.
        voxel_size: metres; 0 while not known.
    """

    def __init__(self, name: str) -> None:
        self.name, self.epoch, self.voxel_size = name, "", 0.0
        self._past: deque[str] = deque(maxlen=8)  # earlier epochs: their updates may still come
        self._server: tuple[str, int] | None = None
        self._is_idle = False
        self._begin()

    def _begin(self) -> None:
        if self.epoch:
            self._past.append(self.epoch)
        self.epoch, self._held = "", HeldCells()
        self._number = 0  # number of the newest update
        self._until = 0, 0  # version and drops up to which all updates came
        self._missed: tuple[int, int] | None = None  # version and drops after which an update is missing
        self._refined: tuple[int, int] | None = None  # version and drops up to which all cells are refined
        self._misses_refined = False
        self._refines = True  # the map's settings ask for another surface than the raw one
        self._behind: tuple[int, float] | None = None  # server's newest number, and since when it is missed
        self._quiet_from = 0.0
        self._sweep: _Sweep | None = None

    def forget(self) -> list[MapEvent]:
        """Drop all cells: the server has no such map."""
        was_known, self.voxel_size = self.voxel_size, 0.0
        self._begin()
        return [Cleared(self.name, was_known)] if was_known else []

    # --- what to ask ---

    def question(self, now: float) -> Cells | None:
        """Return the next question, or None without one."""
        if self._missed is not None and (self._sweep is None or not self._sweep.is_raw):
            self._sweep, self._missed = _Sweep(True, *self._missed), None
        elif self._sweep is None and not self.epoch:
            self._sweep = _Sweep(True)
        elif self._sweep is None and self._is_idle and now >= self._quiet_from and self._lacks_refined:
            self._sweep = _Sweep(False, *(self._refined or ()))
        sweep = self._sweep
        if sweep is None or not (sweep.is_raw or self._is_idle):
            return None
        first = None if sweep.first is None else tuple(sweep.first.tolist())
        return Cells(first=first, since=sweep.since, surface="raw" if sweep.is_raw else None)

    @property
    def _lacks_refined(self) -> bool:
        return self._refines and (self._refined is None or self._misses_refined)

    # --- what came ---

    def on_cells(self, epoch: str, arrays: dict[str, NDArray[Any]]) -> list[MapEvent]:
        """Take the answer to the last question. Return the events that follow from it.

        Raises:
            DecodeError: for a malformed answer; ask again.
        """
        events: list[MapEvent] = []
        sweep = self._sweep
        if sweep is None:
            return []
        part = part_of_answer(arrays, is_raw=sweep.is_raw)
        version, drops, number = (int(one) for one in arrays["state"])
        if epoch != self.epoch:
            if not sweep.is_first:
                self._begin()
                return []
            self._begin()
            self.epoch, self.voxel_size = epoch, float(arrays["voxel_size"])
            self._number, self._until, self._sweep = number, (version, drops), sweep
            self._refines = not part.is_refined
            events.append(Cleared(self.name, self.voxel_size))
        if sweep.since is not None and drops != sweep.drops:  # blocks were removed: no version says which
            self._sweep = _Sweep(sweep.is_raw)
            return events
        if sweep.began is None:
            sweep.began = version, drops
            self._misses_refined &= sweep.is_raw
        return events + self._take_answer(sweep, part, arrays["next"])

    def _take_answer(self, sweep: _Sweep, part: SurfacePart, following: NDArray[np.int32]) -> list[MapEvent]:
        end = following if len(following) else None
        events = self._take(part)
        if sweep.since is None:
            gone = self._held.take_absent(sweep.first, end, part)
            if len(gone):
                events.append(_without_triangles(gone, is_refined=part.is_refined))
        sweep.first = end
        if end is None:
            if not sweep.is_raw or (sweep.since is None and not len(self._held)):
                self._refined = sweep.began
            self._sweep = None
        return events

    def on_update(self, meshed: Meshed, frames: Sequence[Any], now: float) -> list[MapEvent]:
        """Take a mesh update. Return the events that follow from it.

        Raises:
            DecodeError: for a malformed update; it then counts as missed.
        """
        update = meshed.update
        if update is None or update.epoch in self._past or not self.epoch:
            return []
        if update.epoch != self.epoch:
            self._begin()
            return []
        if update.number <= self._number:
            return []
        if update.number > self._number + 1:
            self._miss()
        self._number = update.number
        self._quiet_from = now + _QUIET_S
        try:
            part = part_of_update(meshed, frames)
        except Exception:
            self._miss()
            raise
        self._until = update.sent_until, update.drops
        if update.settled and self._refined is not None and not self._misses_refined:
            self._refined = self._until
        return self._take(part)

    def on_health(self, health: MapHealth, server: str, now: float) -> None:
        """Take the health of the map, sent by the server of epoch `server`."""
        self._is_idle = health.state == "idle"
        before, self._server = self._server, (server, health.fuser_restarts)
        if before not in (None, self._server) and self.epoch:
            self._miss()  # the next answer shows if the fuser is another process
        if health.mesh_epoch != self.epoch or health.mesh_number <= self._number:
            self._behind = None
        elif self._behind is None or self._behind[0] <= self._number:
            self._behind = health.mesh_number, now
        elif now - self._behind[1] > _LOST_S:
            self._number, self._behind = self._behind[0], None
            self._miss()

    def _miss(self) -> None:
        """Remember that an update after `_until` is missing."""
        self._missed = self._missed or self._until
        self._misses_refined = True

    def _take(self, part: SurfacePart) -> list[MapEvent]:
        chosen = self._held.take(part)
        if not chosen.any():
            return []
        part = part.only(chosen)
        return [
            SurfaceUpdate(
                cells=part.cells,
                first_face=part.first_face,
                mesh=part.mesh,
                is_refined=part.is_refined,
                clients=part.clients,
                client=part.client,
            )
        ]


def _without_triangles(cells: NDArray[np.int32], *, is_refined: bool) -> SurfaceUpdate:
    nothing = Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.float32))
    return SurfaceUpdate(
        cells=cells,
        first_face=np.zeros(len(cells) + 1, np.int32),
        mesh=nothing,
        is_refined=is_refined,
        client=np.full(len(cells), -1, np.int32),
    )
