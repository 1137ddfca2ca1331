# SPDX-License-Identifier: MIT
"""Journal, spool and checkpoint on a disk that refuses one system call, whichever it is; a JSON line each.

    python tests/support/storage_faults.py FOLDER KIND EVERY     such as EIO 1, for each call; FOLDER is empty

A process of its own works with all three, and writes down what it was promised. The next opens them again,
on a disk that is good, and must find just that.
"""

import errno
import itertools
import json
import os
import re
import sys
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import sum_map
from keyframes_and_servers import VOLUME

from lab.reliability.forked_processes import Forked
from lab.reliability.syscall_faults import SHORT, Call, Watcher, install
from tsfusion.core.errors import JournalError, TsfusionError
from tsfusion.delivery.spool import Spool, Waiting
from tsfusion.fuser.fuser_messages import SessionProgress
from tsfusion.fuser.map_checkpoints import MapCheckpoints
from tsfusion.journal import Journal, Unwritten

SESSION = bytes(range(16))
SEGMENT_BYTES = 1 << 16
RECORD = bytes(40_000)  # two fill a segment
CALL = "faulty call"


class Promises:
    """Numbers that a process was promised, on the disk."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def note(self, name: str, number: int) -> None:
        with (self._folder / name).open("a") as file:
            file.write(f"{number} ")

    def read(self, name: str) -> list[int]:
        path = self._folder / name
        return [int(word) for word in path.read_text().split()] if path.exists() else []


def work(folder: Path, promises: Promises) -> None:
    """Work with all three as server, client and fuser do, and go on where the disk refuses."""
    for part in (use_journal, use_spool, use_checkpoints):
        with suppress(TsfusionError):
            part(folder, promises)


def use_journal(folder: Path, promises: Promises) -> None:
    for first in (1, 6):  # opened again behind what is there
        log = Journal(folder / "journal", SEGMENT_BYTES)
        for seqs in ([first], [first + 1], [first + 2, first + 3, first + 4]):
            with suppress(JournalError):
                log.append_all([Unwritten([RECORD], SESSION, seq) for seq in seqs])
                for seq in seqs:
                    promises.note("journaled", seq)
        with suppress(JournalError):
            log.close()


def use_spool(folder: Path, promises: Promises) -> None:
    spool = Spool(folder / "spool", SEGMENT_BYTES)
    for _ in range(5):
        with suppress(JournalError):
            entry = spool.write([RECORD])
            spool.add(entry)
            promises.note("spooled", entry.seq)
    for entry in list(spool.waiting)[:3:2]:
        promises.note("left", entry.seq)
        spool.remove(spool.waiting.index(entry))
    if durable := [entry.seq for entry in spool.waiting][:1]:
        promises.note("left", durable[0])
        spool.drop(durable[0])
    spool.close()


def use_checkpoints(folder: Path, promises: Promises) -> None:
    for number in (1, 2):
        kept = MapCheckpoints(folder / "map", VOLUME, keep_previous=True)
        kept.done[SESSION] = SessionProgress(number, "", "")
        if kept.save():
            promises.note("saved", number)


def problems(folder: Path, promises: Promises) -> list[str]:
    """Promises that were not kept."""
    found = []
    log = Journal(folder / "journal", SEGMENT_BYTES)
    seqs = [entry.seq for entry in log.found]
    if seqs != promises.read("journaled") or log.damaged:
        found.append(f"the journal has {seqs}, {log.damaged} damaged")
    spool = Spool(folder / "spool", SEGMENT_BYTES)
    waiting = [entry.seq for entry in spool.waiting if _can_be_read(spool, entry)]
    promised = set(promises.read("spooled")) - set(promises.read("left"))
    if not promised <= set(waiting) <= set(promises.read("spooled")) or sorted(waiting) != waiting:
        found.append(f"the spool has {waiting}, promised are {sorted(promised)}")
    spool.close()
    kept = MapCheckpoints(folder / "map", VOLUME, keep_previous=True)
    done = kept.done[SESSION].seq if kept.done else 0
    if done < max(promises.read("saved"), default=0):
        found.append(f"the checkpoint is that of {done}")
    left = [path.name for path in folder.rglob(".*.partial")] + [
        path.name for path in folder.rglob("*.new.*")
    ]
    return found + [f"files are left: {left}"] * bool(left)


def _can_be_read(spool: Spool, entry: Waiting) -> bool:
    return len(spool.read(entry)[0]) == len(RECORD)


def decide(folder: Path, kind: str) -> Callable[[Call], int]:
    """Fail the n-th call of the process that is named n."""
    counts = Counter[str]()

    def fail(call: Call) -> int:
        counts[call.process] += 1
        if counts[call.process] != int(call.process):
            return 0
        (folder / call.process / CALL).write_text(f"{call.name} {call.place}")
        return SHORT if kind == "short" else int(getattr(errno, kind))

    return fail


def watch(folder: Path, address: str, kind: str) -> None:
    """Answer the system calls on files of journal, spool and map, until this process's stdin ends."""

    def place(path: str) -> str | None:
        found = re.fullmatch(f"{folder}/[0-9]+/((journal|spool|map)($|/.*))", path)
        return found[1] if found else None

    Watcher(address, place, decide(folder, kind))
    sys.stdin.read()


def main() -> None:
    sum_map.take_the_place_of_volume()
    folder, kind, every = Path(sys.argv[1]), sys.argv[2], int(sys.argv[3])
    address = str(folder / "watcher")
    reading, writing = os.pipe()
    watcher = Forked(lambda: watch(folder, address, kind), folder, "watcher", stdin=reading)
    while not Path(address).exists():
        watcher.wait(0.001)
    for number in itertools.count(1, every):
        own = folder / str(number)
        (own / "map").mkdir(parents=True)
        promises = Promises(own)

        def run(own: Path = own, promises: Promises = promises, name: str = str(number)) -> None:
            install(address, name)
            work(own, promises)

        process = Forked(run, own, "work")
        status = process.wait(30.0)
        process.kill()
        if not (own / CALL).exists():
            break
        found = problems(own, promises) + [f"it ended with {status}: {process.complained()}"] * (status != 0)
        print(json.dumps({"number": number, "call": (own / CALL).read_text(), "problems": found}))
    os.close(writing)
    watcher.wait(5.0)


if __name__ == "__main__":
    main()
