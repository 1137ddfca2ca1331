# SPDX-License-Identifier: MIT
"""A model of what servers hold and of what `tsfusion fuse` takes, simulated with SimPy, checked against what
lab/bench/fleet.py and lab/bench/cluster.py measured.

    python lab/bench/capacity.py                          the committed points, the check, a city
    python lab/bench/capacity.py points.jsonl --json      other points: lines that lab/bench/fleet.py printed
    python lab/bench/capacity.py --fuse lines.jsonl       … that lab/bench/cluster.py printed

A gateway is one thread: it takes up to 16 keyframes that came, works on each, waits once for the disk, and
answers. The wait for the disk is the floor that was measured without a server, and what the run added to it
(`--disk-wait`). Two numbers are fitted to two runs: its work on a keyframe, and the way of an answer to the
scanner and of the next keyframe back.

`tsfusion fuse` is jobs that take turns on the cores: a worker's start and its share of the keyframes, the
addition of the parts, a share of the mesh each, and its assembly. Two runs of one worker and one of two are
fitted: the shortest, and the longest.

All other points are predicted, and the script fails when one is off by more than 15 %.
"""

import argparse
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import simpy
from msgspec import Struct
from msgspec.structs import replace

from tsfusion.cluster import tiling

DOCS = Path(__file__).parents[2] / "docs"
POINTS, FUSE_POINTS = DOCS / "scale-points.jsonl", DOCS / "fuse-points.jsonl"
FIT, FIT_DISK_WAIT_MS = (1, 10), 5  # scanners
TOLERANCE = 0.15
WINDOW = 8  # keyframes under way of a scanner (`window_keyframes`)
BATCH = 16  # keyframes that a gateway reads before the others have their turn
SIMULATED_S = 2.0
Row = dict[str, Any]


class Gateway(Struct, frozen=True):
    """Seconds of a gateway: of its work on a keyframe, of a wait for the disk, of the way there and back."""

    work: float
    wait: float
    wait_more: float  # for each further keyframe of a batch
    way: float


def simulate_gateway(model: Gateway, scanners: int) -> float:
    """Durable keyframes a second of scanners that send as many as the server's credit allows."""
    env = simpy.Environment()
    came: simpy.Store = simpy.Store(env)
    written = 0

    def send(delay: float) -> Iterator[Any]:
        yield env.timeout(delay)
        yield came.put(None)

    def serve() -> Iterator[Any]:
        nonlocal written
        while True:
            yield came.get()
            count = 1
            while came.items and count < BATCH:
                yield came.get()
                count += 1
            yield env.timeout(count * (model.work + model.wait_more) + model.wait)
            written += count
            for _ in range(count):
                env.process(send(model.way))

    env.process(serve())
    for _ in range(WINDOW * scanners):
        env.process(send(0.0))
    env.run(until=SIMULATED_S)
    return float(written) / SIMULATED_S


def fit_gateway(rows: list[Row]) -> Gateway:
    """The gateway, without a disk, whose throughput is that of the fitted runs.

    The run with many scanners shows its work, whatever the way is, and the one with a single scanner the way.
    """
    few, many = sorted((row for row in rows if _is_fitted(row)), key=lambda row: int(row["scanners"]))

    def error(model: Gateway, row: Row) -> float:
        found = simulate_gateway(_with_disk(model, row), row["scanners"])
        return abs(found / float(row["durable_a_second"]) - 1.0)

    steps = [1.05**step for step in range(60)]
    work = min((0.0001 * step for step in steps), key=lambda one: error(Gateway(one, 0.0, 0.0, 0.001), many))
    way = min((0.0003 * step for step in steps), key=lambda one: error(Gateway(work, 0.0, 0.0, one), few))
    return Gateway(work, 0.0, 0.0, way)


def _with_disk(model: Gateway, row: Row) -> Gateway:
    """The gateway with the disk of a run: its floor, and what each wait was made longer by."""
    one, eight = 1.0 / row["floor"]["one_a_second"], 8.0 / row["floor"]["eight_a_second"]
    more = max((eight - one) / 7, 0.0)
    return replace(model, wait=max(one - more, 0.0) + row["disk_wait_ms"] / 1e3, wait_more=more)


def _is_fitted(row: Row) -> bool:
    return row["scanners"] in FIT and row["disk_wait_ms"] == FIT_DISK_WAIT_MS


