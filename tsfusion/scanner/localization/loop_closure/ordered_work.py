# SPDX-License-Identifier: MIT
"""Work beside the tracker: done in order, by one thread of lower priority, with an end to what waits."""

import os
import threading
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress
from typing import ParamSpec

Given = ParamSpec("Given")
_NICE = 10  # of the thread


class OrderedWork:
    """Calls that one thread makes, one after the other.

    Args:
        name: of the thread.
        most: number of calls that wait or are under way; `add` waits for room.
    """

    def __init__(self, name: str, most: int) -> None:
        self._thread = ThreadPoolExecutor(1, thread_name_prefix=name, initializer=_be_nice)
        self._most = most
        self._waiting: deque[Future[None]] = deque()

    def add(self, call: Callable[Given, None], *args: Given.args, **kwargs: Given.kwargs) -> None:
        """Have a call made after those before it. An earlier call's error is raised here, or by `wait`."""
        while self._waiting and (self._waiting[0].done() or len(self._waiting) >= self._most):
            self._waiting.popleft().result()
        self._waiting.append(self._thread.submit(call, *args, **kwargs))

    def wait(self) -> None:
        """Wait until all calls were made."""
        while self._waiting:
            self._waiting.popleft().result()


def _be_nice() -> None:
    """Let the tracker's thread go first, where threads have a priority of their own."""
    if hasattr(os, "setpriority") and hasattr(os, "sched_setaffinity"):  # Linux
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
