# SPDX-License-Identifier: MIT
"""System calls that fail once, on the way of a keyframe. All of them: `python lab/reliability/faults.py`."""

import json
import subprocess
import sys

import pytest
from repository import ROOT

from lab.reliability import syscall_faults

KINDS = [
    "server write state/maps/default/journal/N.mcap 8 short",
    "fuser rename state/maps/default/map.tsf 3 EIO",
    "client send tcp 9 ECONNRESET",
]
OTHERS = [
    "server fdatasync state/maps/default/journal/N.mcap 8 EIO for a while",
    "client write spool/N.mcap 8 ENOSPC for a while",
    # Each of these once ended a process with a traceback, or kept keyframes out of the map.
    "server listdir state/maps 1 EIO",
    "server open state/maps/default/corrections 1 EIO",
    "server open state/maps/default/quarantine 2 EIO",
    "fuser stat state/maps/default 1 EIO",
    "fuser mmap tmp/* 1 EAGAIN",
    "fuser pread state/maps/default/journal/N.mcap 1 EIO for a while",
    "fuser open state/maps/default/journal/N.mcap 1 ENOENT",
    "client listdir spool/refused 2 EIO",
    "client stat spool/corrections.tsc 2 EIO",
    "client open spool/N.mcap 12 ENOENT",
    "client unlink spool/N.mcap 1 EIO",
]


@pytest.mark.skipif(not syscall_faults.is_possible(), reason="needs seccomp's user notification")
@pytest.mark.parametrize("cases", [KINDS, pytest.param(OTHERS, marks=pytest.mark.nightly)])
def test_a_call_that_fails_once_costs_nothing_but_what_is_said(cases: list[str]) -> None:
    arguments = [word for case in cases for word in ("--case", case)]
    command = [sys.executable, ROOT / "lab/reliability/faults.py", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    outcomes = [json.loads(line) for line in done.stdout.splitlines()]
    assert {one["case"]: one["problems"] for one in outcomes} == {case: [] for case in cases}, done.stderr
    assert [one["case"] for one in outcomes if not one["happened"]] == []
