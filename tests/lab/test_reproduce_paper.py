# SPDX-License-Identifier: MIT
"""lab/paper/reproduce_paper.py: its plan, its verdicts, its figures' data, and two modes from end to end."""

import hashlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from repository import ROOT

from lab.paper import (
    paper_events,
    paper_figures,
    paper_limits,
    paper_outcome,
    paper_report,
    paper_runs,
    paper_verdicts,
    paper_worlds,
    reproduce_paper,
)
from lab.paper.paper_frontend import LiveRecording, PlannedKeyframes
from lab.paper.paper_outcome import Outcome
from lab.paper.paper_verdicts import Findings, Verdict
from lab.paper.paper_worlds import PaperWorld
from tsfusion.datasets import Synthetic
from tsfusion.datasets.dataset import frame_of
from tsfusion.evaluation.trajectory_error import TrajectoryError
from tsfusion.wire.messages.health import Spread

pytestmark = pytest.mark.nightly

SCRIPT = ROOT / "lab" / "paper" / "reproduce_paper.py"
WORLD = PaperWorld(
    name="kitti06", title="a street", stands_for="06_KITTI", source="synthetic:street:stereo",
    sensor="stereo", localizer="stereo", voxel_size=0.15, died_at=60, published_rmse=0.8, loops=True,
)  # fmt: skip


def outcome(mode: str = "decentralised", **more: Any) -> Outcome:
    """A run that went well, with changes."""
    fine: dict[str, Any] = {
        "name": f"kitti06-{mode}", "world": "kitti06", "mode": mode, "map": "regularised", "number": 1,
        "machine": "all of this machine", "frames": 1101, "located": 1101, "planned": 428, "sent": 428,
        "fused": 428, "drained": True, "cores": 1.0, "robot_peak_bytes": 200_000_000,
        "delay_ms": Spread(count=428, mean=90.0, p50=80.0, p95=200.0, p99=300.0, max=400.0),
    }  # fmt: skip
    return Outcome(**{**fine, **more})


def error(rmse: float) -> TrajectoryError:
    names = ("min", "max", "mean", "median", "std", "length", "drift_percent", "rotation_deg")
    return TrajectoryError(count=9, rmse=rmse, **dict.fromkeys(names, 0.5))


def slow(**more: Any) -> dict[str, Any]:
    return {"delay_ms": Spread(count=60, mean=9e3, p50=9e3, p95=2e4, p99=2e4, max=2e4), **more}


SMALL = "simulated small machine: 1 core, 1024 MiB"


def judged(*outcomes: Outcome, **more: Any) -> dict[str, Verdict]:
    return paper_verdicts.verdicts(Findings(worlds=[WORLD], outcomes=list(outcomes), **more))


def test_a_run_that_went_well_meets_its_claims() -> None:
    made = judged(outcome(ate=error(0.4)))
    names = ("delay", "delay target", "fused", "memory", "scanner", "drift")
    assert {name: made[f"{name}, kitti06"].met for name in names} == dict.fromkeys(names, True)
    assert made["versatility"].met is None  # nothing was swept
    assert "explanation, kitti06" not in made  # there is no control


@pytest.mark.parametrize(
    ("name", "changes"),
    [
        ("delay", {"delay_ms": Spread(count=9, mean=501.0, p99=600.0)}),
        ("delay", {"delay_ms": Spread(count=9, mean=50.0, p99=9e3)}),
        ("delay", {"slope_ms_per_keyframe": 1.0}),
        ("delay target", {"delay_ms": Spread(count=9, mean=101.0, p99=200.0)}),
        ("fused", {"fused": 427}),
        ("memory", {"growth_mib": 17.0}),
        ("scanner", {"cores": 1.3}),
        ("scanner", {"robot_peak_bytes": 251_000_000}),
        ("drift", {"ate": error(0.1), "lost": 3}),
    ],
)
def test_a_claim_that_is_missed_is_not_met(name: str, changes: dict[str, Any]) -> None:
    verdict = judged(outcome(**changes))[f"{name}, kitti06"]
    assert verdict.met is False
    assert verdict.words
    assert verdict.wanted
    assert verdict.measured is not None


