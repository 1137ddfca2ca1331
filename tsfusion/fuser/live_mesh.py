# SPDX-License-Identifier: MIT
"""Mesh the changed cells of a map for viewers: raw at once, and refined while the fuser is idle."""

import logging
import time
from array import array
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry.mesh import Mesh
from tsfusion.wire.messages.health import MeshLayout
from tsfusion.wire.messages.mesh_updates import Meshed, MeshUpdate

if TYPE_CHECKING:
    from tsfusion.tsdf.surface.mesh_extraction import CellMeshes
    from tsfusion.tsdf.volume import Volume

_REFINED_AT_ONCE = 512  # blocks: some 20 ms
_REFINED_BETWEEN = 128  # blocks, while the next keyframe may be near
_QUIET_S = 1.0  # seconds without a record, after which no record is expected soon
_REFINE_REST_FACTOR = 40.0  # else pause for this many times the work's duration: few keyframes wait
_REST_FACTOR = 3  # no mesh for three times as long as the last took: a quarter of a busy fuser's time

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
    """The mesh of a map for its viewers.

    Args:
        sparing: context that limits the memory for a mesh, so that memory is left for the next keyframe.
    """

    def __init__(
        self,
        volume: "Volume",
        *,
        interval: float,
        sparing: Callable[[], AbstractContextManager[None]],
        send: Callable[..., None],
        touched_by: TouchedBy,
        epoch: str,
        on_taken: Callable[[NDArray[np.int32]], None] = lambda _blocks: None,
    ) -> None:
        self._volume, self._interval, self._sparing, self._send = volume, interval, sparing, send
        self._touched_by, self._epoch, self._on_taken = touched_by, epoch, on_taken
        self.number = 0  # number of the newest update
        self._sent_until = volume.version, volume.drops
        self._watched = False
        self._answered = self._meshed = 0  # records that this process answered, and those that the mesh shows
        self._is_behind = False
        self._next = self._next_refined = 0.0  # time.monotonic()
        self._quiet_from = time.monotonic() + _QUIET_S
        self._unrefined = np.zeros((0, 3), np.int32)  # cells of which viewers have the raw surface
        self._refined = volume.surface.kept_values()

    def watch(self, wanted: bool) -> None:
        """Switch the sending of triangles on or off."""
        self._watched = wanted
        if not wanted:
            self._refined.clear()
        if not wanted and self.refine_waits:
            self._unrefined = self._unrefined[:0]
            self.number += 1  # the gap in the numbers tells a returning viewer that it missed an update

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
        """Update the mesh with the raw surface, which is fast because the next keyframe may be near.

        Without viewers, nothing is meshed: a mesh on request uses the map's state at that time. Without
        enough memory, viewers miss this update, but a later mesh on request is complete.
        """
        try:
            with self._sparing():
                self._update()
        except MemoryError as error:
            log.error("no memory to mesh the changed part of the map: %s", error)
            self._note_meshed()
            self._send(self._message(time.monotonic_ns()))  # viewers notice the missing update

    def _note_meshed(self) -> None:
        self._meshed, self._is_behind = self._answered, False
        self._sent_until = self._volume.version, self._volume.drops

    def _update(self) -> None:
        started = time.monotonic()
        blocks = self._volume.take_dirty()
        self._on_taken(blocks)
        if not self._watched:  # a new viewer first gets the whole mesh
            self._note_meshed()
            self._next = started + self._interval
            self._send(self._message(time.monotonic_ns()))
            return
        from tsfusion.tsdf.store.block_store import cells_of, distinct_blocks, unpack_keys

        found = self._volume.surface.mesh_cells(cells_of(blocks), "raw")
        self._note_meshed()
        pause = max(self._interval, _REST_FACTOR * (time.monotonic() - started))
        self._next = time.monotonic() + pause
        meshed_ns = time.monotonic_ns()
        if self._volume.model.surface != "raw":
            reached = self._volume.surface.values_reached(blocks)
            unrefined = np.concatenate([self._unrefined, cells_of(unpack_keys(reached))])
            self._unrefined = distinct_blocks(unrefined)
            self._refined.forget(reached)
        self._publish(meshed_ns, len(blocks), found, refined=self._volume.model.surface == "raw")

    @property
    def refine_waits(self) -> bool:
        """True if viewers have cells that do not yet show the configured surface."""
        return len(self._unrefined) > 0

    @property
    def quiet_wait(self) -> float:
        """Seconds until no record is expected soon."""
        return max(self._quiet_from - time.monotonic(), 0.0)

    def refine_wait(self) -> float | None:
        """Return the seconds until `refine`, which makes a new keyframe wait; None = never."""
        if not self.refine_waits:
            return None
        return max(min(self._quiet_from, self._next_refined) - time.monotonic(), 0.0)

    def refine(self) -> None:
        """Mesh some cells again, with the configured surface.

        Call it only while the fuser is idle: a keyframe that arrives meanwhile waits.
        """
        began = time.monotonic()
        count = _REFINED_AT_ONCE if began >= self._quiet_from else _REFINED_BETWEEN
        cells, self._unrefined = self._unrefined[:count], self._unrefined[count:]
        try:
            with self._sparing():
                found = self._volume.surface.mesh_cells(cells, values=self._refined)
                self._publish(time.monotonic_ns(), 0, found, refined=True)
        except MemoryError:  # the raw surface stays
            self.number += 1
        now = time.monotonic()
        self._next_refined = now + _REFINE_REST_FACTOR * (now - began)

    def _publish(self, meshed_ns: int, blocks: int, found: "CellMeshes", *, refined: bool) -> None:
        _, touched = self._volume.surface.cell_versions(found.cells)
        sessions, client = self._touched_by.of(touched)
        layout, frames = mesh_frames(found.mesh)
        frames.insert(0, np.ascontiguousarray(found.cells).data)
        message = self._message(
            meshed_ns,
            blocks,
            layout,
            refined=refined,
            settled=not self.refine_waits,
            first_face=found.first_face.tobytes(),
            client=client.tobytes(),
            sessions=sessions,
        )
        self._send(message, frames)

    def _message(
        self, meshed_ns: int, blocks: int = 0, layout: MeshLayout | None = None, **fields: Any
    ) -> Meshed:
        self.number += 1
        stats, (sent_until, drops) = self._volume.stats(), self._sent_until
        update = MeshUpdate(
            epoch=self._epoch,
            number=self.number,
            version=self._volume.version,
            sent_until=sent_until,
            drops=drops,
            **fields,
        )
        return Meshed(self._meshed, meshed_ns, blocks, stats.blocks, stats.bytes, layout, update)


def mesh_frames(mesh: Mesh) -> tuple[MeshLayout, list[Any]]:
    """Return a mesh's layout, and its arrays as frames of a message."""
    arrays: list[NDArray[Any]] = [mesh.vertices, mesh.faces, mesh.normals]
    if mesh.colors is not None:
        arrays.append(mesh.colors)
    counts = {"vertices": len(mesh.vertices), "faces": len(mesh.faces)}
    layout = MeshLayout(**counts, colors=mesh.colors is not None, up=mesh.up)
    return layout, [np.ascontiguousarray(array).data for array in arrays]
