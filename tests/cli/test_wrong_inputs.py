# SPDX-License-Identifier: MIT
"""Wrong inputs, over three hundred: each gives one line with cause and cure, and a status that is not 0."""

import os
import subprocess
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from command_processes import python, tsfusion
from wrong_inputs import CALLS, COMMANDS, Wrong, addresses, make_files, run_call, run_command

LEAST = 300
KEPT = {"tsfusion-state", "tsfusion-spool", "s", "out"}  # state folders, and what scans without a server keep
OF_A_PROCESS = [row for row in COMMANDS if not row.line.startswith("TSFUSION_")][:: len(COMMANDS) // 3]
ON_A_BAD_DISK = (
    "keys new robot --dir {disk}/k",
    "ate tum/groundtruth.txt tum/groundtruth.txt --plot {disk}/a.png",
    "journal recover left/default {disk}/recovered",
    "journal export left/default {disk}/a.mcap",
    "scan tum --connect {nobody} --spool {disk}/spool --out {disk}/out",
    "demo --count 1 --out {disk}/out",
    "map resume small.tsf --state {disk}/state",
)


@pytest.fixture(scope="module")
def named() -> Iterator[dict[str, str]]:
    """Addresses that the rows name."""
    with addresses() as found:
        yield found


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wrong")
    make_files(folder)
    return folder


@pytest.fixture(autouse=True)
def in_the_folder(files: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(files)
    for name in [name for name in os.environ if name.startswith("TSFUSION_")]:
        monkeypatch.delenv(name)


def test_the_table_is_long_and_every_row_asks_for_cause_and_cure() -> None:
    rows = [*COMMANDS, *CALLS]
    assert len({row.line for row in rows}) == len(rows) >= LEAST
    assert all(row.cause and row.cure and row.status for row in rows)


@pytest.mark.usefixtures("quick_servers")
@pytest.mark.parametrize("row", COMMANDS, ids=lambda row: row.line)
def test_a_wrong_command_says_cause_and_cure_and_leaves_nothing(
    row: Wrong, files: Path, named: dict[str, str]
) -> None:
    before = listed(files)
    status, said = run_command(row.line.format(**named))
    check(row, status, said)
    assert listed(files) - before == set()
    assert (files / "file").read_text() == "here first"


@pytest.mark.parametrize("row", CALLS, ids=lambda row: row.line)
def test_a_wrong_call_says_cause_and_cure(row: Wrong) -> None:
    said = run_call(row.line)
    assert row.cause in said
    assert row.cure in said
    assert "\n" not in said


@pytest.mark.parametrize("row", OF_A_PROCESS, ids=lambda row: row.line)
def test_a_process_of_its_own_ends_so_too(row: Wrong, files: Path, named: dict[str, str]) -> None:
    done = tsfusion(*row.line.format(**named).split(), cwd=files)
    check(row, done.returncode, done.stderr)


def test_a_disk_that_is_full_or_read_only_is_named(
    small_disk: Callable[[int], Path], named: dict[str, str], files: Path
) -> None:
    disk = small_disk(1)
    with suppress(OSError), (disk / "rest").open("wb", buffering=0) as rest:
        while rest.write(bytes(4096)):
            pass
    for kind, why in (("full", "No space left on device"), ("read-only", "Read-only file system")):
        if kind == "read-only":
            subprocess.run(["mount", "-o", "remount,ro", disk], check=True)
        for line in ON_A_BAD_DISK:
            status, said = run_command(line.format(disk=disk, **named))
            last = said.strip().splitlines()[-1]
            assert status == 1, said
            assert "Traceback" not in said
            assert last.startswith("tsfusion: ")
            assert why in last or "the disk of their spool is full" in last


def test_an_uncaught_error_of_python_names_the_error_last(files: Path) -> None:
    done = python("import tsfusion; tsfusion.Volume(voxel_size=-1)")
    assert done.stderr.splitlines()[-1].endswith("InvalidConfig: voxel_size must be > 0, got -1")


def listed(folder: Path) -> set[Path]:
    """All below a folder but what a run keeps on purpose."""
    return {path for path in folder.rglob("*") if path.relative_to(folder).parts[0] not in KEPT}


def check(row: Wrong, status: int, said: str) -> None:
    """The last line is the only message, and names cause and cure."""
    assert status == row.status, said
    assert "Traceback" not in said
    last = said.strip().splitlines()[-1]
    assert row.cause in last
    assert row.cure in last
    if not row.line.startswith("doctor") and "depth_scale" not in row.line:  # whose reports are on stdout
        assert last.startswith("tsfusion: ")
        assert said.count("\ntsfusion: ") + said.startswith("tsfusion: ") == 1


@pytest.mark.parametrize(
    "line", ["mesh PIPE a.ply", "ask PIPE --at 0 0 0", "report PIPE", "map info PIPE", "view PIPE",
             "replay PIPE", "check PIPE"]
)  # fmt: skip
def test_a_named_pipe_is_refused_and_not_waited_for(line: str, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "map.tsf")
    status, said = run_command(line.replace("PIPE", str(tmp_path / "map.tsf")))
    assert status == 2
    assert "map.tsf is a pipe, not a file" in said