def test_a_delay_of_no_keyframe_is_not_measured() -> None:
    assert judged(outcome(delay_ms=Spread()))["delay, kitti06"].met is None


@pytest.mark.parametrize(
    ("unbounded", "bounded", "met", "says"),
    [
        (slow(death="killed", died_of="memory"), {"fused": 300}, True, "is not enough"),
        (slow(), {}, False, "Bounding the queue is enough"),
        ({}, {"fused": 300}, False, "Neither is needed"),
    ],
)
def test_the_control_decides_what_explains_the_gain(
    unbounded: dict[str, Any], bounded: dict[str, Any], met: bool, says: str
) -> None:
    made = judged(
        outcome(),
        outcome("traditional-unbounded", **unbounded),
        outcome("traditional-bounded", **bounded),
    )
    verdict = made["explanation, kitti06"]
    assert verdict.met is met
    assert says in verdict.words
    for mode in ("traditional-unbounded", "traditional-bounded", "decentralised"):
        assert paper_runs.MODES[mode] in verdict.words


def test_a_smaller_machine_explains_nothing() -> None:
    bad = {"fused": 300, "machine": SMALL}
    made = judged(outcome(), outcome("traditional-unbounded", **bad), outcome("traditional-bounded", **bad))
    verdict = made["explanation, kitti06"]
    assert verdict.met is False
    assert "Not shown" in verdict.words


def test_two_processes_may_be_all_that_is_needed() -> None:
    bad = {"fused": 300, "machine": SMALL}
    made = judged(
        outcome(),
        outcome("traditional-unbounded", **bad),
        outcome("traditional-bounded", **bad),
        outcome("one-machine", machine=SMALL),
    )
    verdict = made["explanation, kitti06"]
    assert verdict.met is False
    assert "a second machine is not needed" in verdict.words


def test_a_decentralised_run_that_fails_too_explains_nothing() -> None:
    bad = {"fused": 300}
    made = judged(
        outcome(**bad), outcome("traditional-unbounded", **bad), outcome("traditional-bounded", **bad)
    )
    assert made["explanation, kitti06"].met is False
    assert "Neither reaches all of it" in made["explanation, kitti06"].words


def test_the_baseline_is_said_to_die_where_it_did() -> None:
    died = {"death": "killed with 1030 MiB resident", "died_of": "memory", "died_at": 77}
    verdict = judged(outcome("traditional-unbounded", machine=SMALL, **died))["baseline, kitti06"]
    assert verdict.met is True
    assert "ended at keyframe 77" in verdict.words
    assert "keyframe 60" in verdict.wanted
    alive = judged(outcome("traditional-unbounded"))["baseline, kitti06"]
    assert alive.met is False
    assert "did not die" in alive.words


def test_another_map_is_not_the_same() -> None:
    name = paper_runs.MODES["two-robots"]
    run = {"map_hash": "a", "expected_hash": "a"}
    assert judged(outcome("two-robots", **run))[name].met is True
    assert judged(outcome("two-robots", **run | {"map_hash": "b"}))[name].met is False
    assert judged(outcome("two-robots", **run | {"expected_hash": ""}))[name].met is None


