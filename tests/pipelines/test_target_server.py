# SPDX-License-Identifier: MIT
"""The server that a run starts for itself."""

import sys
from pathlib import Path

import pytest

from tsfusion.core.config import ServerConfig, VolumeConfig
from tsfusion.core.errors import TransportError
from tsfusion.pipelines import target_server


@pytest.mark.skipif(sys.platform == "darwin", reason="Metal is there")
def test_warnings_of_a_start_reach_who_runs_it(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    server = ServerConfig(listen="tcp://127.0.0.1:0", state=str(tmp_path / "state"))
    with target_server.serving(server, VolumeConfig(arch="metal", threads=1), tmp_path):
        pass
    (warning,) = [one.message for one in caplog.records if "metal" in one.message]
    assert "keyframes are fused on the CPU" in warning


def test_when_a_run_fails_the_servers_errors_are_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    lines = [
        "tsfusion: WARNING: not told",
        *(f"tsfusion fuser: ERROR: mistake {number}" for number in range(3)),
        "  File unknown.py, line 1",
        "Fatal Python error: Segmentation fault",
    ]

    def fail() -> None:
        with (tmp_path / "server.log").open("a", encoding="utf-8") as log:
            log.write("\n".join(lines))
        raise TransportError("the fuser restarts; ask again")

    server = ServerConfig(listen="tcp://127.0.0.1:0", state=str(tmp_path / "state"))
    with (
        pytest.raises(TransportError, match="the fuser restarts"),
        target_server.serving(server, VolumeConfig(threads=1), tmp_path),
    ):
        fail()
    told = [record.getMessage() for record in caplog.records if record.levelname == "ERROR"]
    assert told == [
        "the server says: mistake 1",
        "the server says: mistake 2",
        "the server says: Fatal Python error: Segmentation fault",
    ]
