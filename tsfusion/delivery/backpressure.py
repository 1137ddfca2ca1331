# SPDX-License-Identifier: MIT
"""Put keyframes and corrections into the spool, or skip them by a policy (`thin`, `block` …) and count them.

The policies act on the number of keyframes that the map lacks: those in the spool, and those on the server's
disk but not yet fused.

    thin         keeps everything until the map is `catch_up` seconds behind or the spool is nearly full; then
                 keeps 1 of n keyframes, so that the map can follow with less detail but without holes
    block        `send` waits: nothing is skipped, the sensor is held up (replays)
    drop_oldest  drops the oldest: the map follows the sensor closely, with holes (teleoperation)
    spool_all    keeps everything: the map may be long behind, but is complete (surveys)
"""

import logging
import math
import shutil
import time
from collections import deque
from typing import Any

from tsfusion.core import process
from tsfusion.core.config import ClientConfig
from tsfusion.core.errors import JournalError
from tsfusion.delivery.outbox import Outbox
from tsfusion.geometry.keyframe import Keyframe
from tsfusion.journal.writer import lacking
from tsfusion.wire.records import codec, corrections
from tsfusion.wire.records.corrections import Correction

log = logging.getLogger(__name__)


class Backpressure:
    """Puts records into the spool within the policy and the spool's limits. For one thread at a time."""

    def __init__(self, outbox: Outbox, config: ClientConfig) -> None:
        self._outbox = outbox
        self._config = config
        self._limits = SpoolLimits(outbox, config.spool_bytes, config.min_free_bytes)
        self._thinning = Thinning(outbox, config.catch_up)

    @property
    def must_wait(self) -> bool:
        """True if the policy `block` makes `send` wait, because enough keyframes wait already."""
        return self._config.policy == "block" and self._outbox.behind >= self._config.backlog

    def put(self, keyframe: Keyframe) -> int | None:
        """Put a keyframe into the spool; return its number there, or None if it was skipped.

        Raises:
            JournalError: any failure but the disk's; a keyframe that the disk refuses is skipped instead.
        """
        if self._config.policy == "thin" and (reason := self._thinning.reason(self._limits.room())):
            self._outbox.skip(reason)
            return None
        frames = codec.encode(
            keyframe,
            jpeg_quality=self._config.jpeg_quality,
            **self._addressed(),
        )
        return self._store(frames, keyframe)

    def put_correction(self, correction: Correction) -> int | None:
        """Put a correction into the spool; return its number there, or None if the spool or its disk is full.

        No policy thins corrections out or holds them up.

        Raises:
            JournalError: as `put`.
        """
        return self._store(corrections.encode(correction, **self._addressed()), None)

    def _addressed(self) -> dict[str, Any]:
        """Return header fields for the next record: its session, number, map and world."""
        spool = self._outbox.spool
        return {
            "session": spool.session,
            "seq": spool.next_seq,
            "map_name": self._config.map,
            "world": spool.world,
            "same_frame": spool.same_frame,
        }

    @process.uninterrupted()  # Ctrl-C would leave half a record, and hide what follows it
    def _store(self, frames: list[bytes], keyframe: Keyframe | None) -> int | None:
        outbox, nbytes = self._outbox, sum(map(len, frames))
        if reason := self._why_full(nbytes):
            outbox.skip(reason, is_correction=keyframe is None)
            return None
        try:
            entry = outbox.spool.write(frames)
        except JournalError as error:
            if error.errno is None:
                raise
            self._limits.on_failed_write(error)
            outbox.skip("disk", is_correction=keyframe is None)
            return None
        self._limits.on_write(nbytes)
        outbox.add(entry, keyframe)
        if keyframe is not None and self._config.policy == "drop_oldest":
            outbox.drop_to(self._config.backlog, entry.seq)
        return entry.seq

    def _why_full(self, nbytes: int) -> str:
        """Return the reason why the spool cannot keep `nbytes` more bytes; empty if it can."""
        while self._limits.is_full(nbytes):
            if self._config.policy != "drop_oldest" or not self._outbox.drop_oldest():
                self._limits.on_full()
                return "spool"
        return "disk" if self._limits.disk_refuses(nbytes) else ""


_ARRIVALS = 64  # keyframes of the sensor over which their rate is measured
_THINNEST = 16  # at least one of this many keyframes is kept
_LATEST = 3  # a map later than this many times `catch_up` is thinned no further