def test_surfaces_are_judged_by_f_score_at_equal_completeness() -> None:
    def rows(f_score: float, completeness: float, ray_f_score: float = 55.0) -> list[dict[str, Any]]:
        ray = {"sensor": "stereo", "method": "ray", "support": 3.0}
        off: dict[str, Any] = {"sensor": "stereo", "method": "off"}
        return [
            {**off, "f_score": 60.0, "completeness": 90.0, "min_weight": None},
            {**off, "f_score": 64.0, "completeness": 80.0, "min_weight": 2.0},
            {"sensor": "stereo", "method": "regularised", "f_score": f_score, "completeness": completeness},
            {**ray, "smoothness": 0.0, "f_score": 50.0, "mean_mm": 9.0},
            {**ray, "smoothness": 9.0, "f_score": ray_f_score, "mean_mm": 8.0},
        ]

    found = judged(sweep=rows(71.0, 90.0))
    assert found["surface, stereo"].met is True
    assert found["versatility"].met is True
    assert judged(sweep=rows(71.0, 89.0, 50.1))["versatility"].met is True  # its error is smaller
    assert judged(sweep=rows(71.0, 89.0, 49.0))["versatility"].met is False
    assert judged(sweep=rows(69.0, 90.0))["surface, stereo"].met is False
    less = judged(sweep=rows(71.0, 85.0))["surface, stereo"]
    assert less.met is False
    assert less.measured["gain"] == 9.0  # of 62, halfway between both weights


def shifted(count: int, *, wrong_from: int) -> tuple[np.ndarray, np.ndarray]:
    """(estimate, truth): a straight way, and one that leaves it at a frame."""
    truth = np.tile(np.eye(4), (count, 1, 1))
    truth[:, 2, 3] = np.arange(count)
    estimate = truth.copy()
    estimate[wrong_from:, 0, 3] += 5.0
    return estimate, truth


def test_the_error_is_cut_at_the_frame_where_the_baseline_died(tmp_path: Path) -> None:
    estimate, truth = shifted(30, wrong_from=20)
    kept = np.delete(np.arange(30), [3, 4, 25])  # late frames have no pose
    path = tmp_path / paper_outcome.POSES
    np.savez(path, indices=kept, poses=estimate[kept], truth=truth[kept])
    full, cut = paper_outcome.error_until(path), paper_outcome.error_until(path, 19)
    assert full is not None
    assert cut is not None
    assert full.rmse > 1
    assert cut.rmse < 1e-9
    assert cut.count == 18
    assert paper_outcome.error_until(path, 0) is None  # one pose has no error
    assert paper_outcome.error_until(tmp_path / "none.npz") is None


def test_the_cut_is_that_of_the_small_machine_where_both_died() -> None:
    runs = [
        outcome("traditional-unbounded", machine=SMALL, died_frame=100, name="small"),
        outcome("traditional-unbounded", died_frame=700, name="whole"),
        outcome("traditional-bounded", died_frame=9, name="control"),
    ]
    assert paper_report.cut_frames(runs) == {("kitti06", "regularised", 1): 100}
    assert paper_report.cut_frames(runs[1:]) == {("kitti06", "regularised", 1): 700}
    assert paper_report.cut_frames([outcome()]) == {}


def test_a_series_ends_with_a_cross_where_its_mode_died() -> None:
    rows = [{"seq": str(n), "delay_ms": f"{10 * n}"} for n in range(1, 5)] + [{"seq": "5", "delay_ms": ""}]
    series = paper_figures.series_of(
        outcome("traditional-unbounded", machine=SMALL, death="killed", died_of="memory"), rows
    )
    assert series.number.tolist() == [1, 2, 3, 4]
    assert series.delay_ms.tolist() == [10.0, 20.0, 30.0, 40.0]
    assert series.end == (4, 40.0)
    assert series.died_of == "memory"
    assert not series.dashed
    alive = paper_figures.series_of(outcome("traditional-bounded"), rows)
    assert alive.end is None
    assert alive.dashed  # the control on the whole machine


def test_what_a_killed_front_end_wrote_is_told() -> None:
    frame = {"due_ns": 5, "T_world_camera": None, "late": 0, "cpu_s": 0.1, "rss_bytes": 1, "queue": 1}
    lines = [
        {"event": "start", "t": 5},
        {"event": "frame", "t": 9, "index": 0, "queue_bytes": 7, **frame},
        {"event": "keyframe", "t": 10, "seq": 1, "captured_ns": 5, "sent_ns": 10},
        {"event": "keyframe", "t": 20, "seq": 2, "captured_ns": 15, "sent_ns": 20},
        {"event": "fused", "t": 30, "seq": 1, "fuse_start_ns": 11, "map_bytes": 4096},
    ]
    story = paper_events.of([*map(json.dumps, lines), '{"event":"fused","t":4'])
    assert story.fused == 1
    assert [record.fused_ns for record in story.times] == [30, 0]
    assert story.map_bytes == [(30, 4096)]
    assert not story.ended
    fields = paper_outcome.of_story(story, [], paper_limits.Death("memory", "killed"))
    assert (fields["died_at"], fields["died_frame"], fields["sent"], fields["lost"]) == (1, 0, 2, 1)


