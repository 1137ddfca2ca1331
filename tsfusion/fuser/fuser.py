# SPDX-License-Identifier: MIT
"""The fuser: reads keyframes from the journal at the positions the gateway sends, and adds them to the map.

Its process ends when the gateway does, at whatever moment: the last checkpoint and the journal are enough to
begin again. While it opens the map or waits, it sees its standard input close and clears up; while it works,
the system ends it (Linux), however long the work would take.
"""

import errno
import logging
import os
import platform
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from tsfusion import journal
from tsfusion.core import process
from tsfusion.core.errors import JournalError, TsfusionError
from tsfusion.fuser import messages as fuser_messages
from tsfusion.fuser.current_keyframe import CurrentKeyframe
from tsfusion.fuser.map_checkpoints import MapCheckpoints
from tsfusion.geometry.keyframe import Keyframe
from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.sample_ranges import NO_SAMPLES
from tsfusion.journal import state_folder
from tsfusion.wire import codec, sockets
from tsfusion.wire.health import MeshLayout
from tsfusion.wire.record_header import Refused

if TYPE_CHECKING:
    from tsfusion.tsdf.volume import IntegrateStats

_WORKING_MEMORY = 768 << 20  # bytes for keyframes and meshes, beyond those of the map
_FOR_KEYFRAMES = 256 << 20  # bytes of it that meshes leave free
_FOR_A_CHECKPOINT = 64 << 20  # bytes beyond both
LOCK = "fuser.lock"  # in the map's folder
_PATIENCE_S = 10.0  # for a record that the system refuses to read, or whose segment is not there
RETRY_MS = 500  # until it is tried again
_CARVING = 10  # times `quota_cost` where rays also vote for the free space before them
_MORE_MS = 50  # milliseconds within which the next record comes, if the gateway said that one waits
_REFINED_AT_ONCE = 256  # blocks: about 50 ms
_REST_FACTOR = 3  # no mesh for three times as long as the last took: a quarter of a busy fuser's time

log = logging.getLogger(__name__)