class Thinning:
    """Choice of the keyframes that the policy `thin` skips: none while map and spool keep up.

    Args:
        catch_up: seconds; limit for the lag of the map, and for the time until the spool is full.
    """

    def __init__(self, outbox: Outbox, catch_up: float) -> None:
        self._outbox = outbox
        self._catch_up = catch_up
        self._arrivals: deque[float] = deque(maxlen=_ARRIVALS)
        self._acts = False
        self._left_out = self._in_a_row = 0

    def reason(self, room: int) -> str:
        """Return why to skip the next keyframe: `thinned` (map lags) or `room` (full spool); empty = keep."""
        self._arrivals.append(self._outbox.clock())
        lag, full = self._outbox.lag, self._fullness(room)
        shortage = max(lag.seconds / self._catch_up, full)  # 1 = act, 0.5 = enough
        if full == math.inf:  # `SpoolLimits` says what is wrong
            return ""
        if shortage < (0.5 if self._acts else 1.0):
            self._end()
            return ""
        reason = "room" if full >= shortage else "thinned"
        one_of = self._one_of(shortage, 0.0 if reason == "room" else self._arrival_rate() / (lag.rate or 1.0))
        self._begin(self._why(reason, room), one_of)
        if self._in_a_row + 1 >= one_of:
            self._in_a_row = 0
            return ""
        self._in_a_row += 1
        self._left_out += 1
        return reason

    @staticmethod
    def _one_of(shortage: float, faster: float) -> int:
        """Return n, of which one keyframe is kept, so that the map gets no more keyframes than it can fuse.

        Args:
            faster: the sensor's rate divided by the map's rate; 0 = only the spool's room is short.
        """
        pressure = max(int(shortage), 1)
        return min((min(pressure, _LATEST) if faster else pressure) + max(int(faster), 1), _THINNEST)

    def _arrival_rate(self) -> float:
        """Return the keyframes per second that `send` was given lately."""
        seconds = self._arrivals[-1] - self._arrivals[0]
        return (len(self._arrivals) - 1) / seconds if seconds > 0 else 0.0

    def _fullness(self, room: int) -> float:
        """Return the bytes of the waiting keyframes, or of `catch_up` seconds if fewer, divided by the free
        bytes of the spool (`room`).

        So nothing is left out until the spool is half full: a small spool may soon be empty again.
        """
        _, waiting, nbytes = self._outbox.usage()
        if not waiting:
            return 0.0
        if room < nbytes / waiting:
            return math.inf
        return min(self._arrival_rate() * self._catch_up / waiting, 1.0) * nbytes / room

    def _why(self, reason: str, room: int) -> str:
        if reason == "room":
            return f"the spool {self._outbox.spool.folder} has room for {room / 1e6:.3g} MB more"
        lag = self._outbox.lag
        return (
            f"the map is {lag.seconds:.3g} s behind ({lag.keyframes} keyframes wait, it takes "
            f"{lag.rate or 0:.1f} a second, {self._arrival_rate():.1f} come; catch_up = {self._catch_up:g} s)"
        )

    def _begin(self, why: str, one_of: int) -> None:
        if not self._acts:
            self._acts, self._left_out = True, 0
            log.warning("keyframes are left out from here on, 1 of %d is kept: %s", one_of, why)

    def _end(self) -> None:
        if self._acts:
            self._acts, self._in_a_row = False, 0
            log.info("every keyframe is kept again; %d were left out", self._left_out)


_LOOK_INTERVAL = 0.25  # seconds between questions for the free space
_RETRY_INTERVAL = 0.5  # seconds until a disk that refused is tried again: each try may take long
_MAX_WAITING = 1_000_000  # records: some 200 bytes of memory each


class SpoolLimits:
    """Limits of a spool: its bytes, and the disk's free space; `outbox.state` shows a reached limit."""

    def __init__(self, outbox: Outbox, spool_bytes: int, min_free_bytes: int) -> None:
        self._outbox = outbox
        self._spool_bytes = spool_bytes
        self._min_free_bytes = min_free_bytes
        self._free = self._written = 0
        self._look_due = self._retry_due = 0.0

    def is_full(self, nbytes: int) -> bool:
        """Return True if `nbytes` more would exceed the spool's limit of bytes or of records."""
        used, *_ = self._outbox.usage()
        if used + nbytes > self._spool_bytes:
            self._outbox.tidy()
        used, waiting, _ = self._outbox.usage()
        return used + nbytes > self._spool_bytes or waiting >= _MAX_WAITING

    def room(self) -> int:
        """Return the bytes that the spool can still take, within its limit and the disk's free space."""
        used, *_ = self._outbox.usage()
        room = self._spool_bytes - used
        if self._min_free_bytes:
            now = time.monotonic()
            if now >= self._look_due:
                self._measure_free_space(now)
            room = min(room, self._free - self._written - self._min_free_bytes)
        return room

    def on_full(self) -> None:
        """Set `outbox.state` to `spool`: a keyframe is lost because the spool is full."""
        self._enter("spool", f"it has reached its limit of {self._spool_bytes} bytes (spool_bytes)")

    def disk_refuses(self, nbytes: int) -> bool:
        """Return True if the disk has just failed, or `nbytes` more would leave too little free space."""
        now = time.monotonic()
        if now < self._retry_due:
            return True
        if not self._min_free_bytes:
            return False
        wanted = self._min_free_bytes
        if self._outbox.state == "disk":
            wanted += wanted // 4  # else the state would end with each keyframe that leaves the spool
        if now >= self._look_due or self._free - self._written - nbytes < wanted:
            self._measure_free_space(now)
        free = self._free - self._written
        if free - nbytes >= wanted:
            return False
        self._retry_due = now + _RETRY_INTERVAL
        self._enter("disk", lacking(free, self._min_free_bytes))
        return True

    def on_failed_write(self, error: Exception) -> None:
        """Set `outbox.state` to `disk`: a record is lost because the disk did not take it."""
        self._retry_due = time.monotonic() + _RETRY_INTERVAL
        self._enter("disk", str(error))

    def on_write(self, nbytes: int) -> None:
        """Count `nbytes` written to the disk, and end the state of loss if the spool has room again."""
        self._written += nbytes
        state, (used, *_) = self._outbox.state, self._outbox.usage()
        if state == "disk" or (state == "spool" and used < 0.9 * self._spool_bytes):
            self._outbox.state, self._outbox.spool_problem = "ok", ""
            log.info("the spool %s takes every keyframe again", self._outbox.spool.folder)

    def _measure_free_space(self, now: float) -> None:
        self._look_due, self._written = now + _LOOK_INTERVAL, 0
        try:
            self._free = shutil.disk_usage(self._outbox.spool.folder).free
        except OSError:  # the write will say why
            self._free = 1 << 62

    def _enter(self, state: str, why: str) -> None:
        problem = f"the spool {self._outbox.spool.folder} cannot keep them: {why}"
        if self._outbox.state != state:
            log.error("keyframes are lost from here on: %s", problem)
        self._outbox.state, self._outbox.spool_problem = state, f"keyframes are lost: {problem}"
