# SPDX-License-Identifier: MIT
"""A scanner as a process of its own, that may be killed at any moment and started again.

    python lab/reliability/scanner_process.py '{"address": …, "spool": …}'

Keyframe number i carries i in its `timestamp_ns`. A scanner that comes back decides by looking which ones
were taken: what is in the spool or in the server's journal was, whatever its predecessor lived to say of it.
"""

import os
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "support"))
sys.path.append(str(Path(__file__).parents[2]))  # lab is not installed
from keyframes_and_servers import NUMBERED_NS, pose, wall
from msgspec import Struct

from tsfusion import Client, Intrinsics, Keyframe, journal
from tsfusion.core.config import SERVER_SESSION, ClientConfig
from tsfusion.wire.messages.messages import KeyframeTimes
from tsfusion.wire.records.record_header import CorrectionHeader, unpack, unpack_keyframe

LOST = 3  # exit status


class Plan(Struct, kw_only=True):
    """Orders for a scanner process.

    Attributes:
        address, control: of the server.
        spool: its folder.
        state: the server's folder, to see what was taken before.
        count: keyframes to send, all lives together.
        first, step: which numbers below `count` are this scanner's; the others have others.
        rate: of sending, a second; None = as fast as `send` returns (`block`: as the map follows).
        correct_every: after each keyframe whose number is a multiple of this comes a correction that carries
            the number in its `T_map_odometry`; 0 = none.
        log: a line is on the disk here for each `send` that returned.
        trimmed: the server deletes old parts of its journal: what is logged was taken, wherever it is now.
        report: where the `Report` goes when all is fused.
        erased: a file of numbers, a line each, that were erased from the journal; None = none are.
        room: a file of `save_room`, seen again and again; None = `wire.wall`s, each elsewhere.
        until: sends no more once this file is there.
        patience: seconds to wait for the map in the end.
    """

    address: str
    spool: str
    state: str
    count: int
    first: int = 0
    step: int = 1
    control: str | None = None
    rate: float | None = None
    correct_every: int = 0
    log: str | None = None
    trimmed: bool = False
    report: str | None = None
    erased: str | None = None
    room: str | None = None
    until: str | None = None
    patience: float = 120.0
    client: ClientConfig = ClientConfig()


def plan_in(folder: Path, address: str, **more: Any) -> Plan:
    """Orders for a scanner whose spool, report and server's state lie in a folder."""
    places = {"spool": "spool", "state": "state", "report": "report.json"}
    paths = {name: str(folder / place) for name, place in places.items()}
    return Plan(**{"address": address, **paths, **more})


class Report(Struct, kw_only=True):
    """Counts of the process that saw everything fused."""

    sent: int
    durable: int
    fused: int
    refused: dict[str, int]
    rejected: dict[str, int]
    skipped: dict[str, int]
    seconds: float
    cpu_seconds: float
    times: list[KeyframeTimes]


def numbers(folder: Path) -> list[int]:
    """Which keyframes lie in a spool or journal folder, in its order."""
    return [
        unpack_keyframe(record.frames[0]).timestamp_ns - NUMBERED_NS
        for record in _records(folder)
        if not record.is_correction
    ]


def corrections(folder: Path) -> list[int]:
    """The numbers that corrections in a spool or journal folder carry, in its order."""
    found = [record for record in _records(folder) if record.is_correction]
    return [correction_number(record) for record in found if record.session != SERVER_SESSION]


def correction_number(record: journal.Record) -> int:
    """The number that `scan` gave a correction."""
    header = unpack(record.frames[0])
    assert isinstance(header, CorrectionHeader)
    assert header.T_map_odometry is not None
    return round(header.T_map_odometry[3])


def _records(folder: Path) -> Iterator[journal.Record]:
    for number in journal.segments(folder):
        yield from journal.records(journal.segment_path(folder, number))


def journals(state: Path) -> list[Path]:
    """The journal folders of a state folder, one a map."""
    return [*state.glob("maps/*/journal"), *state.glob("journal")]


def save_room(path: Path, count: int, width: int) -> None:
    """Views of the synthetic room, so that it is rendered once and not by each scanner."""
    from tsfusion.datasets.worlds.synthetic import Synthetic

    views = list(Synthetic("room", count=count, width=width, path="tour"))
    camera = views[0].intrinsics
    assert camera is not None
    np.savez(
        path,
        depth=np.stack([np.asarray(view.depth) for view in views]),
        color=np.stack([np.asarray(view.color) for view in views]),
        pose=np.stack([view.T_world_camera for view in views]),
        camera=np.array(msgspec.structs.astuple(camera)),
        scale=np.array(views[0].depth_scale),
    )


