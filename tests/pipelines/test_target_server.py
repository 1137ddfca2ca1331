# SPDX-License-Identifier: MIT
"""The server that a run starts for itself."""

import os
import signal
import sys
from pathlib import Path

import pytest
from keyframes_and_servers import VOLUME
from saved_maps import make_map

from tsfusion.core.config import ClientConfig, ServerConfig, VolumeConfig
from tsfusion.core.errors import InvalidConfig, TransportError
from tsfusion.gateway.maps import moved_maps
from tsfusion.pipelines.runs import target_server


@pytest.mark.usefixtures("quick_servers")
@pytest.mark.skipif(sys.platform == "darwin", reason="Metal is there")
def test_warnings_of_a_start_reach_who_runs_it(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    server = ServerConfig(listen="tcp://127.0.0.1:0", state=str(tmp_path / "state"))
    with target_server.serving(server, VolumeConfig(arch="metal", threads=1), tmp_path):
        pass
    (warning,) = [one.message for one in caplog.records if "metal" in one.message]
    assert "keyframes are fused on the CPU" in warning


@pytest.mark.usefixtures("sum_servers")
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


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="POSIX signals")
@pytest.mark.usefixtures("sum_servers")
def test_a_map_that_the_server_could_not_save_is_told(tmp_path: Path) -> None:
    earlier = tmp_path / "state" / "maps" / "default" / "map.tsf"
    earlier.parent.mkdir(parents=True)
    earlier.write_bytes(b"of an earlier run")
    server = ServerConfig(listen="tcp://127.0.0.1:0", state=str(tmp_path / "state"))
    with target_server.opened(
        None, tmp_path / "scratch", volume=VolumeConfig(threads=1), server=server
    ) as target:
        target.keep_map("default", tmp_path / "map.tsf")
        assert target.child is not None
        os.kill(target.child.pid, signal.SIGKILL)
    assert "could not save the map default: map.tsf is missing; its keyframes are in" in target.unkept
    assert not (tmp_path / "map.tsf").exists()


@pytest.mark.usefixtures("quick_servers")
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="POSIX signals")
def test_a_saved_map_is_kept_whatever_became_of_others(tmp_path: Path) -> None:
    saved = make_map(tmp_path / "state" / "maps" / "yard", range(2)) / "map.tsf"
    server = ServerConfig(listen="tcp://127.0.0.1:0", state=str(tmp_path / "state"))
    with target_server.opened(None, tmp_path / "scratch", volume=VOLUME, server=server) as target:
        target.keep_map("yard", tmp_path / "map.tsf")
        assert target.child is not None
        os.kill(target.child.pid, signal.SIGKILL)
    assert target.unkept == ""
    content = saved.read_bytes()
    assert (tmp_path / "map.tsf").read_bytes() == content
    (tmp_path / "map.tsf").write_bytes(b"of the user")  # as `cp` writes: into the file that is there
    assert saved.read_bytes() == content


@pytest.mark.usefixtures("sum_servers")
def test_a_map_that_has_moved_is_not_scanned_into_elsewhere(tmp_path: Path) -> None:
    state = tmp_path / "state"
    moved_maps.write_departed(
        state, "yard", moved_maps.Departed("1", "", "tcp://there:5555", "tcp://there:5556")
    )
    server = ServerConfig(listen="tcp://127.0.0.1:0", state=str(state))
    with (
        pytest.raises(InvalidConfig, match="has moved to tcp://there:5555: give --connect"),
        target_server.opened(
            None, tmp_path / "scratch", volume=VolumeConfig(threads=1), server=server,
            client=ClientConfig(map="yard"),
        ),
    ):  # fmt: skip
        pass
    assert not (tmp_path / "scratch").exists()


def test_a_system_that_starts_no_server_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", str(tmp_path / "missing"))
    serving = target_server.serving(ServerConfig(), VolumeConfig(), tmp_path)
    with pytest.raises(TransportError, match="no server can be started: No such file"), serving:
        pass
