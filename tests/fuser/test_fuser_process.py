# SPDX-License-Identifier: MIT
"""The log lines of the fuser process."""

import json
import subprocess
import sys

import pytest

_CODE = """
import logging, sys
from tsfusion.fuser import __main__ as process, fuser, map_checkpoints

def run(endpoint):
    for module in (fuser, map_checkpoints):
        module.log.info("a line")
        module.log.error("an error")
    assert not hasattr(process, "log")  # it would be called __main__, outside tsfusion's own loggers
    return 0

process.run = run
sys.argv = ["", "ipc://nowhere", "json", sys.argv[1], "yard"]
sys.exit(process.main())
"""


@pytest.mark.parametrize(("level", "shown"), [("info", ["a line", "an error"]), ("error", ["an error"])])
def test_a_fusers_own_lines_obey_log_level(level: str, shown: list[str]) -> None:
    done = subprocess.run(
        [sys.executable, "-c", _CODE, level], capture_output=True, text=True, timeout=60, check=True
    )
    lines = [json.loads(line) for line in done.stderr.splitlines()]
    for name in ("tsfusion.fuser.fuser", "tsfusion.fuser.map_checkpoints"):
        assert [line["message"] for line in lines if line["logger"] == name] == shown
    assert {(line["process"], line["map"]) for line in lines} == {("fuser", "yard")}
    assert len(lines) == 2 * len(shown)
