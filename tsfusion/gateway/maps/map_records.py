# SPDX-License-Identifier: MIT
"""Records of a map: on the server's disk, with sessions and index, and what became of each keyframe.

Clients are told the outcomes, and rejected records go to the quarantine.
"""

import logging
import time
from collections import Counter, OrderedDict, deque
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import msgspec
import numpy as np

from tsfusion.core import logs
from tsfusion.core.config import ServerConfig
from tsfusion.core.errors import MISSING, JournalError
from tsfusion.fuser import fuser_messages
from tsfusion.gateway.clients.client_routes import ClientRoute, ClientRoutes, Session, Sessions
from tsfusion.gateway.health.metrics import Metrics
from tsfusion.gateway.health.problems import Problem
from tsfusion.gateway.maps import map_journal, moved_maps
from tsfusion.gateway.maps.map_journal import JournalRetention
from tsfusion.gateway.records.journaled_records import IndexEntry, KeyframeIndex
from tsfusion.geometry.sample_ranges import NO_SAMPLES
from tsfusion.journal import Journal, Position, ReadingWatcher, Unwritten, mcap_layout, read, state_folder
from tsfusion.journal.quarantine import Quarantine
from tsfusion.wire.messages import health, messages
from tsfusion.wire.messages.health import Spread
from tsfusion.wire.records.record_header import CorrectionHeader, RecordHeader

log = logging.getLogger(__name__)

_DISK_PAUSE = 1.0  # seconds without keyframes after the disk refused one, and between two checks of it
_FULL = ("memory", "MapFull")  # reasons of a fuser: the map has no room for a keyframe
_OVER_QUOTA = "MapQuota"  # reason of a fuser: the client has used up its share
_MAX_UNTOLD = 64  # most unsent rejections of a session, and most sessions with some
_NO_MOVES = fuser_messages.CorrectionProgress(0, 0, 0, 0, 0, 0.0)


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
        logged_ns = mcap_layout.wall_clock_ns()
        unwritten = [Unwritten(one.frames, one.header.session, one.header.seq, one.client) for one in records]
        try:
            positions = self.journal.append_all(unwritten, logged_ns=logged_ns)
        except JournalError as error:
            self.disk.begin(error)
            raise
        self.disk.end()
        now_ns = time.monotonic_ns()
        places = zip(records, positions, strict=True)
        return [self._add(one, place, logged_ns, now_ns) for one, place in places], now_ns

    def _add(self, record: IncomingRecord, position: Position, logged_ns: int, durable_ns: int) -> int:
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
            client=record.client,
            logged_ns=logged_ns,
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


