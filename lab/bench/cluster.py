# SPDX-License-Identifier: MIT
"""Fuse the journal of a street with one worker and with several: throughput, cost of adding, equal hashes.

    python lab/bench/cluster.py                        400 keyframes; 1, 2 and 8 workers; a JSON line each
    python lab/bench/cluster.py --kills 20             20 more runs of 4 workers, of which one is killed
    python lab/bench/cluster.py --ray --workers 1 2    the same by a Ray cluster of this machine
    python lab/bench/cluster.py --worker-memory 700MB  a map that is larger than a worker

Forty stereo keyframes of the synthetic street are rendered once and repeated, 40 m further along each time.
Each run is the command `tsfusion fuse`: nothing else should run then. `rate` is keyframes
a second while they are fused and the parts are added, the start of the workers included; `adding` is CPU time
of adding against that of fusing. The exit status is 1 when a hash differs, or a killed run does not end well.
"""

import argparse
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).parents[2]))  # lab is not installed

from lab.bench.memory import recording
from tsfusion.journal import Journal
from tsfusion.wire.records import codec

SESSION = b"street".ljust(16, b"\0")
_POLL_S = 0.02


def write_journal(folder: Path, count: int, width: int) -> None:
    """Write the keyframes of the street, unless they are there."""
    if folder.is_dir():
        return
    journal = Journal(folder.with_suffix(".partial"), 256 << 20)
    for seq, keyframe in enumerate(recording("street", count, width), 1):
        frames = codec.encode(keyframe, jpeg_quality=90, session=SESSION, seq=seq)
        journal.append(frames, session=SESSION, seq=seq)
    journal.close()
    folder.with_suffix(".partial").rename(folder)


def command(options: argparse.Namespace, journal: Path, workers: int, out: Path) -> list[str]:
    """The command of a run."""
    flags = ["--workers", workers, "--voxel-size", options.voxel_size, "--sensor", "stereo", "--out", out]
    flags += ["--ray"] * options.ray
    flags += ["--worker-memory", options.worker_memory] * bool(options.worker_memory)
    words = [sys.executable, "-m", "tsfusion", "fuse", journal, *flags, "--json"]
    return [str(word) for word in words]


def run(options: argparse.Namespace, journal: Path, workers: int, out: Path) -> dict[str, Any]:
    """Run the command to its end: a line of figures."""
    begin = time.monotonic()
    done = subprocess.run(command(options, journal, workers, out), capture_output=True, text=True, check=True)
    found, whole = json.loads(done.stdout), time.monotonic() - begin
    steps, cpu = found["seconds"], found["worker_seconds"]
    return {
        "workers": workers,
        "keyframes": found["keyframes_fused"],
        "map_hash": found["map_hash"],
        "blocks": found["blocks"],
        "rate": round(found["keyframes_fused"] / (steps["fusing"] + steps["adding"]), 2),
        "adding": round(cpu["adding"] / cpu["fusing"], 3),
        "seconds": steps,
        "worker_seconds": cpu,
        "whole_seconds": round(whole, 2),
        "worker_peak_mb": round(found["worker_peak_rss"] / 1e6),
        "jobs": found["jobs"],
        "tiles": found["tiles"],
        "cores": len(os.sched_getaffinity(0)),
    }


def killed_run(
    options: argparse.Namespace, journal: Path, out: Path, after: float, draw: random.Random
) -> dict[str, Any]:
    """A run of 4 workers, of which one is killed so many seconds after the first has begun."""
    process = subprocess.Popen(
        command(options, journal, 4, out), stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    while not (workers := _workers(process.pid)) and process.poll() is None:
        time.sleep(_POLL_S)
    end = time.monotonic() + after
    while time.monotonic() < end and process.poll() is None:
        time.sleep(_POLL_S)
    workers = _workers(process.pid)
    if workers:
        with suppress(ProcessLookupError):
            os.kill(draw.choice(workers), signal.SIGKILL)
    found = json.loads(process.communicate()[0] or "{}")
    return {
        "killed_after": round(after, 2),
        "status": process.returncode,
        "workers_lost": found.get("workers_lost"),
        "map_hash": found.get("map_hash"),
    }


def _workers(pid: int) -> list[int]:
    """The processes that do its jobs."""
    with suppress(OSError):
        return [int(word) for word in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    return []


def main() -> int:
    """Run all, a JSON line each."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--keyframes", type=int, default=400)
    parser.add_argument("--width", type=int, default=1241, help="of the images, pixels")
    parser.add_argument("--voxel-size", type=float, default=0.1)
    parser.add_argument("--workers", type=int, nargs="*", default=[1, 2, 8])
    parser.add_argument("--kills", type=int, default=0)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--ray", action="store_true")
    parser.add_argument("--worker-memory", metavar="BYTES")
    parser.add_argument("--journal", type=Path, help="made there, and kept for the next run")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="tsfusion-cluster-") as name:
        work = Path(name)
        journal = options.journal or work / "journal"
        write_journal(journal, options.keyframes, options.width)
        lines = []
        for number, workers in enumerate(options.workers):
            lines.append(run(options, journal, workers, work / f"run-{number}"))
            print(json.dumps(lines[-1]), flush=True)
        draw = random.Random(options.seed)
        longest = lines[-1]["whole_seconds"] if lines else 10.0
        for number in range(options.kills):
            after = draw.uniform(0, longest)
            lines.append(killed_run(options, journal, work / f"killed-{number}", after, draw))
            print(json.dumps(lines[-1]), flush=True)
    is_well = len({line["map_hash"] for line in lines}) == 1 and not any(line.get("status") for line in lines)
    return 0 if is_well else 1


if __name__ == "__main__":
    sys.exit(main())
