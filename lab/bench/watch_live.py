# SPDX-License-Identifier: MIT
"""Cost of a watcher of a live map, and its effect on the delay of keyframes.

    python lab/bench/watch_live.py                                keyframes at 2 cm, 8 a second, for 30 s
    python lab/bench/watch_live.py --watchers 3 --stalled 1 --rate 5 --voxel-size 0.05
    python lab/bench/watch_live.py --watchers 0 --pages 1 --rate 10       live pages, each read by a browser

The keyframes are those of `lab/bench/ask_live.py`. Two servers run, and a scanner turns from one to the other
every few seconds: the one is watched, the other is not. A JSON line for each watcher (a process of its own):
CPU seconds a second, updates, triangles and bytes a second, and whether it holds the map in the end. A line
for each page (`tsfusion view`): CPU seconds a second of its process while the watched server gets keyframes,
and what a browser reads of it, which draws nothing (`--browser real` for one that does). The last line has
the keyframes' delay, captured → fused, with and without watchers.
"""

import argparse
import json
import os
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import msgspec

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "support"))
sys.path.append(str(Path(__file__).parents[2]))  # lab is not installed
from headless_browser import browser
from keyframes_and_servers import serving
from live_pages import address_of, viewing
from reading_browser import ReadingBrowser

from lab.bench.ask_live import FIRST, TURN, Scanner
from lab.bench.peers import surroundings
from lab.reliability.delivery import PATIENCE, _keyframes
from tsfusion import VolumeConfig
from tsfusion.wire.asking.followed_map import MapEvent, ScannerSeen, SurfaceUpdate
from tsfusion.wire.asking.map_watcher import MapWatcher
from tsfusion.wire.asking.queries import fetch_health, fetch_mesh

TARGET = 1.10  # the keyframes' delay, p95, with watchers : without
BROWSERS = ("reading", "real", "none")
SETTLED_S = 5.0  # without an event: the watcher has all


class Watched:
    """A process that watches a map.

    Args:
        is_stalled: it reads nothing until it is told that the scan is over.
    """

    def __init__(self, address: str, *, is_stalled: bool) -> None:
        context = get_context("spawn")
        self._pipe, other = context.Pipe()
        self._process = context.Process(target=_watch, args=(other, address, is_stalled))
        self._process.start()
        other.close()
        self._pipe.recv()

    def finish(self) -> dict[str, Any]:
        """Let it catch up, and end; its figures."""
        self._pipe.send(None)
        found: dict[str, Any] = self._pipe.recv()
        self._process.join()
        return found


