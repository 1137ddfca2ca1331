# SPDX-License-Identifier: MIT
"""The capacity model predicts the committed measurements, and a wrong model is found out."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from repository import ROOT

pytestmark = pytest.mark.nightly

POINTS = ROOT / "docs" / "scale-points.jsonl"
SCRIPT = ROOT / "lab" / "bench" / "capacity.py"


def capacity(*arguments: object) -> "subprocess.CompletedProcess[str]":
    pytest.importorskip("simpy")
    command = [sys.executable, str(SCRIPT), *map(str, arguments), "--json"]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


def test_what_was_not_fitted_is_predicted_within_fifteen_percent() -> None:
    done = capacity()
    assert done.returncode == 0, done.stdout + done.stderr
    found = json.loads(done.stdout)
    checked = [one for one in found["points"] if not one["fitted"]]
    assert len(checked) >= 5
    assert all(abs(one["error"]) <= 0.15 for one in checked)
    runs = [one for one in found["runs"] if not one["fitted"]]
    assert {one["workers"] for one in runs} >= {1, 2, 4}
    assert all(abs(one["error"]) <= 0.15 for one in runs)
    hours = [one["hours"] for one in found["city"]]
    assert hours == sorted(hours, reverse=True)
    assert hours[0] / hours[1] > 1.5
    assert hours[-2] == hours[-1], "more machines than maps give nothing"


def test_a_measurement_that_does_not_fit_fails(tmp_path: Path) -> None:
    rows = [json.loads(line) for line in POINTS.read_text(encoding="utf-8").splitlines()]
    wrong = next(one for one in rows if one["scanners"] == 40)
    wrong["durable_a_second"] *= 2
    (tmp_path / "points.jsonl").write_text("".join(f"{json.dumps(one)}\n" for one in rows), encoding="utf-8")
    assert capacity(tmp_path / "points.jsonl").returncode == 1


def test_a_run_of_fuse_that_does_not_fit_fails(tmp_path: Path) -> None:
    lines = (ROOT / "docs" / "fuse-points.jsonl").read_text(encoding="utf-8").splitlines()
    rows = [json.loads(line) for line in lines]
    wrong = next(one for one in rows if one["workers"] == 4)
    wrong["whole_seconds"] *= 2
    (tmp_path / "runs.jsonl").write_text("".join(f"{json.dumps(one)}\n" for one in rows), encoding="utf-8")
    done = capacity("--fuse", tmp_path / "runs.jsonl")
    assert done.returncode == 1
    assert json.loads(done.stdout)["worst_error"] > 0.4


@pytest.mark.parametrize("case", ["empty", "absent", "of another script"])
def test_points_that_do_not_suffice_are_named(case: str, tmp_path: Path) -> None:
    points = tmp_path / "points.jsonl"
    if case == "empty":
        points.touch()
    if case == "of another script":
        points.write_bytes(POINTS.read_bytes())
    done = capacity("--fuse", points)
    assert done.returncode == 2, done.stdout
    assert str(points) in done.stderr.splitlines()[-1]
    assert "Traceback" not in done.stderr
