# SPDX-License-Identifier: MIT
"""Figures, files and plot of the latency ledger."""

import csv
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from tsfusion.pipelines.report import latency_ledger
from tsfusion.pipelines.runs import run_files
from tsfusion.wire.messages import messages
from tsfusion.wire.messages.messages import KeyframeTimes

MS = 1_000_000


def record(seq: int, delay_ms: int, *, captured_ms: int = 1000) -> KeyframeTimes:
    """Stages of 1, 2, 3 and 4 ms, then fusing until `delay_ms`, then 5 ms to the mesh."""
    at = (captured_ms + 250 * seq) * MS
    names = ("sent_ns", "received_ns", "durable_ns", "fuse_start_ns", "fused_ns", "meshed_ns")
    after_ms = (1, 3, 6, 10, delay_ms, delay_ms + 5)
    stamps = {name: at + ms * MS for name, ms in zip(names, after_ms, strict=True)}
    return KeyframeTimes(seq=seq, timestamp_ns=7, captured_ns=at, clock_bound_ns=40_000, **stamps)


def test_summary() -> None:
    summary = latency_ledger.summarise([record(i, 100 + i) for i in range(1, 102)])
    delay = summary.delay_ms
    assert (delay.count, delay.mean, delay.p50, delay.max) == (101, 151.0, 151.0, 201.0)
    assert delay.p95 == pytest.approx(196.0)
    assert delay.p99 == pytest.approx(200.0)
    assert summary.slope_ms_per_keyframe == pytest.approx(1.0)
    stages = {name: spread.mean for name, spread in summary.stages_ms.items()}
    assert stages == {"encode": 1, "wire": 2, "journal": 3, "queue": 4, "fuse": 141, "mesh": 5}
    assert summary.clock_bound_ms == 0.04


def test_stages_add_up_to_the_delay() -> None:
    records = [record(i, 90) for i in range(5)]
    parts = [
        latency_ledger.durations_ms(records, *ends)
        for name, ends in messages.STAGES.items()
        if name != "mesh"
    ]
    assert np.sum(parts, axis=0) == pytest.approx(latency_ledger.durations_ms(records, *messages.DELAY))


def test_unknown_stamps_are_left_out() -> None:
    lost = KeyframeTimes(seq=3, captured_ns=5 * MS, sent_ns=6 * MS)
    summary = latency_ledger.summarise([record(1, 50), lost, record(2, 50)])
    assert summary.delay_ms.count == 2
    assert summary.stages_ms["encode"].count == 3
    assert summary.stages_ms["mesh"].max == 5


@pytest.mark.parametrize("records", [[], [KeyframeTimes(seq=1)], [record(1, 80)]])
def test_few_records_make_no_trouble(records: list[KeyframeTimes], tmp_path) -> None:
    summary = latency_ledger.summarise(records)
    assert summary.slope_ms_per_keyframe == 0
    assert summary.delay_ms.mean in (0, 80)
    latency_ledger.plot(records, tmp_path / "delay.png")
    latency_ledger.write_csv(records, tmp_path / "delay.csv")


def test_csv_holds_stamps_and_stages(tmp_path) -> None:
    latency_ledger.write_csv([record(1, 60), KeyframeTimes(seq=2, captured_ns=1)], tmp_path / "delay.csv")
    with (tmp_path / "delay.csv").open(encoding="utf-8") as file:
        first, second = csv.DictReader(file)
    assert (first["seq"], first["delay_ms"], first["wire_ms"]) == ("1", "60.000", "2.000")
    assert int(first["fused_ns"]) - int(first["captured_ns"]) == 60 * MS
    assert (second["captured_ns"], second["fused_ns"], second["delay_ms"]) == ("1", "0", "")


def test_plot_is_a_picture(tmp_path) -> None:
    latency_ledger.plot([record(i, 80 + 3 * i) for i in range(40)], tmp_path / "delay.png")
    image = cv2.imread(str(tmp_path / "delay.png"))
    assert image.shape[0] > 300
    assert len(np.unique(image.reshape(-1, 3), axis=0)) > 8


def test_a_robot_without_matplotlib_has_the_figures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(run_files, "find_spec", lambda name: None)
    for name in [name for name in sys.modules if name.startswith("matplotlib")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    run_files.write_ledger(tmp_path, [record(1, 100)])
    assert [path.name for path in tmp_path.iterdir()] == ["delay.csv"]
