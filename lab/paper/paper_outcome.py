# SPDX-License-Identifier: MIT
"""Figures of one run, from what its processes left."""

import csv
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from lab.paper.paper_events import SeenFrame, Story
from lab.paper.paper_limits import Death, Sample
from tsfusion.core.errors import DatasetError
from tsfusion.evaluation.trajectory_error import TrajectoryError, absolute_error
from tsfusion.pipelines.report import latency_ledger
from tsfusion.pipelines.runs.map_growth import GrowthRow
from tsfusion.wire.messages.health import Spread

OUTCOME, POSES = "outcome.json", "poses.npz"
DELAY, MEMORY = "delay.csv", "memory.csv"
_MIB = 1 << 20
LOST_FOR_GOOD = 20  # frames in a row without a pose: as an end counts the first time
_SETTLED_FROM = 0.5  # of a run: by then caches are full and kernels are loaded

Poses = NDArray[np.float64]


class MemoryRow(Struct, frozen=True):
    """Memory of a machine at a moment of a run, bytes; `other` is the process without map and queue."""

    seconds: float
    machine: str  # robot, server
    rss_bytes: int
    map_bytes: int
    queue_bytes: int

    @property
    def other_bytes(self) -> int:
        return self.rss_bytes - self.map_bytes - self.queue_bytes


class Outcome(Struct, frozen=True, kw_only=True):
    """Figures of one run.

    Attributes:
        machine: limits of the robot, in words.
        death: how the front end ended before its time, in words; empty = it did not. `died_of`: in a word:
            `memory`, `a lost sensor`.
        died_at: keyframes in the map by then; `died_frame`: index of the last frame it took, or located.
        planned, sent, fused: keyframes. `skipped`: those that never entered the map, by reason.
        ate: of the poses as they were given, live, over the frames that got one; None = fewer than two.
        corrected: of the poses after loop closure.
        cores: of processor time that the front end took, on average.
        growth_mib: of memory without map and queue, in the second half of the run, by least squares.
    """

    name: str
    world: str
    mode: str
    map: str
    number: int
    machine: str
    settings: str = ""  # of the run, as a fingerprint
    seconds: float = 0.0
    death: str = ""
    died_of: str = ""
    died_at: int | None = None
    died_frame: int | None = None
    frames: int = 0
    located: int = 0
    late: int = 0
    lost: int = 0
    planned: int = 0
    sent: int = 0
    fused: int = 0
    skipped: dict[str, int] = {}
    drained: bool = False
    delay_ms: Spread = Spread()
    slope_ms_per_keyframe: float = 0.0
    stages_ms: dict[str, Spread] = {}
    ate: TrajectoryError | None = None
    corrected: TrajectoryError | None = None
    loops: int = 0
    cores: float = 0.0
    robot_peak_bytes: int = 0
    server_peak_bytes: int = 0
    queue_peak: int = 0
    queue_peak_bytes: int = 0
    growth_mib: float = 0.0
    map_bytes: int = 0
    map_hash: str = ""
    expected_hash: str = ""  # that the map must have; empty = nothing to compare with
    notes: list[str] = []


def of_story(story: Story, rows: Sequence[MemoryRow], death: Death | None) -> dict[str, Any]:
    """The fields of an outcome that a front end's own words and its memory give."""
    ledger = latency_ledger.summarise(story.times)
    located = [frame for frame in story.frames if frame.T_world_camera is not None]
    last = story.frames[-1] if story.frames else None
    ended, fused = last, story.fused
    way_lost = _way_lost(story.frames) if death is None else None
    if way_lost is not None:
        ended, found = way_lost
        death = Death(
            "a lost sensor",
            f"the localizer lost its way behind frame {ended.index}, and "
            + ("never found it again" if found is None else f"found it again at frame {found.index} only"),
        )
        fused = sum(0 < record.sent_ns <= ended.done_ns and record.fused_ns > 0 for record in story.times)
    stats = story.closing.get("stats", {})
    return {
        "death": death.words if death else "",
        "died_of": death.of if death else "",
        "died_at": fused if death else None,
        "died_frame": ended.index if death and ended else None,
        "frames": len(story.frames), "located": len(located), "late": last.late if last else 0,
        "lost": len(story.frames) - len(located), "sent": len(story.times), "fused": story.fused,
        "skipped": {**stats.get("skipped", {}), **stats.get("rejected", {}), **stats.get("refused", {})},
        "drained": bool(story.closing.get("drained")), "loops": story.closing.get("loops", 0),
        "delay_ms": ledger.delay_ms, "slope_ms_per_keyframe": ledger.slope_ms_per_keyframe,
        "stages_ms": ledger.stages_ms, "cores": cores(story),
        "robot_peak_bytes": peak([row for row in rows if row.machine == "robot"]),
        "server_peak_bytes": peak([row for row in rows if row.machine == "server"]),
        "queue_peak": max((frame.queue for frame in story.frames), default=0),
        "queue_peak_bytes": max((frame.queue_bytes for frame in story.frames), default=0),
        "growth_mib": growth_mib(rows, until=_seconds(story)),
        "map_bytes": max((row.map_bytes for row in rows), default=0),
    }  # fmt: skip


