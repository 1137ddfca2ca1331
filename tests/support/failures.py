# SPDX-License-Identifier: MIT
"""Functions that fail, to be put in the place of those that a disk or the memory would let down."""

import os
from collections.abc import Callable
from typing import Any


def raising(error: BaseException) -> Callable[..., Any]:
    """Fail so, whatever it is called with."""

    def fail(*_arguments: object, **_more: object) -> Any:
        raise error

    return fail


def refuse(code: int) -> Callable[..., Any]:
    """Fail as the operating system does, with an `errno`."""
    return raising(OSError(code, os.strerror(code)))
