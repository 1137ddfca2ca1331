# SPDX-License-Identifier: MIT
"""What becomes of a keyframe that is handed over: it goes into the spool, or is skipped and counted.

The policies act on how far the map is behind: on keyframes in the spool, and on those the server has on its
disk but not yet in the map. A link that is down and a map that is slow are the same to whoever scans.

    thin         1 of n is kept, n = 1 to 4 by how far behind: the map gets less detail, but no hole
    block        `send` waits: nothing is skipped, the sensor is held up (replays)
    drop_oldest  the oldest goes: the map follows the sensor closely, with holes (teleoperation)
    spool_all    everything is kept: the map may be long behind, and complete (surveys)
"""

import logging
import time

from tsfusion.core import durable_files, process
from tsfusion.core.config import ClientConfig
from tsfusion.core.errors import JournalError
from tsfusion.delivery.outbox import Outbox
from tsfusion.delivery.spool import Waiting
from tsfusion.geometry.keyframe import Keyframe
from tsfusion.wire import codec, corrections
from tsfusion.wire.corrections import Correction

_THINNEST = 4


class Backpressure:
    """The door of the spool, for one thread at a time."""

    def __init__(self, outbox: Outbox, config: ClientConfig) -> None:
        self._outbox = outbox
        self._config = config
        self._room = SpoolLimits(outbox, config.spool_bytes, config.min_free_bytes)
        self._passed_over = 0

    @property
    def must_wait(self) -> bool:
        """Whether the policy lets nothing in for now."""
        return self._config.policy == "block" and self._outbox.behind >= self._config.backlog

    def put(self, keyframe: Keyframe) -> int | None:
        """The number under which the keyframe is in the spool; None = it was skipped.

        Raises:
            JournalError: never for what the disk refuses; that is skipped.
        """
        box = self._outbox
        with box.changed:
            if self._config.policy == "thin" and self._is_thinned_out():
                box.skipped["thinned"] += 1
                return None
        frames = codec.encode(
            keyframe,
            session=box.spool.session,
            seq=box.spool.next_seq,
            map_name=self._config.map,
            jpeg_quality=self._config.jpeg_quality,
        )
        return self._store(frames, keyframe)

    def put_correction(self, correction: Correction) -> int | None:
        """The number under which the correction is in the spool; None = its limit or disk refused it.

        No policy thins corrections out or holds them up.

        Raises:
            JournalError: as `put`.
        """
        box = self._outbox
        frames = corrections.encode(
            correction, session=box.spool.session, seq=box.spool.next_seq, map_name=self._config.map
        )
        return self._store(frames, None)

    def _is_thinned_out(self) -> bool:
        one_of = 1 + min(self._outbox.behind // self._config.backlog, _THINNEST - 1)
        thinned_out = self._passed_over + 1 < one_of
        self._passed_over = self._passed_over + 1 if thinned_out else 0
        return thinned_out

    def _store(self, frames: list[bytes], keyframe: Keyframe | None) -> int | None:
        with process.uninterrupted():  # Ctrl-C would leave half a record, and hide what follows it
            return self._write(frames, keyframe)

    def _write(self, frames: list[bytes], keyframe: Keyframe | None) -> int | None:
        box, nbytes = self._outbox, sum(map(len, frames))
        with box.changed:
            if reason := self._no_room(nbytes):
                box.skipped[reason] += 1
                return None
        try:
            entry = box.spool.write(frames)
        except JournalError as error:
            if not isinstance(error.__cause__, OSError):
                raise
            with box.changed:
                self._room.failed(error)
                box.skipped["disk"] += 1
            return None
        with box.changed:
            self._room.took(nbytes)
            box.add(entry, keyframe)
            if keyframe is not None:
                self._drop_to_backlog(entry)
        return entry.seq

    def _no_room(self, nbytes: int) -> str:
        while self._room.full(nbytes):
            if self._config.policy != "drop_oldest" or not self._outbox.drop_oldest_unsent():
                self._room.is_full()
                return "spool"
        return "disk" if self._room.disk_refuses(nbytes) else ""

    def _drop_to_backlog(self, newest: Waiting) -> None:
        if self._config.policy == "drop_oldest":
            while self._outbox.behind > self._config.backlog:
                if not self._outbox.drop_oldest_unsent(newest.seq):
                    return


log = logging.getLogger(__name__)

_LOOK_INTERVAL = 0.25  # seconds between questions for the free space
_RETRY_INTERVAL = 0.5  # seconds until a disk that refused is tried again: each try may take long
_MAX_WAITING = 1_000_000  # keyframes: some 200 bytes of memory each


class SpoolLimits:
    """The limits of a spool. Call under `outbox.changed`; what it says stands in `outbox.state`.

    Args:
        spool_bytes: of the disk the spool may take.
        min_free_bytes: stay free on it.
    """

    def __init__(self, outbox: Outbox, spool_bytes: int, min_free_bytes: int) -> None:
        self._outbox = outbox
        self._spool_bytes = spool_bytes
        self._min_free_bytes = min_free_bytes
        self._free = self._written = 0
        self._look_due = self._retry_due = 0.0

    def full(self, nbytes: int) -> bool:
        """Whether the spool would pass its own limit with so many bytes more."""
        spool = self._outbox.spool
        if spool.used_bytes + nbytes > self._spool_bytes:
            spool.tidy()
        return spool.used_bytes + nbytes > self._spool_bytes or len(spool.waiting) >= _MAX_WAITING

    def is_full(self) -> None:
        """The spool is at its limit, and nothing could be dropped."""
        self._enter("spool", f"it has reached its limit of {self._spool_bytes} bytes (spool_bytes)")

    def disk_refuses(self, nbytes: int) -> bool:
        """Whether the disk has failed just now, or would have too little left with so many bytes more."""
        now = time.monotonic()
        if now < self._retry_due:
            return True
        if not self._min_free_bytes:
            return False
        wanted = self._min_free_bytes
        if self._outbox.state == "disk":
            wanted += wanted // 4  # else each keyframe that leaves the spool would end the state
        if now >= self._look_due or self._free - self._written - nbytes < wanted:
            self._look(now)
        free = self._free - self._written
        if free - nbytes >= wanted:
            return False
        self._retry_due = now + _RETRY_INTERVAL
        self._enter("disk", f"its disk has {free} bytes left, {self._min_free_bytes} must stay free")
        return True

    def failed(self, error: Exception) -> None:
        """The disk would not take a keyframe."""
        self._retry_due = time.monotonic() + _RETRY_INTERVAL
        self._enter("disk", str(error))

    def took(self, nbytes: int) -> None:
        """The disk took a keyframe."""
        self._written += nbytes
        state = self._outbox.state
        if state == "disk" or (state == "spool" and self._outbox.spool.used_bytes < 0.9 * self._spool_bytes):
            self._outbox.state = "ok"
            log.info("the spool %s takes every keyframe again", self._outbox.spool.folder)

    def _look(self, now: float) -> None:
        self._look_due, self._written = now + _LOOK_INTERVAL, 0
        try:
            self._free = durable_files.free_bytes(self._outbox.spool.folder)
        except OSError:  # the write will say why
            self._free = 1 << 62

    def _enter(self, state: str, why: str) -> None:
        if self._outbox.state != state:
            self._outbox.state = state
            log.error(
                "keyframes are lost from here on: the spool %s cannot keep them: %s",
                self._outbox.spool.folder, why,
            )  # fmt: skip
