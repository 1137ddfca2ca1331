# SPDX-License-Identifier: MIT
"""Small machines, simulated on this one: a share of the time, and memory whose end is death.

    python lab/paper/paper_limits.py PID SHARE      stop and continue a process and its children in turn

The share is kept by SIGSTOP and SIGCONT many times a second, in a process of its own that lets them go on
when whoever started it ends.
"""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

PERIOD_S = 0.04  # of stop and go
SAMPLE_S = 0.2
_SPIN_S = 0.4  # of each of the calibration's measurements
_SPIN = "import time\ninput()\ne=time.monotonic()+{s}\nn=0\nwhile time.monotonic()<e: n+=1\nprint(n)"


class Sample(NamedTuple):
    """Memory of a process and its children at a moment."""

    t_ns: int  # monotonic
    rss_bytes: int


class Death(NamedTuple):
    """How a process ended before its time.

    Attributes:
        of: `memory`, or `signal 11`, `status 1`.
        words: with the figures.
    """

    of: str
    words: str


class MemoryWatch:
    """Samples the memory of a process and its children, and kills it where a small machine would.

    Args:
        limit_bytes: None = only sample.
        rss: bytes of a process and its children.
    """

    def __init__(
        self, process: "subprocess.Popen[bytes]", limit_bytes: int | None, rss: Callable[[int], int]
    ) -> None:
        self._process, self._limit, self._rss = process, limit_bytes, rss
        self.samples: list[Sample] = []
        self.death: Death | None = None
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="memory watch", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._ended.is_set():
            self._take()
            self._ended.wait(SAMPLE_S)

    def _take(self) -> None:
        found = self._rss(self._process.pid)
        if found:
            self.samples.append(Sample(time.monotonic_ns(), found))
        if self._limit is not None and found > self._limit and self.death is None:
            self.death = Death(
                "memory",
                f"killed with {found / 2**20:.0f} MiB resident, of {self._limit / 2**20:.0f} there are",
            )
            self._process.kill()

    def stop(self) -> None:
        """Sample no more."""
        self._ended.set()
        self._thread.join()


def death_of(returncode: int | None, watch: MemoryWatch, stderr: str) -> Death | None:
    """How a process ended, if not well."""
    if watch.death is not None or returncode == 0:
        return watch.death
    last = stderr.strip().splitlines()[-1:] or ["without a word"]
    if returncode is None:
        return Death("time", "it did not end, and was killed")
    how = f"signal {-returncode}" if returncode < 0 else f"status {returncode}"
    return Death("memory" if "MemoryError" in last[0] else how, last[0])


@contextmanager
def share_of_time(pid: int, share: float) -> Iterator[None]:
    """Let a process and its children run for a share of the time during the block."""
    if share >= 1:
        yield
        return
    command = [sys.executable, __file__, str(pid), str(share)]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdin=pipe, stdout=pipe, start_new_session=True) as throttle:
        assert throttle.stdin is not None
        assert throttle.stdout is not None
        try:
            throttle.stdout.readline()  # it has begun
            yield
        finally:
            throttle.stdin.close()  # it lets them go on, and ends
            throttle.wait(10)


def calibrate(share: float) -> float:
    """Speed of a spinning process that may run for a share of the time, as a share of its full speed."""
    return _spun(share) / max(_spun(1.0), 1)


def _spun(share: float) -> int:
    with (
        subprocess.Popen(
            [sys.executable, "-c", _SPIN.format(s=_SPIN_S)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        ) as spinning,
        share_of_time(spinning.pid, share),
    ):
        answer, _ = spinning.communicate("\n")  # once the share holds
    return int(answer)


def tree(pid: int) -> list[int]:
    """A process and all below it (Linux)."""
    found = [pid]
    with suppress(OSError):
        for task in Path(f"/proc/{pid}/task").iterdir():
            for child in (task / "children").read_text(encoding="ascii").split():
                found += tree(int(child))
    return found


def _throttle(pid: int, share: float) -> None:
    """Stop and continue until standard input is closed; then let all go on."""
    closed = threading.Event()

    def wait_for_end() -> None:
        sys.stdin.read()
        closed.set()

    threading.Thread(target=wait_for_end, daemon=True).start()
    print("begun", flush=True)
    try:
        while not closed.is_set():
            _signal(pid, signal.SIGSTOP)
            closed.wait((1 - share) * PERIOD_S)
            _signal(pid, signal.SIGCONT)
            closed.wait(share * PERIOD_S)
    finally:
        _signal(pid, signal.SIGCONT)


def _signal(pid: int, number: signal.Signals) -> None:
    for each in tree(pid):
        with suppress(ProcessLookupError):
            os.kill(each, number)


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _throttle(int(sys.argv[1]), float(sys.argv[2]))
