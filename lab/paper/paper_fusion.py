# SPDX-License-Identifier: MIT
"""Fusion in the process that localises: the paper's "traditional" design, built of this project's own parts.

The same kernels and the same map as in the server, in a thread beside the localizer. A Taichi
kernel holds Python's global lock for its whole run, so the localizer stands still while a keyframe is fused:
that is what the design suffers from here, besides the queue between both.
"""

import threading
import time
from collections import Counter, deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lab.paper.paper_events import EventLog
from tsfusion.core.config import VolumeConfig
from tsfusion.core.errors import MapError
from tsfusion.delivery.outcomes import ClientStats
from tsfusion.geometry.keyframe import Keyframe
from tsfusion.wire.messages.messages import KeyframeTimes

_START_S = 180.0  # a cold compilation


class FusionBeside:
    """A stand-in for a `Scanner`'s client: a queue, and a thread that fuses what is in it.

    Args:
        bounded: a new keyframe replaces the one that waits; else all of them wait.
        log: each keyframe's stamps go there.
    """

    def __init__(self, config: VolumeConfig, *, bounded: bool, log: EventLog) -> None:
        self._config, self._bounded, self._log = config, bounded, log
        self._waiting: deque[tuple[int, Keyframe]] = deque()
        self._changed = threading.Condition()
        self._sent = self._fused = 0
        self._busy = self._closing = False
        self._skipped: Counter[str] = Counter()
        self._rejected: Counter[str] = Counter()
        self._failure: BaseException | None = None
        self._ready = threading.Event()
        self._keep: Path | None = None
        self.map_hash = ""
        self.first_rejection = self.problem = ""
        self.newest_fused: KeyframeTimes | None = None
        self._thread = threading.Thread(target=self._run, name="fusion", daemon=True)
        self._thread.start()
        if not self._ready.wait(_START_S):
            raise TimeoutError(f"the kernels were not compiled within {_START_S:.0f} s")
        self._check()

    def send(self, keyframe: Keyframe) -> int:
        """Put a keyframe into the queue."""
        self._check()
        now = time.monotonic_ns()
        with self._changed:
            self._sent += 1
            seq = self._sent
            stamps = dict.fromkeys(("sent_ns", "received_ns", "durable_ns"), now)
            self._log.note("keyframe", seq=seq, timestamp_ns=keyframe.timestamp_ns,
                           captured_ns=keyframe.captured_ns, **stamps)  # fmt: skip
            if self._bounded and self._waiting:
                self._waiting.clear()
                self._skipped["replaced"] += 1
            self._waiting.append((seq, keyframe))
            self._changed.notify_all()
        return seq

    def correct(self, poses: Mapping[int, NDArray[np.float64]], **_more: Any) -> None:
        """Corrections are not part of the paper's design."""

    @property
    def stats(self) -> ClientStats:
        """The counts, as those of a client."""
        with self._changed:
            return ClientStats(
                sent=self._sent, durable=self._sent, fused=self._fused, refused={},
                rejected=dict(self._rejected), skipped=dict(self._skipped), waiting=len(self._waiting),
                waiting_bytes=sum(_bytes(keyframe) for _, keyframe in self._waiting), state="ok",
            )  # fmt: skip

    def finish(self, seconds: float, keep: Path) -> bool:
        """Fuse what waits, for so long at most, and save the map; whether nothing waits any more."""
        with self._changed:
            done = self._changed.wait_for(lambda: self._failure or not (self._waiting or self._busy), seconds)
            self._waiting.clear()
            self._keep, self._closing = keep, True
            self._changed.notify_all()
        self._thread.join()
        self._check()
        return bool(done)

    def _check(self) -> None:
        if self._failure is not None:
            raise self._failure

    def _run(self) -> None:
        """Compile the kernels, fuse until the end, save; a failure is raised in the scanner's thread."""
        try:
            self._fuse_all()
        except BaseException as error:  # noqa: BLE001
            with self._changed:
                self._failure = error
                self._changed.notify_all()
            self._ready.set()

    def _fuse_all(self) -> None:
        from tsfusion.tsdf.volume import Volume

        volume = Volume(self._config)
        volume.warm_up()
        self._ready.set()
        while (taken := self._take()) is not None:
            self._fuse(volume, *taken)
        assert self._keep is not None
        self.map_hash = volume.map_hash()
        volume.save(self._keep)

    def _take(self) -> tuple[int, Keyframe] | None:
        """The oldest keyframe that waits, as soon as there is one; None = the end."""
        with self._changed:
            self._busy = False
            self._changed.notify_all()
            while not self._waiting:
                if self._closing:
                    return None
                self._changed.wait()
            self._busy = True
            return self._waiting.popleft()

    def _fuse(self, volume: Any, seq: int, keyframe: Keyframe) -> None:
        started = time.monotonic_ns()
        try:
            volume.integrate(keyframe)
        except MapError as error:
            self._rejected[type(error).__name__] += 1
            self.first_rejection = self.first_rejection or str(error)
            return
        self._fused += 1
        self._log.note("fused", seq=seq, fuse_start_ns=started, map_bytes=volume.stats().bytes)


def _bytes(keyframe: Keyframe) -> int:
    """Memory of a keyframe that waits."""
    arrays = (keyframe.depth, keyframe.disparity, keyframe.points, keyframe.color, keyframe.confidence)
    return sum(array.nbytes for array in arrays if array is not None)
