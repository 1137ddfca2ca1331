# SPDX-License-Identifier: MIT
"""Lines that a front end writes as it goes, so that they outlive it however it ends, and what they tell."""

import json
import os
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import Struct, field
from numpy.typing import NDArray

from tsfusion.wire.messages.messages import KeyframeTimes


class EventLog:
    """Writes one JSON line an event, each at once: a process that is killed has written all before.

    Any thread may write.
    """

    def __init__(self, path: Path) -> None:
        self._file = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)

    def note(self, event: str, **more: Any) -> None:
        """Write an event with the time, monotonic nanoseconds."""
        line = json.dumps({"event": event, "t": time.monotonic_ns(), **more}, separators=(",", ":"))
        os.write(self._file, line.encode() + b"\n")  # one write: lines of two threads do not mix

    def close(self) -> None:
        os.close(self._file)


class SeenFrame(Struct, frozen=True, kw_only=True):
    """A frame that the front end took.

    Attributes:
        index: in the recording.
        due_ns, done_ns: when the sensor gave it, and when its pose was known; monotonic.
        T_world_camera: (4, 4); None = lost.
        late: frames dropped so far, as the front end was late.
        cpu_s: processor time of the front end's process so far.
        queue, queue_bytes: keyframes that wait at this moment, and their memory.
    """

    index: int
    due_ns: int
    done_ns: int
    T_world_camera: list[list[float]] | None
    late: int
    cpu_s: float
    rss_bytes: int
    queue: int
    queue_bytes: int


class Story(Struct, kw_only=True):
    """All that a front end wrote.

    Attributes:
        times: of its keyframes, in order; of those that were never fused the later stamps are 0.
        map_bytes: (monotonic ns, bytes) of the map, where it is in the same process.
        started_ns: when the first frame was due; None = it never came so far.
        ended: whether it came to its end by itself.
        closing: what it said at its end.
    """

    frames: list[SeenFrame] = field(default_factory=list)
    times: list[KeyframeTimes] = field(default_factory=list)
    map_bytes: list[tuple[int, int]] = field(default_factory=list)
    started_ns: int | None = None
    ended: bool = False
    closing: dict[str, Any] = field(default_factory=dict)

    @property
    def fused(self) -> int:
        return sum(record.fused_ns > 0 for record in self.times)

    def poses(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Indices of the frames with a pose, (n,), and their poses, (n, 4, 4)."""
        located = [frame for frame in self.frames if frame.T_world_camera is not None]
        indices = np.array([frame.index for frame in located], dtype=np.int64)
        return indices, np.array([frame.T_world_camera for frame in located]).reshape(-1, 4, 4)


def read(path: Path) -> Story:
    """The story in a file; a last line that a kill tore is left out."""
    if not path.is_file():
        return Story()
    return of(path.read_text(encoding="utf-8").splitlines())


def of(lines: Iterable[str]) -> Story:
    """The story of some lines."""
    story = Story()
    times: dict[int, KeyframeTimes] = {}
    for line in lines:
        try:
            event = json.loads(line)
        except ValueError:
            continue
        _tell(story, times, event)
    story.times = [times[seq] for seq in sorted(times)]
    return story


def _tell(story: Story, times: dict[int, KeyframeTimes], event: dict[str, Any]) -> None:
    kind = event["event"]
    if kind == "start":
        story.started_ns = event["t"]
    elif kind == "frame":
        names = (name for name in SeenFrame.__struct_fields__ if name != "done_ns")
        story.frames.append(SeenFrame(done_ns=event["t"], **{name: event[name] for name in names}))
    elif kind == "keyframe":
        times[event["seq"]] = KeyframeTimes(**{k: v for k, v in event.items() if k not in ("event", "t")})
    elif kind == "fused":
        record = times[event["seq"]]
        record.fuse_start_ns, record.fused_ns = event["fuse_start_ns"], event["t"]
        story.map_bytes.append((event["t"], event["map_bytes"]))
    elif kind == "end":
        story.ended = True
        story.closing = {k: v for k, v in event.items() if k not in ("event", "t")}
