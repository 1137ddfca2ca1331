# SPDX-License-Identifier: MIT
"""Run a worker process: read jobs from stdin, write messages to stdout, and end when stdin closes."""

import os
import signal
import struct
import sys
from typing import BinaryIO

import msgspec

from tsfusion.cluster.jobs import AnyJob
from tsfusion.core import process

LENGTH = struct.Struct("<I")  # before each job and each message


def main() -> None:
    """Do the jobs that arrive on stdin, and write their messages to stdout, until stdin closes."""
    process.on_parent_end(signal.SIGKILL)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the process that gives the jobs handles Ctrl-C
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # output of libraries goes to stderr: stdout is for messages
    from tsfusion.cluster import job_runner

    while (job := _next(sys.stdin.buffer)) is not None:
        for message in job_runner.run(job):
            encoded = msgspec.msgpack.encode(message)
            answers.write(LENGTH.pack(len(encoded)) + encoded)
            answers.flush()


def _next(stream: BinaryIO) -> AnyJob | None:
    head = stream.read(LENGTH.size)
    if len(head) < LENGTH.size:
        return None
    try:
        job: AnyJob = msgspec.msgpack.decode(stream.read(LENGTH.unpack(head)[0]), type=AnyJob)
    except (msgspec.MsgspecError, RecursionError) as error:
        sys.exit(f"tsfusion worker: what came on stdin is no job: {error}")
    return job


if __name__ == "__main__":
    main()
