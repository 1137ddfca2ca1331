# SPDX-License-Identifier: MIT
"""Jobs carried out by a scheduler: those that are done already are not done again, lost ones are."""

import logging
from collections import deque
from collections.abc import Callable, Iterable
from pathlib import Path

import msgspec

from tsfusion.cluster import jobs
from tsfusion.cluster.jobs import AnyJob, JobDone, JobFailed, JobLost, JobProgress
from tsfusion.cluster.schedulers import Scheduler
from tsfusion.core import errors
from tsfusion.core.errors import OutputError, TsfusionError, WorkerLost

ATTEMPTS = 5  # at a job that takes whoever does it along: then it is the job's own fault

log = logging.getLogger(__name__)


class CarryingOut:
    """Jobs of one run.

    Args:
        scheduler: who does them.
        folder: where they write, and where those that are done are found again.

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
        """Do all of these jobs, in any order; what they say in the end, in theirs.

        Raises:
            TsfusionError: as a job that failed; `WorkerLost` where a job ends one worker after the other.
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
                f"the job {message.name} has ended {attempt} workers, one after the other; {message.why} "
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
        """Result of a job in an earlier run, if all of its files are still there, as it wrote them."""
        try:
            content = jobs.done_file(self._folder, job.name).read_bytes()
            done = msgspec.msgpack.decode(content, type=JobDone)
            is_whole = (done.name, done.digests) == (job.name, jobs.digests(self._folder, done.files))
        except (OSError, ValueError, msgspec.DecodeError, RecursionError):
            is_whole = False
        return done if is_whole else None


def _error(message: JobFailed) -> TsfusionError:
    """The error of a job, as if it had been raised here."""
    kind: type[Exception] = getattr(errors, message.kind, TsfusionError)
    return kind(message.why) if issubclass(kind, TsfusionError) else TsfusionError(message.why)
