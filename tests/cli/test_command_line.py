# SPDX-License-Identifier: MIT
"""The `tsfusion` command as a person or a script meets it: output, exit status, and what is left behind."""

import json
import os
import shlex
import signal
import struct
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_processes import COMMAND, DEADLINE, Here, python, tsfusion
from small_recordings import seven_scenes

from tsfusion import __version__
from tsfusion.cli import options
from tsfusion.core import config
from tsfusion.core.config import Config
from tsfusion.core.errors import InvalidConfig, OutputError
from tsfusion.pipelines.runs.run import RunPlan

NOBODY = "tcp://127.0.0.1:9"  # the discard port: nobody listens there, and nobody may without being root
VERBS = [
    "demo", "replay", "scan", "check", "serve", "mesh", "status", "ate", "doctor", "download", "keys",
    "spool", "journal", "map", "config", "datasets",
]  # fmt: skip


STREET = {"voxel_size": 0.1, "max_range": 40.0}


@pytest.mark.parametrize(
    ("sensor", "usual", "file", "flags", "voxel_size", "whose"),
    [
        ("kinect", {}, "", {}, 0.02, ""), (None, {}, "", {}, 0.02, ""),
        ("lidar", {}, "", {}, 0.1, "a lidar"), (None, {}, "", {"sensor": "lidar"}, 0.1, "a lidar"),
        ("kinect", {}, "sensor = 'lidar'", {}, 0.1, "a lidar"),
        ("lidar", {}, "", {"voxel_size": 0.3}, 0.3, ""), ("lidar", {}, "voxel_size = 0.05", {}, 0.05, ""),
        ("lidar", {}, "", {"sensor": "scanner"}, 0.02, ""), ("lidar", {}, "sensor = 'scanner'", {}, 0.02, ""),
        ("stereo", STREET, "", {}, 0.1, "this recording"),
        ("stereo", STREET, "", {"sensor": "kinect"}, 0.1, "this recording"),
        ("stereo", STREET, "", {"voxel_size": 0.3}, 0.3, ""),
        ("stereo", STREET, "voxel_size = 0.05", {}, 0.05, ""),
    ],
)  # fmt: skip
def test_a_recording_or_its_sensor_brings_usual_settings(
    sensor: str | None,
    usual: dict[str, Any],
    file: str,
    flags: dict[str, Any],
    voxel_size: float,
    whose: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / "mine.toml").write_text(f"[volume]\n{file}\n")
    found = options.configuration_for(sensor, tmp_path / "mine.toml", usual=usual, tell=True, **flags).volume
    assert (found.voxel_size, found.max_range) == (voxel_size, usual.get("max_range"))
    told = f"voxels: {voxel_size:g} m, usual for {whose} (--voxel-size gives others)"
    assert (told in capsys.readouterr().err) == bool(whose)


def one_line(done: "subprocess.CompletedProcess[str]") -> str:
    """The message of a command that failed as it should."""
    assert done.returncode == 1, done.stderr
    lines = done.stderr.strip().splitlines()
    messages = [line for line in lines if line.startswith("tsfusion: ")]
    assert len(messages) == 1, done.stderr
    assert lines[-1] == messages[0], done.stderr
    assert "Traceback" not in done.stderr
    return messages[0]


def test_help_names_every_verb() -> None:
    done = tsfusion("--help")
    assert done.returncode == 0
    assert all(verb in done.stdout for verb in VERBS)


@pytest.mark.parametrize("given", ["", "3"])
def test_small_products_take_one_thread_unless_somebody_says_otherwise(given: str) -> None:
    program = """
import os
from contextlib import suppress
from tsfusion.__main__ import main
with suppress(SystemExit):
    main(["--version"])
print(os.environ["OPENBLAS_NUM_THREADS"])
"""
    environment = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
    if given:
        environment["OPENBLAS_NUM_THREADS"] = given
    assert python(program, env=environment).stdout.splitlines()[-1] == (given or "1")


def test_nothing_is_help_and_version_is_a_line(here: Here) -> None:
    assert "Usage" in here().stdout
    assert here("--version").stdout == f"tsfusion {__version__}\n"


