# SPDX-License-Identifier: MIT
"""One open map of a server: its journal, its sessions, and the fuser that turns the journal into the map."""

import logging
import time
from collections.abc import Callable, Sequence

import numpy as np
import zmq
from numpy.typing import NDArray

from tsfusion.core import logs
from tsfusion.core.config import SERVER_SESSION, ServerConfig, VolumeConfig
from tsfusion.core.errors import JournalError
from tsfusion.fuser import fuser_messages
from tsfusion.gateway.clients.client_routes import ClientRoutes
from tsfusion.gateway.fusers.fuser_supervisor import FuserSupervisor
from tsfusion.gateway.fusers.spare_fusers import SpareFusers
from tsfusion.gateway.health.metrics import Metrics
from tsfusion.gateway.maps import map_journal
from tsfusion.gateway.maps.forgetting import Forgetting
from tsfusion.gateway.maps.map_journal import CheckpointOrders
from tsfusion.gateway.maps.map_records import IncomingRecord, KeyframeOutcomes, MapRecords, QuestionCounts
from tsfusion.gateway.records.journaled_records import FuserBacklog
from tsfusion.journal import ReadingWatcher
from tsfusion.wire.records import corrections
from tsfusion.wire.records.record_header import unpack

log = logging.getLogger(__name__)

PassOn = Callable[[fuser_messages.FuserAnswer, Sequence[zmq.Frame]], None]


