# SPDX-License-Identifier: MIT
"""A map as one follows it: what is held of its surface, and what has to be asked for. No sockets here.

All cells are asked for with the raw surface first. From then on mesh updates bring what changes, and the
refined surface behind it; they are numbered. Who misses one asks for what has changed since the last that
came. The refined surface of cells that no update brings is asked for once the map is idle.

Questions and updates overtake each other: of each cell the newest state counts (`held_cells`).
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

_QUIET_S = 1.5  # without an update, in an idle map, until what is not refined is asked for
_LOST_S = 2.0  # until an update that the server has sent is taken for lost


@dataclass
class _Sweep:
    """A pass over the cells.

    Attributes:
        is_raw: whether the raw surface is asked for.
        since: stamp after which cells changed; None = all cells.
        drops: `Volume.drops` at that stamp.
        first: where it goes on; None = at the first cell.
        began: stamp and drops at its first answer; None = there was none.
    """

    is_raw: bool
    since: int | None = None
    drops: int = 0
    first: NDArray[np.int32] | None = None
    began: tuple[int, int] | None = None

    @property
    def is_first(self) -> bool:
        """True if nothing was asked before: the answer is the beginning of everything."""
        return self.is_raw and self.since is None and self.began is None


class FollowedMap:
    """Known part of a map, and the next question about it.

    Attributes:
        epoch: of the fuser's process; empty = nothing is known.
        voxel_size: metres; 0 = not known.
    """

    def __init__(self, name: str) -> None:
        self.name, self.epoch, self.voxel_size = name, "", 0.0
        self._past: deque[str] = deque(maxlen=8)  # epochs of which updates may still come
        self._server: tuple[str, int] | None = None
        self._is_idle = False
        self._begin()

    def _begin(self) -> None:
        if self.epoch:
            self._past.append(self.epoch)
        self.epoch, self._held = "", HeldCells()
        self._number = 0  # of the newest update
        self._until = 0, 0  # stamp and drops up to which all updates came
        self._missed: tuple[int, int] | None = None  # likewise, where something is missing
        self._refined: tuple[int, int] | None = None  # likewise, of refined cells
        self._misses_refined = False
        self._refines = True  # whether the map's settings ask for another surface than the raw one
        self._behind: tuple[int, float] | None = None  # number that the server is at, and since when
        self._quiet_from = 0.0
        self._sweep: _Sweep | None = None

    def forget(self) -> list[MapEvent]:
        """Hold nothing any more: there is no such map."""
        was_known, self.voxel_size = self.voxel_size, 0.0
        self._begin()
        return [Cleared(self.name, was_known)] if was_known else []

    # --- what to ask ---

    def question(self, now: float) -> Cells | None:
        """Next question; None = none."""
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
        """Take the answer to the last question.

        Raises:
            DecodeError: when it is none; ask again.
        """
        events: list[MapEvent] = []
        sweep = self._sweep
        if sweep is None:
            return []
        part = part_of_answer(arrays, is_raw=sweep.is_raw)
        stamp, drops, number = (int(one) for one in arrays["state"])
        if epoch != self.epoch:
            if not sweep.is_first:
                self._begin()
                return []
            self._begin()
            self.epoch, self.voxel_size = epoch, float(arrays["voxel_size"])
            self._number, self._until, self._sweep = number, (stamp, drops), sweep
            self._refines = not part.is_refined
            events.append(Cleared(self.name, self.voxel_size))
        if sweep.since is not None and drops != sweep.drops:  # blocks have gone: no stamp says which
            self._sweep = _Sweep(sweep.is_raw)
            return events
        if sweep.began is None:
            sweep.began = stamp, drops
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
        """Take a mesh update.

        Raises:
            DecodeError: when it is none; it is missed then.
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
        """Take the map's health, which a server of this epoch sent."""
        self._is_idle = health.state == "idle"
        before, self._server = self._server, (server, health.fuser_restarts)
        if before not in (None, self._server) and self.epoch:
            self._miss()  # the answer shows whether it is another process
        if health.mesh_epoch != self.epoch or health.mesh_number <= self._number:
            self._behind = None
        elif self._behind is None or self._behind[0] <= self._number:
            self._behind = health.mesh_number, now
        elif now - self._behind[1] > _LOST_S:
            self._number, self._behind = self._behind[0], None
            self._miss()

    def _miss(self) -> None:
        """Note that something after what came is missing."""
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
