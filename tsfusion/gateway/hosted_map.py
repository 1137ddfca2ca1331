# SPDX-License-Identifier: MIT
"""One map of a server: its journal, its sessions, and the fuser that works through the journal."""

import glob
import logging
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import zmq
from numpy.typing import NDArray

from tsfusion.core import logs
from tsfusion.core.config import SERVER_SESSION, ServerConfig, VolumeConfig
from tsfusion.core.counts import count_of
from tsfusion.core.errors import JournalError
from tsfusion.fuser import messages as fuser_messages
from tsfusion.gateway import moved_maps
from tsfusion.gateway.client_routes import ClientRoutes
from tsfusion.gateway.disk_pause import DiskPause
from tsfusion.gateway.forgetting import Forgetting
from tsfusion.gateway.fuser_backlog import FuserBacklog
from tsfusion.gateway.fuser_supervisor import FuserSupervisor
from tsfusion.gateway.journal_retention import JournalRetention
from tsfusion.gateway.keyframe_index import KeyframeIndex
from tsfusion.gateway.keyframe_outcomes import KeyframeOutcomes
from tsfusion.gateway.metrics import Metrics
from tsfusion.gateway.question_counts import QuestionCounts
from tsfusion.gateway.sessions import Sessions
from tsfusion.journal import Journal, Position, ReadingWatcher, Unwritten, state_folder
from tsfusion.journal.quarantine import Quarantine
from tsfusion.wire import corrections, keyframe_times
from tsfusion.wire.health import MapHealth, MapState
from tsfusion.wire.mesh_updates import Meshed, MeshUpdate
from tsfusion.wire.record_header import CorrectionHeader, RecordHeader, unpack

log = logging.getLogger(__name__)

