# SPDX-License-Identifier: MIT
"""One map of a server: its journal, its sessions, and the fuser that works through them."""

import logging
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import zmq

from tsfusion.core import logs
from tsfusion.core.config import ServerConfig, VolumeConfig
from tsfusion.core.errors import JournalError
from tsfusion.fuser import messages as fuser_messages
from tsfusion.gateway.fuser_supervisor import FuserSupervisor
from tsfusion.gateway.journal_retention import JournalRetention
from tsfusion.gateway.keyframe_index import KeyframeIndex
from tsfusion.gateway.keyframe_outcomes import Clients, KeyframeOutcomes
from tsfusion.gateway.sessions import FairQueue, Sessions
from tsfusion.journal import Journal, state_folder
from tsfusion.journal.quarantine import Quarantine
from tsfusion.wire import keyframe_times
from tsfusion.wire.health import MapHealth, MapState
from tsfusion.wire.record_header import CorrectionHeader, RecordHeader

log = logging.getLogger(__name__)

_SEGMENTS_KEPT = 4  # a journal with a limit goes in pieces of a quarter of it


Other = Callable[[fuser_messages.Meshed | fuser_messages.FuserReply, Sequence[zmq.Frame]], None]


class HostedMap:
    """Call `step` for ever, and `accept` for each keyframe.

    Attributes:
        warm: the fuser has been ready once: what the map has of each session is known.
        problem: why keyframes are not taken now; empty = they are.
    """

    def __init__(
        self,
        context: "zmq.Context[Any]",
        name: str,
        server: ServerConfig,
        volume: VolumeConfig,
        clients: Clients,
    ) -> None:
        self.name = name
        self.folder = state_folder.folder(server.state, name)
        self.warm = False
        self.problem = ""
        self._server = server
        self._clients = clients
        most = server.journal_bytes
        segment = server.segment_bytes if most is None else min(server.segment_bytes, most // _SEGMENTS_KEPT)
        self._journal = Journal(
            self.folder / state_folder.JOURNAL_FOLDER, segment, min_free_bytes=server.min_free_bytes
        )
        self._quarantine = Quarantine(self.folder / state_folder.QUARANTINE_FOLDER, server.quarantine_bytes)
        self.sessions = Sessions()
        self._index = KeyframeIndex()
        self._index.recover(self._journal.found, self.sessions)
        self._journal.found = []
        self._turns = FairQueue()
        self._count_waiting()
        self._corrections = self._waiting_corrections
        self._outcomes = KeyframeOutcomes(
            name,
            self._index,
            self.sessions,
            clients,
            journal=self._journal.folder,
            quarantine=self._quarantine,
        )
        self._last: float | None = None
        self._held_until = 0.0
        self._lost = ""
        self._retention = JournalRetention(self._journal, self._index, self.sessions, most)
        _warn_of_old_corrections(self.folder)
        self.fuser = FuserSupervisor(context, self.folder, server, volume)

    @property
    def drained(self) -> bool:
        """Whether the map has every keyframe of the journal."""
        return self.fuser.idle and not self._waiting and not self._waiting_corrections

    @property
    def settled(self) -> bool:
        """Drained, or never to be: its fuser cannot be kept alive."""
        return self.drained or bool(self.fuser.failed)

    def calm(self, since: float) -> bool:
        """Whether no keyframe waits, nor came since then (`time.monotonic()`)."""
        return self.drained and (self._last is None or self._last < since)

    def close(self) -> None:
        """End the fuser and finish the journal; what the disk refuses of that is logged."""
        self.fuser.close()
        try:
            self._journal.close()
        except JournalError as error:  # its index only: every keyframe is on the disk
            log.error("%s", error, extra=logs.about(map=self.name))

    # --- keyframes ---

    def held(self, now: float) -> float:
        """Seconds for which nothing is taken because the disk refused."""
        return max(self._held_until - now, 0.0)

    def accept(self, header: RecordHeader, frames: Sequence[Any], client: str, received_ns: int) -> None:
        """Write the session's next keyframe or correction to the journal, and say so.

        Raises:
            JournalError: when the disk refuses; `held` says for how long nothing is tried.
        """
        try:
            position = self._journal.append(frames, session=header.session, seq=header.seq, client=client)
        except JournalError as error:
            if str(error) != self.problem:
                log.error("no keyframes are taken: %s", error, extra=logs.about(map=self.name))
            self.problem = str(error)
            self._held_until = time.monotonic() + 1.0
            raise
        if self.problem:
            self._recovered()
        session = self.sessions.open(header.session, client)
        session.durable = header.seq
        durable_ns = time.monotonic_ns()
        is_correction = isinstance(header, CorrectionHeader)
        self._index.add(
            position,
            session,
            header.seq,
            captured_ns=0 if isinstance(header, CorrectionHeader) else header.captured_ns,
            received_ns=received_ns,
            durable_ns=durable_ns,
            is_correction=is_correction,
        )
        self._turns.add(session)
        if is_correction:
            self._corrections += 1
            self._waiting_corrections += 1
        else:
            self._waiting += 1
            self._last = durable_ns / 1e9
            self._clients.observe(self.name, "journal", (durable_ns - received_ns) / 1e9)
        self._outcomes.acknowledge(
            header.session, [keyframe_times.Stamps(header.seq, received_ns, durable_ns)]
        )

    def acknowledge(self, key: bytes, *, resend: bool = False) -> None:
        """Tell a client how far its session is."""
        self._outcomes.acknowledge(key, resend=resend)

    # --- fuser ---

    def step(self, other: Other) -> None:
        """Hear the fuser, bring it back if it died, give it work, keep the journal to its limit.

        Args:
            other: takes what the fuser says to people.

        Raises:
            TsfusionError: when the map cannot be opened.
        """
        ended = self.fuser.ended()  # before its last words are read
        while (heard := self.fuser.receive()) is not None:
            message, frames = heard
            if isinstance(message, fuser_messages.Done):
                is_correction = self._index[message.index].is_correction
                self._waiting_corrections -= is_correction
                self._waiting -= not is_correction
                self._outcomes.on_done(message)
            elif isinstance(message, fuser_messages.Ready):
                self._on_ready(message)
            elif isinstance(message, fuser_messages.Saved):
                self._retention.on_saved(message)
            elif isinstance(message, fuser_messages.Meshed):
                self._outcomes.on_meshed(message)
                other(message, frames)
            elif isinstance(message, fuser_messages.FuserReply):
                other(message, frames)
        if ended and not self.fuser.finishing:
            self.fuser.restart()
        self._hand_out()
        self._look_for_room()
        self._retention.step(self.fuser, self._outcomes.unmeshed)

    def _look_for_room(self) -> None:
        """Who waits for this server to be ready again may be who would send the next keyframe."""
        now = time.monotonic()
        if self.problem and now > self._held_until:
            self._held_until = now + 1.0 if self._is_full() else 0.0
            if not self._held_until:
                self._recovered()

    def _is_full(self) -> bool:
        try:
            return self._journal.free_bytes < self._server.min_free_bytes
        except JournalError:
            return True

    def _recovered(self) -> None:
        log.warning("keyframes are taken again", extra=logs.about(map=self.name))
        self.problem = ""

    def _hand_out(self) -> None:
        while self.fuser.wants_work and (session := self._turns.next()) is not None:
            entry = self._index[session.entries[session.handed]]
            order = fuser_messages.Fuse(
                entry.index,
                entry.position,
                session.key,
                entry.stamps.seq,
                session.client,
                is_correction=entry.is_correction,
            )
            if not self.fuser.fuse(order):
                return
            session.handed += 1
            self._turns.served()

    def _on_ready(self, ready: fuser_messages.Ready) -> None:
        for key, progress in ready.done.items():
            session = self.sessions.open(key, progress.client)
            session.durable = max(session.durable, progress.seq)
            session.fused = max(session.fused, progress.seq)
        self._turns.clear()
        for session in self.sessions:
            done = ready.done.get(session.key)
            session.in_map = done.seq if done else 0
            session.handed = self._index.after(session, done.seq) if done else 0
            if session.handed < len(session.entries):
                self._turns.add(session)
        self._count_waiting()
        self._outcomes.on_ready(ready)
        self._retention.on_ready()
        if not self.warm:
            self.warm = True
            log.info("the map is open", extra=logs.about(map=self.name))
        self._check_begin(ready)

    def _count_waiting(self) -> None:
        """Count the keyframes and the corrections that were not given to the fuser."""
        waiting = [session.entries[session.handed :] for session in self.sessions]
        self._waiting_corrections = sum(map(self._index.corrections, waiting))
        self._waiting = sum(map(len, waiting)) - self._waiting_corrections

    def _check_begin(self, ready: fuser_messages.Ready) -> None:
        self._lost = ""
        if not ready.done and self._journal.first > 1:
            first = self._journal.first
            self._lost = f"its checkpoints are lost, and with them what was journaled before segment {first}"
            log.error("%s", self._lost, extra=logs.about(map=self.name))

    # --- what people ask ---

    @property
    def state(self) -> MapState:
        """In a word."""
        if self.fuser.failed:
            return "failed"
        if not self.warm:
            return "opening"
        if not self.fuser.ready:
            return "restarting"
        return "idle" if self.drained else "busy"

    @property
    def notices(self) -> list[str]:
        """What a person should know, though keyframes are taken and fused."""
        damaged = self._journal.damaged
        told = [f"{damaged} keyframes of its journal are damaged and lost"] if damaged else []
        return [*told, self._lost] if self._lost else told

    def health(self) -> MapHealth:
        """As far as it is known without the fuser."""
        now, told = time.monotonic(), self._outcomes
        return MapHealth(
            state=self.state,
            problem=self.problem or self.fuser.failed,
            keyframes_durable=told.fused + told.rejected.total() + self._waiting,
            keyframes_fused=told.fused,
            waiting=self._waiting,
            rejected=dict(told.rejected),
            quarantined=len(self._quarantine),
            sessions=len(self.sessions),
            journal_bytes=self._journal.nbytes,
            journal_damaged=self._journal.damaged,
            fuser_restarts=self.fuser.restarts,
            blocks=told.blocks,
            map_bytes=told.map_bytes,
            last_keyframe_s=None if self._last is None else max(now - self._last, 0.0),
            delay_ms=told.delays.summary(),
            delay_bound_ms=told.delays.bound_ms,
            corrections=self._corrections,
        )


def _warn_of_old_corrections(folder: Path) -> None:
    old = folder / "corrections"
    if any(old.glob("*.tsc")):
        log.warning(
            "%s holds corrected poses as an earlier development version kept them: they are not read; "
            "delete the folder to silence this",
            old,
        )
