# SPDX-License-Identifier: MIT
"""One run of client, gateway and fuser in which one system call fails; and what must be true afterwards.

A run has three lives: a client without a server, whose keyframes stay in its spool; a client and a server
that takes them, refuses one and cannot fuse one; and both once more, over the files that are there by then.
"""

import errno
import functools
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import sum_map
from clients_and_spools import NOBODY
from keyframes_and_servers import VOLUME, lasting_address, map_hash
from msgspec import Struct
from repository import ROOT

from lab.reliability import faulty_client, syscall_faults
from lab.reliability.faulty_client import REFUSED, REJECTED, Orders
from lab.reliability.forked_processes import Forked, answer
from lab.reliability.scanner_process import numbers
from lab.reliability.syscall_faults import SHORT, Call, Watcher
from tsfusion import server
from tsfusion.core import logs
from tsfusion.core.config import ServerConfig
from tsfusion.fuser import __main__ as fuser
from tsfusion.gateway.ports import fuser_process
from tsfusion.journal import inspection, state_folder

FIRST, SECOND, LAST, LAST_LIMITED = 4, 12, 16, 110  # walls up to the end of each life
SERVER = {"checkpoint_every": 3, "segment_bytes": 1 << 16}
PATIENCE = 40.0  # seconds for a life
_LASTS = 1.0  # seconds of a fault that stays for a while
_STARTS, _PAUSE = 6, 0.3  # of a process that ends by itself; seconds from the second on

_DISK = ("ENOSPC", "EIO")
_KINDS: dict[str, tuple[str, ...]] = {
    "write": (*_DISK, "EINTR", "short", "ENOSPC for a while", "EIO for a while"),
    "pwrite": (*_DISK, "EINTR", "short"),
    "fdatasync": (*_DISK, "EINTR", "EIO for a while"),
    "fsync": (*_DISK, "EINTR", "EIO for a while"),
    "create": (*_DISK, "ENOENT", "EINTR", "EMFILE", "ENOSPC for a while"),
    "open": ("EIO", "ENOENT", "EINTR", "EMFILE", "EIO for a while"),
    "rename": (*_DISK, "ENOENT"),
    "unlink": ("EIO", "ENOENT"),
    "rmdir": ("EIO",),
    "mkdir": _DISK,
    "ftruncate": ("EIO", "EINTR"),
    "mmap": ("ENOMEM", "EAGAIN"),
    "read": ("EIO", "EINTR"),
    "pread": ("EIO", "EINTR", "EIO for a while"),
    "listdir": ("EIO", "ENOENT"),
    "stat": ("EIO", "ENOENT"),
    "statvfs": ("EIO", "ENOENT"),
    "flock": ("EINTR", "ENOLCK"),
    "send": ("EAGAIN", "EINTR", "ECONNRESET", "short"),
    "recv": ("EAGAIN", "EINTR", "ECONNRESET"),
}
_REPEATED = ("EINTR", "EAGAIN", "short", "ECONNRESET")
PROCESSES = ("server", "fuser", "client", "limit")  # the last: a server with a limited journal


class Case(Struct, frozen=True):
    """A system call that fails. `number` counts the calls of that process, name and place from 1."""

    process: str
    call: str
    place: str
    number: int
    kind: str

    def __str__(self) -> str:
        return f"{self.process} {self.call} {self.place} {self.number} {self.kind}"


class Outcome(Struct, kw_only=True):
    """End of a run. `problems` is empty when every promise was kept."""

    case: Case | None
    happened: bool  # the call was made, and failed
    problems: list[str]
    ended: list[str]  # last words of processes that ended by themselves and were started again
    told: list[str]  # problems in the server's health in the end of a life
    skipped: int  # keyframes of which `send` said so; they were sent once more
    seconds: float
    counts: dict[tuple[str, str, str], int] = {}


class Fault:
    """Decides for each call whether it fails."""

    def __init__(self, case: Case | None) -> None:
        self.happened = False
        self._case = case
        self._until = 0.0

    def __call__(self, call: Call) -> int:
        case = self._case
        if case is None or (call.process, call.name, call.place) != (case.process, case.call, case.place):
            return 0
        kind, _, lasts = case.kind.partition(" ")
        if call.number == case.number:
            self.happened = True
            self._until = time.monotonic() + (_LASTS if lasts else 0.0)
        elif not (self.happened and time.monotonic() < self._until):
            return 0
        return SHORT if kind == "short" else int(getattr(errno, kind))


