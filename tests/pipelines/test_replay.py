# SPDX-License-Identifier: MIT
"""`tsfusion replay` and `tsfusion demo` as users run them: processes, sockets, files, Ctrl-C."""

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import msgspec
import numpy as np
import own_recordings
import pytest
import trimesh
from command_processes import (
    FORGETFUL_RUN,
    QUICK_RUN,
    Here,
    alive,
    descendants,
    end,
    eventually,
    read_until,
    server,
    started,
    tsfusion,
)
from keyframes_and_servers import map_hash
from small_recordings import first_views

from tsfusion import Volume, VolumeConfig, journal
from tsfusion.cli import options
from tsfusion.core.config import Config, ServerConfig
from tsfusion.core.output_folder import building
from tsfusion.core.process import chosen_engine
from tsfusion.pipelines.maps import settled_maps
from tsfusion.tsdf.files import checkpoint, map_history

RESULTS = {
    "mesh.ply", "mesh.glb", "preview.png", "delay.csv", "delay.png", "growth.csv", "keyframes.txt",
    "run.json", "map.tsf", "report.html", *(f"report-side{side}.png" for side in (1, 2, 3, 4)),
}  # fmt: skip
WITH_TRUTH = {"error.npy", "report-error1.png", "report-error2.png"}
VOXEL = 0.08


