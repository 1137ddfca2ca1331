# SPDX-License-Identifier: MIT
"""What the operating system knows of this process."""

import resource
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType


def peak_rss_bytes() -> int:
    """The most memory this process has held, bytes."""
    if sys.platform == "linux":
        # not getrusage: its maximum survives exec, so a child would report its parent's
        with suppress(OSError):  # no file descriptor is left: better that figure than none
            for line in Path("/proc/self/status").read_text(encoding="ascii").splitlines():
                if line.startswith("VmHWM:"):
                    return int(line.split()[1]) * 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Hold Ctrl-C back until the end of the block: what must happen whole happens whole, or not at all."""
    if threading.current_thread() is not threading.main_thread():
        yield  # signals only ever interrupt the main thread
        return
    pressed: list[tuple[int, FrameType | None]] = []
    usual = signal.getsignal(signal.SIGINT)
    signal.signal(signal.SIGINT, lambda number, frame: pressed.append((number, frame)))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, usual)
    if pressed and callable(usual):
        usual(*pressed[0])
