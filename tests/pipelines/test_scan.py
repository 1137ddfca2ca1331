# SPDX-License-Identifier: MIT
"""`tsfusion scan` as users run it: processes, sockets, files, Ctrl-C."""

import dataclasses
import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import quick_fusers
from clients_and_spools import NOBODY
from command_processes import (
    QUICK_RUN,
    Here,
    end,
    environment,
    eventually,
    python,
    read_until,
    server,
    started,
)
from small_recordings import seven_scenes

from lab.evaluation.held_out_views import compare_scans
from tsfusion import Volume, open_dataset
from tsfusion.cli.progress import Quiet
from tsfusion.core.config import ClientConfig, ScanConfig, VolumeConfig
from tsfusion.core.errors import InvalidConfig, InvalidKeyframe
from tsfusion.datasets.trajectory_files import read_tum, write_tum
from tsfusion.geometry.frame import Frame
from tsfusion.journal.journaled_keyframes import JournalRecording
from tsfusion.pipelines.report.run_record import RunRecord
from tsfusion.pipelines.runs import engine
from tsfusion.pipelines.runs.run import RunPlan, run
from tsfusion.scanner.sources.source import LiveSource
from tsfusion.wire.asking.queries import fetch_health

VOXEL = 0.05
SUMMING = quick_fusers.server_command(quick_fusers.SUMS)
COARSE = ("--voxel-size", VOXEL)
SOURCE = "synthetic:room"
# As on a robot without Taichi: importing it fails.
BARE = "import sys; sys.modules['taichi'] = None; from tsfusion.__main__ import main; main(sys.argv[1:])"
IMPATIENT = (
    "import sys; from tsfusion.pipelines.runs import engine; engine.LINGER = 0.5; "
    "from tsfusion.__main__ import main; main(sys.argv[1:])"
)