def check(rows: list[Row]) -> tuple[Gateway, list[Row]]:
    """The fitted gateway, and each measured point beside the prediction."""
    gateway = fit_gateway(rows)
    table = []
    for row in rows:
        predicted = simulate_gateway(_with_disk(gateway, row), row["scanners"])
        table.append({
            "scanners": row["scanners"], "disk_wait_ms": row["disk_wait_ms"],
            "measured": row["durable_a_second"], "predicted": round(predicted, 1),
            "error": round(predicted / row["durable_a_second"] - 1.0, 3), "fitted": _is_fitted(row),
        })  # fmt: skip
    return gateway, table


# --- fusing a journal ---

TURN_S = 0.05  # of a job on a core, while others wait for one


class Fusing(Struct, frozen=True):
    """Seconds of `tsfusion fuse`: of the command beside its jobs; until a worker fuses, a keyframe; of adding
    a block; until a worker meshes, a block; of putting the mesh of a block into the whole one."""

    command: float
    start: float
    keyframe: float
    adding: float
    mesh_start: float
    meshing: float
    joining: float


def simulate_fusing(model: Fusing, keyframes: int, blocks: int, workers: int, cores: int) -> float:
    """Seconds of a whole run."""
    env = simpy.Environment()
    machine = simpy.Resource(env, cores)

    def job(seconds: float) -> Iterator[Any]:
        while seconds > 0:
            with machine.request() as turn:
                yield turn
                yield env.timeout(min(seconds, TURN_S))
            seconds -= TURN_S

    def run() -> Iterator[Any]:
        yield env.timeout(model.command)
        share = model.start + model.keyframe * keyframes / workers
        yield env.all_of([env.process(job(share)) for _ in range(workers)])
        if workers > 1:
            yield env.process(job(model.adding * blocks))
        runs = len(tiling.shares(blocks, workers)) or 1
        share = model.mesh_start + model.meshing * blocks / runs
        yield env.all_of([env.process(job(share)) for _ in range(runs)])
        if runs > 1:
            yield env.process(job(model.joining * blocks))

    env.run(until=env.process(run()))
    return float(env.now)


def fit_fusing(rows: list[Row]) -> Fusing:
    """The times that make up the three fitted runs."""
    short, long = (min(_alone(rows), key=_keyframes), max(_alone(rows), key=_keyframes))
    pair = next(row for row in rows if _is_pair(row, rows))
    more, blocks = long["keyframes"] - short["keyframes"], long["blocks"] - short["blocks"]
    keyframe = (long["seconds"]["fusing"] - short["seconds"]["fusing"]) / more
    meshing = (long["seconds"]["meshing"] - short["seconds"]["meshing"]) / blocks
    mesh_start = long["seconds"]["meshing"] - meshing * long["blocks"]
    beside = [row["whole_seconds"] - sum(row["seconds"].values()) for row in (short, long, pair)]
    together = pair["seconds"]["meshing"] - mesh_start - meshing * pair["blocks"] / 2
    return Fusing(
        command=sum(beside) / len(beside),
        start=long["seconds"]["fusing"] - keyframe * long["keyframes"],
        keyframe=keyframe,
        adding=pair["seconds"]["adding"] / pair["blocks"],
        mesh_start=mesh_start,
        meshing=meshing,
        joining=max(together, 0.0) / pair["blocks"],
    )


def _keyframes(row: Row) -> int:
    return int(row["keyframes"])


def _alone(rows: list[Row]) -> list[Row]:
    return [row for row in rows if row["workers"] == 1]


def _is_pair(row: Row, rows: list[Row]) -> bool:
    """True for the longest run of two workers."""
    return bool(row["workers"] == 2 and row["keyframes"] == max(map(_keyframes, rows)))


def check_fusing(rows: list[Row]) -> tuple[Fusing, list[Row]]:
    """The fitted times, and each measured run beside the prediction."""
    model, table = fit_fusing(rows), []
    ends = {min(map(_keyframes, _alone(rows))), max(map(_keyframes, _alone(rows)))}
    for row in rows:
        predicted = simulate_fusing(model, row["keyframes"], row["blocks"], row["workers"], row["cores"])
        table.append({
            "workers": row["workers"], "keyframes": row["keyframes"], "measured": row["whole_seconds"],
            "predicted": round(predicted, 1), "error": round(predicted / row["whole_seconds"] - 1.0, 3),
            "fitted": (row["workers"] == 1 and row["keyframes"] in ends) or _is_pair(row, rows),
        })  # fmt: skip
    return model, table


# --- a city ---