def source(room: str | None) -> Callable[..., Keyframe]:
    """Keyframes by number."""
    if room is None:
        return wall
    names = ("depth", "color", "pose", "camera", "scale")
    with np.load(room) as file:
        depth, color, pose, camera, scale = (file[name] for name in names)

    def view(i: int, captured_ns: int = 0) -> Keyframe:
        at = i % len(depth)
        return Keyframe(
            depth=depth[at],
            color=color[at],
            T_world_camera=pose[at],
            intrinsics=Intrinsics(*camera.tolist()),
            depth_scale=float(scale),
            timestamp_ns=NUMBERED_NS + i,
            captured_ns=captured_ns,
        )

    return view


def unsent(plan: Plan) -> range:
    """The numbers to go on with; ends the process when something that was taken is nowhere any more."""
    own = range(plan.first, plan.count, plan.step)
    taken = set(numbers(Path(plan.spool))) if Path(plan.spool).is_dir() else set()
    for folder in journals(Path(plan.state)):
        taken.update(numbers(folder))
    taken.update(map(int, _lines(plan.erased)))
    logged = {int(line) for line in _lines(plan.log)}
    if plan.trimmed and plan.log is not None:  # what was not logged for a kill may be found no more, later
        with Path(plan.log).open("a") as log:
            log.writelines(f"\n{i}\n" for i in sorted(taken & set(own) - logged))
    taken = (taken | logged if plan.trimmed else taken) & set(own)
    if logged - taken or taken != set(own[: len(taken)]):
        sys.stderr.write(f"taken {sorted(taken)}, but logged {sorted(logged)}\n")
        sys.exit(LOST)
    return own[len(taken) :]


def uncorrected(plan: Plan, left: range) -> list[int]:
    """The corrections of keyframes that were taken, which an earlier life did not come to send."""
    due = [i for i in range(plan.first, plan.count, plan.step) if i not in left and _corrects(plan, i)]
    folders = [Path(plan.spool)] if Path(plan.spool).is_dir() else []
    sent = {i for folder in [*folders, *journals(Path(plan.state))] for i in corrections(folder)}
    return [i for i in due if i not in sent]


def _corrects(plan: Plan, i: int) -> bool:
    return plan.correct_every > 0 and i % plan.correct_every == 0


def _lines(log: str | None) -> list[str]:
    if log is None or not Path(log).exists():
        return []
    return [line for line in Path(log).read_text().split("\n")[:-1] if line]  # the last one may be torn


def scan(plan: Plan) -> Report:
    """Send what is left and see it fused."""
    left, keyframe = unsent(plan), source(plan.room)
    late = uncorrected(plan, left)
    with (
        Path(os.devnull if plan.log is None else plan.log).open("ab", buffering=0) as log,
        Client(plan.address, spool=plan.spool, control=plan.control, config=plan.client) as client,
    ):
        for i in late:
            client.correct({}, T_map_odometry=pose(i))
        started = due = time.monotonic()
        for i in left:
            if plan.until is not None and Path(plan.until).exists():
                break
            if plan.rate is not None:
                due = max(due + 1 / plan.rate, time.monotonic())
                time.sleep(max(due - time.monotonic(), 0))
            seq = client.send(keyframe(i, captured_ns=time.monotonic_ns()))
            if seq is None:
                continue  # skipped, by its policy: the report counts it
            log.write(f"\n{i}\n".encode())  # a torn line ends at the next one's beginning
            if plan.log is not None:
                os.fdatasync(log.fileno())
            if _corrects(plan, i):
                client.correct({seq: pose(i)}, T_map_odometry=pose(i))
        client.wait_fused(timeout=plan.patience)
        stats, times = client.stats, client.records
        seconds = time.monotonic() - started
    names = ("sent", "durable", "fused", "refused", "rejected", "skipped")
    counts: dict[str, Any] = {name: getattr(stats, name) for name in names}
    return Report(seconds=seconds, cpu_seconds=time.process_time(), times=times, **counts)


def main() -> None:
    plan = msgspec.json.decode(sys.argv[1], type=Plan)
    report = scan(plan)
    if plan.report is not None:
        Path(plan.report).write_bytes(msgspec.json.encode(report))


if __name__ == "__main__":
    main()
