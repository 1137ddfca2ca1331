# SPDX-License-Identifier: MIT
"""lab/evaluation/accuracy.py: its rows, its files and a tiny slice from end to end."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from repository import ROOT

pytestmark = pytest.mark.nightly

SCRIPT = ROOT / "lab" / "evaluation" / "accuracy.py"


def accuracy(*arguments: str | Path, **environment: str) -> "subprocess.CompletedProcess[str]":
    command = [sys.executable, str(SCRIPT), *map(str, arguments)]
    return subprocess.run(
        command, capture_output=True, text=True, timeout=120, check=False,
        env={**os.environ, "PYTHONPATH": str(ROOT), **environment},
    )  # fmt: skip


def test_a_slice_gives_rows_tables_and_plots(tmp_path: Path) -> None:
    slice_ = ("--quick", "--only", "kinect-20-default")
    done = accuracy(*slice_, "--output", tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""
    rows = [json.loads(line) for line in (tmp_path / "rows.jsonl").read_text().splitlines()]
    assert [row["method"] for row in rows] == ["default"]
    for row in rows:
        assert 0.5 < row["accuracy_mm"]["mean"] < 2.5
        assert row["precision"] > 99
        assert row["f_score"] > 80
        assert 0 < row["normal_deg"]["median"] < 10
        assert row["edge_mm"] > row["accuracy_mm"]["mean"]
        assert row["keyframe_cpu_ms"] > 0
    table = (tmp_path / "tables.md").read_text()
    assert "| room-circle-kinect-20 | default |" in table
    assert (tmp_path / "keyframes.png").read_bytes().startswith(b"\x89PNG")
    again = accuracy(*slice_, "--output", tmp_path, "--missing")
    assert again.returncode == 0, again.stderr
    assert "[1/" not in again.stderr


def test_every_row_has_a_name_of_its_own() -> None:
    names = accuracy("--list").stdout.split()
    assert len(names) == len(set(names)) > 200
    assert accuracy("--list", "--only", "kitchen").stdout.split() == [n for n in names if "kitchen" in n]


def test_missing_data_is_said_and_left_out(tmp_path: Path) -> None:
    done = accuracy("--only", "kitchen-recorded-125-off", "bunny-recorded", TSFUSION_DATA=str(tmp_path))
    assert done.returncode == 0
    assert done.stdout == ""
    assert "no 7scenes/redkitchen" in done.stderr
    assert "no stanford_bunny" in done.stderr


def test_an_interrupt_keeps_the_rows_measured(tmp_path: Path) -> None:
    command = [sys.executable, str(SCRIPT), "--quick", "--jobs", "1", "--output", str(tmp_path)]
    with subprocess.Popen(
        command, stderr=subprocess.PIPE, text=True, env={**os.environ, "PYTHONPATH": str(ROOT)}
    ) as running:
        assert running.stderr is not None
        for line in running.stderr:
            if line.startswith("[1/"):
                running.send_signal(signal.SIGINT)
                break
        rest = running.stderr.read()
    assert running.returncode == 130
    assert rest.startswith("stopped; the rows measured so far are kept")
    assert "Traceback" not in rest
    assert len((tmp_path / "rows.jsonl").read_text().splitlines()) == 1
    assert (tmp_path / "tables.md").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--jobs", "0"), "expected 1 or more"),
        (("--only", "nowhere"), "no row has such a name"),
        (("--tables",), "--output folder"),
    ],
)
def test_a_mistake_is_one_line(arguments: tuple[str, ...], message: str) -> None:
    done = accuracy(*arguments)
    assert done.returncode == 2
    assert message in done.stderr.splitlines()[-1]
