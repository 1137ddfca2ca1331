# SPDX-License-Identifier: MIT
"""The mesh that follows the map: its changed part raw at once, and refined when nothing else is to do."""

import logging
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from tsfusion.fuser import messages as fuser_messages
from tsfusion.geometry.mesh import Mesh
from tsfusion.wire.health import MeshLayout

if TYPE_CHECKING:
    from tsfusion.tsdf.volume import Volume

_REFINED_AT_ONCE = 256  # blocks: about 50 ms
_REST_FACTOR = 3  # no mesh for three times as long as the last took: a quarter of a busy fuser's time

log = logging.getLogger(__name__)


class LiveMesh:
    """The mesh of a map for its viewers.

    Args:
        interval: seconds between two meshes, at least.
        sparing: limits the memory while a mesh is made, so that the next keyframe finds some.
        send: takes a message and its frames.
        on_taken: told of the changed blocks that were taken.
    """

    def __init__(
        self,
        volume: "Volume",
        *,
        interval: float,
        sparing: Callable[[], AbstractContextManager[None]],
        send: Callable[..., None],
        on_taken: Callable[[NDArray[np.int32]], None] = lambda _blocks: None,
    ) -> None:
        self._volume, self._interval, self._sparing, self._send = volume, interval, sparing, send
        self._on_taken = on_taken
        self._watched = False
        self._answered = self._meshed = 0  # records of this process
        self._is_behind = False
        self._next = 0.0  # time.monotonic()
        self._unrefined = np.zeros((0, 3), np.int32)  # cells that viewers have with the raw surface

    def watch(self, wanted: bool) -> None:
        """Send the triangles, too, or no more."""
        self._watched = wanted
        if not wanted:
            self._unrefined = self._unrefined[:0]

    def note_answer(self) -> None:
        """Note that one more record was answered."""
        self._answered += 1
        self._is_behind = True

    def note_move(self) -> None:
        """Note that a keyframe was moved."""
        self._is_behind = True

    def is_due(self, *, idle: bool) -> bool:
        """Whether the mesh is behind and it is time for it: at once when idle, otherwise after a pause."""
        return self._is_behind and (idle or time.monotonic() >= self._next)

    def update(self) -> None:
        """Bring the mesh up to date with the raw surface: it is fast, and the next keyframe may be near.

        Without enough memory, viewers miss a part; a mesh on request is whole, once there is enough.
        """
        try:
            with self._sparing():
                self._update()
        except MemoryError as error:
            log.error("no memory to mesh the changed part of the map: %s", error)
            self._note_meshed()
            self._send(self._message(time.monotonic_ns()))

    def _note_meshed(self) -> None:
        self._meshed, self._is_behind = self._answered, False

    def _update(self) -> None:
        from tsfusion.tsdf.block_store import cells_of

        started = time.monotonic()
        blocks = self._volume.take_dirty()
        self._on_taken(blocks)
        cells = cells_of(blocks)
        mesh = self._volume.extract_mesh(blocks=cells, surface="raw")
        self._note_meshed()
        pause = max(self._interval, _REST_FACTOR * (time.monotonic() - started))
        self._next = time.monotonic() + pause
        meshed_ns = time.monotonic_ns()
        if self._watched:
            self._publish(meshed_ns, len(blocks), cells, mesh)
            if self._volume.model.surface != "raw":
                unrefined = np.concatenate([self._unrefined, self._volume.cells_to_mesh(blocks)])
                self._unrefined = np.unique(unrefined, axis=0)
        else:
            self._send(self._message(meshed_ns))

    @property
    def refine_due(self) -> bool:
        """Whether viewers have cells that do not yet show the surface that the settings ask for."""
        return len(self._unrefined) > 0

    def refine(self) -> None:
        """Mesh some cells again, with the surface that the settings ask for.

        Call it only while there is nothing else to do: a keyframe that comes meanwhile waits.
        """
        cells, self._unrefined = self._unrefined[:_REFINED_AT_ONCE], self._unrefined[_REFINED_AT_ONCE:]
        with suppress(MemoryError), self._sparing():  # the raw surface stays
            self._publish(time.monotonic_ns(), 0, cells, self._volume.extract_mesh(blocks=cells))

    def _publish(self, meshed_ns: int, blocks: int, cells: NDArray[np.int32], mesh: Mesh) -> None:
        layout, frames = mesh_frames(mesh)
        frames.insert(0, np.ascontiguousarray(cells).data)
        self._send(self._message(meshed_ns, blocks, layout), frames)

    def _message(
        self, meshed_ns: int, blocks: int = 0, layout: MeshLayout | None = None
    ) -> fuser_messages.Meshed:
        stats = self._volume.stats()
        return fuser_messages.Meshed(self._meshed, meshed_ns, blocks, stats.blocks, stats.bytes, layout)


def mesh_frames(mesh: Mesh) -> tuple[MeshLayout, list[Any]]:
    """A mesh for the way: its layout, and its arrays as frames."""
    arrays: list[NDArray[Any]] = [mesh.vertices, mesh.faces, mesh.normals]
    if mesh.colors is not None:
        arrays.append(mesh.colors)
    counts = {"vertices": len(mesh.vertices), "faces": len(mesh.faces)}
    layout = MeshLayout(**counts, colors=mesh.colors is not None, up=mesh.up)
    return layout, [np.ascontiguousarray(array).data for array in arrays]
