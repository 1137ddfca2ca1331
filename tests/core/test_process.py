# SPDX-License-Identifier: MIT
"""Processes that are started, the terminal, and the cores that threads run on."""

import os
import platform
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import pytest

from tsfusion.core import process


def test_a_process_of_its_own_group_stays_in_this_session() -> None:
    print_ids = "import os; print(os.getpgid(0), os.getsid(0), os.getpid())"
    command = [sys.executable, "-c", print_ids]
    found = subprocess.run(command, capture_output=True, check=True, text=True, **process.OWN_GROUP).stdout
    group, session, pid = map(int, found.split())
    assert group == pid  # Ctrl-C goes to the group in the foreground
    assert session == (os.getsid(0) if sys.version_info >= (3, 11) else pid)


@contextmanager
def waiting(count: int) -> Iterator[list[int]]:
    """Numbers of so many threads, which wait until the end of the block."""
    over = threading.Event()
    threads = [threading.Thread(target=over.wait, args=(60,)) for _ in range(count)]
    try:
        for thread in threads:
            thread.start()
        yield [thread.native_id for thread in threads if thread.native_id is not None]
    finally:
        over.set()
        for thread in threads:
            thread.join()


@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="a system without cores of one's own")
def test_as_many_threads_as_cores_have_one_each() -> None:
    ours = process.cores()
    assert set(ours) == os.sched_getaffinity(0)
    with ExitStack() as stack:
        (early,) = stack.enter_context(waiting(1))
        with process.cores_of_their_own(len(ours)):
            first, *apart = stack.enter_context(waiting(len(ours) + 1))
        with process.cores_of_their_own(len(ours) + 1):
            free = stack.enter_context(waiting(len(ours) + 1))
        with process.cores_of_their_own(len(ours)), waiting(2):
            pass  # they have ended, which does no harm
        assert [os.sched_getaffinity(thread) for thread in apart] == [{core} for core in ours]
        for thread in (0, early, first, *free):
            assert os.sched_getaffinity(thread) == set(ours)


_ALLOCATES = """
import resource
import numpy as np
from tsfusion.core import process
process.keep_freed_memory()
def work():
    return sum(int(array[-1]) for array in [np.ones(600_000, np.uint8) for _ in range(20)])
for _ in range(3):
    work()
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(20):
    work()
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another allocator")
def test_freed_memory_does_not_come_back_page_by_page() -> None:
    """Twenty times 12 MB, 3,000 pages, as the arrays of keyframes come and go."""
    found = subprocess.run([sys.executable, "-c", _ALLOCATES], check=True, capture_output=True).stdout
    assert int(found) < 2_000