def recording(folder: Path, count: int = 12, *, broken: int | None = None) -> Path:
    """The room's first frames of a slow walk, as a TUM recording with its true poses."""
    room = open_dataset(SOURCE, count=150)
    for name in ("depth", "rgb"):
        (folder / name).mkdir(parents=True)
    lists: dict[str, list[str]] = {"depth": [], "rgb": []}
    stamps = [10**9 + index * 10**8 for index in range(count)]
    for index, stamp in enumerate(stamps):
        keyframe, seconds = room[index], f"{stamp / 1e9:.6f}"
        depth = (keyframe.measurement // 2).astype(np.uint16)  # 0.1 mm to the layout's 0.2 mm
        cv2.imwrite(str(folder / f"depth/{seconds}.png"), depth)
        cv2.imwrite(str(folder / f"rgb/{seconds}.png"), keyframe.color)
        for name, lines in lists.items():
            lines.append(f"{seconds} {name}/{seconds}.png\n")
    for name, lines in lists.items():
        (folder / f"{name}.txt").write_text("".join(lines))
    write_tum(folder / "groundtruth.txt", stamps, [room[index].T_world_camera for index in range(count)])
    (folder / "camera-intrinsics.txt").write_text("292.5 0 159.5\n0 292.5 119.5\n0 0 1\n")
    if broken is not None:
        (folder / lists["depth"][broken].split()[1]).write_bytes(b"\x89PNG, but cut")
    return folder


@pytest.fixture(scope="module")
def walk(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recording(tmp_path_factory.mktemp("walk") / "room")


def figures(done: "subprocess.CompletedProcess[str]") -> dict[str, Any]:
    assert done.returncode == 0, done.stderr
    found: dict[str, Any] = json.loads(done.stdout)
    return found


@pytest.mark.usefixtures("quick_servers")
def test_a_scan_leaves_mesh_trajectory_and_figures(walk: Path, here: Here, tmp_path: Path) -> None:
    out = tmp_path / "out"
    state = tmp_path / "state"
    given = ("--localizer", "rgbd", "--up", "-y", "--out", out, "--state", state, "--json")
    run = figures(here("scan", walk, *COARSE, *given))
    assert {path.name for path in out.iterdir()} == {
        "mesh.ply", "mesh.glb", "preview.png", "delay.csv", "delay.png", "run.json", "trajectory.txt",
        "keyframes.txt", "map.tsf", "reference.txt", "growth.csv", "report.html",
        *(f"report-side{side}.png" for side in (1, 2, 3, 4)),
    }  # fmt: skip
    assert run == json.loads((out / "run.json").read_text())
    assert (run["frames"], run["frames_tracked"], run["complete"], run["left"]) == (12, 12, True, 0)
    assert run["localizer"] == "rgbd"
    assert run["camera"] == "fx 292.5 fy 292.5 cx 159.5 cy 119.5, 320×240, from camera-intrinsics.txt"
    assert run["keyframes_sent"] == run["keyframes_fused"] == sum(run["keyframes_by_rule"].values()) >= 3
    (found,) = run["maps"]
    assert found["mesh"]["triangles"] > 1000
    assert Volume.load(out / "map.tsf").map_hash() == found["map_hash"]
    assert len(JournalRecording(state)) == run["keyframes_sent"]
    assert found["mesh"]["up"] == {"direction": [0.0, -1.0, 0.0], "found_by": "given"}
    assert found["trajectory_error"]["rmse"] < 0.005
    assert 0 < found["expected_error_mm"] < 5
    assert 0 < found["expected_error_deg"] < 1
    assert run["color_delay_ms"] == 0
    assert len(read_tum(out / "trajectory.txt").timestamps_ns) == 12
    assert len(read_tum(out / "keyframes.txt").timestamps_ns) == run["keyframes_sent"]
    assert cv2.imread(str(out / "preview.png")).std() > 5


def test_poses_may_be_given_by_time_and_in_order(
    walk: Path, here: Here, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The command names the poses that it takes, also where no server is there."""
    monkeypatch.setattr(engine, "LINGER", 0.0)
    poses = [keyframe.T_world_camera[:3].ravel() for keyframe in open_dataset(walk)]
    rows = (" ".join(f"{number:.9f}" for number in pose) + "\n" for pose in poses)
    (tmp_path / "kitti.txt").write_text("".join(rows))
    (tmp_path / "settings.toml").write_text('[scan]\nfeed = "tcp://127.0.0.1:1"\nlocalizer = "rgbd"\n')
    in_order = ("--trajectory", tmp_path / "kitti.txt")
    by_time = ("--trajectory", walk / "groundtruth.txt", "--time-offset", 0.0)
    settings = ("--config", tmp_path / "settings.toml")
    feed = {"TSFUSION_FEED": "tcp://127.0.0.1:1"}
    trajectory = {"TSFUSION_TRAJECTORY": str(tmp_path / "kitti.txt")}
    rgbd = ("--localizer", "rgbd")
    for variables, flags, words in (
        ({}, in_order, "3/3 localised by given"),
        ({}, (*in_order, "--localizer", "given"), "3/3 localised by given"),
        ({}, (*by_time, "--localizer", "auto"), "3/3 localised by trajectory"),
        ({}, (*by_time, "--localizer", "trajectory", *settings), "3/3 localised by trajectory"),
        ({}, (*by_time, *settings), "3/3 localised by trajectory"),
        (feed, by_time, "3/3 localised by trajectory"),
        (feed | trajectory, rgbd, "two sources of poses"),
        (trajectory, rgbd, "3/3 localised by rgbd"),
        ({}, (*in_order, "--time-offset", 1), "--time-offset is for poses that are looked up by time"),
    ):
        with monkeypatch.context() as patched:
            for name, value in variables.items():
                patched.setenv(name, value)
            nowhere = ("--connect", NOBODY, "--spool", tmp_path / "spool", "--out", tmp_path / "out")
            done = here("scan", walk, "--max-frames", 3, *flags, *nowhere, "--overwrite")
        assert words in done.stdout + done.stderr
        assert ("between a frame and its tracking keyframe" in done.stdout) == ("by rgbd" in words)
        assert (
            "by given" not in words or "ATE" not in done.stdout
        )  # given poses have no error against themselves


@pytest.mark.usefixtures("hangs_up")
@pytest.mark.slow
def test_a_terminal_that_goes_away_ends_a_scan_with_its_results(walk: Path, tmp_path: Path) -> None:
    """The shell and the kernel may both send SIGHUP."""
    process = started("scan", walk, "--rate", 2, *COARSE, "--out", tmp_path / "out", command=QUICK_RUN)
    read_until(process, "; frames ")
    process.send_signal(signal.SIGHUP)
    time.sleep(0.3)
    process.send_signal(signal.SIGHUP)
    process.communicate(timeout=60)
    run = json.loads((tmp_path / "out" / "run.json").read_text())
    assert not run["complete"]
    assert 1 <= run["frames"] < 12
    assert (tmp_path / "out" / "mesh.ply").is_file()
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_without_taichi_to_a_server_elsewhere(walk: Path, here: Here, tmp_path: Path) -> None:
    with server(tmp_path / "state", command=SUMMING) as (address, process):
        command = ["scan", walk, "--connect", address, "--map", "hall",
                   "--spool", tmp_path / "spool", "--out", tmp_path / "out", "--json"]  # fmt: skip
        done = python(BARE, *command, env=environment())
        run = figures(done)
        assert run["keyframes_durable"] == run["keyframes_sent"] >= 3
        assert run["left"] == 0
        assert not (tmp_path / "out" / "mesh.ply").exists()
        assert run["peak_rss_bytes"]["client"] < 200e6
        sent = run["keyframes_sent"]
        assert eventually(lambda: fetch_health(address).maps["hall"].keyframes_fused == sent)
        kept = read_tum(tmp_path / "out" / "keyframes.txt")
        again = here(
            "scan", walk, "--connect", address, "--map", "hall", "--max-frames", 1,
            "--spool", tmp_path / "spool", "--out", tmp_path / "out", "--overwrite",
        )  # fmt: skip
        assert again.returncode == 1
        assert "use --map hall-2 or --map auto" in again.stderr.splitlines()[-1]
        assert end(process) == 0
    stamps = [keyframe.timestamp_ns for keyframe in JournalRecording(tmp_path / "state", "hall")]
    assert stamps == [*kept.timestamps_ns]


def test_ctrl_c_without_a_server_keeps_all_for_the_next_scan(walk: Path, here: Here, tmp_path: Path) -> None:
    spool = tmp_path / "spool"
    command = ["scan", SOURCE, "--rate", "3", "--connect", NOBODY, "--spool", spool]
    process = subprocess.Popen(
        [sys.executable, "-c", IMPATIENT, *command, "--out", tmp_path / "out"],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment(),
    )  # fmt: skip
    read_until(process, "no server answers")
    assert end(process, signal.SIGINT) == 1  # what was scanned is not at the server
    run = json.loads((tmp_path / "out" / "run.json").read_text())
    assert not run["complete"]
    assert 0 < run["frames"] < 40
    assert run["left"] == run["keyframes_sent"] >= 1
    assert run["missed"].startswith(f"{run['left']} keyframe")
    assert "not at the server (no server answers" in run["missed"]
    assert "no server answers" in run["link"]
    assert len(JournalRecording(spool / "default")) == run["left"]
    with server(tmp_path / "state", command=SUMMING) as (address, _):
        more = figures(
            here(
                "scan", walk, "--max-frames", 3, "--connect", address, "--map", "walk",
                "--spool", spool, "--out", tmp_path / "more", "--json",
            )
        )  # fmt: skip
        assert more["left"] == 0
        assert eventually(lambda: fetch_health(address).maps["default"].keyframes_durable == run["left"])


@pytest.mark.nightly  # else a replay that is ended so, and a scan whose terminal goes away
def test_ctrl_c_ends_a_scan_with_its_results(tmp_path: Path) -> None:
    words = ("scan", SOURCE, "--rate", 4, "--voxel-size", 0.1, "--out", tmp_path / "out")
    process = started(*words, command=QUICK_RUN)
    read_until(process, "frames ")
    read_until(process, "frames ")
    process.send_signal(signal.SIGINT)
    read_until(process, "ending: what is on its way is finished")
    process.wait(60)
    assert end(process) == 0
    run = json.loads((tmp_path / "out" / "run.json").read_text())
    assert 0 < run["frames"] < 40
    assert run["keyframes_fused"] == run["keyframes_sent"]
    assert (tmp_path / "out" / "mesh.ply").exists()
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]


@pytest.mark.usefixtures("quick_servers")
def test_a_recording_with_a_broken_frame_goes_on_without_it(here: Here, tmp_path: Path) -> None:
    folder = recording(tmp_path / "broken", broken=7)
    done = here("scan", folder, *COARSE, "--out", tmp_path / "out")
    assert done.returncode == 1
    assert "1 of 12 frames cannot be read" in done.stderr.splitlines()[-1]
    run = json.loads((tmp_path / "out" / "run.json").read_text())
    assert (run["frames"], run["frames_skipped"], run["complete"]) == (11, {"unreadable": 1}, True)
    assert (tmp_path / "out" / "mesh.ply").exists()


def test_a_sensor_that_is_never_localised(here: Here, tmp_path: Path) -> None:
    seven_scenes(tmp_path / "flat", 4, (48, 64))  # no texture, nothing near enough to be seen
    nowhere = ("--connect", NOBODY, "--out", tmp_path / "out")
    done = here("scan", tmp_path / "flat", "--trajectory", tmp_path / "none.txt", *nowhere)
    assert done.returncode == 1
    (tmp_path / "late.txt").write_text("5000 0 0 0 0 0 0 1\n5001 0 0 0 0 0 0 1\n")
    done = here("scan", tmp_path / "flat", "--trajectory", tmp_path / "late.txt", *nowhere)
    assert done.returncode == 1
    assert "was not localised in any of 4 frames" in done.stderr
    assert not (tmp_path / "out").exists()


def test_the_client_is_light() -> None:
    """What a scanner loads before its first frame; without the optional packages."""
    program = (
        "import resource, tsfusion.client; used = resource.getrusage(resource.RUSAGE_SELF);"
        "from tsfusion.core import process; print(used.ru_utime + used.ru_stime, process.peak_rss_bytes())"
    )
    done = python(program, env={**os.environ, "OPENBLAS_NUM_THREADS": "1"})
    _, rss = map(float, done.stdout.split())
    assert rss < 100e6


@pytest.mark.nightly
@pytest.mark.usefixtures("quick_servers")
@pytest.mark.parametrize("count", [25, 125])
def test_a_mesh_with_poses_of_its_own_is_as_good_as_with_the_true_ones(
    data, here: Here, tmp_path: Path, count: int
) -> None:
    kitchen = data("7scenes/redkitchen")
    for name in ("rgbd", "given"):
        run = figures(
            here(
                "scan", kitchen, "--localizer", name, "--voxel-size", 0.02,
                "--max-frames", count, "--out", tmp_path / name, "--json",
            )
        )  # fmt: skip
        assert run["frames_tracked"] == count
    assert run["maps"][0]["trajectory_error"]["rmse"] < 1e-9
    own, given = compare_scans(
        open_dataset(kitchen), [tmp_path / "rgbd", tmp_path / "given"], voxel_size=0.02
    )
    assert own["median_mm"] <= 1.3 * given["median_mm"]
    assert own["p90_mm"] <= 1.3 * given["p90_mm"]
    assert own["predicted"] > 94


class Frames(LiveSource):
    """Frames from a list."""

    def __init__(self, frames: list[Frame], *, live: bool = False) -> None:
        super().__init__("a list", "kinect")
        self._frames, self.live, self.length = frames, live, None if live else len(frames)

    def __iter__(self) -> Iterator[Frame]:
        return iter(self._frames)


@pytest.fixture
def scanned(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., RunRecord]:
    """Scan in this process for a server that does not answer, and do not wait for it."""
    monkeypatch.setattr(engine, "LINGER", 0.2)

    def scan(source: Frames, out: str = "out", **settings: Any) -> RunRecord:
        usual = {"volume": VolumeConfig(), "connect": NOBODY, "spool": tmp_path / "spool"}
        return run(RunPlan(source=source, **usual | settings), tmp_path / out, Quiet(), overwrite=True)

    return scan


def unposed(count: int) -> list[Frame]:
    """The room's first frames, without their poses."""
    room = open_dataset(SOURCE, count=150)
    return [
        dataclasses.replace(room.frame(index), T_world_camera=None, timestamp_ns=(index + 1) * 10**8)
        for index in range(count)
    ]


@pytest.mark.parametrize(("count", "gap_ns", "taken"), [(1, 0, 1), (3, 0, 3), (3, 3 * 10**9, 2)])
def test_a_live_sources_first_frame_is_taken_unless_it_is_old(
    count: int, gap_ns: int, taken: int, scanned: Callable[..., RunRecord]
) -> None:
    first, *others = unposed(count)
    later = [dataclasses.replace(frame, timestamp_ns=frame.timestamp_ns + gap_ns) for frame in others]
    result = scanned(Frames([first, *later], live=True))
    assert (result.frames, result.frames_tracked) == (taken, taken)


def test_a_frame_that_cannot_be_followed_keeps_what_came_before(
    scanned: Callable[..., RunRecord], tmp_path: Path
) -> None:
    points = Frame(sensor="lidar", points=np.ones((9, 3), np.float32), timestamp_ns=10**9)
    with pytest.raises(InvalidKeyframe, match="needs a depth"):
        scanned(Frames([*unposed(4), points]), scan=ScanConfig(loop_closure=False))
    run = json.loads((tmp_path / "out" / "run.json").read_text())
    assert (run["frames_tracked"], run["complete"]) == (4, False)
    assert len(read_tum(tmp_path / "out" / "trajectory.txt").timestamps_ns) == 4
    with pytest.raises(InvalidConfig, match="rgbd follows depth images, and this source gives points"):
        scanned(Frames([points]), "none", scan=ScanConfig(localizer="rgbd"))
    assert not (tmp_path / "none").exists()


def test_keyframes_that_are_refused_do_not_cost_the_results(walk: Path, here: Here, tmp_path: Path) -> None:
    settings = tmp_path / "server.toml"
    settings.write_text("[server]\nquota_extent = 0.001\n")
    with server(tmp_path / "state", "--config", settings) as (address, _):
        done = here(
            "scan", walk, "--localizer", "given", "--connect", address,
            "--spool", tmp_path / "spool", "--out", tmp_path / "out", "--json",
        )  # fmt: skip
    run = json.loads(done.stdout)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1] == f"tsfusion: {run['missed']}"
    assert run["missed"].startswith(f"{run['keyframes_sent']} keyframe")
    assert "will never be at the server" in run["missed"]
    assert run["keyframes_rejected"] == {"quota": run["keyframes_sent"]}
    assert run["left"] == 0
    assert len(read_tum(tmp_path / "out" / "trajectory.txt").timestamps_ns) == 12


@pytest.mark.usefixtures("quick_servers")
def test_a_map_without_a_surface_keeps_the_trajectory(walk: Path, here: Here, tmp_path: Path) -> None:
    done = here("scan", walk, *COARSE, "--max-frames", 2, "--min-weight", 1000, "--out", tmp_path / "out")
    assert done.returncode == 1
    assert "the map has no surface to write: 1 of 1 keyframes fused" in done.stderr.splitlines()[-1]
    assert len(read_tum(tmp_path / "out" / "trajectory.txt").timestamps_ns) == 2
    assert not (tmp_path / "out" / "mesh.ply").exists()


@pytest.mark.parametrize("live", [True, False])
def test_only_what_cannot_wait_is_left_out(live: bool, scanned: Callable[..., RunRecord]) -> None:
    """Also where nobody knows how many frames there will be, as in a folder or a camera's recording."""
    source = Frames(unposed(6), live=live)
    source.length = None
    result = scanned(
        source, scan=ScanConfig(distance=1e-6), client=ClientConfig(policy="drop_oldest", backlog=1)
    )
    assert bool(result.keyframes_rejected.get("dropped")) == live
    assert live or result.left == 6