def test_a_localizer_that_lost_its_way_for_long_is_the_end() -> None:
    def lines(lost: int, found: int = 0) -> list[str]:
        frame = {"event": "frame", "late": 0, "cpu_s": 0.1, "rss_bytes": 1, "queue": 0, "queue_bytes": 0}
        keyframe = {"event": "keyframe", "captured_ns": 1}
        told = []
        for n in range(5 + lost + found):
            pose = None if 5 <= n < 5 + lost else np.eye(4).tolist()
            told.append(frame | {"t": 10 * n, "due_ns": n, "index": 2 * n, "T_world_camera": pose})
            if pose is not None:
                told.append(keyframe | {"t": 10 * n, "seq": n, "sent_ns": 10 * n + 1})
                told.append({"event": "fused", "t": 10 * n + 5, "seq": n, "fuse_start_ns": 1, "map_bytes": 1})
        return [json.dumps(event) for event in told]

    starved = paper_outcome.of_story(paper_events.of(lines(25)), [], None)
    assert (starved["died_of"], starved["died_frame"], starved["lost"]) == ("a lost sensor", 8, 25)
    assert "behind frame 8, and never found it again" in starved["death"]
    assert paper_outcome.of_story(paper_events.of(lines(15)), [], None)["death"] == ""
    late = paper_outcome.of_story(paper_events.of(lines(25, found=30)), [], None)
    assert (late["died_frame"], late["died_at"], late["fused"]) == (8, 4, 35)
    assert "found it again at frame 60 only" in late["death"]
    assert paper_outcome.of_story(paper_events.of(lines(15, found=30)), [], None)["death"] == ""


def test_memory_without_map_and_queue_is_what_grows() -> None:
    rows = [paper_outcome.MemoryRow(s, "server", (100 + s) << 20, s << 20, 0) for s in range(21)]
    assert paper_outcome.growth_mib(rows) == pytest.approx(0.0, abs=1e-6)  # the map alone grows
    rows = [paper_outcome.MemoryRow(s, "robot", (100 + s) << 20, 0, 0) for s in range(21)]
    assert paper_outcome.growth_mib(rows) == pytest.approx(10.0)


def test_keyframes_are_chosen_to_be_as_many_as_wanted() -> None:
    dataset = msgspec.structs.replace(WORLD, options={"count": 60}).open()
    assert len(paper_worlds.planned_keyframes(dataset, 20, outdoors=True)) == 20
    usual = paper_worlds.planned_keyframes(dataset, None, outdoors=True)
    assert usual[0] == 0
    assert 25 <= len(usual) <= 31  # every 2 m


def test_a_planned_keyframe_that_was_dropped_is_the_next_frame() -> None:
    class Seen:
        def __init__(self, stamp: int) -> None:
            self.timestamp_ns = stamp

    rule: Any = PlannedKeyframes(np.array([0, 30, 60, 70]))
    taken = []
    for stamp in (0, 10, 20, 40, 50, 80, 90):  # 30, 60 and 70 were dropped
        if rule.reason(Seen(stamp), np.eye(4)):
            rule.accept(Seen(stamp), np.eye(4))
            taken.append(stamp)
    assert taken == [0, 40, 80]


def test_a_process_that_outgrows_its_machine_is_killed() -> None:
    command = "import time\nkept = bytearray(300 << 20)\ntime.sleep(60)"
    with subprocess.Popen([sys.executable, "-c", command]) as child:
        watch = paper_limits.MemoryWatch(child, 150 << 20, _rss_of_outcome)
        code = child.wait(60)
        watch.stop()
    death = paper_limits.death_of(code, watch, "")
    assert death is not None
    assert death.of == "memory"
    assert "of 150 there are" in death.words