class Fuser:
    """One map, and the work for each message of the gateway."""

    def __init__(self, link: sockets.AnySocket, begin: fuser_messages.Begin) -> None:
        from tsfusion.kernels import runtime

        self._link = link
        self._begin = begin
        self._folder = Path(begin.folder)
        self._since_checkpoint = 0
        self._watched = False
        self._orders: deque[fuser_messages.Fuse] = deque()  # not answered; the first cannot be read for now
        self._held_since: float | None = None  # time.monotonic(); None = nothing is held
        self._answered = self._meshed = 0  # keyframes of this process
        self._more_waits = False  # at the gateway
        self._next_mesh = 0.0
        self._unrefined = np.zeros((0, 3), np.int32)  # cells that viewers have with the raw surface
        self._hashes: tuple[int, str, str] | None = None  # keyframes answered, map hash, colour hash
        self._current = CurrentKeyframe(begin.working)
        runtime.start(begin.volume.threads)  # it reserves a GB, and more for each thread, and hardly uses it
        self._memory_limit = process.data_bytes() + _WORKING_MEMORY + begin.memory_bytes
        process.limit_memory(self._memory_limit)
        self.exit_status: int | None = None  # of the process, which has to end; None = it goes on
        self._home, self._journal_home = os.stat(self._folder), None
        with suppress(OSError):
            self._journal_home = os.stat(self._folder / state_folder.JOURNAL_FOLDER)
        # A map of any size opens, as long as there is memory; from then on it may not outgrow its own.
        self._map = MapCheckpoints(self._folder, begin.volume, keep_previous=begin.keep_previous)
        self._volume = self._map.volume
        self._volume.warm_up()
        self._volume.limit_memory(begin.memory_bytes)

    def ready(self) -> fuser_messages.Ready:
        """The message that the map is open, and how far it is."""
        stats = self._volume.stats()
        return fuser_messages.Ready(
            self._map.done, self._volume.keyframes, self._map.rejected, stats.blocks, stats.bytes
        )

    def handle(self, message: fuser_messages.ToFuser) -> None:
        """Do the work for a message of the gateway."""
        if isinstance(message, fuser_messages.Fuse):
            self._orders.append(message)
            self.go_on()
        elif isinstance(message, fuser_messages.FuserQuery):
            self._answer(message)
        elif isinstance(message, fuser_messages.Publish):
            self._watched = message.wanted
            if not self._watched:
                self._unrefined = self._unrefined[:0]
        elif isinstance(message, fuser_messages.Save):
            self._checkpoint()
        elif isinstance(message, fuser_messages.Finish):
            self.exit_status = 0 if self._checkpoint() else 1

    @property
    def is_held(self) -> bool:
        """Whether records wait for one that cannot be read for now: call `go_on` every `RETRY_MS`."""
        return bool(self._orders)

    def go_on(self) -> None:
        """Take the records that were ordered, in order, up to one that cannot be read now."""
        while self._orders and self.exit_status is None and self._fuse(self._orders[0]):
            self._orders.popleft()
            self._held_since = None

    @property
    def idle_after_ms(self) -> int:
        """Milliseconds without a message after which nothing is to be done but to mesh."""
        return _MORE_MS if self._more_waits else 0

    def mesh_due(self, idle: bool) -> bool:
        """Whether the mesh is behind and it is time for it: at once when idle, otherwise after a pause."""
        behind = self._answered > self._meshed
        return behind and (idle or time.monotonic() >= self._next_mesh)

    def mesh(self) -> None:
        """Bring the mesh up to date with the raw surface: it is fast, and the next keyframe may be near.

        Without enough memory, viewers miss a part; a mesh on request is whole, once there is enough.
        """
        try:
            with self._memory_beyond(-_FOR_KEYFRAMES):
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
        pause = max(self._begin.mesh_interval, _REST_FACTOR * (time.monotonic() - started))
        self._next_mesh = time.monotonic() + pause
        meshed_ns = time.monotonic_ns()
        if self._watched:
            self._publish(meshed_ns, len(blocks), cells, mesh)
            if self._volume.model.surface != "raw":
                unrefined = np.concatenate([self._unrefined, self._volume.cells_to_mesh(blocks)])
                self._unrefined = np.unique(unrefined, axis=0)
        else:
            self._send(self._meshed_message(meshed_ns))

    @property
    def refine_due(self) -> bool:
        """Whether viewers have cells that do not yet show the surface that the settings ask for."""
        return len(self._unrefined) > 0

    def refine(self) -> None:
        """Mesh some cells again, with the surface that the settings ask for.

        Call it only while there is nothing else to do: a keyframe that comes meanwhile waits.
        """
        cells, self._unrefined = self._unrefined[:_REFINED_AT_ONCE], self._unrefined[_REFINED_AT_ONCE:]
        with suppress(MemoryError), self._memory_beyond(-_FOR_KEYFRAMES):  # the raw surface stays
            self._publish(time.monotonic_ns(), 0, cells, self._volume.extract_mesh(blocks=cells))

    def _publish(self, meshed_ns: int, blocks: int, cells: NDArray[np.int32], mesh: Mesh) -> None:
        layout, frames = _mesh_frames(mesh)
        frames.insert(0, np.ascontiguousarray(cells).data)
        self._send(self._meshed_message(meshed_ns, blocks, layout), frames)

    def _meshed_message(
        self, meshed_ns: int, blocks: int = 0, layout: MeshLayout | None = None
    ) -> fuser_messages.Meshed:
        stats = self._volume.stats()
        return fuser_messages.Meshed(self._meshed, meshed_ns, blocks, stats.blocks, stats.bytes, layout)

    def _fuse(self, order: fuser_messages.Fuse) -> bool:
        """Take a record into the map, or reject it; False when it cannot be read for now."""
        start = time.monotonic_ns()
        self._more_waits = order.more
        before = self._map.done.get(order.session)
        if before is not None and order.seq <= before.seq:
            self._answered += 1
            self._send(fuser_messages.Done(order.index, start, start))
            return True
        reason, message = order.skip, ""
        if reason is None:
            self._current.set(order.index)
            try:
                record = journal.read(self._folder / state_folder.JOURNAL_FOLDER, order.position)
                found = codec.decode(record.frames)
                if isinstance(found, Keyframe):  # a correction does not change the map (yet)
                    stats = self._integrate(found, order.client)
                    if not stats.samples:
                        reason, message = NO_SAMPLES, self._volume.why_no_samples(found)
            except TsfusionError as error:
                if isinstance(error, JournalError) and self._hold(error):
                    return False
                reason, message = _reason(error), str(error)
            except MemoryError as error:
                reason, message = "memory", f"no memory to fuse it: {error}; raise fuser_memory_bytes"
            self._current.set(fuser_messages.NOT_WORKING)  # not reached if the keyframe ended the process
        if reason is not None and not order.is_correction:
            self._map.rejected[reason] = self._map.rejected.get(reason, 0) + 1
        self._answered += 1
        self._map.done[order.session] = fuser_messages.SessionProgress(order.seq, order.client, order.world)
        self._send(fuser_messages.Done(order.index, start, time.monotonic_ns(), reason, message))
        self._since_checkpoint += 1
        if self._begin.checkpoint_every and self._since_checkpoint >= self._begin.checkpoint_every:
            self._checkpoint()
        return True

    def _hold(self, error: JournalError) -> bool:
        """Whether to wait with a record that cannot be read: its folder, its file or the disk may come back.

        When the system refuses to read it for long, another process tries again, and the gateway gives the
        record up after a few of them. One whose segment alone is missing for long is rejected.
        """
        now = time.monotonic()
        if not error.temporary:
            return False
        if self._held_since is None:
            log.warning("%s; it is tried again", error)
            self._held_since = now
        is_over = now - self._held_since >= _PATIENCE_S
        is_away = journal.is_away(self._folder / state_folder.JOURNAL_FOLDER, self._journal_home)
        if is_over and not is_away and error.errno == errno.ENOENT:
            return False
        if is_over and not is_away:
            log.error("%s: another process tries again, from the checkpoint", error)
            self.exit_status = 1  # marked as at work on it
            return True
        self._current.set(fuser_messages.NOT_WORKING)
        self._send(fuser_messages.Held(str(error)))
        return True

    @contextmanager
    def _memory_beyond(self, nbytes: int) -> Iterator[None]:
        """The memory limit moved by so many bytes for the block."""
        process.limit_memory(self._memory_limit + nbytes)
        try:
            yield
        finally:
            process.limit_memory(self._memory_limit)

    def _integrate(self, keyframe: Keyframe, client: str) -> "IntegrateStats":
        """Add a client's keyframe to the map, within its quota. Without keys all clients are one."""
        from tsfusion.tsdf.integrator import KeyframeQuota

        taken = self._map.blocks
        cost = self._begin.quota_cost * (_CARVING if self._volume.config.space_carving else 1)
        self._volume.quota = KeyframeQuota(cost)
        if client:
            share = int(self._begin.quota_map * self._volume.most_blocks)
            self._volume.quota = KeyframeQuota(cost, share - taken.get(client, 0))
        stats = self._volume.integrate(keyframe)
        if client and stats.new_blocks:
            taken[client] = taken.get(client, 0) + stats.new_blocks
        return stats

    def _checkpoint(self) -> bool:
        written, problem = False, ""
        if self._since_checkpoint and not self._is_home:
            problem = f"the folder {self._folder} is not there, or is another one"
            log.error("no checkpoint: %s", problem)
        elif self._since_checkpoint:
            with self._memory_beyond(_FOR_A_CHECKPOINT):
                written = self._map.save()
            self._since_checkpoint = 0 if written else 1
            problem = self._map.problem
        self._send(fuser_messages.Saved(written, problem))
        return not self._since_checkpoint

    @property
    def _is_home(self) -> bool:
        """Whether the folder is the one that was opened: another may be the place of a disk that is away."""
        try:
            return os.path.samestat(os.stat(self._folder), self._home) or (self._folder / LOCK).exists()
        except OSError:
            return False

    def _answer(self, query: fuser_messages.FuserQuery) -> None:
        try:
            if query.command.name == "mesh":
                with self._memory_beyond(-_FOR_KEYFRAMES):
                    mesh = self._volume.extract_mesh(query.command.min_weight)
                layout, frames = _mesh_frames(mesh)
                self._send(fuser_messages.FuserReply(query.number, layout=layout), frames)
            else:
                self._send(fuser_messages.FuserReply(query.number, status=self._status()))
        except MemoryError as error:
            why = f"not enough memory for that: {error}; raise fuser_memory_bytes"
            self._send(fuser_messages.FuserReply(query.number, error=why))
        except (TsfusionError, ArithmeticError, ValueError) as error:
            # The process goes on whatever was asked: a crash would be blamed on the next keyframe.
            self._send(fuser_messages.FuserReply(query.number, error=str(error) or type(error).__name__))

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


def _mesh_frames(mesh: Mesh) -> tuple[MeshLayout, list[Any]]:
    arrays: list[NDArray[Any]] = [mesh.vertices, mesh.faces, mesh.normals]
    if mesh.colors is not None:
        arrays.append(mesh.colors)
    counts = {"vertices": len(mesh.vertices), "faces": len(mesh.faces)}
    layout = MeshLayout(**counts, colors=mesh.colors is not None, up=mesh.up)
    return layout, [np.ascontiguousarray(array).data for array in arrays]


def _reason(error: TsfusionError) -> str:
    """The word under which a rejected keyframe is counted."""
    return error.reason if isinstance(error, Refused) else type(error).__name__
