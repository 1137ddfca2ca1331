# SPDX-License-Identifier: MIT
"""`tsfusion serve` as users run it: processes, sockets and files."""

import json
import signal
from pathlib import Path

import pytest
from command_processes import end, read_until, server, started, tsfusion

from tsfusion import Client, FlushTimeout, Keyframe, Volume
from tsfusion.datasets import Synthetic

VOXEL = 0.08


def room(count: int) -> list[Keyframe]:
    """The first keyframes of the synthetic room of 40."""
    return [Synthetic("room", count=40)[index] for index in range(count)]


def test_serve_answers_and_ends_well(tmp_path: Path) -> None:
    with server(tmp_path / "state", "--voxel-size", VOXEL) as (address, process):
        with Client(address, spool=tmp_path / "spool") as client:
            for keyframe in room(2):
                client.send(keyframe)
            client.flush(timeout=30)
            client.wait_fused(timeout=30)
        status = json.loads(tsfusion("status", "--connect", address, "--json").stdout)["maps"]["default"]
        assert (status["keyframes_durable"], status["keyframes_fused"]) == (2, 2)
        assert status["blocks"] > 10
        assert len(status["map_hash"]) == 32
        assert " 2/2 " in tsfusion("status", "--connect", address).stdout
        done = tsfusion("mesh", address, tmp_path / "live.obj", "--min-weight", 0.5)
        assert done.returncode == 0, done.stderr
        done = tsfusion(
            "replay", "synthetic:room", "--start", 2, "--max-keyframes", 1, "--connect", address,
            "--out", tmp_path / "more", "--json",
        )  # fmt: skip
        assert json.loads(done.stdout)["keyframes_fused"] == 1, done.stderr
        assert end(process) == 0
    assert Volume.load(tmp_path / "state/maps/default/map.tsf").keyframes == 3


def test_a_server_that_fell_silent_is_not_called_slow(tmp_path: Path) -> None:
    with (
        server(tmp_path / "state", "--voxel-size", VOXEL) as (address, process),
        Client(address, spool=tmp_path / "spool") as client,
    ):
        client.connect()
        process.send_signal(signal.SIGSTOP)
        try:
            client.send(room(1)[0])
            heard = r"nothing was heard from the server at tcp://\S+ for \d+\.\d s; they stay in .*spool"
            with pytest.raises(FlushTimeout, match=heard):
                client.flush(timeout=1.5)
        finally:
            process.send_signal(signal.SIGCONT)
        client.flush(timeout=30)


@pytest.mark.slow
def test_ready_line_is_for_people_too(tmp_path: Path) -> None:
    process = started("serve", "--listen", "tcp://127.0.0.1:0", "--state", tmp_path / "state")
    try:
        line = read_until(process, "ready")
        assert "ready in" in line
        assert line.count("tcp://127.0.0.1:") == 3
    finally:
        status = end(process, signal.SIGINT)
    assert status == 0