def _rss_of_outcome(pid: int) -> int:
    from tsfusion.core import process

    return process.tree_rss_bytes(pid)


def test_a_share_of_the_time_is_a_share_of_the_work() -> None:
    assert paper_limits.calibrate(0.1) < 0.6


def test_runs_have_names_of_their_own_and_come_after_what_they_need() -> None:
    worlds = paper_worlds.worlds(quick=False)
    runs = paper_runs.plan(worlds, paper_runs.Limits(), quick=False, runs=2)
    names = [run.name for run in runs]
    assert len(set(names)) == len(names)
    for place, run in enumerate(runs):
        if run.mode in paper_runs.AGAIN:
            assert paper_runs.source_of(run).name in names[:place]
    only = paper_runs.plan(worlds, paper_runs.Limits(), quick=False, only=["two-robots"])
    assert [run.mode for run in only] == ["decentralised", "two-robots"]


def test_with_one_run_a_mode_the_plain_map_is_made_in_one_world() -> None:
    worlds = paper_worlds.worlds(quick=False)
    for runs, expected in ((1, {worlds[0].name}), (2, {world.name for world in worlds})):
        planned = paper_runs.plan(worlds, paper_runs.Limits(), quick=False, runs=runs)
        assert {run.world.name for run in planned if run.map == "off"} == expected
        assert {run.world.name for run in planned if run.map == "regularised"} == {w.name for w in worlds}


def test_frames_that_are_read_ahead_are_those_of_the_recording(tmp_path: Path) -> None:
    dataset = Synthetic("room", count=6, width=64)
    log = paper_events.EventLog(tmp_path / "events.jsonl")
    recording = LiveRecording(dataset, log, pace=0.1)
    seen = []
    for frame in recording:
        assert frame.timestamp_ns == paper_worlds.stamps_ns(dataset)[recording.index]
        np.testing.assert_array_equal(frame.depth, frame_of(dataset, recording.index).depth)
        seen.append(recording.index)
        if recording.index == 2:
            time.sleep(0.03)  # some are late: what was read ahead is not what comes next
    log.close()
    assert seen == sorted(set(seen))
    assert len(seen) + recording.late == len(dataset)
    assert recording.late > 0


