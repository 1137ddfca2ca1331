# SPDX-License-Identifier: MIT
"""Processes that are started, and the terminal."""

import os
import subprocess
import sys

from tsfusion.core import process


def test_a_process_of_its_own_group_stays_in_this_session() -> None:
    print_ids = "import os; print(os.getpgid(0), os.getsid(0), os.getpid())"
    command = [sys.executable, "-c", print_ids]
    found = subprocess.run(command, capture_output=True, check=True, text=True, **process.OWN_GROUP).stdout
    group, session, pid = map(int, found.split())
    assert group == pid  # Ctrl-C goes to the group in the foreground
    assert session == (os.getsid(0) if sys.version_info >= (3, 11) else pid)