class Page:
    """A live page in a process of its own, and a browser that has it open.

    Args:
        kind: of the browser: one of `BROWSERS`.
    """

    def __init__(self, address: str, kind: str) -> None:
        self._kind, self._stack = kind, ExitStack()
        self._process = self._stack.enter_context(viewing(address, "--listen", "127.0.0.1:0"))
        url = address_of(self._process)
        self._reading = ReadingBrowser(url) if kind == "reading" else None
        if kind == "real":
            self._stack.enter_context(browser()).open(url, width=960, height=540)
        self._seconds = self._cpu = 0.0

    @contextmanager
    def measured(self) -> Iterator[None]:
        """Count what it costs meanwhile."""
        began, cpu = time.monotonic(), self._cpu_s()
        yield
        self._seconds += time.monotonic() - began
        self._cpu += self._cpu_s() - cpu

    def finish(self) -> dict[str, Any]:
        """End it; its figures."""
        read = {} if self._reading is None else {"mb_read": round(self._reading.close() / 1e6, 1)}
        self._stack.close()
        return {"browser": self._kind, "page_cpu": round(self._cpu / self._seconds, 4), **read}

    def _cpu_s(self) -> float:
        fields = Path(f"/proc/{self._process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _watch(pipe: "Connection[Any, Any]", address: str, is_stalled: bool) -> None:
    watcher = MapWatcher(address)
    faces: dict[tuple[int, ...], int] = {}
    counts: Counter[str] = Counter()
    while not any(type(event).__name__ == "Cleared" for event in watcher.events(1.0)):
        pass
    pipe.send(None)
    began, cpu = time.monotonic(), time.process_time()
    while not pipe.poll():
        if is_stalled:
            time.sleep(0.1)
        else:
            _count(watcher.events(0.1), faces, counts)
    seconds, cpu = time.monotonic() - began, time.process_time() - cpu
    during = dict(counts)
    last = time.monotonic()
    while time.monotonic() - last < SETTLED_S:
        found = watcher.events(0.1)
        if any(isinstance(event, SurfaceUpdate) for event in found):
            last = time.monotonic()
        _count(found, faces, counts)
    watcher.close()
    rates = {f"{name}_a_second": round(count / seconds, 1) for name, count in during.items()}
    pipe.send(
        {"stalled": is_stalled, "cpu": round(cpu / seconds, 4), **rates, "faces_held": sum(faces.values())}
    )


def _count(events: list[MapEvent], faces: dict[tuple[int, ...], int], counts: Counter[str]) -> None:
    for event in events:
        if isinstance(event, ScannerSeen):
            counts["scans"] += 1
            counts["pictures"] += event.picture is not None
            counts["bytes"] += len(event.picture or b"")
        elif isinstance(event, SurfaceUpdate):
            counts["updates"] += 1
            counts["cells"] += len(event.cells)
            counts["faces"] += len(event.mesh.faces)
            arrays = (event.mesh.vertices, event.mesh.faces, event.mesh.normals, event.mesh.colors)
            counts["bytes"] += sum(array.nbytes for array in arrays if array is not None)
            in_cells = (event.first_face[1:] - event.first_face[:-1]).tolist()
            faces.update(zip(map(tuple, event.cells.tolist()), in_cells, strict=True))


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rate", type=float, default=8.0, help="keyframes a second")
    parser.add_argument("--seconds", type=float, default=30.0, help="of keyframes to each server")
    parser.add_argument("--watchers", type=int, default=1)
    parser.add_argument("--stalled", type=int, default=0, help="of these, how many read nothing meanwhile")
    parser.add_argument("--pages", type=int, default=0, help="live pages, beside the watchers")
    parser.add_argument(
        "--browser", choices=BROWSERS, default="reading", help="real: Chromium, which draws on the same cores"
    )
    parser.add_argument("--voxel-size", type=float, default=0.02)
    options = parser.parse_args()
    _, source = _keyframes()
    count = int(options.seconds * options.rate)
    cores = len(os.sched_getaffinity(0))
    volume = VolumeConfig(voxel_size=options.voxel_size, threads=cores)
    with tempfile.TemporaryDirectory(prefix="tsfusion-watch-") as scratch, ExitStack() as stack:
        watched, plain = (
            stack.enter_context(serving(Path(scratch) / name, volume)) for name in ("watched", "plain")
        )
        scanner = Scanner()
        stack.callback(scanner.close)
        for server in (watched, plain):
            scanner.send(server.address, FIRST, options.rate)
            scanner.wait()
        watchers = [Watched(watched.address, is_stalled=i < options.stalled) for i in range(options.watchers)]
        pages = [Page(watched.address, options.browser) for _ in range(options.pages)]
        time.sleep(SETTLED_S if pages else 0.0)  # they show what there is
        for _ in range(0, count, TURN):
            with ExitStack() as during:
                for page in pages:
                    during.enter_context(page.measured())
                scanner.send(watched.address, TURN, options.rate)
                scanner.wait()
            scanner.send(plain.address, TURN, options.rate)
            scanner.wait()
        for page in pages:
            print(json.dumps(page.finish()), flush=True)
        lines = [one.finish() for one in watchers]
        whole = len(fetch_mesh(watched.address, timeout=PATIENCE).faces)
        health = {name: fetch_health(one.address) for name, one in (("with", watched), ("without", plain))}
    common = {"source": source, "voxel_size": options.voxel_size, **surroundings(cores)}
    for line in lines:
        print(json.dumps({**line, "faces_of_the_map": whole, **common}), flush=True)
    delays = {name: one.maps["default"].delay_ms for name, one in health.items()}
    ratio = delays["with"].p95 / delays["without"].p95
    lost = health["with"].refused or health["with"].maps["default"].rejected
    held = all(abs(one["faces_held"] - whole) < 0.001 * whole for one in lines)
    met = ratio <= TARGET and held and not lost
    last = {"p95_ratio": round(ratio, 3), "target": TARGET, "lost": lost, "all_hold_it": held, "met": met}
    delay_ms = {name: msgspec.to_builtins(one) for name, one in delays.items()}
    print(json.dumps({"keyframe_delay_ms": delay_ms, "rate": options.rate, **last}))
    return 0 if met else 1


if __name__ == "__main__":
    sys.exit(main())
