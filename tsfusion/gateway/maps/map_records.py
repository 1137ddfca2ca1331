# SPDX-License-Identifier: MIT
"""Records of a map on the server's disk: its journal, its sessions, and the index of records."""

import logging
import time
from collections.abc import Sequence
from typing import Any, NamedTuple

from tsfusion.core import logs
from tsfusion.core.config import ServerConfig
from tsfusion.core.errors import MISSING, JournalError
from tsfusion.gateway.clients.client_routes import ClientRoute, Sessions
from tsfusion.gateway.health.problems import Problem
from tsfusion.gateway.maps import map_journal, moved_maps
from tsfusion.gateway.maps.map_journal import JournalRetention
from tsfusion.gateway.records.journaled_records import KeyframeIndex
from tsfusion.journal import Journal, Position, ReadingWatcher, Unwritten, state_folder
from tsfusion.journal.quarantine import Quarantine
from tsfusion.wire.records.record_header import CorrectionHeader, RecordHeader

log = logging.getLogger(__name__)

_DISK_PAUSE = 1.0  # seconds without keyframes after the disk refused one, and between two checks of it


class IncomingRecord(NamedTuple):
    """A received record, with its sender and time."""

    header: RecordHeader
    frames: Sequence[Any]
    client: str  # name under which its sender's key is allowed
    received_ns: int
    route: ClientRoute | None = None  # route to its client; None if it is not connected

    @property
    def is_correction(self) -> bool:
        return isinstance(self.header, CorrectionHeader)

    @property
    def nbytes(self) -> int:
        return sum(frame.nbytes for frame in self.frames)

    def about(self, reason: str = "") -> dict[str, Any]:
        """Return the fields that tell a log line which record it is about."""
        header = self.header
        return logs.about(
            map=header.map, session=header.session, seq=header.seq, client=self.client, reason=reason
        )


class MapRecords:
    """Records of one map: those in the journal, and those in quarantine.

    Attributes:
        is_new: True if there was nothing of the map on disk.
        has_arrived: True if the map came from another server, with its sessions' progress.
        corrections: number of corrections in the journal.
        last_keyframe: time of the last keyframe (`time.monotonic()`); None before the first.
        loss: records that no checkpoint and no journal has, in words; empty without a loss.
    """

    def __init__(self, name: str, server: ServerConfig, watch: ReadingWatcher) -> None:
        self.folder = folder = state_folder.map_folder(server.state, name)
        self.is_new = not state_folder.holds_a_map(folder)
        self.journal = map_journal.open_journal(folder, server, watch)
        map_journal.warn_of_old_corrections(folder)
        self.disk = DiskPause(self.journal, name)
        self.quarantine = Quarantine(folder / state_folder.QUARANTINE_FOLDER, server.quarantine_bytes)
        self.sessions, self.index = Sessions(), KeyframeIndex()
        self.index.recover(self.journal.found, self.sessions)
        self.journal.found = []
        self.retention = JournalRetention(self.journal, self.index, self.sessions, server.journal_bytes)
        self.corrections = sum(session.corrections for session in self.sessions)
        self.last_keyframe: float | None = None
        self.loss = ""
        arrived = moved_maps.arrival_of(folder)
        self.has_arrived = arrived is not None
        for known in () if arrived is None else arrived.sessions:
            session = self.sessions.open(known.key, known.client, known.world)
            session.durable = max(session.durable, known.durable)

    def append(self, records: Sequence[IncomingRecord]) -> tuple[list[int], int]:
        """Journal records, all or none. Return their indices, and the time when they were on disk.

        Raises:
            JournalError: when the disk refuses.
        """
        unwritten = [Unwritten(one.frames, one.header.session, one.header.seq, one.client) for one in records]
        try:
            positions = self.journal.append_all(unwritten)
        except JournalError as error:
            self.disk.begin(error)
            raise
        self.disk.end()
        now_ns = time.monotonic_ns()
        return [self._add(one, place, now_ns) for one, place in zip(records, positions, strict=True)], now_ns

    def _add(self, record: IncomingRecord, position: Position, durable_ns: int) -> int:
        header = record.header
        if record.is_correction:
            self.corrections += 1
        else:
            self.last_keyframe = durable_ns / 1e9
        session = self.sessions.open(header.session, record.client, header.world)
        session.durable = header.seq
        return self.index.add(
            position,
            session,
            header.seq,
            captured_ns=0 if isinstance(header, CorrectionHeader) else header.captured_ns,
            received_ns=record.received_ns,
            durable_ns=durable_ns,
            is_correction=record.is_correction,
        )

    def close_segment(self) -> None:
        """Close the journal's last file. Raise JournalError if the disk refuses."""
        try:
            self.journal.rotate()
        except OSError as error:
            raise JournalError(f"cannot close a file of {self.journal.folder}: {error}") from error


class DiskPause:
    """Pause after the disk refused a keyframe, in which no other keyframe is tried."""

    def __init__(self, journal: Journal, map_name: str) -> None:
        self.problem = ""  # why no keyframe is taken; empty if they are
        self.is_away = False  # True if the journal's folder is not found
        self._journal = journal
        self._map = map_name
        self._until = self._look_at = 0.0  # time.monotonic()
        self._shows = False  # True if a check of the disk can see the problem, and so its end

    def seconds_left(self, now: float) -> float:
        """Return the seconds until the disk is tried again; 0 without a pause."""
        return max(self._until - now, 0.0)

    def begin(self, error: JournalError) -> None:
        """Start a pause because of an error."""
        if Problem(str(error)).key != Problem(self.problem).key:  # log each problem only once
            log.error("no keyframes are taken: %s", error, extra=logs.about(map=self._map))
        self.problem = str(error)
        self.is_away = error.errno in MISSING
        self._shows = self.is_away or error.errno is None
        self._until = self._look_at = time.monotonic() + _DISK_PAUSE

    def end(self) -> None:
        """Record that the disk takes keyframes (again)."""
        if self.problem:
            log.warning("keyframes are taken again", extra=logs.about(map=self._map))
            self.problem, self.is_away, self._shows = "", False, False

    def step(self) -> None:
        """Try the disk once a second during a pause, even if no keyframe comes.

        Clients may wait for the end of a pause, and a person should know of it before the next scan.
        """
        if time.monotonic() >= self._look_at:
            self.look()

    def look(self) -> None:
        """Write a test to the disk now, to see if it would take a keyframe."""
        self._look_at = time.monotonic() + _DISK_PAUSE
        try:
            self._journal.check()
        except JournalError as error:
            self.begin(error)
            self._shows = True
        else:
            self._until = 0.0
            if self._shows:  # otherwise only the next keyframe shows the end of the problem
                self.end()