_SEGMENTS_KEPT = 4  # a journal with a limit is deleted in quarters of that limit
_FOR_GONE = "what no checkpoint holds of them is lost, unless they are put back"
_SAVE_PAUSE = 10.0  # seconds until a checkpoint is tried again that could not be written
_LONGEST_WAIT = 0.2  # seconds of a step, for a segment of the journal that is put back
_STALLED_AFTER = 10.0  # seconds in which keyframes wait and none is fused
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
    ) -> None:
        self.name, self.volume = name, volume
        self.folder = state_folder.map_folder(server.state, name)
        self.sessions = Sessions()
        self.questions = QuestionCounts()
        self.is_leaving = self.is_frozen = False  # to another server; it takes no records any more
        self.warm = False  # the fuser has been ready once: from then on it is known what the map has
        self._metrics = metrics
        self._keeps_window = (server.keep_seconds, server.keep_keyframes, server.keep_radius) != (None,) * 3
        self._last_keyframe: float | None = None  # time.monotonic()
        self._moved = 0.0  # time.monotonic(): the fuser answered, or had nothing to answer
        self._loss = ""
        self._newest_mesh: MeshUpdate | None = None
        self._checkpoints = 0  # written since the map was opened
        self._unsaved = ""  # why no checkpoint can be written; empty = it can
        self._save_at = 0.0  # time.monotonic()
        self._missing = 0  # segments of the journal that were missing when a checkpoint was asked for
        self._is_new = not state_folder.holds_a_map(self.folder)
        self._journal = _open_journal(self.folder, server, watch)
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
        _warn_of_old_corrections(self.folder)
        self.fuser = FuserSupervisor(context, self.folder, server, volume)
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
        return self.fuser.idle and self._backlog.is_empty and not self.outcomes.moves.waiting

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
        return self.drained and (self._last_keyframe is None or self._last_keyframe < since)

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
            self._moved = time.monotonic()
        self._backlog.add(session, is_correction=is_correction)
        if is_correction:
            self._corrections += 1
        else:
            self._last_keyframe = durable_ns / 1e9
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
        self.is_leaving = True
        self._close_segment()
        if self.fuser.ready:
            self.fuser.send(fuser_messages.Save())

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
                self._moved = time.monotonic()
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
                self._newest_mesh = message.update or self._newest_mesh
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
        self._save_again()
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
        self._checkpoints += saved.written
        if saved.written:
            self.outcomes.on_checkpoint()
        self._unsaved = saved.problem
        self._save_at = time.monotonic() + _SAVE_PAUSE
        self._retention.on_saved(saved)
        self.forgetting.on_saved(saved)

    def _save_again(self) -> None:
        """Ask for a checkpoint where the last one failed, or segments of the journal have gone since."""
        now, missing = time.monotonic(), len(self._journal.missing)
        is_due = self._unsaved and now >= self._save_at
        if (
            self.fuser.ready
            and (is_due or missing > self._missing)
            and self.fuser.send(fuser_messages.Save())
        ):
            self._save_at = now + _SAVE_PAUSE
            self._missing = missing
        self._missing = min(self._missing, missing)

    def _on_ready(self, ready: fuser_messages.Ready) -> None:
        if not self.warm:
            self._compare(ready)
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
            self.warm = True
            self._moved = time.monotonic()
            log.info("%s", self._contents(ready), extra=logs.about(map=self.name))
        self._check_checkpoint(ready)

    def _compare(self, ready: fuser_messages.Ready) -> None:
        """Say that the journal, of which nothing was deleted on purpose, ends before the checkpoint does."""
        shorter = [key for key, done in ready.done.items() if self.sessions.progress(key)[0] < done.seq]
        if shorter and self._journal.first == 1:
            log.warning(
                "its checkpoint holds keyframes of %s that its journal %s lacks: was the journal "
                "deleted, or is its disk not mounted? The map cannot be built again from it",
                count_of(len(shorter), "session"),
                self._journal.folder,
                extra=logs.about(map=self.name),
            )

    def _contents(self, ready: fuser_messages.Ready) -> str:
        """What there is of a map when it is opened, for the log."""
        waiting = self._backlog.keyframes
        if not ready.done and not waiting:
            return "a new map is open"
        rest = f"; {waiting} more are fused from its journal" if waiting else ""
        return f"the map is open, with {count_of(ready.keyframes, 'keyframe')}{rest}"

    def _check_checkpoint(self, ready: fuser_messages.Ready) -> None:
        """Report keyframes that are neither in a checkpoint nor in the journal."""
        self._loss = ""
        if not ready.done and self._journal.first > 1:
            first = self._journal.first
            self._loss = f"its checkpoints are lost, and with them what was journaled before segment {first}"
            log.error("%s", self._loss, extra=logs.about(map=self.name))

    # --- health ---

    @property
    def state(self) -> MapState:
        """The state in a word."""
        if self.fuser.failed:
            return "failed"
        if not self.warm:
            return "opening"
        if not self.fuser.ready:
            return "restarting"
        return "idle" if self.drained else "busy"

    @property
    def problem(self) -> str:
        """Why keyframes are not accepted or not fused, and what to do; empty = they are."""
        if problem := self.disk.problem or self.fuser.problem:
            return problem
        stalled = self.warm and not self._backlog.is_empty and time.monotonic() - self._moved > _STALLED_AFTER
        if stalled and self.fuser.ready:
            return "keyframes wait and none is fused: its fuser makes a mesh or a checkpoint, or it hangs"
        return "keyframes wait, and its fuser is still starting again: read the log" if stalled else ""

    @property
    def notices(self) -> list[str]:
        """What a person should know of, though keyframes are taken and will be fused."""
        damaged, put_back = self._journal.damaged, self._journal.put_back
        lost = count_of(damaged, "keyframe of its journal is", "keyframes of its journal are")
        notices = [f"{lost} damaged and lost"] if damaged else []
        if absent := self._journal.absent:
            gone = count_of(absent, "segment of its journal was", "segments of its journal were")
            notices.append(f"{gone} not there at the start: {_FOR_GONE}")
        if missing := self._journal.missing:
            first = f"{missing[0]:06d}.mcap"
            gone = count_of(len(missing), "segment of its journal is", "segments of its journal are")
            notices.append(f"{gone} gone, first {first}: {_FOR_GONE}")
        if put_back:
            notices.append(
                f"its journal was taken away while it was written to, {count_of(put_back, 'time')}, and was "
                "put back with every keyframe: find out who deletes or moves files there"
            )
        if self._unsaved:
            notices.append(f"no checkpoint can be written: {self._unsaved}")
        if self.state == "restarting" and not self.problem:
            notices.append("its fuser ended, and another one takes over: the log says why")
        notices += filter(None, (self._quarantine.problem, self._loss))
        return [*notices, *self.outcomes.notices.values()]

    def health(self) -> MapHealth:
        """How the map is doing, as far as it is known without asking the fuser."""
        now, outcomes = time.monotonic(), self.outcomes
        return MapHealth(
            state=self.state,
            problem=self.problem,
            keyframes_durable=outcomes.taken + outcomes.rejected.total() + self._backlog.keyframes,
            keyframes_fused=outcomes.fused,
            waiting=self._backlog.keyframes,
            rejected=dict(outcomes.rejected),
            quarantined=len(self._quarantine),
            sessions=self.sessions.of_clients,
            journal_bytes=self._journal.nbytes,
            journal_damaged=self._journal.damaged,
            fuser_restarts=self.fuser.restarts,
            blocks=outcomes.blocks,
            map_bytes=outcomes.map_bytes,
            last_keyframe_s=None if self._last_keyframe is None else max(now - self._last_keyframe, 0.0),
            delay_ms=outcomes.delays.summary(),
            delay_bound_ms=outcomes.delays.bound_ms,
            corrections=self._corrections,
            corrections_waiting=self.corrections_waiting,
            corrections_unavailable=outcomes.moves.unavailable,
            keyframes_moved=outcomes.moves.moved,
            moving_s=outcomes.moves.seconds,
            keyframes_forgotten=outcomes.moves.forgotten,
            checkpoints=self._checkpoints,
            journal_missing=self._journal.absent + len(self._journal.missing),
            journal_put_back=self._journal.put_back,
            fusing_s=self.fuser.seconds_at_work,
            questions=dict(self.questions.by_outcome),
            question_ms=self.questions.delay_ms,
            mesh_epoch=self._newest_mesh.epoch if self._newest_mesh else "",
            mesh_number=self._newest_mesh.number if self._newest_mesh else 0,
        )


def _open_journal(folder: Path, server: ServerConfig, watch: ReadingWatcher) -> Journal:
    """The map's journal, in segments small enough to keep it to its limit."""
    segment_bytes = server.segment_bytes
    if server.journal_bytes is not None:
        segment_bytes = min(segment_bytes, server.journal_bytes // _SEGMENTS_KEPT)
    return Journal(
        folder / state_folder.JOURNAL_FOLDER,
        segment_bytes,
        min_free_bytes=server.min_free_bytes,
        longest_wait=_LONGEST_WAIT,
        watch=watch,
    )


def _warn_of_old_corrections(folder: Path) -> None:
    old = folder / "corrections"
    if glob.glob("*.tsc", root_dir=old):  # nothing where the disk does not say
        log.warning(
            "%s holds corrected poses as an earlier development version kept them: they are not read; "
            "delete the folder to silence this",
            old,
        )
