# SPDX-License-Identifier: MIT
"""The engine of whole runs: when the next keyframe may go, and how long a run waits for map and server."""

import subprocess
import sys
from pathlib import Path
from typing import IO, Any, cast

import pytest

from tsfusion.client import Client, ClientStats
from tsfusion.core.config import ServerConfig, VolumeConfig
from tsfusion.core.errors import FlushTimeout, TransportError
from tsfusion.pipelines.runs import engine, target_server
from tsfusion.pipelines.runs.engine import Engine
from tsfusion.pipelines.runs.run_files import no_surface
from tsfusion.pipelines.runs.target_server import ServerChild, Target


class Run:
    """A target and clients whose counts are given, one a look; the last one stays."""

    def __init__(self, *looks: ClientStats, dies_after: int | None = None) -> None:
        self.looks = 0
        self._stats, self._dies_after = looks, dies_after

    def check(self) -> None:
        if self._dies_after is not None and self.looks >= self._dies_after:
            raise TransportError("the server ended with status -9")

    def observe(self) -> ClientStats:
        self.looks += 1
        return self._stats[min(self.looks, len(self._stats)) - 1]

    @property
    def engine(self) -> Engine:
        return Engine(cast(Target, self), self.observe)


class SlowClient:
    """A client that never hears of its last keyframe."""

    is_of_other_world = False

    @property
    def stats(self) -> ClientStats:
        return stats(5, 5)

    def flush(self) -> None:
        raise FlushTimeout("late")

    wait_meshed = flush


def stats(sent: int, fused: int, **others: Any) -> ClientStats:
    given = {"durable": fused, "refused": {}, "rejected": {}, "skipped": {}, "waiting": 0, "waiting_bytes": 0}
    return ClientStats(sent=sent, fused=fused, state="ok", **{**given, **others})


def test_the_next_keyframe_goes_when_fewer_are_under_way() -> None:
    run = Run(stats(5, 1), stats(5, 2), stats(5, 3))
    run.engine.wait_turn(3)
    assert run.looks == 3


def test_what_was_turned_away_is_not_waited_for() -> None:
    run = Run(stats(9, 3, rejected={"MapFull": 2}, refused={"quota": 3}, skipped={"dropped": 1, "disk": 7}))
    run.engine.wait_fused()
    assert run.looks == 1


def test_a_run_whose_server_ends_while_it_waits_says_so() -> None:
    with pytest.raises(TransportError, match="ended with status -9"):
        Run(stats(5, 1), dies_after=2).engine.wait_turn(3)


def test_a_server_that_fuses_nothing_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine, "STALL_TIMEOUT", 0.05)
    with pytest.raises(TransportError, match="the server has fused nothing for 0 s"):
        Run(stats(5, 1, waiting=4)).engine.wait_fused()


def test_why_nothing_moves_is_logged_once_and_named_at_the_end(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(engine, "_PATIENCE", 0.02)
    monkeypatch.setattr(engine, "STALL_TIMEOUT", 0.1)
    run = Run(stats(5, 1, waiting=4))
    waiting = Engine(cast(Target, run), run.observe, lambda: "the server's disk is full")
    with pytest.raises(TransportError, match="keyframes wait: the server's disk is full"):
        waiting.wait_fused()
    assert [record.message for record in caplog.records] == [
        "nothing moves: the server's disk is full; waiting for at most 0 s"
    ]


def test_a_run_whose_disk_is_full_says_so() -> None:
    assert "the disk of their spool is full" in no_surface(stats(0, 0, skipped={"disk": 4}), "")
    assert "raise --voxel-size" in no_surface(stats(4, 4), "")


def test_a_server_elsewhere_that_takes_nothing_is_left(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine, "LINGER", 0.05)
    Run(stats(5, 0, waiting=5)).engine.wait_acknowledged([])


def test_missing_stamps_do_not_cost_the_run() -> None:
    late = [cast(Client, SlowClient())]
    run = Run(stats(5, 5))
    run.engine.wait_meshed(late)
    run.engine.wait_acknowledged(late)


@pytest.mark.parametrize(
    ("log", "reason"),
    [
        ("tsfusion: INFO: the map is open\n", "status 3; was it killed?"),
        ("tsfusion: the disk is full\ntsfusion: INFO: the fuser ended\n", "status 3: the disk is full"),
        (
            "Traceback (most recent call last):\n  File …\nstruct.error: short\n",
            "status 3: struct.error: short",
        ),
    ],
)
def test_a_server_that_ended_names_its_error(tmp_path: Path, log: str, reason: str) -> None:
    (tmp_path / "server.log").write_text(log)
    with subprocess.Popen([sys.executable, "-c", "raise SystemExit(3)"], text=True) as process:
        process.wait(60)
        with pytest.raises(TransportError, match="the server ended with " + reason.replace("?", r"\?")):
            ServerChild(process, tmp_path / "server.log").check()


def test_a_run_says_that_its_server_ended_not_that_nobody_answers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dies = 'import sys; print(\'{"listen": "", "control": ""}\', flush=True); sys.stdin.read(1); 1 / 0'

    def start(_settings: Path, stderr: IO[str]) -> "subprocess.Popen[str]":
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
        return subprocess.Popen(
            [sys.executable, "-c", dies], stderr=stderr, text=True, process_group=0, **pipes
        )

    def fails() -> None:
        with target_server.serving(ServerConfig(), VolumeConfig(), tmp_path) as child:
            process = child._process
            assert process.stdin is not None
            process.stdin.close()
            process.wait(60)
            raise TransportError("no server answers")

    monkeypatch.setattr(target_server, "_start", start)
    with pytest.raises(TransportError, match="the server ended with status 1: ZeroDivisionError"):
        fails()