class KeyframeOutcomes:
    """Counts and reports of what became of one map's keyframes, over all its fuser processes."""

    def __init__(self, name: str, records: MapRecords, routes: ClientRoutes, metrics: Metrics) -> None:
        self.fused = 0  # keyframes in the map
        self.moves = _NO_MOVES  # progress of corrections
        self.rejected: Counter[str] = Counter()  # by reason
        self.unmeshed: deque[int] = deque()  # indices; answered by the present fuser, oldest first
        self.blocks = self.map_bytes = 0  # from the fuser's last message about them
        self.delays = DelayStatistics()
        self._name = name
        self._records = records
        self._routes = routes
        self._metrics = metrics
        # Indices of rejected records that were reported: before the last checkpoint, and since then. Records
        # in a checkpoint are never fused again, but if it is damaged, the one before is used.
        self._rejected_before: set[int] = set()
        self._rejected_since: set[int] = set()
        self.notices: dict[str, str] = {}  # instructions for a person, by reason and client
        self._untold: OrderedDict[bytes, deque[messages.Nack]] = OrderedDict()  # session → unsent rejections
        self._without_samples: set[bytes] = set()  # sessions with a logged keyframe without samples
        self._meshed = 0  # keyframes that the present fuser answered and meshed

    def acknowledge(
        self, key: bytes, stamps: Sequence[messages.Stamps] = (), *, resend: bool = False
    ) -> None:
        """Send a client an Ack with the progress of its session."""
        self._routes.send(
            key, messages.Ack(key, *self._records.sessions.progress(key), tuple(stamps), resend)
        )

    def on_durable(self, record: IncomingRecord, durable_ns: int) -> None:
        """Acknowledge a record that was journaled at `durable_ns` to its client."""
        header, received_ns = record.header, record.received_ns
        if not record.is_correction:
            self._metrics.observe(self._name, "journal", (durable_ns - received_ns) / 1e9)
        self.acknowledge(header.session, [messages.Stamps(header.seq, received_ns, durable_ns)])

    def on_ready(self, ready: fuser_messages.Ready) -> None:
        """Reset the counts to those of the checkpoint with which a new fuser began."""
        self.fused, self.rejected = ready.keyframes, Counter(ready.rejected)
        self.blocks, self.map_bytes = ready.blocks, ready.map_bytes
        self.notices.clear()  # the new fuser may have more room
        self.on_moves(ready.moves or msgspec.structs.replace(_NO_MOVES, keyframes=ready.keyframes))
        self._settle_unmeshed()

    def _settle_unmeshed(self) -> None:
        """Count what an earlier fuser fused but did not mesh as meshed, unless it is fused again."""
        now = time.monotonic_ns()
        for index in self.unmeshed:
            session = self._records.sessions.numbered(self._records.index[index].session)
            if self._records.index.after(session, self._records.index[index].stamps.seq) <= session.handed:
                self._stamp_meshed(index, now)
        self.unmeshed.clear()
        self._meshed = 0

    def on_done(self, done: fuser_messages.Done) -> None:
        """Count a record that the fuser fused or rejected, and report it to its client."""
        entry = self._records.index[done.index]
        session = self._records.sessions.numbered(entry.session)
        session.in_map = entry.stamps.seq
        self.unmeshed.append(done.index)
        if not entry.is_correction:
            self.fused += done.reason is None
            self.rejected.update([done.reason] if done.reason else [])
        if done.reason is None:
            reported = entry.stamps.fused_ns > 0
        else:
            reported = done.index in self._rejected_since or done.index in self._rejected_before
        if reported:
            return  # an earlier fuser answered it, and died before its checkpoint
        if not entry.is_correction:
            session.answered += 1
            session.rejected += done.reason is not None
        self._records.index.set_fused(done.index, done.fuse_start_ns, done.fused_ns)
        entry = self._records.index[done.index]
        session.fused = max(session.fused, entry.stamps.seq)
        if done.reason is None:
            self._on_fused(session, entry)
        else:
            self._on_rejected(session, entry, done)
        self.acknowledge(session.key, [entry.stamps])

    def _on_fused(self, session: Session, entry: IndexEntry) -> None:
        route, stamps = self._routes.get(session.key), entry.stamps
        if route is not None and not entry.is_correction:
            route.fates.fused()
        if stamps.durable_ns and not entry.is_correction:  # 0: journaled by an earlier server
            waited, fused = stamps.fuse_start_ns - stamps.durable_ns, stamps.fused_ns - stamps.fuse_start_ns
            self._metrics.observe(self._name, "queue", waited / 1e9)
            self._metrics.observe(self._name, "fuse", fused / 1e9)
        if entry.captured_ns and route is not None and route.offset_ns is not None:
            delay_ns = stamps.fused_ns - entry.captured_ns - route.offset_ns
            if self.delays.add(delay_ns, route.bound_ns):
                self._metrics.observe(self._name, "total", delay_ns / 1e9)

    def _on_rejected(self, session: Session, entry: IndexEntry, done: fuser_messages.Done) -> None:
        assert done.reason is not None
        self._rejected_since.add(done.index)
        seq, is_empty = entry.stamps.seq, done.reason == NO_SAMPLES
        log.log(
            logging.DEBUG if is_empty and session.key in self._without_samples else logging.ERROR,
            "a %s is not in the map: %s",
            "correction" if entry.is_correction else "keyframe",
            done.message or done.reason,
            extra=logs.about(
                map=self._name, session=session.key, seq=seq, client=session.client, reason=done.reason
            ),
        )
        if (route := self._routes.get(session.key)) is not None:
            route.fates.turned_away(done.message or done.reason)
        self._tell(messages.Nack(session.key, seq, "map", done.reason, done.message))
        self._note_want_of_room(done.reason, session.client)
        if is_empty:  # nothing is wrong with the record
            self._without_samples.add(session.key)
            return
        try:
            frames = read(self._records.journal.folder, entry.position).frames
        except JournalError:  # unreadable in the journal: the reason of the rejection
            return
        self._records.quarantine.keep(
            frames, session=session.key, seq=seq, client=session.client, reason=done.reason
        )

    @property
    def taken(self) -> int:
        """Number of keyframes that the map ever took, including those that a correction removed."""
        return self.fused + self.moves.removed

    def on_moves(self, moves: fuser_messages.CorrectionProgress) -> None:
        """Store how many keyframes the fuser has moved to corrected poses or removed, and how many wait."""
        self.moves, self.fused = moves, moves.keyframes
        self.notices.pop("unmoved", None)
        if moves.unavailable:
            stay = f"{moves.unavailable} corrected keyframe{'s' * (moves.unavailable > 1)}"
            self.notices["unmoved"] = f"{stay} cannot be moved and left where fused: the log says why"

    def on_checkpoint(self) -> None:
        """Record that all records fused or rejected so far are in a checkpoint: they are not fused again."""
        self._rejected_before, self._rejected_since = self._rejected_since, set()

    def _tell(self, nack: messages.Nack) -> None:
        """Send a client the rejection of its record, and keep it for later if the client may be away."""
        route = self._routes.get(nack.session)
        if route is not None and not route.left:
            self._routes.send(nack.session, nack)
            if route.state(time.monotonic()) == "connected":
                return
        self._untold.setdefault(nack.session, deque(maxlen=_MAX_UNTOLD)).append(nack)
        if len(self._untold) > _MAX_UNTOLD:
            self._untold.popitem(last=False)

    def tell_untold(self, key: bytes) -> None:
        """Send a client that is back the rejections of its records while it was away."""
        for nack in self._untold.pop(key, ()):
            self._routes.send(key, nack)

    def _note_want_of_room(self, reason: str, client: str) -> None:
        if reason in _FULL:
            self.notices["full"] = (
                "it is full, keyframes that need more room are rejected: raise max_blocks, "
                "fuser_memory_bytes or fuser_disk_bytes, make room on the disk, or begin another map"
            )
        elif reason == _OVER_QUOTA:
            self.notices[f"client {client}"] = (
                f"client {client} has used up its share of the map's room, its keyframes that need more are "
                "rejected: raise quota_map, or look at what it sends"
            )

    def on_meshed(self, meshed: fuser_messages.Meshed) -> None:
        """Record that viewers can get these keyframes."""
        self.blocks, self.map_bytes = meshed.map_blocks, meshed.map_bytes
        for _ in range(meshed.count - self._meshed):
            self._stamp_meshed(self.unmeshed.popleft(), meshed.meshed_ns)
        self._meshed = meshed.count

    def _stamp_meshed(self, index: int, meshed_ns: int) -> None:
        entry = self._records.index[index]
        if entry.stamps.fused_ns and not entry.is_correction:
            self._metrics.observe(self._name, "mesh", (meshed_ns - entry.stamps.fused_ns) / 1e9)
        stamps = msgspec.structs.replace(entry.stamps, meshed_ns=meshed_ns)
        self.acknowledge(self._records.sessions.numbered(entry.session).key, [stamps])


