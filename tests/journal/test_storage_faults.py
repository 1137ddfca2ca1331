# SPDX-License-Identifier: MIT
"""Each system call of journal, spool and checkpoint refused once: what was promised is there."""

import json
import subprocess
import sys
import tempfile

import pytest
from repository import TESTS

from lab.reliability import syscall_faults


@pytest.mark.skipif(not syscall_faults.is_possible(), reason="needs seccomp's user notification")
@pytest.mark.parametrize(
    ("kind", "every"),
    [
        ("EIO", 8),
        *(pytest.param(kind, 1, marks=pytest.mark.nightly) for kind in ("EIO", "ENOSPC", "EINTR", "short")),
    ],
)
def test_what_was_promised_is_there_whichever_call_is_refused(kind: str, every: int) -> None:
    with tempfile.TemporaryDirectory(prefix="tsf-", dir="/tmp") as folder:  # a socket's path has to be short
        command = [sys.executable, TESTS / "support/storage_faults.py", folder, kind, str(every)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    runs = [json.loads(line) for line in done.stdout.splitlines()]
    assert [one for one in runs if one["problems"]] == []
    assert done.returncode == 0, done.stderr
    assert len(runs) * every > 150
    calls = {one["call"].split()[0] for one in runs}
    assert every > 1 or calls > {"create", "fdatasync", "flock", "fsync", "open", "rename", "unlink", "write"}
