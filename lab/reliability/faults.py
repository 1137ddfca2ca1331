# SPDX-License-Identifier: MIT
"""Let every system call on the way of a keyframe fail once, each in a run of its own, and see what is left.

    python lab/reliability/faults.py                          all of them: a JSON line each, then a table
    python lab/reliability/faults.py --only "client.*ENOSPC"  whose `process call place number kind` matches
    python lab/reliability/faults.py --first 120 --limit 50   the 120th to the 169th; --list only names them
    python lab/reliability/faults.py --case "client flock spool/lock 1 ENOLCK"  this one, with no counting run
    python lab/reliability/faults.py --real                   with the real map, not a sum that starts at once

A counting run of client, gateway and fuser lists their calls on spool, state folder, temporary folder and
sockets. A run is good when each keyframe that `send` returned a number for is in journal and map exactly
once, the map's hash is that of an undisturbed run, every process went on, or ended with one clear line and
was started again, and no file stays open or is left behind. The exit status is 1 unless all are. Linux on
x86-64 only.
"""

import argparse
import multiprocessing
import re
import sys
import tempfile
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import msgspec

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "support"))
sys.path.append(str(Path(__file__).parents[2]))  # lab is not installed
from lab.reliability import syscall_faults
from lab.reliability.fault_run import PROCESSES, Case, Outcome, Run, cases


def live(case: Case | None, process: str, real: bool) -> Outcome:
    """One run in a folder of its own."""
    with tempfile.TemporaryDirectory(prefix="tsf-", dir="/tmp") as folder:
        return Run(Path(folder), case, process=process, real=real).run()


def listed(pool: ProcessPoolExecutor, real: bool) -> list[Case]:
    """The cases of undisturbed runs."""
    runs = [(process, pool.submit(live, None, process, real)) for process in PROCESSES]
    found: dict[tuple[str, str, str], Case] = {}
    for process, run in runs:
        if (outcome := run.result()).problems:
            sys.exit(f"the undisturbed run of {process} went wrong: {outcome.problems}")
        new = cases(outcome.counts, process)
        if process == "limit":  # only what a server without a limit does not do
            new = [one for one in new if one.call == "unlink" and "journal" in one.place]
        found.update({msgspec.structs.astuple(one): one for one in new})
    return list(found.values())


def verdict(outcome: Outcome) -> str:
    """The end of a run in a word."""
    if outcome.problems:
        return "wrong"
    if not outcome.happened:
        return "not reached"
    if outcome.ended:
        return "started again"
    return "skipped, told" if outcome.skipped else "went on"


def table(done: list[tuple[Case, str]]) -> str:
    """Counts by process, call and kind."""
    words = ("went on", "skipped, told", "started again", "not reached", "wrong")
    counts = Counter(((case.process, case.call, case.kind), word) for case, word in done)
    rows = sorted({row for row, _ in counts})
    lines = [f"{'process call kind':<42}" + "".join(f"{word:>15}" for word in words)]
    lines += [f"{' '.join(row):<42}" + "".join(f"{counts[row, word]:>15}" for word in words) for row in rows]
    totals = Counter(word for _, word in done)
    return "\n".join([*lines, f"{'all':<42}" + "".join(f"{totals[word]:>15}" for word in words)])


def chosen(options: argparse.Namespace, pool: ProcessPoolExecutor) -> list[tuple[int, Case]]:
    """The cases that are asked for, with their numbers."""
    if options.case:
        named = [one.split(" ", 4) for one in options.case]
        given = [
            Case(process, call, where, int(number), kind) for process, call, where, number, kind in named
        ]
        return list(enumerate(given, 1))
    wanted = [one for one in listed(pool, options.real) if re.search(options.only, str(one))]
    first = options.first - 1
    end = None if options.limit is None else first + options.limit
    return list(enumerate(wanted, 1))[first : end : options.every]


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--case", action="append", help="`PROCESS CALL PLACE NUMBER KIND`; any number of times"
    )
    parser.add_argument("--only", default="", help="a regular expression")
    parser.add_argument("--first", type=int, default=1, help="number of the first case")
    parser.add_argument("--limit", type=int, help="how many cases")
    parser.add_argument("--every", type=int, default=1, help="of so many one")
    parser.add_argument("--jobs", type=int, default=2, help="runs at a time")
    parser.add_argument("--real", action="store_true", help="with Taichi's map")
    parser.add_argument("--list", action="store_true", help="name the cases")
    options = parser.parse_args()
    if not syscall_faults.is_possible():
        sys.exit("this system cannot watch system calls: Linux on x86-64 with seccomp's user notification")
    done: list[tuple[Case, str]] = []
    with ProcessPoolExecutor(options.jobs, multiprocessing.get_context("spawn")) as pool:
        cases_ = chosen(options, pool)
        if options.list:
            print("\n".join(f"{number} {case}" for number, case in cases_))
            return 0
        runs = [
            (number, case, pool.submit(live, case, case.process, options.real)) for number, case in cases_
        ]
        for number, case, run in runs:
            outcome = run.result()
            done.append((case, verdict(outcome)))
            line = {"number": number, **msgspec.structs.asdict(outcome), "case": str(case)}
            del line["counts"]
            print(msgspec.json.encode(line).decode(), flush=True)
    print(table(done), file=sys.stderr)
    return int(any(word == "wrong" for _, word in done))


if __name__ == "__main__":
    sys.exit(main())
