# SPDX-License-Identifier: MIT
"""Start the `tsfusion` command, also for `python -m tsfusion`."""

import os
import signal
import sys
from typing import NoReturn


def main(arguments: list[str] | None = None) -> NoReturn:
    """Run a command line (default: this process's) and exit; Ctrl-C during imports ends it silently."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:  # closed by who started us; the lowest descriptor takes its place
            setattr(sys, name, open(os.devnull, mode))  # noqa: SIM115
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    os.environ.setdefault("OPENCV_LOG_LEVEL", "SILENT")  # its errors are told once, in our own words
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # and those of videos
    # It takes gigabytes for a file of some bytes that claims them; a program that imports us may read such
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(1 << 26))
    # Products of matrices are small here, and NumPy's second thread waits for the next one at full speed
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    from tsfusion import cli

    cli.main(arguments)


if __name__ == "__main__":
    main()
