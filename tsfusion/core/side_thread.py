# SPDX-License-Identifier: MIT
"""Work in C that a second thread does meanwhile: hashes, compression, NumPy on large arrays."""

from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType

_MOST_WAITING = 2  # calls: what they hold is memory


class SideThread:
    """Does calls one after the other, in their order, beside the thread that uses it as a context.

    Where no thread can be had the calls are done at once.
    """

    def __init__(self) -> None:
        self._pool: ThreadPoolExecutor | None = ThreadPoolExecutor(1)
        self._waiting: deque[Future[None]] = deque()

    def __enter__(self) -> "SideThread":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, where: TracebackType | None
    ) -> None:
        if self._pool is not None:
            self._pool.shutdown(cancel_futures=True)

    def do(self, call: Callable[[], None]) -> None:
        """Do a call soon; waits while too many others are to be done. Raises what one of them raised."""
        if self._pool is not None:
            try:
                self._waiting.append(self._pool.submit(call))
            except RuntimeError:  # no thread, for want of memory
                self._pool = None
        if self._pool is None:
            call()
        while len(self._waiting) > _MOST_WAITING:
            self._waiting.popleft().result()

    def wait(self) -> None:
        """Wait until every call is done; raises what one of them raised."""
        while self._waiting:
            self._waiting.popleft().result()