def test_surfaces_are_measured_side_by_side_and_end_together(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    jobs: list[Any] = [(None, str(number)) for number in range(5)]
    monkeypatch.setattr(reproduce_paper, "answer", lambda _job, _out, title, _failures: title)
    assert reproduce_paper.answers(jobs, tmp_path, {}) == ["0", "1", "2", "3", "4"]

    def interrupted(_job: Any, _out: Path, title: str, _failures: Any) -> None:
        if title == "1":
            reproduce_paper.child(["-c", "import time; time.sleep(300)"], tmp_path / "log")
        while not reproduce_paper._RUNNING:
            time.sleep(0.01)
        raise KeyboardInterrupt

    monkeypatch.setattr(reproduce_paper, "answer", interrupted)
    began = time.monotonic()
    with pytest.raises((KeyboardInterrupt, subprocess.SubprocessError)):
        reproduce_paper.answers(jobs, tmp_path, {})
    assert not reproduce_paper._RUNNING
    assert time.monotonic() - began < 250  # the child was ended, it did not end


def reproduce(*arguments: str | Path, data: Path) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [sys.executable, str(SCRIPT), *map(str, arguments)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={**os.environ, "TSFUSION_DATA": str(data)},
    )  # fmt: skip


@pytest.fixture
def interrupted(tmp_path: Path) -> tuple[str, ...]:
    """Arguments of a command that was interrupted in its first run."""
    modes = ("street-traditional-bounded", "street-decentralised")
    arguments = ("--quick", "--frames", "12", "--pace", "2", "--out", str(tmp_path / "out"), "--only", *modes)
    with reproduce(*arguments, data=tmp_path) as running:
        assert running.stderr is not None
        for line in running.stderr:
            if line.startswith("[1/2]"):
                running.send_signal(signal.SIGINT)
                break
        rest = running.stderr.read()
    assert running.returncode == 130, rest
    assert "the same command goes on" in rest
    assert "Traceback" not in rest
    return arguments


def test_a_folder_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with reproduce("--out", tmp_path / "file" / "out", "--only", "desk1", data=tmp_path) as running:
        _, told = running.communicate(timeout=120)
    assert running.returncode == 1
    assert f"cannot write {tmp_path / 'file' / 'out'}" in told
    assert "choose another --out or --cache" in told
    assert "Traceback" not in told


def test_two_modes_from_end_to_end(interrupted: tuple[str, ...], tmp_path: Path) -> None:
    with reproduce(*interrupted, data=tmp_path) as running:
        said, told = running.communicate(timeout=240)
    assert running.returncode == 0, told
    assert "rendering" not in told  # kept by the one that was interrupted
    out = tmp_path / "out"
    record = json.loads((out / "run.json").read_text())
    runs = {run["mode"]: run for run in record["runs"]}
    assert set(runs) == {"traditional-bounded", "decentralised"}
    for run in runs.values():
        assert run["fused"] + sum(run["skipped"].values()) == run["sent"] > 0
        assert run["delay_ms"]["count"] == run["fused"]
        assert run["frames"] + run["late"] == 12
        assert run["ate"]["count"] == run["located"]
        assert run["map_hash"]
    for verdict in record["verdicts"].values():
        assert set(verdict) == {"met", "measured", "wanted", "words"}
    assert "delay, street" in said
    for name in ("delay.csv", "memory.csv", "ate.csv", "surface.csv"):
        assert (out / name).read_text().startswith("run,")
    assert (out / "figure3.png").read_bytes().startswith(b"\x89PNG")
    assert (out / "runs" / "street-decentralised-regularised-1" / "picture-whole.png").exists()
    page = (out / "report.html").read_text()
    assert "http" not in page.replace("http-equiv", "").replace("http://www.w3.org", "")
    began = time.monotonic()
    with reproduce(*interrupted, data=tmp_path) as running:
        _, told = running.communicate(timeout=240)
    assert running.returncode == 0, told
    assert "[1/2]" not in told
    assert "measuring" not in told
    assert time.monotonic() - began < 120


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--runs", "0"), "expected more than 0"),
        (("--server-share", "2"), "at most 1"),
        (("--only", "nowhere"), "no run has such a name"),
        (("--kitti", "nowhere"), "no sequences/06/image_0 in nowhere"),
        (("--corbs", "nowhere"), "no folder nowhere"),
    ],
)
def test_a_mistake_is_one_line(arguments: tuple[str, ...], message: str, tmp_path: Path) -> None:
    with reproduce(*arguments, data=tmp_path) as running:
        _, told = running.communicate(timeout=60)
    assert running.returncode == 2
    assert message in told.splitlines()[-1]


@pytest.mark.parametrize("taken", ["out", "world"])
def test_what_cannot_be_written_is_one_line(taken: str, tmp_path: Path) -> None:
    world = paper_worlds.worlds(quick=True, frames=2)[1]
    (tmp_path / "worlds").mkdir()
    digest = hashlib.sha256(msgspec.json.encode(world)).hexdigest()[:12]
    file = tmp_path / {"out": "out", "world": f"worlds/{world.name}-{digest}"}[taken]
    file.touch()
    command = (sys.executable, str(SCRIPT), "--quick", "--frames", "2", "--only", world.name)
    folders = ("--out", str(tmp_path / "out"), "--cache", str(tmp_path / "worlds"))
    done = subprocess.run([*command, *folders], capture_output=True, text=True, timeout=240, check=False)
    assert done.returncode == 1
    assert str(file) in done.stderr.splitlines()[-1]
    assert "Traceback" not in done.stderr