def test_config_dump_is_read_back(here: Here, tmp_path: Path) -> None:
    text = here("config", "dump").stdout
    assert "voxel_size = 0.02  # > 0; metres" in text
    assert "TSFUSION_VOXEL_SIZE is --voxel-size" in text.splitlines()[0]
    assert "of each fuser; None = three quarters" in text  # whose line the formatter has broken
    (tmp_path / "a.toml").write_text(text)
    assert config.load(tmp_path / "a.toml") == Config()
    (tmp_path / "b.toml").write_text('[volume]\nvoxel_size = 0.5\nmax_range = 7\n[server]\nstate = "ä\\"b"\n')
    changed = config.load(tmp_path / "b.toml")
    (tmp_path / "c.toml").write_text(here("config", "dump", "--config", tmp_path / "b.toml").stdout)
    assert config.load(tmp_path / "c.toml") == changed != Config()
    dumped = json.loads(here("config", "dump", "--json", "--config", tmp_path / "b.toml").stdout)
    assert dumped["volume"]["voxel_size"] == 0.5


def test_datasets_list(here: Here, tmp_path: Path) -> None:
    assert "7-Scenes" in here("datasets", "list").stdout
    seven_scenes(tmp_path / "kitchen", 1, (48, 64))
    found = json.loads(here("datasets", "list", tmp_path, "--json").stdout)
    assert found == [
        {
            "path": str(tmp_path),
            "name": "7-Scenes kitchen",
            "sensor": "kinect",
            "keyframes": 1,
            "posed": True,
            "uncolored": 0,
            "camera": "fx 5 fy 5 cx 4 cy 3, 64×48, from camera-intrinsics.txt",
        }
    ]
    assert "kinect  1 keyframes" in here("datasets", "list", tmp_path).stdout
    layouts = json.loads(here("datasets", "list", "--json").stdout)
    assert all(value == value.strip() for row in layouts for value in row.values())
    (tmp_path / "empty").mkdir()
    assert "no datasets" in here("datasets", "list", tmp_path / "empty").stderr
    assert "missing does not exist" in one_line(here("datasets", "list", tmp_path / "missing"))


def test_doctor(here: Here) -> None:
    done = here("doctor", "--json")
    report = json.loads(done.stdout)
    assert done.returncode == (0 if report["ok"] else 1)
    failed = {check["name"] for check in report["checks"] if not (check["ok"] or check["optional"])}
    assert failed <= {"pyrealsense2"}, report  # which needs libusb of the system
    names = {check["name"] for check in report["checks"]}
    assert {"python", "taichi", "numpy", "kernels", "loopback"} <= names


def test_doctor_names_an_engine_that_is_none_and_goes_on(tmp_path: Path) -> None:
    env = os.environ | {"TSFUSION_ENGINE": "opengl"}
    done = subprocess.run(
        [sys.executable, "-m", "tsfusion", "doctor", tmp_path],
        check=False,
        capture_output=True,
        text=True,
        env=env,
    )
    assert done.returncode == 1
    assert (
        "✗ kernels: InvalidConfig: TSFUSION_ENGINE must be taichi or quadrants, got 'opengl'" in done.stdout
    )
    assert f"✓ disk {tmp_path}" in done.stdout


def test_doctor_says_what_to_do(here: Here, tmp_path: Path) -> None:
    done = here("doctor", tmp_path / "missing")
    assert done.returncode == 1
    assert done.stdout.count("✗") == here("doctor").stdout.count("✗") + 1
    assert "→ choose another folder" in done.stdout
    assert "✓ numpy" in done.stdout


