# SPDX-License-Identifier: MIT
"""Whoever does jobs: what every engine offers, and processes of this machine."""

import os
import selectors
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from typing import Protocol

import msgspec

from tsfusion.cluster.__main__ import LENGTH
from tsfusion.cluster.jobs import AnyJob, JobDone, JobFailed, JobLost, JobMessage
from tsfusion.core import process
from tsfusion.core.errors import OutputError

_END_S = 5.0


class Scheduler(Protocol):
    """An engine that does some jobs at the same time.

    Attributes:
        name: of the engine.
        workers: how many jobs at most.
    """

    name: str
    workers: int

    def start(self, job: AnyJob) -> None:
        """Begin a job; there are fewer than `workers` under way."""

    def wait(self) -> Sequence[JobMessage]:
        """Next messages of the jobs under way, at least one. `JobDone`, `JobFailed` or `JobLost` end one."""

    def close(self) -> None:
        """End all, also what is under way."""


class LocalProcesses:
    """Jobs in processes of this machine; one that dies is replaced when the next job comes."""

    name = "processes"

    def __init__(self, workers: int) -> None:
        self.workers = workers
        self._idle: list[_Worker] = []
        self._busy = selectors.DefaultSelector()

    @property
    def pids(self) -> list[int]:
        """Pids of the processes that do jobs now."""
        return [key.data.process.pid for key in self._busy.get_map().values()]

    def start(self, job: AnyJob) -> None:
        worker = self._idle.pop() if self._idle else _Worker()
        self._busy.register(worker.output, selectors.EVENT_READ, worker)
        worker.begin(job)

    def wait(self) -> Sequence[JobMessage]:
        found: list[JobMessage] = []
        while not found:
            for key, _ in self._busy.select():
                worker: _Worker = key.data
                found.extend(worker.read())
                if worker.job is None:
                    self._busy.unregister(worker.output)
                    if worker.is_over:
                        worker.end()
                    else:
                        self._idle.append(worker)
        return found

    def close(self) -> None:
        for worker in [*self._idle, *(key.data for key in self._busy.get_map().values())]:
            worker.end()
        self._busy.close()


class _Worker:
    """A process, and the job that it does."""

    def __init__(self) -> None:
        try:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "tsfusion.cluster"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                **process.OWN_GROUP,
            )
        except OSError as error:
            raise OutputError(f"a worker cannot be started: {error.strerror}") from error
        assert self.process.stdout is not None
        self.output = self.process.stdout.fileno()
        self.job: str | None = None
        self.is_over = False
        self._unread = b""

    def begin(self, job: AnyJob) -> None:
        self.job = job.name
        encoded = msgspec.msgpack.encode(job)
        assert self.process.stdin is not None
        with suppress(BrokenPipeError):  # its end shows when it is read
            self.process.stdin.write(LENGTH.pack(len(encoded)) + encoded)
            self.process.stdin.flush()

    def read(self) -> list[JobMessage]:
        """The messages that have come."""
        content = os.read(self.output, 1 << 16)
        if not content:
            name, self.job, self.is_over = self.job, None, True
            return [JobLost(name or "", f"its process ended with status {self.process.wait()}")]
        self._unread += content
        found: list[JobMessage] = []
        while len(self._unread) >= LENGTH.size:
            end = LENGTH.size + LENGTH.unpack_from(self._unread)[0]
            if len(self._unread) < end:
                break
            found.append(msgspec.msgpack.decode(self._unread[LENGTH.size : end], type=JobMessage))
            self._unread = self._unread[end:]
        if any(isinstance(one, JobDone | JobFailed) for one in found):
            self.job = None
        return found

    def end(self) -> None:
        """End the process at once: what it writes appears whole or not at all."""
        self.process.kill()
        with suppress(OSError, subprocess.TimeoutExpired), self.process:  # closes its pipes
            self.process.wait(_END_S)