_DELAYS = 1024  # only the newest delays count
_LONGEST_DELAY_NS = 86_400 * 10**9  # a day


class DelayStatistics:
    """Delays of the last keyframes, from capture by the sensor to fusion into the map."""

    def __init__(self) -> None:
        self._recent_ms: deque[tuple[float, float]] = deque(maxlen=_DELAYS)

    def add(self, delay_ns: int, bound_ns: int) -> bool:
        """Add a keyframe's delay, with its error bound. Return False for an impossible delay."""
        if not -bound_ns <= delay_ns <= _LONGEST_DELAY_NS:
            return False
        self._recent_ms.append((delay_ns / 1e6, bound_ns / 1e6))
        return True

    @property
    def bound_ms(self) -> float:
        """Largest error bound of the delays."""
        return max((bound for _, bound in self._recent_ms), default=0.0)

    def summary(self) -> Spread:
        """Return mean, percentiles and maximum of the delays, in milliseconds."""
        return health.spread(np.array([delay for delay, _ in self._recent_ms]))


# refused: not passed on to the fuser; late: its time was over; failed: the fuser could not answer
Outcome = Literal["answered", "refused", "late", "failed"]


class QuestionCounts:
    """Counts of a map's questions by outcome, and the delays of its answers."""

    def __init__(self) -> None:
        self.by_outcome: Counter[str] = Counter()
        self._delays_ms: deque[float] = deque(maxlen=_DELAYS)

    def add(self, outcome: Outcome, seconds: float | None = None) -> None:
        """Count a client's question about the map. `seconds`: from the question to its answer."""
        self.by_outcome[outcome] += 1
        if seconds is not None:
            self._delays_ms.append(1e3 * seconds)

    @property
    def delay_ms(self) -> Spread:
        """Delays from question to answer of the newest questions, in milliseconds."""
        return health.spread(np.array(self._delays_ms))
