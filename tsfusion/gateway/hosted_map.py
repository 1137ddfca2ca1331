# SPDX-License-Identifier: MIT
"""One map of a server: its journal, its sessions, and the fuser that works through the journal."""

import logging
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import zmq
from numpy.typing import NDArray

from tsfusion.core import logs
from tsfusion.core.config import SERVER_SESSION, ServerConfig, VolumeConfig
from tsfusion.core.errors import JournalError
from tsfusion.fuser import messages as fuser_messages
from tsfusion.gateway import map_opening, moved_maps
from tsfusion.gateway.checkpoint_orders import CheckpointOrders
from tsfusion.gateway.client_routes import ClientRoutes
from tsfusion.gateway.disk_pause import DiskPause
from tsfusion.gateway.forgetting import Forgetting
from tsfusion.gateway.fuser_backlog import FuserBacklog
from tsfusion.gateway.fuser_supervisor import FuserSupervisor
from tsfusion.gateway.journal_retention import JournalRetention
from tsfusion.gateway.keyframe_index import KeyframeIndex
from tsfusion.gateway.keyframe_outcomes import KeyframeOutcomes
from tsfusion.gateway.map_condition import MapCondition, QuestionCounts
from tsfusion.gateway.metrics import Metrics
from tsfusion.gateway.sessions import Sessions
from tsfusion.gateway.spare_fusers import SpareFusers
from tsfusion.journal import Position, ReadingWatcher, Unwritten, state_folder
from tsfusion.journal.quarantine import Quarantine
from tsfusion.wire import corrections, keyframe_times
from tsfusion.wire.health import MapHealth
from tsfusion.wire.mesh_updates import Meshed
from tsfusion.wire.record_header import CorrectionHeader, RecordHeader, unpack

log = logging.getLogger(__name__)

ForPeople = tuple[Meshed | fuser_messages.FuserReply | fuser_messages.FuserAnswer, Sequence[zmq.Frame]]


class Checked(NamedTuple):
    """A message that was found to be the next record of its session."""

    header: RecordHeader
    frames: Sequence[Any]
    client: str  # name that its sender's key is allowed under
    received_ns: int