CORES = 16  # of a machine
READ_BYTES_S = 1e9  # of its disk
METRES, METRES_A_KEYFRAME = 1e7, 1.0  # 10,000 km of street
# docs/memory.md, the synthetic street at 15 cm: 2,000 keyframes, 2 km, a map of 2954 MB, 15.7 CPU s, of which
# one mesh in tiles takes 10.2 s for 458 MB
BLOCK_BYTES = 10240
BLOCKS_A_METRE = 2954e6 / BLOCK_BYTES / 2000
FUSING_S, MESHING_S_A_BLOCK = 15.7 / 2000, 10.2 / (458e6 / BLOCK_BYTES)
MOST_BLOCKS = 4_000_000  # of a map (`max_blocks`)


def city(machines: int, keyframe_bytes: int) -> Row:
    """Time until a city is fused and meshed anew from its journals, on machines that share the maps."""
    maps = round(METRES * BLOCKS_A_METRE / MOST_BLOCKS + 0.5)
    metres = METRES / maps
    env = simpy.Environment()
    work = simpy.Store(env)
    work.items.extend(range(maps))
    disks = [simpy.Resource(env, 1) for _ in range(machines)]
    ended = []

    def core(machine: int) -> Iterator[Any]:
        while work.items:
            yield work.get()
            with disks[machine].request() as turn:
                yield turn
                yield env.timeout(metres / METRES_A_KEYFRAME * keyframe_bytes / READ_BYTES_S)
            blocks = metres * BLOCKS_A_METRE
            yield env.timeout(metres / METRES_A_KEYFRAME * FUSING_S + blocks * MESHING_S_A_BLOCK)
            with disks[machine].request() as turn:
                yield turn
                yield env.timeout(blocks * BLOCK_BYTES / READ_BYTES_S)
            ended.append(env.now)

    for machine in range(machines):
        for _ in range(CORES):
            env.process(core(machine))
    env.run()
    return {"machines": machines, "maps": maps, "hours": round(max(ended) / 3600, 2)}


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("points", nargs="?", type=Path, default=POINTS)
    parser.add_argument("--fuse", type=Path, default=FUSE_POINTS, metavar="POINTS")
    parser.add_argument("--json", action="store_true", help="one object")
    options = parser.parse_args()
    rows, lines = _read(options.points, parser), _read(options.fuse, parser)
    try:
        fusing, runs = check_fusing(lines)
    except (KeyError, StopIteration, TypeError, ValueError, ZeroDivisionError):
        parser.error(
            f"{options.fuse} needs lines of cluster.py: one worker with two numbers of keyframes, "
            "and two workers with the larger one"
        )
    try:
        gateway, table = check(rows)
    except (KeyError, TypeError, ValueError):
        parser.error(f"{options.points} needs lines of fleet.py, with {FIT[0]} and {FIT[1]} scanners")
    if not (errors := [abs(row["error"]) for row in table + runs if not row["fitted"]]):
        parser.error("all points are fitted, and none is left to predict; give more of them")
    cities = [city(machines, rows[0]["keyframe_bytes"]) for machines in (1, 2, 4, 8, 16, 32, 64)]
    worst = max(errors)
    if options.json:
        print(json.dumps({
            "gateway_ms": _milliseconds(gateway), "points": table,
            "fusing_ms": _milliseconds(fusing), "runs": runs, "worst_error": worst, "city": cities,
        }))  # fmt: skip
    else:
        for row in table:
            print(
                f"{row['scanners']:4} scanners, disk wait {row['disk_wait_ms']:3.0f} ms: durable a second "
                f"{row['measured']:7.1f} measured, {row['predicted']:7.1f} predicted ({_off(row)})"
            )
        for row in runs:
            print(
                f"{row['workers']:4} workers, {row['keyframes']} keyframes: seconds {row['measured']:5.1f} "
                f"measured, {row['predicted']:5.1f} predicted ({_off(row)})"
            )
        print(f"worst of those that were not fitted: {100 * worst:.1f} %")
        for one in cities:
            print(f"{one['machines']:4} machines, {one['maps']} maps: {one['hours']:6.2f} h")
    return 0 if worst <= TOLERANCE else 1


def _read(points: Path, parser: argparse.ArgumentParser) -> list[Row]:
    try:
        return [json.loads(line) for line in points.read_text(encoding="utf-8").splitlines()]
    except (OSError, ValueError) as error:
        parser.error(f"cannot read {points}: {error}")


def _off(row: Row) -> str:
    return f"{100 * row['error']:+.1f} %{', fitted' if row['fitted'] else ''}"


def _milliseconds(model: Struct) -> dict[str, float]:
    return {name: round(1e3 * getattr(model, name), 4) for name in model.__struct_fields__}


if __name__ == "__main__":
    sys.exit(main())
