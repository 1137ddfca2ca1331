# SPDX-License-Identifier: MIT
"""Load on one server: simulated scanners on loopback, a JSON line a case.

    python lab/bench/fleet.py                                  1, 10, 50 and 200 scanners at 0.5 keyframes/s
    python lab/bench/fleet.py --scanners 50 --maps 4           four maps, each with a fuser of its own
    python lab/bench/fleet.py --scanners 50 --maps 4 --spare 3 the same, with fusers that wait for three
    python lab/bench/fleet.py --scanners 10 --flood --no-fuser as fast as the gateway makes them durable
    python lab/bench/fleet.py --flood --no-fuser --disk-wait 5 --state /dev/shm
                                                               the same with a disk whose waits are known
    python lab/bench/fleet.py --scanners 4 --rate 2 --move     real clients, whose map moves to another server
    python lab/bench/fleet.py --scanners 50 --profile out.txt  where the gateway's time goes

Every case has a new server. `lost`: keyframes that a scanner took and that are not once in the journal, read
from the disk when the server has ended; `doubled`: those that are there twice. `jain`: fairness over the
keyframes of each scanner that were fused (with --no-fuser: durable) while all scanned; 1 = all had the same.
`delay_ms`: captured → fused, `durable_ms`: captured → on the server's disk. `gateway_cpu_ms` and
`fuser_cpu_ms`: processor time of a keyframe. `floor`: what the disk does at the same place, without a server:
appends of one such keyframe, and of eight, each with its fdatasync.
"""

import argparse
import json
import os
import shutil
import sys
import tempfile
import time
from collections import Counter
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "support"))
sys.path.append(str(Path(__file__).parents[2]))  # lab is not installed
from idle_fuser import keeping
from keyframes_and_servers import Server

from lab.bench.fleet_move import measure as measure_move
from lab.bench.fleet_scanners import Scanner, bodies, drive
from lab.bench.peers import surroundings
from tsfusion import VolumeConfig, journal
from tsfusion.core import process
from tsfusion.journal import state_folder
from tsfusion.wire.asking.queries import fetch_health

RAMP_S = 1.0  # in which the scanners begin one after the other
_QUIET_S = 3.0  # in which a fuser that has nothing to do takes no processor time
DRAIN_S = 60.0  # after the last keyframe
TICKS = os.sysconf("SC_CLK_TCK")
TARGETS = {"lost": 0, "jain": 0.95, "delay_p95_ms": 500.0, "gateway_mb": 512.0, "frozen_s": 2.0}
PROFILED = """
import atexit, cProfile, io, pstats, sys
_profile = cProfile.Profile(); _profile.enable()
def _write():
    _profile.disable(); text = io.StringIO()
    pstats.Stats(_profile, stream=text).sort_stats("tottime").print_stats(40)
    open({path!r}, "w").write(text.getvalue())
atexit.register(_write)
"""
SLOW_DISK = """
import os, time
_sync = os.fdatasync
os.fdatasync = lambda descriptor: (time.sleep({seconds}), _sync(descriptor))
"""


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--scanners", type=int, nargs="+", default=[1, 10, 50, 200])
    parser.add_argument("--maps", type=int, default=1, help="over which they are spread (default 1)")
    parser.add_argument("--spare", type=int, default=0, help="`spare_fusers` of the server (default 0)")
    parser.add_argument("--rate", type=float, default=0.5, help="keyframes a second of each (default 0.5)")
    parser.add_argument("--flood", action="store_true", help="as many as the server's credit allows")
    parser.add_argument("--seconds", type=float, default=20.0, help="for which they scan (default 20)")
    parser.add_argument("--no-fuser", action="store_true", help="only the gateway: nothing is fused")
    parser.add_argument("--voxel-size", type=float, default=0.04, help="metres (default 0.04)")
    parser.add_argument("--state", help="folder on the disk that is to be measured (default: temporary)")
    parser.add_argument(
        "--disk-wait", type=float, help="ms that the gateway sleeps in each wait for its disk, besides"
    )
    parser.add_argument(
        "--move", action="store_true", help="move the map meanwhile; nothing else is measured"
    )
    parser.add_argument("--profile", help="file for the gateway's functions by time, of the last case")
    return parser.parse_args()


