# SPDX-License-Identifier: MIT
"""Note the changed cells of a map for viewers at once, and refine them while the fuser is idle."""

import logging
import time
from array import array
from collections.abc import Callable
from contextlib import AbstractContextManager
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.fuser.fuser_messages import Meshed
from tsfusion.geometry.mesh import Mesh
from tsfusion.wire.messages.health import MeshLayout

if TYPE_CHECKING:
    from tsfusion.tsdf.surface.changed_cells import ChangedCells
    from tsfusion.tsdf.volume import Volume

_REFINED_AT_ONCE = 512  # blocks: some 20 ms
_REFINED_ALONE = 4096  # blocks, where no keyframe can come: two thirds of the time for each
_REFINED_BETWEEN = 128  # blocks, while the next keyframe may be near
_QUIET_S = 1.0  # seconds without a record, after which no record is expected soon
_REFINE_REST_FACTOR = 40.0  # else pause for this many times the work's duration: few keyframes wait

log = logging.getLogger(__name__)


class TouchedBy:
    """Sessions by the version of a keyframe (`Volume.version`)."""

    def __init__(self) -> None:
        self._sessions: dict[bytes, int] = {}
        self._firsts = array("q")  # versions at which the session changes
        self._numbers = array("q")  # number of the session from that version on

    def clear(self) -> None:
        """Forget all of them: another map took the place of the present one."""
        del self._firsts[:], self._numbers[:]

    def note(self, version: int, session: bytes) -> None:
        """Record the session of keyframes from this version on."""
        number = self._sessions.setdefault(session, len(self._sessions))
        if not self._numbers or self._numbers[-1] != number:
            self._firsts.append(version)
            self._numbers.append(number)

    def of(self, versions: NDArray[np.int32]) -> tuple[tuple[bytes, ...], NDArray[np.int32]]:
        """Return the sessions of (n,) versions, and for each version its index in them; −1 = unknown."""
        if not self._firsts:
            return (), np.full(len(versions), -1, np.int32)
        run = np.searchsorted(np.array(self._firsts), versions, side="right") - 1
        numbers = np.where(run >= 0, np.array(self._numbers)[run], -1)
        used, rows = np.unique(numbers, return_inverse=True)
        first = int(np.count_nonzero(used < 0))
        sessions = list(self._sessions)
        return tuple(sessions[one] for one in used[first:]), (rows - first).astype(np.int32)


class LiveMesh:
    """The mesh of a map for its viewers: changed cells are noted, and meshed when a viewer asks.

    Args:
        interval: least seconds between two notes while keyframes wait.
        expects: keyframes may come.
        sparing: context that limits the memory for a mesh, so that memory is left for the next keyframe.
    """

    def __init__(
        self,
        volume: "Volume",
        *,
        interval: float,
        expects: bool = True,
        sparing: Callable[[], AbstractContextManager[None]],
        send: Callable[[Meshed], Any],
    ) -> None:
        self._volume, self._interval, self.sparing = volume, interval, sparing
        self._send = send
        self._refined_at_once = _REFINED_AT_ONCE if expects else _REFINED_ALONE
        self.is_held = False  # a viewer holds all cells now, and waits for more
        self._answered = 0  # records that this process answered
        self._is_behind = False
        self._next = self._next_refined = 0.0  # time.monotonic()
        self._quiet_from = time.monotonic() + (_QUIET_S if expects else 0.0)

    @cached_property
    def changes(self) -> "ChangedCells":
        """Order in which the map's cells change, from the first question on: no viewer, no cost."""
        from tsfusion.tsdf.surface.changed_cells import ChangedCells

        return ChangedCells(self._volume.surface)

    def note_answer(self) -> None:
        """Count a record whose result the gateway got. The mesh is then older than the map."""
        self._answered += 1
        self._is_behind = True
        self._quiet_from = time.monotonic() + _QUIET_S

    def note_move(self) -> None:
        """Note that a keyframe moved. The mesh is then older than the map."""
        self._is_behind = True

    def wait(self, *, idle: bool) -> float | None:
        """Return the seconds until `update`: 0 when idle, otherwise the rest of a pause; None = never."""
        if not self._is_behind:
            return None
        return 0.0 if idle else max(self._next - time.monotonic(), 0.0)

    def update(self) -> None:
        """Note what has changed. Nothing is meshed: a viewer's question is answered with the newest state."""
        if "changes" in vars(self):
            self._note()
        self._is_behind = False
        self._next = time.monotonic() + self._interval
        self._send(Meshed(self._answered, time.monotonic_ns(), *self._volume.size))

    def _note(self) -> None:
        try:
            with self.sparing():
                self.changes.follow()
        except MemoryError as error:
            log.error("no memory to note what has changed: viewers get it later: %s", error)

    @property
    def quiet_wait(self) -> float:
        """Seconds until no record is expected soon."""
        return max(self._quiet_from - time.monotonic(), 0.0)

    def refine_wait(self) -> float | None:
        """Return the seconds until `refine`, which makes a new keyframe wait; None = never."""
        if not self.is_held or not self.changes.refine_waits():
            return None
        return max(min(self._quiet_from, self._next_refined) - time.monotonic(), 0.0)

    def refine(self) -> None:
        """Solve the configured surface of some cells, which viewers then get again.

        Call it only while the fuser is idle: a keyframe that arrives meanwhile waits.
        """
        began = time.monotonic()
        try:
            with self.sparing():
                is_quiet = began >= self._quiet_from
                self.changes.refine(self._refined_at_once if is_quiet else _REFINED_BETWEEN)
        except MemoryError as error:
            log.error("no memory to refine a part of the map, which stays raw for viewers: %s", error)
        now = time.monotonic()
        self._next_refined = now + _REFINE_REST_FACTOR * (now - began)


def mesh_frames(mesh: Mesh) -> tuple[MeshLayout, list[Any]]:
    """Return a mesh's layout, and its arrays as frames of a message."""
    arrays: list[NDArray[Any]] = [mesh.vertices, mesh.faces, mesh.normals]
    if mesh.colors is not None:
        arrays.append(mesh.colors)
    counts = {"vertices": len(mesh.vertices), "faces": len(mesh.faces)}
    layout = MeshLayout(**counts, colors=mesh.colors is not None, up=mesh.up)
    return layout, [np.ascontiguousarray(array).data for array in arrays]
