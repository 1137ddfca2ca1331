# SPDX-License-Identifier: MIT
"""Functions that fail, to be put in the place of those that a disk or the memory would let down."""

import os
import resource
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from tsfusion.core import process


def raising(error: BaseException) -> Callable[..., Any]:
    """Fail so, whatever it is called with."""

    def fail(*_arguments: object, **_more: object) -> Any:
        raise error

    return fail


def refuse(code: int) -> Callable[..., Any]:
    """Fail as the operating system does, with an `errno`."""
    return raising(OSError(code, os.strerror(code)))


@contextmanager
def memory_limited(nbytes: int) -> Iterator[None]:
    """Let this process take so many bytes more for the block, or so many less than it has (Linux)."""
    before = resource.getrlimit(resource.RLIMIT_DATA)
    process.limit_memory(process.data_bytes() + nbytes)
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, before)