def main() -> int:
    options = _options()
    process.raise_file_limit()
    frames, met = bodies(8), True
    with tempfile.TemporaryDirectory(prefix="tsfusion-fleet-", dir=options.state) as scratch:
        for number, count in enumerate(options.scanners):
            folder = Path(scratch) / str(number)
            if options.move:
                row = measure_move(folder, count, options.rate, options.seconds, options.voxel_size)
                row["met"] = row["lost"] == row["doubled"] == 0 and row["frozen_s"] <= TARGETS["frozen_s"]
            else:
                row = _case(folder, count, options, frames)
            print(json.dumps({**row, **surroundings(os.cpu_count() or 1)}), flush=True)
            met &= row["met"]
    return 0 if met else 1


def _case(folder: Path, count: int, options: argparse.Namespace, frames: list[list[bytes]]) -> dict[str, Any]:
    floor = disk_floor(folder.parent, sum(map(len, frames[0])))
    code = PROFILED.format(path=options.profile) if options.profile else ""
    if options.disk_wait is not None:
        code += SLOW_DISK.format(seconds=options.disk_wait / 1e3)
    settings: dict[str, Any] = {"max_maps": max(options.maps, 4), "spare_fusers": options.spare}
    if options.flood:
        settings |= {"quota_keyframes": 1e6, "quota_bytes": 1 << 40}  # else they are what is measured
    volume = VolumeConfig(voxel_size=options.voxel_size)
    made = keeping(folder, code=code, **settings) if options.no_fuser else None
    names = ["default", *(f"map-{i}" for i in range(1, options.maps))]
    with closing(Server(folder, volume, code=code, **settings)) if made is None else made as server:
        if options.spare:
            _wait_for_spares(server, 1 + options.spare)
        begin = time.monotonic() + 0.5
        end = begin + RAMP_S + options.seconds
        rate = None if options.flood else options.rate
        scanners = [
            Scanner(i, names[i % len(names)], frames, rate=rate, begin=begin + RAMP_S * i / count, end=end)
            for i in range(count)
        ]
        before = _cpu_seconds(server)
        done = drive(scanners, server.address, server.control, deadline=end + DRAIN_S)
        used = {name: seconds - before.get(name, 0.0) for name, seconds in _cpu_seconds(server).items()}
        memory = {"gateway": _peak_mb(server.process.pid), "fusers": sum(map(_peak_mb, server.children()))}
        maps = fetch_health(server.address).maps.values()
        server.terminate()
    row = _figures(scanners, folder, names, (begin + RAMP_S, end), fused=not options.no_fuser)
    shutil.rmtree(folder)
    total = max(row["durable"], 1)
    row |= {
        "scanners": count, "maps": len(names), "spare": options.spare, "rate": rate,
        "seconds": options.seconds, "drained": done,
        "fuses": made is None, "keyframe_bytes": sum(map(len, frames[0])),
        "blocks": sum(one.blocks for one in maps), "map_bytes": sum(one.map_bytes for one in maps),
        "gateway_mb": memory["gateway"], "fusers_mb": round(memory["fusers"], 1),
        "gateway_cpu_ms": round(1e3 * used["gateway"] / total, 3),
        "fuser_cpu_ms": round(1e3 * used["fusers"] / total, 2),
        "disk_wait_ms": options.disk_wait, "floor": floor,
    }  # fmt: skip
    row["met"] = bool(
        done and row["lost"] == row["doubled"] == 0 and row["jain"] >= TARGETS["jain"]
        and row["gateway_mb"] <= TARGETS["gateway_mb"]
        and (made is not None or rate is None or row["delay_ms"]["p95"] <= TARGETS["delay_p95_ms"])
    )  # fmt: skip
    return row


