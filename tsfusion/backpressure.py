# SPDX-License-Identifier: MIT
"""What becomes of a keyframe that is handed over: it goes into the spool, or is skipped and counted.

The policies act on how far the map is behind: on keyframes in the spool, and on those the server has on its
disk but not yet in the map. A link that is down and a map that is slow are the same to whoever scans.

    thin         1 of n is kept, n = 1 to 4 by how far behind: the map gets less detail, but no hole
    block        `send` waits: nothing is skipped, the sensor is held up (replays)
    drop_oldest  the oldest goes: the map follows the sensor closely, with holes (teleoperation)
    spool_all    everything is kept: the map may be long behind, and complete (surveys)
"""

from tsfusion import codec, process
from tsfusion.config import ClientConfig
from tsfusion.errors import JournalError
from tsfusion.keyframe import Keyframe
from tsfusion.outbox import Outbox
from tsfusion.room import Room
from tsfusion.spool import Waiting

_THINNEST = 4


class Backpressure:
    """The door of the spool, for one thread at a time."""

    def __init__(self, outbox: Outbox, config: ClientConfig) -> None:
        self._outbox = outbox
        self._config = config
        self._room = Room(outbox, config.spool_bytes, config.min_free_bytes)
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
        with process.uninterrupted():  # Ctrl-C would leave half a record, and hide what follows it
            return self._store(frames, keyframe)

    def _is_thinned_out(self) -> bool:
        one_of = 1 + min(self._outbox.behind // self._config.backlog, _THINNEST - 1)
        thinned_out = self._passed_over + 1 < one_of
        self._passed_over = self._passed_over + 1 if thinned_out else 0
        return thinned_out

    def _store(self, frames: list[bytes], keyframe: Keyframe) -> int | None:
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