class HostedMap:
    """Open map of a server, with journal and fuser. Call `step` again and again, and `accept` with records.

    Args:
        watch: called with the progress of reading the journal, which may take minutes and blocks all else.
        fuser: supervisor that read the map ahead; None starts a new one.
        waits: do not start the fuser before `fuser.begin`.

    Attributes:
        records: the map's records on disk.
        backlog: the records that the fuser has yet to answer.
        outcomes: outcomes of the answered records, which clients are told.
        warm: True once the fuser has been ready: from then on the map's content is known.
    """

    def __init__(
        self,
        spares: SpareFusers,
        name: str,
        server: ServerConfig,
        volume: VolumeConfig,
        *,
        routes: ClientRoutes,
        metrics: Metrics,
        watch: ReadingWatcher = lambda _done, _all, _records: None,
        fuser: FuserSupervisor | None = None,
        waits: bool = False,
    ) -> None:
        self.name = name
        self.records = records = MapRecords(name, server, watch)
        self.questions = QuestionCounts()
        self.is_leaving = self.is_frozen = False  # on its way to another server; takes no more records
        self.warm = False
        self.backlog = FuserBacklog(records.index, records.sessions)
        self.outcomes = KeyframeOutcomes(name, records, routes, metrics)
        self.fuser = fuser or FuserSupervisor(spares, records.folder, server, volume, waits=waits)
        if fuser is not None:
            fuser.begin_work()
        self.checkpoints = CheckpointOrders(self.fuser, records.journal)
        self.forgetting = Forgetting(name, records, append=self._append_forgotten, send=self.fuser.send)

    @property
    def takes_records(self) -> bool:
        """True if the map accepts records: its content is known, and it stays on this server.

        The fuser has read the content, or there was none, or the server that had the map sent it.
        """
        return (self.warm or self.records.is_new or self.records.has_arrived) and not self.is_frozen

    @property
    def is_empty(self) -> bool:
        """True if the map certainly has no record and never had one."""
        is_known = self.warm or self.records.is_new
        return is_known and not (len(self.records.sessions) or self.outcomes.blocks or self.outcomes.taken)

    @property
    def keyframes_durable(self) -> int:
        return self.outcomes.taken + self.outcomes.rejected.total() + self.backlog.keyframes

    @property
    def drained(self) -> bool:
        """True if every journaled record is fused or rejected, and each keyframe is at its newest pose."""
        return self.fuser.idle and self.backlog.is_empty and not self.outcomes.moves.waiting

    @property
    def corrections_waiting(self) -> int:
        """Number of keyframes whose newest pose is not fused yet, or that are not yet forgotten."""
        return self.outcomes.moves.waiting + sum(self.backlog.leaving.values())

    @property
    def ended(self) -> bool:
        """True if the map is drained, or cannot be for now: its fuser fails, or its disk does."""
        return self.drained or bool(self.fuser.failed or self.fuser.stuck) or self.records.disk.is_away

    def idle_since(self, since: float) -> bool:
        """True if no keyframe waits, and none came after `since` (`time.monotonic()`)."""
        last = self.records.last_keyframe
        return self.drained and (last is None or last < since)

    def close(self, *, wait: bool = True) -> None:
        """End the fuser and finish the journal. If the journal cannot be finished, log that."""
        self.fuser.close(wait=wait)
        try:
            self.records.journal.close()
        except JournalError as error:  # its index only: every keyframe is on the disk
            log.error("%s", error, extra=logs.about(map=self.name))

    # --- keyframes ---

    def _append_forgotten(self, target: bytes, seqs: NDArray[np.int64]) -> None:
        """Journal the record that removes keyframes `seqs` of the session `target` for good."""
        if self.is_frozen:
            raise JournalError(f"map {self.name} moves to another server")
        durable, _ = self.records.sessions.progress(SERVER_SESSION)
        frames = corrections.encode(
            corrections.forgetting(target, seqs),
            session=SERVER_SESSION,
            seq=durable + 1,
            map_name=self.name,
        )
        (index,) = self.accept([IncomingRecord(unpack(frames[0]), frames, "", time.monotonic_ns())])
        self.backlog.leaving[index] = len(seqs)

    def accept(self, records: Sequence[IncomingRecord]) -> list[int]:
        """Journal records, all or none, and acknowledge them. Return their indices.

        Raises:
            JournalError: when the disk refuses.
        """
        indices, durable_ns = self.records.append(records)
        for record, index in zip(records, indices, strict=True):
            session = self.records.sessions.numbered(self.records.index[index].session)
            self.backlog.add(session, is_correction=record.is_correction)
            self.outcomes.on_durable(record, durable_ns)
        return indices

    # --- another server ---

    def begin_to_leave(self) -> None:
        """Prepare a move to another server: keep all journal files, close the open one, order a checkpoint.

        Raises:
            JournalError: when the disk refuses.
        """
        self.records.close_segment()
        self.is_leaving = True  # only after success: nobody would call `stay` after an error
        self.checkpoints.ask()

    def freeze(self) -> None:
        """Accept no more records, and close the journal's last file. Raises JournalError if that fails."""
        self.is_frozen = True
        self.records.close_segment()

    def stay(self) -> None:
        """End a move to another server without result: the map stays here and accepts records again."""
        self.is_leaving = self.is_frozen = False

    # --- fuser ---

    def step(self, pass_on: PassOn) -> None:
        """Handle the fuser's messages, replace it after its death, give it work, and limit the journal.

        The order matters. `ended` is asked before the last messages are read. All answers of an old fuser are
        handled before the next one begins, or work is handed out.

        Raises:
            TsfusionError: when the map cannot be opened.
        """
        ended = self.fuser.ended()
        while (received := self.fuser.receive()) is not None:
            self._dispatch(*received, pass_on)
        if ended and not self.fuser.finishing:
            self.records.disk.look()
            if not self.records.disk.is_away:  # without its folder, a new fuser would find an empty map
                self.fuser.restart()
        self.backlog.hand_out(self.fuser)
        self.records.disk.step()
        if not self.records.disk.is_away and not self.is_leaving:
            needed = self.outcomes.moves.first_segment if self.fuser.keeps_window else None
            self.records.retention.step(self.fuser, self.outcomes.unmeshed, window_from=needed)
        self.checkpoints.step()
        self._forget()

    def _dispatch(
        self, message: fuser_messages.ToGateway, frames: Sequence[zmq.Frame], pass_on: PassOn
    ) -> None:
        """Give one message of the fuser, after `FuserSupervisor.receive`, to all objects that need it.

        An answer goes out here, before keyframes fused after it are counted.
        """
        match message:
            case fuser_messages.Done():
                self.backlog.on_done(message.index, (message.fused_ns - message.fuse_start_ns) / 1e9)
                self.outcomes.on_done(message)
            case fuser_messages.CorrectionProgress():
                self.outcomes.on_moves(message)
            case fuser_messages.Ready():
                self._on_ready(message)
            case fuser_messages.Saved():
                if message.written:
                    self.outcomes.on_checkpoint()
                self.checkpoints.on_saved(message)
                self.records.retention.on_saved(message)
                self.forgetting.on_saved(message)
            case fuser_messages.Found():
                self.forgetting.on_found(message)
            case fuser_messages.Meshed():
                self.outcomes.on_meshed(message)
            case fuser_messages.FuserAnswer():
                pass_on(message, frames)

    def _forget(self) -> None:
        if self.fuser.failed and not self.fuser.ready:
            self.forgetting.give_up(self.fuser.failed)
        elif self.fuser.ready:
            moves, sessions = self.outcomes.moves, self.records.sessions
            own = sessions.get(SERVER_SESSION)
            is_answered = own is None or own.in_map >= own.durable
            self.forgetting.step(
                is_server_answered=is_answered and not moves.waiting,
                in_map=lambda key: session.in_map if (session := sessions.get(key)) else 0,
                unavailable=moves.unavailable,
            )

    def _on_ready(self, ready: fuser_messages.Ready) -> None:
        records = self.records
        if not self.warm:
            map_journal.warn_of_shorter_journal(self.name, records.journal, records.sessions, ready)
        for key, progress in ready.done.items():
            session = records.sessions.open(key, progress.client, progress.world)
            session.durable = max(session.durable, progress.seq)
            if progress.seq > session.fused:
                session.fused = progress.seq
                session.answered = records.index.keyframes_up_to(session, progress.seq)
        self.backlog.restart(ready.done)
        self.outcomes.on_ready(ready)
        self.records.retention.on_ready()
        self.forgetting.on_ready()
        if not self.warm:
            self.warm, self.backlog.last_progress = True, time.monotonic()
            found = map_journal.describe_contents(ready, self.backlog.keyframes)
            log.info("%s", found, extra=logs.about(map=self.name))
        records.loss = map_journal.find_loss(self.name, records.journal, ready)