def _figures(
    scanners: list[Scanner], folder: Path, names: list[str], span: tuple[float, float], *, fused: bool
) -> dict[str, Any]:
    """Throughput, fairness, delays and losses of a case."""
    taken = sum(len(one.captured_ns) for one in scanners)
    journaled = _journaled(folder, names)
    wanted = {(one.session, seq) for one in scanners for seq in range(1, len(one.captured_ns) + 1)}
    first, last = (int(1e9 * edge) for edge in span)
    stamps = [one.fused_ns if fused else one.durable_ns for one in scanners]
    each = np.array([sum(first <= at < last for at in one.values()) for one in stamps])
    durable, in_map = (
        sum(first <= at < last for stamps in each for at in stamps.values())
        for each in ([one.durable_ns for one in scanners], [one.fused_ns for one in scanners])
    )
    return {
        "taken": taken, "durable": len(journaled), "lost": len(wanted - journaled.keys()),
        "doubled": sum(count - 1 for count in journaled.values()),
        "refused": sum(one.refused for one in scanners), "resent": sum(one.resent for one in scanners),
        "durable_a_second": round(durable / (span[1] - span[0]), 1),
        "fused_a_second": round(in_map / (span[1] - span[0]), 1) if fused else None,
        "jain": round(jain(each), 4),
        "delay_ms": _spread(
            one.fused_ns[seq] - one.captured_ns[seq - 1] for one in scanners for seq in one.fused_ns if fused
        ),
        "durable_ms": _spread(
            one.durable_ns[seq] - one.captured_ns[seq - 1] for one in scanners for seq in one.durable_ns
        ),
    }  # fmt: skip


def jain(shares: "np.ndarray[Any, Any]") -> float:
    """Jain's index of fairness: (Σx)² / (n Σx²); 0 where nobody had anything."""
    squares = float(np.square(shares, dtype=np.float64).sum())
    return float(shares.sum()) ** 2 / (len(shares) * squares) if squares else 0.0


def _spread(delays_ns: Any) -> dict[str, float]:
    found = np.array(list(delays_ns)) / 1e6
    if not len(found):
        return {}
    p50, p95, p99 = np.percentile(found, (50, 95, 99))
    return {"p50": round(p50, 1), "p95": round(p95, 1), "p99": round(p99, 1), "max": round(found.max(), 1)}


def _journaled(folder: Path, names: list[str]) -> Counter[tuple[bytes, int]]:
    """How often each record is in the journals."""
    found: Counter[tuple[bytes, int]] = Counter()
    for name in names:
        place = state_folder.map_folder(folder, name) / state_folder.JOURNAL_FOLDER
        for number in journal.segments(place):
            records, damaged = journal.list_records(journal.segment_path(place, number))
            found.update((record.session, record.seq) for record in records)
            found[b"damaged", number] += 2 * damaged
    return +found


def disk_floor(folder: Path, nbytes: int, seconds: float = 1.0) -> dict[str, float]:
    """Appends a second of so many bytes, each with its fdatasync, and of eight times as many."""
    found = {}
    for name, times in (("one_a_second", 1), ("eight_a_second", 8)):
        content = os.urandom(nbytes) * times
        with tempfile.NamedTemporaryFile(dir=folder) as file:
            count, began = 0, time.monotonic()
            while time.monotonic() - began < seconds:
                file.write(content)
                file.flush()
                os.fdatasync(file.fileno())
                count += times
            found[name] = round(count / (time.monotonic() - began), 1)
    return found


def _wait_for_spares(server: Server, count: int) -> None:
    """Wait until so many fusers have started, and have nothing more to compile."""
    before: dict[str, float] = {}
    while len(server.children()) < count or before.get("fusers") != _cpu_seconds(server)["fusers"]:
        before = _cpu_seconds(server)
        time.sleep(_QUIET_S)


def _cpu_seconds(server: Server) -> dict[str, float]:
    """Processor time of the gateway, and of its fusers."""

    def of(pid: int) -> float:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / TICKS

    return {"gateway": of(server.process.pid), "fusers": sum(map(of, server.children()))}


def _peak_mb(pid: int) -> float:
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return round(next(int(line.split()[1]) for line in lines if line.startswith("VmHWM")) / 1024, 1)


if __name__ == "__main__":
    sys.exit(main())
