# SPDX-License-Identifier: MIT
"""Processes that begin as a copy of this one, so that they need not import what it has.

Fork while there is one thread.
"""

import os
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path

from tsfusion.core.errors import TsfusionError


class Forked:
    """A process that calls `main`; what it writes goes into files.

    Args:
        folder: of the files `NAME.out` and `NAME.err`.
        stdin, kept: descriptors that it has; all others are closed.
    """

    def __init__(
        self,
        main: Callable[[], object],
        folder: Path,
        name: str,
        *,
        stdin: int = -1,
        kept: Iterable[int] = (),
    ) -> None:
        self._out, self._err = folder / f"{name}.out", folder / f"{name}.err"
        self.returncode: int | None = None
        self.pid = os.fork()
        if not self.pid:
            self._become(main, stdin, sorted(kept))

    def _become(self, main: Callable[[], object], stdin: int, kept: list[int]) -> None:
        if stdin < 0:
            stdin = os.open(os.devnull, os.O_RDONLY)
        os.dup2(stdin, 0)
        for number, path in ((1, self._out), (2, self._err)):
            os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND), number)
        first = 3
        for one in [*kept, os.sysconf("SC_OPEN_MAX")]:
            os.closerange(first, one)
            first = one + 1
        sys.stdin, sys.stdout, sys.stderr = (open(i, "rw"[i > 0], 1, closefd=False) for i in range(3))  # noqa: SIM115
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, signal.SIG_DFL)
        status = 1
        try:
            status = _run(main)
        finally:
            with suppress(OSError):
                sys.stdout.flush()
            os._exit(status)

    def poll(self) -> int | None:
        """The exit status, negative for a signal; None = it runs."""
        if self.returncode is None:
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            self.returncode = os.waitstatus_to_exitcode(status) if pid else None
        return self.returncode

    def wait(self, seconds: float) -> int | None:
        """Wait for its end; None = it has not come."""
        end = time.monotonic() + seconds
        while self.poll() is None and time.monotonic() < end:
            time.sleep(0.005)
        return self.returncode

    def kill(self) -> None:
        """End it, if need be."""
        if self.poll() is None:
            os.kill(self.pid, signal.SIGKILL)
            self.wait(10.0)

    def said(self) -> str:
        """What it wrote to stdout."""
        return self._out.read_text() if self._out.exists() else ""

    def complained(self) -> str:
        """What it wrote to stderr."""
        return self._err.read_text() if self._err.exists() else ""


def _run(main: Callable[[], object]) -> int:
    """Call `main` as the interpreter calls a program; the exit status."""
    try:
        main()
    except SystemExit as end:
        if isinstance(end.code, str):
            sys.stderr.write(f"{end.code}\n")
        return end.code if isinstance(end.code, int) else int(end.code is not None)
    except TsfusionError as error:  # as the command line does
        sys.stderr.write(f"{type(error).__name__}: {error}\n")
        return 1
    except BaseException:  # noqa: BLE001  as the interpreter does
        traceback.print_exc(file=sys.stderr)
        return 1
    return 0


def answer(main: Callable[[], str]) -> str:
    """What `main` returns in a copy of this process."""
    reading, writing = os.pipe()
    pid = os.fork()
    if not pid:
        os.write(writing, main().encode())
        os._exit(0)
    os.close(writing)
    with open(reading, encoding="utf-8") as file:
        text = file.read()
    os.waitpid(pid, 0)
    return text
