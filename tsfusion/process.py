# SPDX-License-Identifier: MIT
"""What the operating system knows of this process."""

import resource
import sys
from contextlib import suppress
from pathlib import Path


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
