# SPDX-License-Identifier: MIT
"""What becomes of a map's keyframes, as its fusers say: counted, told to those who sent them, kept aside."""

import logging
import time
from collections import Counter, deque
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import msgspec
import numpy as np

from tsfusion.core import logs
from tsfusion.core.errors import JournalError
from tsfusion.fuser import messages as fuser_messages
from tsfusion.gateway.client_routes import ClientRoute
from tsfusion.gateway.keyframe_index import IndexEntry, KeyframeIndex
from tsfusion.gateway.sessions import Session, Sessions
from tsfusion.journal import read
from tsfusion.journal.quarantine import Quarantine
from tsfusion.wire import keyframe_times, messages
from tsfusion.wire.keyframe_times import Spread

log = logging.getLogger(__name__)


class Clients(Protocol):
    """What a map needs of the gateway to talk to those who send."""

    def send(self, session: bytes, message: messages.ToClient) -> None:
        """Pass it to the session's client, if that is connected."""

    def route(self, session: bytes) -> ClientRoute | None:
        """Its connection."""

    def heard(self, session: bytes, client: str, *, scans: bool) -> None:
        """A keyframe message came. `scans`: it is a good one."""

    def observe(self, map_name: str, stage: str, seconds: float) -> None:
        """A keyframe took so long for a stage."""


class KeyframeOutcomes:
    """One map's, over all its fusers.

    Attributes:
        fused, rejected: what the map has, and has not for a reason.
        unmeshed: answered by the fuser that lives, in its order, and not meshed yet.
        blocks, map_bytes: the map's size, as it was last told.
    """

    def __init__(
        self,
        name: str,
        index: KeyframeIndex,
        sessions: Sessions,
        clients: Clients,
        *,
        journal: Path,
        quarantine: Quarantine,
    ) -> None:
        self.fused = 0
        self.rejected: Counter[str] = Counter()
        self.unmeshed: deque[int] = deque()
        self.blocks = self.map_bytes = 0
        self.delays = DelayStatistics()
        self._name = name
        self._index = index
        self._sessions = sessions
        self._clients = clients
        self._journal = journal
        self._quarantine = quarantine
        self._told_rejected: set[int] = set()
        self._meshed = 0  # how many answers of the fuser that lives went from `unmeshed`

    def acknowledge(
        self, key: bytes, stamps: Sequence[keyframe_times.Stamps] = (), *, resend: bool = False
    ) -> None:
        """Tell a client how far its session is."""
        self._clients.send(key, messages.Ack(key, *self._sessions.progress(key), tuple(stamps), resend))

    def on_ready(self, ready: fuser_messages.Ready) -> None:
        """Another fuser has begun, with what the checkpoint holds, as each session's `handed` says."""
        self.fused, self.rejected = ready.keyframes, Counter(ready.rejected)
        self.blocks, self.map_bytes = ready.blocks, ready.map_bytes
        self._leave_unmeshed()

    def _leave_unmeshed(self) -> None:
        """What an earlier fuser answered and did not mesh: the checkpoint has it, or it comes again."""
        now = time.monotonic_ns()
        for index in self.unmeshed:
            session = self._sessions.numbered(self._index[index].session)
            if self._index.after(session, self._index[index].stamps.seq) <= session.handed:
                self._stamp_meshed(index, now)
        self.unmeshed.clear()
        self._meshed = 0

    def on_done(self, done: fuser_messages.Done) -> None:
        """The fuser answered a keyframe."""
        entry = self._index[done.index]
        session = self._sessions.numbered(entry.session)
        session.in_map = entry.stamps.seq
        self.unmeshed.append(done.index)
        if not entry.is_correction:
            self.fused += done.reason is None
            self.rejected.update([done.reason] if done.reason else [])
        told = done.index in self._told_rejected if done.reason else entry.stamps.fused_ns > 0
        if told:
            return  # a fuser that died before its checkpoint had said so
        self._index.fused(done.index, done.fuse_start_ns, done.fused_ns)
        entry = self._index[done.index]
        session.fused = max(session.fused, entry.stamps.seq)
        if done.reason is None:
            self._on_fused(session, entry)
        else:
            self._on_rejected(session, entry, done)
        self.acknowledge(session.key, [entry.stamps])

    def _on_fused(self, session: Session, entry: IndexEntry) -> None:
        route, stamps = self._clients.route(session.key), entry.stamps
        if stamps.durable_ns and not entry.is_correction:  # 0: journaled by an earlier server
            waited, fused = stamps.fuse_start_ns - stamps.durable_ns, stamps.fused_ns - stamps.fuse_start_ns
            self._clients.observe(self._name, "queue", waited / 1e9)
            self._clients.observe(self._name, "fuse", fused / 1e9)
        if entry.captured_ns and route is not None and route.offset_ns is not None:
            delay_ns = stamps.fused_ns - entry.captured_ns - route.offset_ns
            if self.delays.add(delay_ns, route.bound_ns):
                self._clients.observe(self._name, "total", delay_ns / 1e9)

    def _on_rejected(self, session: Session, entry: IndexEntry, done: fuser_messages.Done) -> None:
        assert done.reason is not None
        self._told_rejected.add(done.index)
        seq = entry.stamps.seq
        subject = logs.about(
            map=self._name, session=session.key, seq=seq, client=session.client, reason=done.reason
        )  # fmt: skip
        kind = "correction" if entry.is_correction else "keyframe"
        log.error("a %s is not in the map: %s", kind, done.message or done.reason, extra=subject)
        self._clients.send(session.key, messages.Nack(session.key, seq, "map", done.reason, done.message))
        try:
            frames = read(self._journal, entry.position).frames
        except JournalError:  # that is why it was rejected
            return
        self._quarantine.keep(frames, session=session.key, seq=seq, client=session.client, reason=done.reason)

    def on_meshed(self, meshed: fuser_messages.Meshed) -> None:
        """The fuser brought the mesh up to date."""
        self.blocks, self.map_bytes = meshed.map_blocks, meshed.map_bytes
        for _ in range(meshed.count - self._meshed):
            self._stamp_meshed(self.unmeshed.popleft(), meshed.meshed_ns)
        self._meshed = meshed.count

    def _stamp_meshed(self, index: int, meshed_ns: int) -> None:
        entry = self._index[index]
        if entry.stamps.fused_ns and not entry.is_correction:
            self._clients.observe(self._name, "mesh", (meshed_ns - entry.stamps.fused_ns) / 1e9)
        stamps = msgspec.structs.replace(entry.stamps, meshed_ns=meshed_ns)
        self.acknowledge(self._sessions.numbered(entry.session).key, [stamps])


_DELAYS = 1024
_LONGEST_DELAY_NS = 86_400 * 10**9  # a day


class DelayStatistics:
    """Capture to fused of the last keyframes."""

    def __init__(self) -> None:
        self._recent_ms: deque[tuple[float, float]] = deque(maxlen=_DELAYS)

    def add(self, delay_ns: int, bound_ns: int) -> bool:
        """A keyframe took so long, give or take the bound. False when that cannot be: it does not count."""
        if not -bound_ns <= delay_ns <= _LONGEST_DELAY_NS:
            return False
        self._recent_ms.append((delay_ns / 1e6, bound_ns / 1e6))
        return True

    @property
    def bound_ms(self) -> float:
        """The most that any of them can be wrong."""
        return max((bound for _, bound in self._recent_ms), default=0.0)

    def summary(self) -> Spread:
        """Mean, percentiles and maximum."""
        return keyframe_times.spread(np.array([delay for delay, _ in self._recent_ms]))
