# SPDX-License-Identifier: MIT
"""Outcome of each keyframe of a map: counted, reported to its client, and quarantined if it was rejected."""

import logging
import time
from collections import Counter, OrderedDict, deque
from collections.abc import Sequence
from typing import Literal

import msgspec
import numpy as np

from tsfusion.core import logs
from tsfusion.core.errors import JournalError
from tsfusion.fuser import fuser_messages
from tsfusion.gateway.clients.client_routes import ClientRoutes, Session
from tsfusion.gateway.health.metrics import Metrics
from tsfusion.gateway.maps.map_records import IncomingRecord, MapRecords
from tsfusion.gateway.records.journaled_records import IndexEntry
from tsfusion.geometry.sample_ranges import NO_SAMPLES
from tsfusion.journal import read
from tsfusion.wire.messages import health, messages
from tsfusion.wire.messages.health import Spread

log = logging.getLogger(__name__)

_FULL = ("memory", "MapFull")  # reasons of a fuser: the map has no room for a keyframe
_OVER_QUOTA = "MapQuota"  # reason of a fuser: the client has used up its share
_MAX_UNTOLD = 64  # most unsent rejections of a session, and most sessions with some


_NO_MOVES = fuser_messages.CorrectionProgress(0, 0, 0, 0, 0, 0.0)


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