def test_replay_leaves_everything(room_run: Path) -> None:
    out = room_run / "out"
    assert {path.name for path in out.iterdir()} == RESULTS | WITH_TRUTH | {"notes.txt"}
    assert (out / "notes.txt").read_text() == "mine"
    run = json.loads((out / "run.json").read_text())
    assert run == json.loads((room_run / "stdout.json").read_text())
    assert (run["keyframes_sent"], run["keyframes_fused"], run["keyframes_rejected"]) == (6, 6, {})
    assert run["camera"].endswith(", 320×240, from its frames")
    assert set(run["delay_ms"]) >= {"mean", "p50", "p95", "p99", "max"}
    assert 0 < run["delay_ms"]["mean"] <= run["delay_ms"]["max"]
    assert "delay_slope_ms_per_keyframe" in run
    assert min(run["peak_rss_bytes"][name] for name in ("server", "client")) > 1 << 20
    assert run["config"]["volume"]["voxel_size"] == VOXEL
    assert {"tsfusion", "python", chosen_engine()} <= set(run["versions"])
    mesh = trimesh.load(out / "mesh.ply", process=False)
    assert (len(mesh.vertices), len(mesh.faces)) == (run["mesh"]["vertices"], run["mesh"]["triangles"])
    assert Volume.load(out / "map.tsf").map_hash() == run["map_hash"]
    assert cv2.imread(str(out / "preview.png")).std() > 5
    with (out / "delay.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 6
    assert all(float(row["delay_ms"]) > 0 for row in rows)


@pytest.mark.nightly  # else `test_a_recording_or_its_sensor_brings_usual_settings`
def test_a_lidars_map_has_voxels_that_its_points_fill(data: Callable[[str], Path], tmp_path: Path) -> None:
    done = tsfusion("replay", data("kitti07_lidar_keyframes"), "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    assert "voxels: 0.1 m, usual for a lidar (--voxel-size gives others)" in done.stderr
    run = json.loads((tmp_path / "out" / "run.json").read_text())
    assert run["config"]["volume"]["voxel_size"] == 0.1
    assert run["mesh"]["triangles"] > 50_000


@pytest.mark.nightly  # else `test_a_recording_or_its_sensor_brings_usual_settings`
def test_a_streets_map_has_voxels_that_a_keyframe_can_fill_in_time(
    data: Callable[[str], Path], tmp_path: Path
) -> None:
    """At 2 cm the first keyframes of KITTI 06 were refused: 41,000 new blocks."""
    out = tmp_path / "out"
    done = tsfusion("replay", data("kitti_odometry"), "--sequence", "06", "--max-frames", 2, "--out", out)
    assert done.returncode == 0, done.stderr
    assert "voxels: 0.1 m, usual for this recording (--voxel-size gives others)" in done.stderr
    run = json.loads((out / "run.json").read_text())
    assert run["config"]["volume"]["voxel_size"] == 0.1
    assert (run["keyframes_fused"], run["keyframes_rejected"]) == (2, {})


def test_a_replay_says_where_up_is_and_its_glb_stands(room_run: Path) -> None:
    """The room's z is up: found by its floor, named in run.json and in the PLY, +Y in the GLB."""
    out = room_run / "out"
    up = json.loads((out / "run.json").read_text())["mesh"]["up"]
    assert up["found_by"] == "floor"
    assert up["direction"] == pytest.approx((0, 0, 1), abs=0.01)
    assert b"\ncomment up +z (floor: " in (out / "mesh.ply").read_bytes()[:400]
    flat = trimesh.load(out / "mesh.ply", process=False)
    stands = trimesh.load(out / "mesh.glb", force="mesh", process=False)
    assert stands.extents[1] == pytest.approx(flat.extents[2], abs=0.05)


def test_replay_over_sockets_is_the_map_of_the_library(room_run: Path) -> None:
    run = json.loads((room_run / "out" / "run.json").read_text())
    assert run["map_hash"] == map_hash(reversed(first_views(6)), VolumeConfig(voxel_size=VOXEL, threads=1))


@pytest.mark.slow
@pytest.mark.usefixtures("quick_servers")
def test_a_journal_replays_to_the_same_map_under_a_new_name(
    room_run: Path, here: Here, tmp_path: Path
) -> None:
    done = here(
        "replay", room_run / "state", "--out", tmp_path / "again", "--json",
        "--state", tmp_path / "kept", "--map", "new",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "kept" / "maps" / "new" / "map.tsf").is_file()
    first = json.loads((room_run / "out" / "run.json").read_text())
    assert json.loads(done.stdout)["map_hash"] == first["map_hash"], "with the saved map's settings"
    assert {path.name for path in (tmp_path / "again").iterdir()} == RESULTS
    assert (tmp_path / "again").stat().st_mode & 0o777 == 0o777 & ~_umask()


@pytest.mark.slow
@pytest.mark.usefixtures("quick_servers")
def test_the_server_table_of_a_file_counts_for_a_runs_own_server(here: Here, tmp_path: Path) -> None:
    (tmp_path / "settings.toml").write_text('[server]\nquota_cost = 1000\ncontrol = "tcp://127.0.0.1:1"\n')
    settings = ("--config", tmp_path / "settings.toml", "--voxel-size", VOXEL)
    done = here("replay", "synthetic:room", "--max-frames", 1, "--out", tmp_path / "out", *settings)
    assert done.returncode == 1, done.stderr
    assert "quota_cost = 1000, these cost" in done.stderr
    forgetful = Config(server=ServerConfig(keep_keyframes=2, journal_bytes=1 << 20))
    assert options.own_server(forgetful, tmp_path / "state").keep_keyframes == 2
    thrown_away = options.own_server(forgetful, None)
    assert (thrown_away.keep_keyframes, thrown_away.journal_bytes) == (None, None), "all in one map"


@pytest.mark.slow
@pytest.mark.parametrize(("damaged", "found"), [(2, (2, 1, 0)), (5, (3, 0, 1)), (None, (3, 0, 0))])
def test_what_damage_costs_is_told_by_where_it_is(
    room_run: Path, tmp_path: Path, damaged: int | None, found: tuple[int, int, int]
) -> None:
    folder = shutil.copytree(room_run / "state" / "maps" / "default", tmp_path / "map")
    (file,) = (folder / "journal").glob("*.mcap")
    records, _ = journal.list_records(file)
    if damaged is not None:
        content = bytearray(file.read_bytes())
        content[next(one for one in records if one.seq == damaged).position.offset + 700] ^= 16
        file.write_bytes(content)
    with checkpoint.reading(folder / "map.tsf") as (header, _):
        (history,) = map_history.sessions(header.meta)
    tail = settled_maps.records_after(folder, [msgspec.structs.replace(history, last=3)])
    assert (tail.keyframes, tail.lost, tail.lost_behind) == found
    assert [one.seq for one in tail.records] == [seq for seq in (4, 5, 6) if seq != damaged]


@pytest.mark.slow
@pytest.mark.usefixtures("quick_servers")
def test_a_saved_map_lacks_what_was_damaged_before_it_was_made(
    room_run: Path, here: Here, tmp_path: Path
) -> None:
    state = shutil.copytree(room_run / "state", tmp_path / "state")
    file = next((state / "maps" / "default" / "journal").glob("*.mcap"))
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 16
    file.write_bytes(content)
    done = here("mesh", state, tmp_path / "whole.ply")
    assert done.returncode == 0, "it was saved before"
    (state / "maps" / "default" / "map.tsf").unlink()
    with server(state, "--voxel-size", VOXEL) as (_, process):
        assert end(process) == 0
    assert (state / "maps" / "default" / "map.tsf").is_file()
    done = here("mesh", state, tmp_path / "less.ply")
    assert done.returncode == 1, done.stderr
    assert "the map lacks 1 keyframe or more" in done.stderr
    assert (tmp_path / "less.ply").is_file()


@pytest.mark.slow
@pytest.mark.usefixtures("quick_servers")
@pytest.mark.parametrize("command", [pytest.param("replay", marks=pytest.mark.nightly), "mesh"])
def test_a_damaged_journal_leaves_its_results_and_status_1(
    room_run: Path, here: Here, tmp_path: Path, command: str
) -> None:
    shutil.copytree(room_run / "state" / "maps" / "default" / "journal", tmp_path / "journal")
    file = next((tmp_path / "journal").glob("*.mcap"))
    content = bytearray(file.read_bytes())
    content[len(content) // 2] ^= 16
    file.write_bytes(content)
    out = {"replay": ("--out", tmp_path / "again", "--voxel-size", VOXEL), "mesh": (tmp_path / "again.ply",)}
    done = here(command, tmp_path / "journal", *out[command])
    assert done.returncode == 1, done.stderr
    assert "the map lacks 1 keyframe or more, which the journal cannot give back" in done.stderr
    if command == "mesh":
        assert (tmp_path / "again.ply").is_file()
    else:
        assert {path.name for path in (tmp_path / "again").iterdir()} == RESULTS
        record = json.loads((tmp_path / "again" / "run.json").read_text())
        assert record["keyframes_fused"] == 5
        assert "tsfusion journal verify" in record["missed"]


@pytest.mark.nightly  # else a scan with a broken frame
@pytest.mark.usefixtures("quick_servers")
@pytest.mark.parametrize("flags", [("--no-check",), ()])  # the check reads that image first
def test_an_image_that_cannot_be_read_is_left_out_and_said(
    here: Here, tmp_path: Path, flags: tuple[str, ...], caplog: pytest.LogCaptureFixture
) -> None:
    views = [
        replace(one, depth=(one.measurement * one.depth_scale * 1000).astype(np.uint16), depth_scale=1e-3)
        for one in first_views(5)
    ]
    folder = own_recordings.images(tmp_path / "room", views)
    image = folder / "depth" / "000003.png"
    image.write_bytes(image.read_bytes()[:60])
    done = here("replay", folder, "--out", tmp_path / "out", "--voxel-size", VOXEL, *flags)
    assert done.returncode == 1, done.stderr
    assert "1 of 5 frames cannot be read, and are not in the map" in done.stderr
    assert image.name in caplog.text
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert (record["keyframes_fused"], record["frames_skipped"]) == (4, {"unreadable": 1})
    assert (tmp_path / "out" / "mesh.ply").is_file()


@pytest.mark.slow
@pytest.mark.usefixtures("quick_servers")
def test_poses_added_to_a_map_are_said_to_be_in_its_frame(
    room_run: Path, here: Here, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    shutil.copytree(room_run / "state", tmp_path / "state")
    done = here(
        "replay", "synthetic:room", "--max-frames", 1, "--voxel-size", VOXEL,
        "--state", tmp_path / "state", "--out", tmp_path / "again",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "the map default has 6 keyframes already, and these are added to them" in caplog.text


def slow_replay(out: Path, *flags: object, command: list[str] = FORGETFUL_RUN) -> "subprocess.Popen[str]":
    """A replay that takes 80 s if nobody ends it."""
    words = ("replay", "synthetic:room", "--rate", 0.5, "--voxel-size", VOXEL, "--out", out)
    return started(*words, *flags, command=command)


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


@pytest.mark.usefixtures("hangs_up")
@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
@pytest.mark.parametrize(
    ("number", "word"),
    [
        (signal.SIGINT, "interrupted"),
        pytest.param(signal.SIGTERM, "terminated", marks=[pytest.mark.slow, pytest.mark.nightly]),
    ],
)
def test_replay_interrupted_twice_leaves_nothing(number: signal.Signals, word: str, tmp_path: Path) -> None:
    process = slow_replay(tmp_path / "new" / "out")
    read_until(process, "scanning")
    below = descendants(process.pid)
    assert len(below) == 2  # gateway and fuser
    process.send_signal(number)
    read_until(process, "ending")
    process.send_signal(number)
    printed = process.communicate(timeout=60)[0]
    assert process.returncode == 128 + number
    assert printed.strip().splitlines()[-1] == f"tsfusion: {word}"
    assert eventually(lambda: not any(map(alive, below)))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
@pytest.mark.usefixtures("hangs_up")
@pytest.mark.parametrize("number", [signal.SIGINT, pytest.param(signal.SIGHUP, marks=pytest.mark.nightly)])
def test_an_ended_replay_leaves_what_was_fused_and_says_what_stays(
    number: signal.Signals, tmp_path: Path
) -> None:
    process = slow_replay(tmp_path / "out", "--state", tmp_path / "state", command=QUICK_RUN)
    while "fused 0 of" in read_until(process, " fused "):
        pass
    process.send_signal(number)
    printed = process.communicate(timeout=120)[0]
    assert process.returncode == 0, printed
    if number == signal.SIGINT:  # else nobody is there to read it
        assert "of this recording, or more, are in the map default and stay there" in printed
        assert "the source was not read to its end" in printed
    record = json.loads((tmp_path / "out" / "run.json").read_text())
    assert 1 <= record["keyframes_fused"] < 40
    assert (record["complete"], record["verdict"]["level"]) == (False, "notice")
    assert {"map.tsf", "mesh.ply", "report.html"} <= {path.name for path in (tmp_path / "out").iterdir()}


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
def test_a_killed_replay_takes_its_server_along(tmp_path: Path) -> None:
    process = slow_replay(tmp_path / "out")
    read_until(process, "scanning")
    below = descendants(process.pid)
    end(process, signal.SIGKILL)
    assert eventually(lambda: not any(map(alive, below)))
    assert not (tmp_path / "out").exists()
    assert len(list(tmp_path.iterdir())) == 1
    with building(tmp_path / "out"):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="looks into /proc")
def test_a_replay_whose_server_dies_says_so(tmp_path: Path) -> None:
    process = slow_replay(tmp_path / "out")
    read_until(process, "scanning")
    gateway, fuser = descendants(process.pid)
    os.kill(gateway, signal.SIGKILL)
    assert "the server ended with status -9" in read_until(process, "tsfusion:")
    assert process.wait(60) == 1
    end(process)
    assert eventually(lambda: not alive(fuser))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.nightly  # else a scan without a surface
@pytest.mark.usefixtures("quick_servers")
def test_a_replay_without_a_surface_says_so(here: Here, tmp_path: Path) -> None:
    done = here(
        "replay", "synthetic:room", "--max-frames", 1, "--min-weight", 1000, "--out", tmp_path / "out"
    )
    assert done.returncode == 1
    assert "tsfusion: the map has no surface to write: 1 of 1 keyframes fused" in done.stderr
    assert not (tmp_path / "out" / "mesh.ply").exists()
    assert "no surface" in json.loads((tmp_path / "out" / "run.json").read_text())["missed"]


@pytest.mark.parametrize("verb", ["replay", "check", "fuse"])
def test_a_live_source_is_for_scans(here: Here, verb: str) -> None:
    done = here(verb, "camera:0")
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].endswith(
        "camera:0 is live and gives no poses: `tsfusion scan camera:0` finds them"
    )


@pytest.mark.slow
@pytest.mark.usefixtures("quick_servers")
@pytest.mark.parametrize(
    ("flags", "count", "vertices", "error_mm"),
    [
        (("--count", 4, "--voxel-size", VOXEL), 4, 2000, 8),
        pytest.param((), 90, 160_000, 2, marks=pytest.mark.nightly),  # the path shows all of the room
    ],
)
def test_demo(
    flags: tuple[object, ...], count: int, vertices: int, error_mm: float, here: Here, tmp_path: Path
) -> None:
    done = here("demo", *flags, "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    run = json.loads((tmp_path / "out" / "run.json").read_text())
    assert run["keyframes_fused"] == count
    assert run["mesh"]["vertices"] > vertices
    assert run["accuracy"]["mean_mm"] < error_mm
    assert "from the known surface" in done.stdout


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize("count", [12, 125])
def test_red_kitchen(data, tmp_path: Path, count: int) -> None:
    done = tsfusion(
        "replay", data("7scenes/redkitchen"), "--max-frames", count, "--voxel-size", 0.02, "--rate", 4,
        "--out", tmp_path, "--json", timeout=300,
    )  # fmt: skip
    run = json.loads(done.stdout)
    assert (run["keyframes_sent"], run["keyframes_fused"]) == (count, count)
    image = cv2.imread(str(tmp_path / "preview.png"))
    assert np.count_nonzero(image.std(axis=2) > 3) > 0.2 * image.shape[0] * image.shape[1]
    assert run["config"]["volume"]["sensor"] == VolumeConfig().sensor