@pytest.fixture
def replayed(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Arguments that `replay` hands to the pipeline, which is not run."""
    asked: dict[str, Any] = {}

    def record(plan: RunPlan, *_: object, **__: object) -> None:
        asked.update(plan=plan)
        raise OutputError("recorded")

    monkeypatch.setattr("tsfusion.pipelines.runs.run.run", record)
    return asked


@pytest.mark.parametrize(
    ("toml", "flags", "sensor"),
    [
        ("", [], "stereo"),
        ("[volume]\nvoxel_size = 0.5\n", [], "stereo"),
        ("[volume]\nsensor = 'kinect'\n", [], "kinect"),
        ("[volume]\nsensor = 'lidar'\n", [], "lidar"),
        ("[volume]\nsensor = 'lidar'\n", ["--sensor", "kinect"], "kinect"),
    ],
)
@pytest.mark.parametrize("command", [["replay", "synthetic:street:stereo"], ["demo", "--world", "street"]])
def test_a_sensor_that_was_chosen_beats_the_datasets(
    here: Here, replayed: dict[str, Any], tmp_path: Path, command: list[str], toml: str, flags: list[str],
    sensor: str,
) -> None:  # fmt: skip
    (tmp_path / "a.toml").write_text(toml)
    assert "recorded" in one_line(here(*command, "--config", "a.toml", *flags))
    assert replayed["plan"].volume.sensor == sensor


def test_a_sensor_chosen_in_the_environment_counts(
    here: Here, replayed: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TSFUSION_SENSOR", "kinect")
    here("replay", "synthetic:street:stereo")
    assert replayed["plan"].volume.sensor == "kinect"


def test_flags_of_the_environment_are_not_refused(here: Here, monkeypatch: pytest.MonkeyPatch) -> None:
    """Variables may be meant for other commands."""
    monkeypatch.setenv("TSFUSION_VOXEL_SIZE", "0.5")
    monkeypatch.setattr("tsfusion.wire.asking.queries._PING_TIMEOUT", 0.2)
    assert "no server" in one_line(here("mesh", NOBODY, "a.ply"))


@pytest.mark.parametrize(
    ("toml", "words"),
    [
        ("[volume]\nvoxel_size = -1\n", "a.toml: volume.voxel_size must be > 0, got -1"),
        ("[volume]\nvoxel_size = inf\n", "voxel_size must be finite, got inf"),
        ("[volume]\nsensor = 'ear'\n", "volume.sensor must be one of kinect, tof,"),
        ("[volume]\nthreads = 'x'\n", "volume.threads must be a whole number, got 'x'"),
        ("[server]\nlisten = 3\n", "server.listen must be text, got 3"),
        ("[volume]\nspeed = 1\n", "unknown setting volume.speed"),
        ("speed = 1\n", "unknown setting speed"),
        ("volume = 1\n", "volume must be a table, got 1"),
        (f"[volume]\nmax_blocks = {'9' * 5000}\n", "a.toml is not TOML: "),
        (f"[volume]\nvoxel_size = {'[' * 20_000}{']' * 20_000}\n", "a.toml is not TOML: "),
        (f"[{'.'.join(['a'] * 5000)}]\nb = 1\n", "a.toml: "),
    ],
)
def test_a_bad_setting_is_named_once(here: Here, tmp_path: Path, toml: str, words: str) -> None:
    (tmp_path / "a.toml").write_text(toml)
    said = one_line(here("config", "dump", "--config", "a.toml"))
    assert words in said
    assert said.count("got") <= 1


def test_what_is_no_job_ends_a_worker_in_one_line() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "tsfusion.cluster"],
        input=struct.pack("<I", 5000) + b"\x93" * 5000, capture_output=True, timeout=DEADLINE, check=False,
    )  # fmt: skip
    assert done.returncode == 1
    assert b"what came on stdin is no job" in done.stderr
    assert b"Traceback" not in done.stderr


def test_settings_may_be_numpy_scalars() -> None:
    made = config.make_settings(config.VolumeConfig, {"voxel_size": np.float32(0.25), "threads": np.int64(2)})
    assert (made.voxel_size, made.threads) == (0.25, 2)
    with pytest.raises(InvalidConfig, match=r"^voxel_size must be > 0, got -1.0$"):
        config.make_settings(config.VolumeConfig, {"voxel_size": np.float32(-1)})


def test_ctrl_c_while_modules_load_is_no_traceback() -> None:
    """The command is interrupted at its first import beyond the door."""
    program = (
        "import builtins, os, signal, sys\n"
        "from tsfusion.__main__ import main\n"
        "load = builtins.__import__\n"
        "def interrupted(name, *rest):\n"
        "    if name == 'tsfusion': os.kill(os.getpid(), signal.SIGINT)\n"
        "    return load(name, *rest)\n"
        "builtins.__import__ = interrupted\n"
        "main(['--version'])\n"
    )
    done = python(program)
    assert done.returncode == -signal.SIGINT
    assert done.stderr == ""


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        ({"truncation": 4.0}, {"min_support": 4.0, "max_support": 4.0, "min_behind": 4.0}),
        ({"support": "3:6.5"}, {"min_support": 3.0, "max_support": 6.5, "min_behind": None}),
        ({"support": "3:6:2"}, {"min_support": 3.0, "max_support": 6.0, "min_behind": 2.0}),
        ({"support": "::16"}, {"min_support": None, "max_support": None, "min_behind": 16.0}),
        ({"min_weight": 0.5, "max_range": 3.0}, {"min_weight": 0.5, "max_range": 3.0}),
        ({"lambda_": 7.0}, {"smoothness": 7.0}),
        ({"space_carving": True}, {"space_carving": True}),
    ],
)
def test_map_flags_become_settings(flags: dict[str, object], expected: dict[str, object]) -> None:
    volume = options.configuration(None, **flags).volume
    assert {name: getattr(volume, name) for name in expected} == expected


@pytest.mark.parametrize("support", ["3:", "::", "3:6:2:1"])
def test_a_bad_band_is_explained(support: str) -> None:
    with pytest.raises(InvalidConfig, match="LEAST:MOST"):
        options.configuration(None, support=support)


@pytest.mark.parametrize("verb", ["serve", "replay", "demo", "mesh"])
def test_every_verb_that_fuses_takes_the_map_flags(here: Here, verb: str) -> None:
    shown = here(verb, "--help-all").stdout
    for option in options.MAP_OPTIONS.values():
        assert option.__metadata__[0].default.partition("/")[0] in shown


def test_options_of_a_dataset() -> None:
    parsed = options.dataset_options(["noise=maybe", "seed=3", "color=false", "poses=a=b"])
    assert parsed == {"noise": "maybe", "seed": 3, "color": False, "poses": "a=b"}


def test_a_file_has_settings_for_each_map(tmp_path: Path) -> None:
    file = tmp_path / "maps.toml"
    text = "[volume]\nvoxel_size = 0.05\n[maps.hall]\nvoxel_size = 0.1\n[client]\nmap = 'hall'\n"
    file.write_bytes(b"\xef\xbb\xbf" + text.encode())  # as Windows' Notepad writes it
    for chosen in (options.configuration(file), options.configuration_for("tof", file, max_range=3.0)):
        assert chosen.volumes()["hall"].voxel_size == 0.1
        assert (chosen.volume.voxel_size, chosen.client.map) == (0.05, "hall")
        assert options.own_volume(chosen, chosen.client, {"voxel_size": None}).voxel_size == 0.1
        assert options.own_volume(chosen, chosen.client, {"voxel_size": 0.07}).voxel_size == 0.07


@pytest.mark.parametrize("closed", ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"])
def test_a_stream_that_is_closed_is_no_traceback(closed: str, tmp_path: Path) -> None:
    said = tmp_path / "said"
    line = f"{shlex.join(map(str, COMMAND))} datasets 2> {said} {closed}"
    done = subprocess.run(["sh", "-c", line], timeout=60, check=False, capture_output=True)
    assert done.returncode == 0
    assert not done.stderr
    assert "Traceback" not in (said.read_text() if said.exists() else "")


@pytest.mark.usefixtures("quick_servers")
@pytest.mark.parametrize(
    ("verb", "flags"), [("replay", []), pytest.param("fuse", ["--workers", 1], marks=pytest.mark.nightly)]
)
def test_the_sensor_of_a_flag_reaches_the_map(here: Here, verb: str, flags: list[object]) -> None:
    recording = ("synthetic:room", "--option", "count=1", "--voxel-size", 0.1, "--out", "out")
    done = here(verb, *recording, "--sensor", "tof", *flags)
    assert done.returncode == 0, done.stderr
    assert "sensor tof" in here("map", "info", "out/map.tsf").stdout
