# SPDX-License-Identifier: MIT
"""The fuser: the one process with Taichi. Reads the journal where the gateway points, and adds to the map.

It ends when the gateway does, at whatever moment: the last checkpoint and the journal are enough to begin
again. Opening the map or waiting, it sees its standard input close and clears up; at work, the system ends it
(Linux), however long it would take.
"""

import logging
import mmap
import platform
import struct
import time
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from tsfusion import journal
from tsfusion.core import process
from tsfusion.core.errors import TsfusionError
from tsfusion.fuser import messages as fuser_messages
from tsfusion.fuser.map_checkpoints import MapCheckpoints
from tsfusion.geometry.keyframe import Keyframe
from tsfusion.geometry.mesh import Mesh
from tsfusion.journal import state_folder
from tsfusion.wire import codec, sockets
from tsfusion.wire.health import MeshLayout
from tsfusion.wire.record_header import Refused

_SET_ASIDE = 2 << 30  # bytes that Taichi asks for and hardly uses
_KEPT_FREE = 256 << 20  # bytes that keyframes leave to meshes and checkpoints
_REFINED_AT_ONCE = 256  # blocks: about 50 ms
_FUSING_SHARE = 3  # a busy fuser meshes for at most a quarter of its time

log = logging.getLogger(__name__)


