# SPDX-License-Identifier: MIT
"""Measure what is fused: error, completeness, normals, edges and unseen views, by method, scene and noise.

    python lab/evaluation/accuracy.py --output FOLDER         every row, tables and plots (25 min on 2 cores)
    python lab/evaluation/accuracy.py --quick                 20 keyframes of one room, two noises (a minute)
    python lab/evaluation/accuracy.py --list                  the names of the rows
    python lab/evaluation/accuracy.py --only kitchen bunny    those whose name holds one of these words
    python lab/evaluation/accuracy.py --output FOLDER --tables --write-docs    what FOLDER holds, into docs/

A row is a scene, a noise, a number of keyframes and a method; each runs in a process of its own. Without
--output each row is one JSON line on stdout. A folder keeps its rows: a later run replaces those it measures
anew, --missing measures only what is not there, --tables none: it writes tables and plots again.

Scenes: the shared room, analytic room, street, corners and thin parts, the Stanford bunny against its
reference mesh, and 7-Scenes and HoloLens views that were not fused, predicted from the mesh.
docs/accuracy.md says what every column means. Recorded scenes need TSFUSION_DATA (default ../shared/data);
what is missing, and Open3D or VDBFusion where they cannot be imported, is left out, with a word. CPU times
compare within one run only; --jobs 1 measures them undisturbed and takes as many times longer as there are
cores.
"""

import argparse
import json
import os
import subprocess
import sys
import time
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).parents[2]))  # lab is not installed

from lab.bench.peers import ROOT, unimportable
from lab.evaluation import accuracy_report
from lab.evaluation.ablation import PEERS, Row, missing_data, rows, run


def main() -> int:
    options, parser = parse()
    chosen = select(options)
    if options.row:
        print(json.dumps(run(chosen[0], options.threads)))
        return 0
    if not chosen and not options.tables:
        parser.error("no row has such a name; --list shows them")
    if options.list:
        print("\n".join(row.name for row in chosen))
        return 0
    if (options.tables or options.write_docs or options.missing) and not options.output:
        parser.error("--tables, --write-docs and --missing need the rows of an --output folder")
    known = accuracy_report.read(options.output) if options.output else {}
    if options.missing:
        chosen = [row for row in chosen if row.name not in known]
    try:
        status = 0 if options.tables else measure(chosen, options, known)
    except KeyboardInterrupt:
        say("stopped; the rows measured so far are kept" if options.output else "stopped")
        status = 130
    if options.output and known:
        order = [row.name for row in rows()]
        written = accuracy_report.write(options.output, known, order)
        if options.write_docs and status != 130:
            written += accuracy_report.write_docs(ROOT / "docs", known, order)
        say("written: " + ", ".join(str(path) for path in written))
    return status


def parse() -> tuple[argparse.Namespace, argparse.ArgumentParser]:
    assert __doc__ is not None
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--list", action="store_true", help="print the names of the rows")
    parser.add_argument("--only", metavar="WORD", nargs="+", help="rows whose name holds any of these words")
    parser.add_argument("--quick", action="store_true", help="a small part, to see that all works")
    parser.add_argument("--threads", type=positive, default=1, help="threads a system may use (default 1)")
    cores = os.cpu_count() or 1
    parser.add_argument("--jobs", type=positive, default=cores, help=f"rows at a time (default {cores})")
    parser.add_argument("--output", metavar="FOLDER", type=Path, help="rows.jsonl, tables.md and plots")
    parser.add_argument("--missing", action="store_true", help="only rows that FOLDER does not hold")
    parser.add_argument("--tables", action="store_true", help="measure nothing, write tables and plots again")
    parser.add_argument("--write-docs", action="store_true", help="also into docs/accuracy.md, docs/images")
    parser.add_argument("--row", metavar="NAME", help="run this one here, in this process")
    return parser.parse_args(), parser


def positive(text: str) -> int:
    """A whole number from 1 on."""
    if (number := int(text)) < 1:
        raise argparse.ArgumentTypeError(f"expected 1 or more, got {number}")
    return number


def select(options: argparse.Namespace) -> list[Row]:
    return [
        row
        for row in rows()
        if not options.only or any(word in row.name for word in options.only)
        if not options.quick or row.quick
        if options.row in (None, row.name)
    ]


def measure(chosen: list[Row], options: argparse.Namespace, known: dict[str, dict[str, Any]]) -> int:
    """Run the rows, `--jobs` at a time; each joins `known` and, with --output, the file at once."""
    possible, number = runnable(chosen), 0
    running: dict[Future[dict[str, Any]], Row] = {}
    children: set[subprocess.Popen[str]] = set()
    started, failed = time.perf_counter(), 0
    pool = ThreadPoolExecutor(options.jobs)
    try:
        running = {pool.submit(measure_row, row, options.threads, children): row for row in possible}
        for number, done in enumerate(as_completed(running), 1):
            name = f"[{number}/{len(possible)}, {time.perf_counter() - started:.0f} s] {running[done].name}"
            try:
                line = done.result()
            except subprocess.CalledProcessError as error:
                failed += 1
                say(f"{name}: failed, the process ended with {error.returncode}")
                continue
            known[line["row"]] = line
            if options.output:
                accuracy_report.keep(options.output, known)
            else:
                print(json.dumps(line), flush=True)
            say(name)
    finally:
        for future in running:
            future.cancel()
        for child in tuple(children):
            child.kill()
        pool.shutdown()
    return int(failed > 0)


def measure_row(row: Row, threads: int, children: set["subprocess.Popen[str]"]) -> dict[str, Any]:
    """One row in a process of its own, which stands in `children` while it runs.

    Raises:
        CalledProcessError: when that process fails.
    """
    command = [sys.executable, __file__, "--row", row.name, "--threads", str(threads)]
    environment = {**os.environ, "OMP_NUM_THREADS": str(threads)}
    # a session of its own, so that Ctrl-C reaches us alone and we end it
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, env=environment, start_new_session=True
    ) as child:
        children.add(child)
        answer, _ = child.communicate()
        children.discard(child)
    if child.returncode:
        raise subprocess.CalledProcessError(child.returncode, command)
    found: dict[str, Any] = json.loads(answer.splitlines()[-1])
    return found


def runnable(chosen: list[Row]) -> list[Row]:
    """The rows that can run here; of the others it is said why not, once a reason."""
    peers = {
        peer: unimportable(peer.partition("-")[0])
        for peer in PEERS
        if any(peer == row.method for row in chosen)
    }
    scipy = unimportable("scipy")
    if scipy:
        say(f"completeness and F are left out: {scipy}")
    reasons = {row: left_out(row, peers, scipy) for row in chosen}
    for reason in dict.fromkeys(filter(None, reasons.values())):
        say(f"{sum(why == reason for why in reasons.values())} rows are left out: {reason}")
    return [row for row in chosen if reasons[row] is None]


def left_out(row: Row, peers: dict[str, str | None], scipy: str | None) -> str | None:
    """Why a row cannot run here, if it cannot."""
    if row.setup.scene == "bunny" and scipy:
        return f"the bunny needs scipy: {scipy}"
    return peers.get(row.method) or missing_data(row.setup)


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


if __name__ == "__main__":
    sys.exit(main())