class HostedMap:
    """An open map. Call `step` again and again, and `accept` with the records that came.

    Args:
        watch: told how far the journal is read: that may take minutes, in which nothing else is done.
        fuser: that read the map ahead; None = one begins now.
        spares: processes that it may take.
        waits: for `fuser.begin`, until when nothing is fused.
    """

    def __init__(
        self,
        context: "zmq.Context[Any]",
        name: str,
        server: ServerConfig,
        volume: VolumeConfig,
        *,
        routes: ClientRoutes,
        metrics: Metrics,
        watch: ReadingWatcher = lambda _done, _all, _records: None,
        fuser: FuserSupervisor | None = None,
        spares: SpareFusers | None = None,
        waits: bool = False,
    ) -> None:
        self.name, self.volume = name, volume
        self.folder = state_folder.map_folder(server.state, name)
        self.sessions = Sessions()
        self.questions = QuestionCounts()
        self.is_leaving = self.is_frozen = False  # to another server; it takes no records any more
        self._metrics = metrics
        self._keeps_window = (server.keep_seconds, server.keep_keyframes, server.keep_radius) != (None,) * 3
        self._is_new = not state_folder.holds_a_map(self.folder)
        self._journal = map_opening.open_journal(self.folder, server, watch)
        self.disk = DiskPause(self._journal, name)
        self._quarantine = Quarantine(self.folder / state_folder.QUARANTINE_FOLDER, server.quarantine_bytes)
        self._index = KeyframeIndex()
        self._index.recover(self._journal.found, self.sessions)
        self._journal.found = []
        arrived = moved_maps.arrival_of(self.folder)
        self._has_arrived = arrived is not None
        for known in () if arrived is None else arrived.sessions:
            session = self.sessions.open(known.key, known.client, known.world)
            session.durable = max(session.durable, known.durable)
        self._backlog = FuserBacklog(self._index, self.sessions)
        self._corrections = self._backlog.corrections  # in the journal
        self.outcomes = KeyframeOutcomes(
            name,
            self._index,
            self.sessions,
            routes,
            metrics,
            journal=self._journal.folder,
            quarantine=self._quarantine,
        )
        self._retention = JournalRetention(self._journal, self._index, self.sessions, server.journal_bytes)
        map_opening.warn_of_old_corrections(self.folder)
        self.fuser = fuser or FuserSupervisor(
            context, self.folder, server, volume, spares=spares, waits=waits
        )
        if fuser is not None:
            fuser.begin_work()
        self._checkpoints = CheckpointOrders(self.fuser, self._journal)
        self._condition = MapCondition(
            self.fuser,
            self._journal,
            self._quarantine,
            disk=self.disk,
            sessions=self.sessions,
            backlog=self._backlog,
            outcomes=self.outcomes,
            checkpoints=self._checkpoints,
            questions=self.questions,
        )
        self._leaving: dict[int, int] = {}  # index of a record that forgets keyframes → how many
        self.forgetting = Forgetting(
            name,
            self.folder,
            self._journal,
            self._quarantine,
            append=self._append_forgotten,
            send=self.fuser.send,
        )

    @property
    def warm(self) -> bool:
        """Whether the fuser has been ready once: from then on it is known what the map has."""
        return self._condition.warm

    @property
    def is_saved(self) -> bool:
        """Whether the checkpoint that it was to leave with is written, or cannot be."""
        return self._checkpoints.is_answered

    @property
    def takes_records(self) -> bool:
        """Whether it is known what the map has, and it stays here.

        Its fuser has read that, or there was nothing, or the server from which it came said it.
        """
        return (self.warm or self._is_new or self._has_arrived) and not self.is_frozen

    @property
    def is_empty(self) -> bool:
        """Whether it is known that the map has nothing, and never had."""
        is_known = self.warm or self._is_new
        return is_known and not (len(self.sessions) or self.outcomes.blocks or self.outcomes.taken)

    @property
    def drained(self) -> bool:
        """Whether the map has every keyframe of the journal, where the newest correction of it says."""
        return self._condition.drained

    @property
    def corrections_waiting(self) -> int:
        """Number of keyframes whose newest pose is not fused, or that are to be forgotten and are not yet."""
        return self.outcomes.moves.waiting + sum(self._leaving.values())

    @property
    def settled(self) -> bool:
        """Whether the map is drained, or will not be soon: its fuser cannot be kept alive, or read."""
        return self.drained or bool(self.fuser.failed or self.fuser.held) or self.disk.is_away

    def idle_since(self, since: float) -> bool:
        """Whether no keyframe waits, nor came since then (`time.monotonic()`)."""
        return self.drained and (
            self._condition.last_keyframe is None or self._condition.last_keyframe < since
        )

    def close(self, *, wait: bool = True) -> None:
        """End the fuser and finish the journal. A journal that cannot be finished is logged.

        Args:
            wait: until the fuser has ended, for some seconds.
        """
        self.fuser.close(wait=wait)
        try:
            self._journal.close()
        except JournalError as error:  # its index only: every keyframe is on the disk
            log.error("%s", error, extra=logs.about(map=self.name))

    # --- keyframes ---

    def _append_forgotten(self, target: bytes, seqs: NDArray[np.int64]) -> None:
        """Write the record to the journal that removes these keyframes of a session."""
        if self.is_frozen:
            raise JournalError(f"map {self.name} moves to another server")
        durable, _ = self.sessions.progress(SERVER_SESSION)
        frames = corrections.encode(
            corrections.forgetting(target, seqs),
            session=SERVER_SESSION,
            seq=durable + 1,
            map_name=self.name,
        )
        (index,) = self.accept([Checked(unpack(frames[0]), frames, "", time.monotonic_ns())])
        self._leaving[index] = len(seqs)

    def accept(self, records: Sequence[Checked]) -> list[int]:
        """Write keyframes and corrections to the journal, all or none, and acknowledge them; their indices.

        Raises:
            JournalError: when the disk refuses.
        """
        unwritten = [Unwritten(one.frames, one.header.session, one.header.seq, one.client) for one in records]
        try:
            positions = self._journal.append_all(unwritten)
        except JournalError as error:
            self.disk.begin(error)
            raise
        self.disk.end()
        durable_ns = time.monotonic_ns()
        return [self._add(one, place, durable_ns) for one, place in zip(records, positions, strict=True)]

    def _add(self, record: Checked, position: Position, durable_ns: int) -> int:
        header, _, client, received_ns = record
        session = self.sessions.open(header.session, client, header.world)
        session.durable = header.seq
        is_correction = isinstance(header, CorrectionHeader)
        index = self._index.add(
            position,
            session,
            header.seq,
            captured_ns=0 if isinstance(header, CorrectionHeader) else header.captured_ns,
            received_ns=received_ns,
            durable_ns=durable_ns,
            is_correction=is_correction,
        )
        if self._backlog.is_empty:
            self._condition.moved = time.monotonic()
        self._backlog.add(session, is_correction=is_correction)
        if is_correction:
            self._corrections += 1
        else:
            self._condition.last_keyframe = durable_ns / 1e9
            self._metrics.observe(self.name, "journal", (durable_ns - received_ns) / 1e9)
        stamps = keyframe_times.Stamps(header.seq, received_ns, durable_ns)
        self.outcomes.acknowledge(header.session, [stamps])
        return index

    # --- another server ---

    def begin_to_leave(self) -> None:
        """Delete no file of the journal any more, close the open one, and have a checkpoint written.

        Raises:
            JournalError: when the disk refuses.
        """
        self._close_segment()
        self.is_leaving = True  # not where that fails: nobody would have it stay
        self._checkpoints.ask()

    def freeze(self) -> None:
        """Take no records any more, and close the journal's last file; raises JournalError."""
        self.is_frozen = True
        self._close_segment()

    def stay(self) -> None:
        """Go on as before."""
        self.is_leaving = self.is_frozen = False

    def _close_segment(self) -> None:
        try:
            self._journal.rotate()
        except OSError as error:
            raise JournalError(f"cannot close a file of {self._journal.folder}: {error}") from error

    # --- fuser ---

    def step(self) -> list[ForPeople]:
        """Read the fuser's messages, replace it if it died, give it work, keep the journal to its limit.

        Returns:
            The messages for viewers and for those who asked, with their frames.

        Raises:
            TsfusionError: when the map cannot be opened.
        """
        for_people: list[ForPeople] = []
        ended = self.fuser.ended()  # before its last messages are read
        while (received := self.fuser.receive()) is not None:
            message, frames = received
            if isinstance(message, fuser_messages.Done):
                self._condition.moved = time.monotonic()
                self._backlog.on_done(message.index, (message.fused_ns - message.fuse_start_ns) / 1e9)
                self._leaving.pop(message.index, None)
                self.outcomes.on_done(message)
            elif isinstance(message, fuser_messages.CorrectionProgress):
                self.outcomes.on_moves(message)
            elif isinstance(message, fuser_messages.Ready):
                self._on_ready(message)
            elif isinstance(message, fuser_messages.Saved):
                self._on_saved(message)
            elif isinstance(message, fuser_messages.Found):
                self.forgetting.on_found(message)
            elif isinstance(message, Meshed):
                self.outcomes.on_meshed(message)
                self._condition.newest_mesh = message.update or self._condition.newest_mesh
                for_people.append((message, frames))
            elif isinstance(message, fuser_messages.FuserAnswer):
                for_people.append((message, frames))
            elif isinstance(message, fuser_messages.FuserReply):
                for_people.append((message, frames))
                if not ended:
                    break  # it is passed on before what was fused after it is counted
        if ended and not self.fuser.finishing:
            self.disk.look()
            if not self.disk.is_away:  # another one would find an empty map
                self.fuser.restart()
        self._backlog.hand_out(self.fuser)
        self.disk.step()
        if not self.disk.is_away and not self.is_leaving:
            needed = self.outcomes.moves.first_segment if self._keeps_window else None
            self._retention.step(self.fuser, self.outcomes.unmeshed, window_from=needed)
        self._checkpoints.step()
        self._forget()
        return for_people

    def _forget(self) -> None:
        if self.fuser.failed and not self.fuser.ready:
            self.forgetting.give_up(self.fuser.failed)
        elif self.fuser.ready:
            moves, own = self.outcomes.moves, self.sessions.get(SERVER_SESSION)
            is_answered = own is None or own.in_map >= own.durable
            self.forgetting.step(
                settled=is_answered and not moves.waiting,
                in_map=lambda key: session.in_map if (session := self.sessions.get(key)) else 0,
                unavailable=moves.unavailable,
            )

    def _on_saved(self, saved: fuser_messages.Saved) -> None:
        if saved.written:
            self.outcomes.on_checkpoint()
        self._checkpoints.on_saved(saved)
        self._retention.on_saved(saved)
        self.forgetting.on_saved(saved)

    def _on_ready(self, ready: fuser_messages.Ready) -> None:
        if not self.warm:
            map_opening.compare(self.name, self._journal, self.sessions, ready)
        for key, progress in ready.done.items():
            session = self.sessions.open(key, progress.client, progress.world)
            session.durable = max(session.durable, progress.seq)
            if progress.seq > session.fused:
                session.fused = progress.seq
                session.answered = self._index.keyframes_up_to(session, progress.seq)
        self._backlog.restart(ready.done)
        self.outcomes.on_ready(ready)
        self._retention.on_ready()
        self.forgetting.on_ready()
        if not self.warm:
            self._condition.warm = True
            self._condition.moved = time.monotonic()
            found = map_opening.contents(ready, self._backlog.keyframes)
            log.info("%s", found, extra=logs.about(map=self.name))
        self._condition.loss = map_opening.loss(self.name, self._journal, ready)

    # --- health ---

    @property
    def problem(self) -> str:
        """Reason why keyframes are not accepted or not fused, and what to do; empty = they are."""
        return self._condition.problem

    @property
    def notices(self) -> list[str]:
        """Problems that a person should know of, though keyframes are taken and will be fused."""
        return self._condition.notices

    def health(self) -> MapHealth:
        """Health of the map, as far as it is known without asking the fuser."""
        return self._condition.health(self._corrections, self.corrections_waiting)
