# SPDX-License-Identifier: MIT
"""The server that a run starts for itself."""

import sys
from pathlib import Path

import pytest

from tsfusion.core.config import ServerConfig, VolumeConfig
from tsfusion.pipelines import target_server


@pytest.mark.skipif(sys.platform == "darwin", reason="Metal is there")
def test_warnings_of_a_start_reach_who_runs_it(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    server = ServerConfig(listen="tcp://127.0.0.1:0", state=str(tmp_path / "state"))
    with target_server.serving(server, VolumeConfig(arch="metal", threads=1), tmp_path):
        pass
    (warning,) = [one.message for one in caplog.records if "metal" in one.message]
    assert "keyframes are fused on the CPU" in warning