def _way_lost(frames: Sequence[SeenFrame]) -> tuple[SeenFrame, SeenFrame | None] | None:
    """The last frame before the way was lost for good, and the one that found it again, if any did."""
    known = [number for number, frame in enumerate(frames) if frame.T_world_camera is not None]
    for number, following in zip(known, [*known[1:], len(frames)], strict=True):
        if following - number - 1 >= LOST_FOR_GOOD:
            return frames[number], frames[following] if following < len(frames) else None
    return None


def cores(story: Story) -> float:
    """Processor time of the front end a second, from its first frame to its last."""
    if len(story.frames) < 2:
        return 0.0
    first, last = story.frames[0], story.frames[-1]
    wall = (last.done_ns - first.done_ns) / 1e9
    return round((last.cpu_s - first.cpu_s) / wall, 3) if wall > 0 else 0.0


def peak(rows: Sequence[MemoryRow]) -> int:
    return max((row.rss_bytes for row in rows), default=0)


def _seconds(story: Story) -> float:
    """From the first frame's coming to the last one's pose."""
    if story.started_ns is None or not story.frames:
        return 0.0
    return (story.frames[-1].done_ns - story.started_ns) / 1e9


def memory_rows(story: Story, samples: Sequence[Sample], grown: Sequence[GrowthRow]) -> list[MemoryRow]:
    """Memory of both machines over a run's time, whose second 0 is the first frame's.

    Args:
        grown: of the server; their seconds are those of the monotonic clock.
    """
    begun = story.started_ns
    if begun is None:
        return []
    map_ns = np.array([t for t, _ in story.map_bytes] or [1 << 62])
    map_bytes = [0, *(size for _, size in story.map_bytes)]
    frame_ns = np.array([frame.done_ns for frame in story.frames] or [1 << 62])
    queue = [0, *(frame.queue_bytes for frame in story.frames)]
    rows = []
    for sample in samples:
        at_map = int(np.searchsorted(map_ns, sample.t_ns, side="right"))
        at_frame = int(np.searchsorted(frame_ns, sample.t_ns, side="right"))
        seconds = round((sample.t_ns - begun) / 1e9, 3)
        if seconds >= 0:
            rows.append(MemoryRow(seconds, "robot", sample.rss_bytes, map_bytes[at_map], queue[at_frame]))
    for row in grown:
        seconds = round(row.seconds - begun / 1e9, 3)
        if seconds >= 0:
            rows.append(MemoryRow(seconds, "server", row.server_bytes, row.map_bytes, 0))
    return rows


def growth_mib(rows: Sequence[MemoryRow], *, until: float = np.inf) -> float:
    """How much memory without map and queue grows in the second half of a run, over all machines, MiB.

    Args:
        until: second at which the run ends; what is left to do then is another matter.
    """
    total = 0.0
    for machine in ("robot", "server"):
        chosen = [row for row in rows if row.machine == machine and row.seconds <= until]
        end = max((row.seconds for row in chosen), default=0.0)
        late = [row for row in chosen if row.seconds >= _SETTLED_FROM * end]
        if len(late) > 2 and late[-1].seconds > late[0].seconds:
            slope = np.polyfit([row.seconds for row in late], [row.other_bytes for row in late], 1)[0]
            total += float(slope) * (late[-1].seconds - late[0].seconds) / _MIB
    return round(total, 2)


def error_until(poses: Path, last_frame: int | None = None) -> TrajectoryError | None:
    """ATE of a run's live poses, up to a frame of the recording; None = fewer than two of them.

    Every mode is cut at the same place of the recording, whatever frames it dropped before.
    """
    if not poses.is_file():
        return None
    with np.load(poses, allow_pickle=False) as kept:
        indices, estimate, truth = kept["indices"], kept["poses"], kept["truth"]
    chosen = np.isfinite(truth).all(axis=(1, 2))
    if last_frame is not None:
        chosen &= indices <= last_frame
    return error_of(estimate[chosen], truth[chosen])


def error_of(estimate: Poses, truth: Poses) -> TrajectoryError | None:
    """ATE of poses in pairs; None = fewer than two."""
    try:
        return absolute_error(estimate, truth)
    except DatasetError:
        return None


def write_memory(rows: Sequence[MemoryRow], path: Path) -> None:
    """Write a line a moment and machine."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["seconds", "machine", "rss_bytes", "map_bytes", "queue_bytes", "other_bytes"])
        for row in rows:
            writer.writerow([*msgspec.structs.astuple(row), row.other_bytes])


def write(outcome: Outcome, folder: Path) -> None:
    """Write an outcome: the last file of a run, which is done then."""
    text = msgspec.json.format(msgspec.json.encode(outcome), indent=2)
    partial = folder / f"{OUTCOME}.partial"
    partial.write_bytes(text + b"\n")
    partial.replace(folder / OUTCOME)


def read(folder: Path, settings: str = "") -> Outcome | None:
    """The outcome in a folder; None = the run is not done, or was made with other settings."""
    try:
        found = msgspec.json.decode((folder / OUTCOME).read_bytes(), type=Outcome)
    except (OSError, msgspec.DecodeError):
        return None
    return found if not settings or found.settings == settings else None