def cases(counts: dict[tuple[str, str, str], int], process: str) -> list[Case]:
    """Every kind of fault of a process's calls: at the first, the middle and the last on each place.

    What the interpreter or libzmq repeats by itself fails at the middle one alone.
    """
    found = []
    for (name_of, name, place_), count in sorted(counts.items()):
        for kind in _KINDS[name] if name_of == process else ():
            if (place_, kind) == ("unix", "ECONNRESET"):  # while both ends live, no system does that
                continue
            chosen = {(count + 1) // 2} if kind in _REPEATED else {1, (count + 1) // 2, count}
            found += [Case(process, name, place_, number, kind) for number in sorted(chosen)]
    return found


class Report(Struct):
    """Findings of a watcher."""

    happened: bool
    counts: list[tuple[str, str, str, int]]


class WatcherProcess:
    """A `Watcher` with a `Fault`, as a process: who forks must have one thread."""

    def __init__(self, folder: Path, case: Case | None) -> None:
        self._folder, self._case = folder, case
        self.address = str(folder / "watcher")
        reading, self._end = os.pipe()
        self._process = Forked(lambda: self._watch(reading), folder, "watcher", kept=[reading])
        os.close(reading)
        while not Path(self.address).exists():
            time.sleep(0.001)

    def _watch(self, reading: int) -> None:
        fault = Fault(self._case)
        watcher = Watcher(self.address, functools.partial(place, self._folder), fault)
        os.read(reading, 1)  # until the other end is closed
        counts = [(*key, count) for key, count in watcher.counts.items()]
        sys.stdout.write(msgspec.json.encode(Report(fault.happened, counts)).decode())

    def end(self) -> Report:
        """Stop watching; the processes have ended."""
        os.close(self._end)
        self._process.wait(PATIENCE)
        return msgspec.json.decode(self._process.said(), type=Report)


def place(folder: Path, path: str) -> str | None:
    """A name for a path in a run's folder, the same in each run; None = it does not count."""
    if not re.match(f"{folder}/(state|spool|tmp)($|/)", path):
        return None
    short = re.sub(r"tsfusion-\w+|tmp/\w{8}$|#\d+", "*", path.removeprefix(f"{folder}/"))
    return re.sub(r"\b\d{6}\b", "N", re.sub(r"[0-9a-f]{8}-\d+-", "*-", short))


class Run:
    """A run in an empty folder, its path short.

    Args:
        process: whose system calls are watched.
        real: with Taichi's map instead of a sum.
    """

    def __init__(self, folder: Path, case: Case | None, *, process: str, real: bool = False) -> None:
        self.folder, self.state, self.spool = folder, folder / "state", folder / "spool"
        self._case, self._watched, self._real = case, process, real
        self._walls = LAST_LIMITED if process == "limit" else LAST
        self._address = lasting_address()
        self._problems: list[str] = []
        self._ended: list[str] = []
        self._told: list[str] = []
        self._skipped = self._begun = 0
        (folder / "tmp").mkdir()
        self._watcher = WatcherProcess(folder, case)

    def run(self) -> Outcome:
        """Live the three lives, and look at what is left."""
        started = time.monotonic()
        self._live(0, FIRST, serves=False)
        for part in ((FIRST, SECOND), (SECOND, self._walls)):
            if not self._problems:
                self._live(*part)
        report = self._watcher.end()
        if not self._problems:
            self._check_journal()
            self._check_left_overs()
            self._check_map()
        return Outcome(
            case=self._case,
            happened=report.happened,
            problems=self._problems,
            ended=self._ended,
            told=self._told,
            skipped=self._skipped,
            seconds=round(time.monotonic() - started, 2),
            counts={(process, name, where): count for process, name, where, count in report.counts},
        )

    # --- lives ---

    def _live(self, first: int, end: int, *, serves: bool = True) -> None:
        gateway = self._keep(self._serve, "server") if serves else None
        client = self._keep(functools.partial(self._scan, first, end, serves), "client")
        both = [one for one in (client, gateway) if one is not None]
        try:
            if self._await(lambda: client.process.poll() == 0, both):
                self._read(client.process)
                if gateway is not None:
                    self._stop(gateway)
        finally:
            for one in both:
                one.process.kill()

    def _keep(self, main: Callable[[], object], name: str) -> "Kept":
        def begin() -> Forked:
            self._begun += 1
            if name == "server":
                (self.folder / "ready").unlink(missing_ok=True)
            return Forked(main, self.folder, f"{name}{self._begun}")

        return Kept(begin, name)

    def _await(self, reached: Callable[[], bool], kept: "list[Kept]") -> bool:
        """Wait, and start again what ends by itself; whether it was reached."""
        end = time.monotonic() + PATIENCE
        while not reached():
            for one in kept:
                if one.process.poll() is not None and not reached():
                    self._note_end(one)
                    if self._problems:
                        return False
                    one.start_again()
            if time.monotonic() > end:
                self._problems.append("hangs: " + " / ".join(one.process.complained()[-300:] for one in kept))
                return False
            time.sleep(0.01)
        return True

    def _note_end(self, one: "Kept") -> None:
        words = one.process.complained()
        last = words.strip().rpartition("\n")[2]
        self._ended.append(f"{one.name} {one.process.returncode}: {last}"[-400:])
        if "Traceback" in words or not last or one.process.returncode != 1:
            self._problems.append(f"the {one.name} ended with {one.process.returncode}: {words[-1500:]}")
        elif one.starts == _STARTS:
            self._problems.append(f"the {one.name} ended {_STARTS} times: {words[-500:]}")

    def _stop(self, gateway: "Kept") -> None:
        """Have the server save its maps and end; once more where it says that it could not."""
        for is_last in (False, True):
            if not self._await((self.folder / "ready").exists, [gateway]):
                return
            self._check_open_files(gateway.process.pid)
            os.kill(gateway.process.pid, signal.SIGTERM)
            status = gateway.process.wait(PATIENCE)
            words = gateway.process.complained() + self._fusers_words()
            if status == 0 and "Traceback" not in words:
                return
            if status != 1 or "Traceback" in words or "no checkpoint" not in words or is_last:
                self._problems.append(f"the stopped server ended with {status}: {words[-1500:]}")
                return
            self._ended.append(f"server {status} when stopped")
            time.sleep(_LASTS)
            gateway.start_again()

    def _fusers_words(self) -> str:
        return "".join(path.read_text() for path in sorted(self.folder.glob("fuser*.err")))

    def _read(self, client: Forked) -> None:
        *told, files, skipped = client.said().splitlines()
        self._skipped += int(skipped.rpartition(" ")[2])
        self._told += told
        if files != "[]":
            self._problems.append(f"the client has files open several times: {files}")

    # --- the processes ---

    def _scan(self, first: int, end: int, waits: bool) -> None:
        self._enter("client")
        faulty_client.scan(Orders(
            address=self._address if waits else NOBODY, spool=str(self.spool), log=str(self.folder / "log"),
            first=first, end=end, waits=waits,
        ))  # fmt: skip

    def _enter(self, *names: str) -> None:
        """Have this process leave its temporary files in the run's folder, and its system calls watched."""
        tempfile.tempdir = os.environ["TMPDIR"] = str(self.folder / "tmp")
        if self._watched in names:
            syscall_faults.install(self._watcher.address, self._watched)

    def _serve(self) -> None:
        logs.configure("text", "warning")
        if self._real:
            own = f"sys.path.append({str(ROOT)!r}); from lab.reliability import syscall_faults"
            install = f"syscall_faults.install({self._watcher.address!r}, 'fuser')"
            lines = ["import sys, tsfusion.tsdf.volume", "from tsfusion.fuser.__main__ import main"]
            lines += [own, install] * (self._watched == "fuser")
            fuser_process.COMMAND = (sys.executable, "-c", "\n".join([*lines, "sys.exit(main())"]))
        else:
            fuser_process.subprocess = SimpleNamespace(  # type: ignore[attr-defined,assignment]
                Popen=self._fuser, PIPE=None, DEVNULL=None, TimeoutExpired=subprocess.TimeoutExpired
            )
        self._enter("server", "limit")
        limit: dict[str, Any] = {"journal_bytes": 1 << 20} if self._watched == "limit" else {}
        config = ServerConfig(listen=self._address, state=str(self.state), **{**SERVER, **limit})
        sys.exit(server.run(config, VOLUME, lambda _: (self.folder / "ready").touch()))

    def _fuser(self, command: list[str], *, pass_fds: Iterable[int], **_: object) -> "ForkedFuser":
        def fuse() -> None:
            self._enter("fuser")
            sum_map.take_the_place_of_volume()
            sys.argv = ["fuser", *command[len(fuser_process.COMMAND) :]]
            sys.exit(fuser.main())

        return ForkedFuser(fuse, self.folder, pass_fds)

    # --- what must be true ---

    def _check_journal(self) -> None:
        verdict = inspection.verify(state_folder.find_journal(self.state), lambda *_: None)
        if not verdict.intact:
            self._problems.append(f"the journal is damaged: {verdict.problems}")
        found = numbers(self.state / "maps/default/journal")
        if self._watched != "limit" and found != [i for i in range(self._walls) if i != REFUSED]:
            self._problems.append(f"the journal has {found}")
        taken = faulty_client.taken(self.folder / "log")
        if taken != list(range(self._walls)):
            self._problems.append(f"the client took {taken}")

    def _check_open_files(self, pid: int) -> None:
        places = Counter(place(self.folder, one) for one in faulty_client.open_files(pid, str(self.state)))
        if several := {where: count for where, count in places.items() if count > 1}:
            self._problems.append(f"the server has files open: {several}")

    def _check_left_overs(self) -> None:
        tmp = self.folder / "tmp"
        left = [path for path in self.folder.rglob("*") if not path.is_dir() or path.parent == tmp]
        places = {where for path in left if (where := place(self.folder, str(path)))}
        usual = {
            "spool/lock", "spool/refused/*-quota.mcap", "state/lock", "state/maps/default/fuser.lock",
            "state/maps/default/journal/N.mcap", "state/maps/default/map.tsf",
            "state/maps/default/quarantine/*-mapfull.mcap",
            *(["state/maps/default/map.previous.tsf"] if self._watched == "limit" else []),
        }  # fmt: skip
        if self._case is not None and self._case.call in ("unlink", "rmdir"):
            usual |= {self._case.place, str(Path(self._case.place).parent)}  # it could not be deleted
        if self._case is not None and (self._case.call, self._case.place) == ("stat", "spool"):
            usual |= {"spool/N.mcap"}  # nothing is deleted then: the next scan sends it, and it is known
        if places - usual:
            self._problems.append(f"these files are left: {sorted(places - usual)}")

    def _check_map(self) -> None:
        lacking = (REFUSED,) if self._real else (REFUSED, REJECTED)
        walls = [i for i in range(self._walls) if i not in lacking]
        path = self.state / "maps/default/map.tsf"
        made = map(faulty_client.noisy_wall, walls)
        hashes = (
            (sum_map.hash_of(made), sum_map.SumMap.load(path).map_hash())
            if not self._real
            else (answer(lambda: map_hash(made)), answer(lambda: _real_hash(path)))
        )
        if len(set(hashes)) > 1:
            self._problems.append(f"the map's hash is {hashes[1]}, not {hashes[0]}")


def _real_hash(path: Path) -> str:
    from tsfusion import Volume

    return Volume.load(path).map_hash()


class Kept:
    """A process that is started again when it ends by itself."""

    def __init__(self, begin: Callable[[], Forked], name: str) -> None:
        self.name, self._begin = name, begin
        self.starts = 1
        self.process = begin()

    def start_again(self) -> None:
        time.sleep(_PAUSE * (self.starts > 1))
        self.starts += 1
        self.process = self._begin()


class ForkedFuser:
    """In the gateway, in the place of `subprocess.Popen`."""

    def __init__(self, main: Callable[[], object], folder: Path, kept: Iterable[int]) -> None:
        reading, writing = os.pipe()
        count = len(list(folder.glob("fuser*.err")))
        self._process = Forked(main, folder, f"fuser{count}", stdin=reading, kept=kept)
        os.close(reading)
        self.stdin = os.fdopen(writing, "wb")
        self.poll, self.kill, self.pid = self._process.poll, self._process.kill, self._process.pid

    def wait(self, timeout: float = PATIENCE) -> int:
        """The exit status."""
        status = self._process.wait(timeout)
        if status is None:
            raise subprocess.TimeoutExpired("fuser", timeout)
        return status
