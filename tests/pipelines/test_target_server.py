# SPDX-License-Identifier: MIT
"""The server that a run sends to: what it says when it ends too soon."""

import subprocess
import sys
from pathlib import Path

import pytest

from tsfusion.core.errors import TransportError
from tsfusion.pipelines.target_server import ServerChild


@pytest.mark.parametrize(
    ("log", "reason"),
    [
        ("tsfusion: INFO: the map is open\n", "status 3; was it killed?"),
        ("tsfusion: the disk is full\ntsfusion: INFO: the fuser ended\n", "status 3: the disk is full"),
    ],
)
def test_a_server_that_ended_names_its_error(tmp_path: Path, log: str, reason: str) -> None:
    (tmp_path / "server.log").write_text(log)
    with subprocess.Popen([sys.executable, "-c", "raise SystemExit(3)"], text=True) as process:
        process.wait(60)
        with pytest.raises(TransportError, match="the server ended with " + reason.replace("?", r"\?")):
            ServerChild(process, tmp_path / "server.log").check()
