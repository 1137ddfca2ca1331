# SPDX-License-Identifier: MIT
"""Carry out jobs by a scheduler, repeat lost ones, skip done ones; run them in local processes."""

import logging
import os
import selectors
import subprocess
import sys
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Protocol

import msgspec

from tsfusion.cluster import jobs
from tsfusion.cluster.__main__ import LENGTH
from tsfusion.cluster.jobs import AnyJob, JobDone, JobFailed, JobLost, JobMessage, JobProgress
from tsfusion.core import errors, process
from tsfusion.core.errors import OutputError, TsfusionError, WorkerLost, refusals_as

_END_S = 5.0
ATTEMPTS = 5  # at a job whose worker ends each time: then the job itself is at fault
log = logging.getLogger(__name__)


class Scheduler(Protocol):
    """An engine that does several jobs at the same time.

    Attributes:
        name: name of the engine.
        workers: most jobs at the same time.
    """

    name: str
    workers: int

    def start(self, job: AnyJob) -> None:
        """Begin a job. The caller ensures that fewer than `workers` jobs are running."""

    def wait(self) -> Sequence[JobMessage]:
        """Return one or more messages of running jobs. `JobDone`, `JobFailed` and `JobLost` end a job."""

    def close(self) -> None:
        """End the engine and its running jobs."""


class LocalProcesses:
    """Does jobs in processes of this machine. A process that dies is replaced for the next job."""

    name = "processes"

    def __init__(self, workers: int) -> None:
        self.workers = workers
        self._idle: list[_Worker] = []
        self._busy = selectors.DefaultSelector()

    @property
    def pids(self) -> list[int]:
        """Ids of the processes that have a job now."""
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
    """A worker process and its present job."""

    def __init__(self) -> None:
        with refusals_as(OutputError, "a worker cannot be started"):
            self.process = subprocess.Popen(
                [sys.executable, "-m", "tsfusion.cluster"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                **process.OWN_GROUP,
            )
        assert self.process.stdout is not None
        self.output = self.process.stdout.fileno()
        self.job: str | None = None
        self.is_over = False
        self._unread = b""

    def begin(self, job: AnyJob) -> None:
        self.job = job.name
        encoded = msgspec.msgpack.encode(job)
        assert self.process.stdin is not None
        with suppress(BrokenPipeError):  # `read` finds out that the process has ended
            self.process.stdin.write(LENGTH.pack(len(encoded)) + encoded)
            self.process.stdin.flush()

    def read(self) -> list[JobMessage]:
        """Return the messages that the process has sent so far."""
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
        """Kill the process. Its job leaves each file complete or not at all."""
        self.process.kill()
        with suppress(OSError, subprocess.TimeoutExpired), self.process:  # closes its pipes
            self.process.wait(_END_S)


class CarryingOut:
    """Carries out the jobs of one run.

    Args:
        scheduler: engine that does the jobs.
        folder: folder of the jobs' files, also those of an earlier run.

    Attributes:
        lost: number of times that a job's worker ended before it was done.
        found: number of jobs that an earlier run had done.
        watch: called with messages of jobs under way.
    """

    def __init__(
        self, scheduler: Scheduler, folder: Path, watch: Callable[[JobProgress], None] = lambda _: None
    ) -> None:
        self._scheduler, self._folder, self._watch = scheduler, folder, watch
        self.lost = self.found = 0

    def do(
        self, todo: Iterable[AnyJob], finished: Callable[[JobDone], None] = lambda _: None
    ) -> list[JobDone]:
        """Do all these jobs in any order. Return their `JobDone` messages in the order of `todo`.

        Raises:
            TsfusionError: the error of a failed job; `WorkerLost` when a job ends one worker after the other.
        """
        todo = list(todo)
        ended: dict[str, JobDone] = {}
        for job in todo:
            if (done := self._done(job)) is not None:
                self.found += 1
                ended[job.name] = done
                finished(done)
        waiting = deque(job for job in todo if job.name not in ended)
        under_way: dict[str, tuple[AnyJob, int]] = {}
        attempts = dict.fromkeys((job.name for job in todo), 0)
        while waiting or under_way:
            while waiting and len(under_way) < self._scheduler.workers:
                job = waiting.popleft()
                attempts[job.name] += 1
                under_way[job.name] = job, attempts[job.name]
                self._scheduler.start(job)
            for message in self._scheduler.wait():
                if isinstance(message, JobProgress):
                    self._watch(message)
                    continue
                job, attempt = under_way.pop(message.name)
                if isinstance(message, JobDone):
                    self._check_shared(message)
                    ended[job.name] = message
                    finished(message)
                elif isinstance(message, JobFailed):
                    raise _error(message)
                else:
                    self._note_loss(message, attempt)
                    waiting.appendleft(job)
        return [ended[job.name] for job in todo]

    def _note_loss(self, message: JobLost, attempt: int) -> None:
        self.lost += 1
        if attempt >= ATTEMPTS:
            raise WorkerLost(
                f"the job {message.name} cost {attempt} workers, one after the other; {message.why} "
                "(was memory short? --worker-memory and fewer --workers need less)"
            )
        self._watch(JobProgress(message.name, 0, 0))
        log.warning("a worker was lost, its job begins again: %s, %s", message.name, message.why)

    def _check_shared(self, done: JobDone) -> None:
        for name in done.files:
            if not (self._folder / name).is_file():
                raise OutputError(
                    f"a worker has written {name}, and it is not in {self._folder}: workers on other "
                    "machines need a folder that all of them share (--out)"
                )

    def _done(self, job: AnyJob) -> JobDone | None:
        """Return the result of a job in an earlier run, if all its files are still there and unchanged."""
        try:
            content = jobs.done_file(self._folder, job.name).read_bytes()
            done = msgspec.msgpack.decode(content, type=JobDone)
            is_whole = (done.name, done.digests) == (job.name, jobs.digests(self._folder, done.files))
        except (OSError, ValueError, msgspec.DecodeError, RecursionError):
            is_whole = False
        return done if is_whole else None


def _error(message: JobFailed) -> TsfusionError:
    """Return the error of a job, as if it had been raised in this process."""
    kind: type[Exception] = getattr(errors, message.kind, TsfusionError)
    return kind(message.why) if issubclass(kind, TsfusionError) else TsfusionError(message.why)