class Fuser:
    """The map of one state folder, and what to do with each message of the gateway."""

    def __init__(self, link: sockets.AnySocket, begin: fuser_messages.Begin) -> None:
        self._link = link
        self._begin = begin
        self._folder = Path(begin.folder)
        self._since_checkpoint = 0
        self._watched = False
        self._answered = self._meshed = 0  # keyframes, by this process
        self._next_mesh = 0.0
        self._rough = np.zeros((0, 3), np.int32)  # cells that viewers have as fused only
        self._hashes: tuple[int, str, str] | None = None
        self._working = CurrentKeyframe(begin.working)
        self._most = process.data_bytes() + _SET_ASIDE + begin.memory_bytes
        process.limit_memory(self._most)
        self.exit_status: int | None = None
        self._map = MapCheckpoints(self._folder, begin.volume, keep_previous=begin.keep_previous)
        self._volume = self._map.volume
        self._volume.warm_up()

    def ready(self) -> fuser_messages.Ready:
        """How far the map is."""
        stats = self._volume.stats()
        return fuser_messages.Ready(
            self._map.done, self._volume.keyframes, self._map.rejected, stats.blocks, stats.bytes
        )

    def take(self, message: fuser_messages.ToFuser) -> None:
        """Do what the gateway says."""
        if isinstance(message, fuser_messages.Fuse):
            self._fuse(message)
        elif isinstance(message, fuser_messages.FuserQuery):
            self._answer(message)
        elif isinstance(message, fuser_messages.Publish):
            self._watched = message.wanted
            if not self._watched:
                self._rough = self._rough[:0]
        elif isinstance(message, fuser_messages.Save):
            self._checkpoint()
        elif isinstance(message, fuser_messages.Finish):
            self.exit_status = 0 if self._checkpoint() else 1

    def mesh_due(self, idle: bool) -> bool:
        """Whether the mesh is behind and it is time: at once when idle, else so that fusing comes first."""
        behind = self._answered > self._meshed
        return behind and (idle or time.monotonic() >= self._next_mesh)

    def mesh(self) -> None:
        """Bring the mesh up to date with the map: as fused, because the next keyframe may be near.

        Without the memory for it, viewers miss a part; a mesh on request is whole, once there is.
        """
        try:
            self._mesh()
        except MemoryError as error:
            log.error("no memory to mesh the changed part of the map: %s", error)
            self._meshed = self._answered
            self._send(self._meshed_message(time.monotonic_ns()))

    def _mesh(self) -> None:
        from tsfusion.tsdf.block_store import cells_of

        started = time.monotonic()
        blocks = self._volume.take_dirty()
        cells = cells_of(blocks)
        mesh = self._volume.extract_mesh(blocks=cells, surface="raw")
        self._meshed = self._answered
        pause = max(self._begin.mesh_interval, _FUSING_SHARE * (time.monotonic() - started))
        self._next_mesh = time.monotonic() + pause
        stamp = time.monotonic_ns()
        if self._watched:
            self._publish(stamp, len(blocks), cells, mesh)
            if self._volume.model.surface != "raw":
                rough = np.concatenate([self._rough, self._volume.cells_to_mesh(blocks)])
                self._rough = np.unique(rough, axis=0)
        else:
            self._send(self._meshed_message(stamp))

    @property
    def refine_due(self) -> bool:
        """Whether what viewers have is not yet the surface that the settings ask for."""
        return len(self._rough) > 0

    def refine(self) -> None:
        """Mesh a part of what was meshed as fused again, as the settings ask: only while there is nothing
        else to do, and little at a time, because a keyframe that comes meanwhile waits."""
        cells, self._rough = self._rough[:_REFINED_AT_ONCE], self._rough[_REFINED_AT_ONCE:]
        with suppress(MemoryError):  # it stays as fused
            self._publish(time.monotonic_ns(), 0, cells, self._volume.extract_mesh(blocks=cells))

    def _publish(self, stamp: int, blocks: int, cells: NDArray[np.int32], mesh: Mesh) -> None:
        layout, frames = _mesh_frames(mesh)
        tiles = np.ascontiguousarray(cells).data
        self._send(self._meshed_message(stamp, blocks, layout), [tiles, *frames])

    def _meshed_message(
        self, stamp: int, blocks: int = 0, layout: MeshLayout | None = None
    ) -> fuser_messages.Meshed:
        stats = self._volume.stats()
        return fuser_messages.Meshed(self._meshed, stamp, blocks, stats.blocks, stats.bytes, layout)

    def _fuse(self, order: fuser_messages.Fuse) -> None:
        start = time.monotonic_ns()
        self._answered += 1
        before = self._map.done.get(order.session)
        if before is not None and order.seq <= before.seq:
            self._send(fuser_messages.Done(order.index, start, start))
            return
        reason, message = order.skip, ""
        if reason is None:
            self._working.at(order.index)
            process.limit_memory(self._most - min(_KEPT_FREE, self._begin.memory_bytes // 2))
            try:
                record = journal.read(self._folder / state_folder.JOURNAL_FOLDER, order.position)
                found = codec.decode(record.frames)
                if isinstance(found, Keyframe):  # a correction does not change the map (yet)
                    self._volume.integrate(found)
            except TsfusionError as error:
                if _may_pass(error):
                    log.error("%s: another process tries again, from the checkpoint", error)
                    self.exit_status = 1
                    return  # still marked as at work on it: the gateway bears with a keyframe only so often
                reason, message = _reason(error), str(error)
            except MemoryError as error:
                reason, message = "memory", f"no memory to fuse it: {error}"
            process.limit_memory(self._most)
            self._working.at(fuser_messages.NOT_WORKING)  # not if it ended the process, however it did
        if reason is not None and not order.is_correction:
            self._map.rejected[reason] = self._map.rejected.get(reason, 0) + 1
        self._map.done[order.session] = fuser_messages.SessionProgress(order.seq, order.client)
        self._send(fuser_messages.Done(order.index, start, time.monotonic_ns(), reason, message))
        self._since_checkpoint += 1
        if self._begin.checkpoint_every and self._since_checkpoint >= self._begin.checkpoint_every:
            self._checkpoint()

    def _checkpoint(self) -> bool:
        written = False
        if self._since_checkpoint:
            written = self._map.save()
            self._since_checkpoint = 0 if written else 1
        self._send(fuser_messages.Saved(written))
        return not self._since_checkpoint

    def _answer(self, ask: fuser_messages.FuserQuery) -> None:
        try:
            if ask.command.name == "mesh":
                layout, frames = _mesh_frames(self._volume.extract_mesh(ask.command.min_weight))
                self._send(fuser_messages.FuserReply(ask.number, layout=layout), frames)
            else:
                self._send(fuser_messages.FuserReply(ask.number, status=self._status()))
        except (TsfusionError, ArithmeticError, ValueError, MemoryError) as error:
            # whatever was asked, the map goes on: a crash would be blamed on the next keyframe
            self._send(fuser_messages.FuserReply(ask.number, error=str(error) or type(error).__name__))

    def _status(self) -> fuser_messages.FuserStatus:
        stats = self._volume.stats()
        if self._hashes is None or self._hashes[0] != self._answered:
            self._hashes = (self._answered, self._volume.map_hash(), self._volume.color_hash())
        return fuser_messages.FuserStatus(
            keyframes_fused=self._volume.keyframes,
            keyframes_rejected=self._map.rejected,
            blocks=stats.blocks,
            voxels=stats.voxels,
            map_bytes=stats.bytes,
            map_hash=self._hashes[1],
            color_hash=self._hashes[2],
            peak_rss_bytes=process.peak_rss_bytes(),
            versions={
                "python": platform.python_version(),
                **{name: version(name) for name in ("tsfusion", "taichi", "numpy", "pyzmq")},
            },
            config=msgspec.to_builtins(self._volume.config),
        )

    def _send(self, message: Any, frames: list[Any] | None = None) -> None:
        self._link.send_multipart([fuser_messages.encode(message), *(frames or [])], copy=False)


class CurrentKeyframe:
    """A word of memory that outlives the process: which keyframe it is at."""

    def __init__(self, path: str) -> None:
        with Path(path).open("r+b") as file:
            self._word = mmap.mmap(file.fileno(), 8)

    def at(self, index: int) -> None:
        """It is this one; `work.NOT_WORKING` = none."""
        struct.pack_into("<q", self._word, 0, index)


def _mesh_frames(mesh: Mesh) -> tuple[MeshLayout, list[Any]]:
    arrays: list[NDArray[Any]] = [mesh.vertices, mesh.faces, mesh.normals]
    if mesh.colors is not None:
        arrays.append(mesh.colors)
    layout = MeshLayout(vertices=len(mesh.vertices), faces=len(mesh.faces), colors=mesh.colors is not None)
    return layout, [np.ascontiguousarray(array).data for array in arrays]


def _may_pass(error: TsfusionError) -> bool:
    """Whether the system refused to read what is there: no fault of the keyframe's."""
    cause = error.__cause__
    return isinstance(cause, OSError) and not isinstance(cause, FileNotFoundError)


def _reason(error: TsfusionError) -> str:
    return error.reason if isinstance(error, Refused) else type(error).__name__
