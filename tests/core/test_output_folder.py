# SPDX-License-Identifier: MIT
"""The folder of a run: whole or not there, and no litter beside it."""

import errno
import os
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path

import pytest
from command_processes import python

from tsfusion.core import durable_files
from tsfusion.core.errors import OutputError
from tsfusion.core.output_folder import building, check_writable, results

_KILLED = """
import os, signal, sys
from tsfusion.core.output_folder import building, results
with building(sys.argv[1]) as work:
    (work / "mesh.ply").write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
"""


def durable_bytes(path: Path, content: bytes) -> None:
    with durable_files.written(path) as file:
        file.write(content)


def half_a_run(out: Path, *, meanwhile: Path | None = None) -> None:
    """A run that goes wrong, while somebody else may write a file."""
    with building(out) as work:
        (work / "mesh.ply").write_text("half")
        if meanwhile is not None:
            meanwhile.write_text("of somebody else")
        raise RuntimeError("went wrong")


def test_an_error_takes_new_parents_along(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError):
        half_a_run(tmp_path / "a" / "b" / "c")
    assert list(tmp_path.iterdir()) == []
    with building(tmp_path / "a" / "b" / "c") as work:
        (work / "run.json").write_text("{}")
    assert (tmp_path / "a" / "b" / "c" / "run.json").read_text() == "{}"


@pytest.mark.parametrize("writes", [Path.write_bytes, durable_bytes])
def test_a_full_disk_is_told_by_the_folder_that_was_to_be(
    small_disk: Callable[[int], Path], writes: Callable[[Path, bytes], object]
) -> None:
    disk = small_disk(1)
    expected = (
        f"cannot write( to)? {disk}/out[^.]*: No space left on device; make room, or choose another place"
    )
    with pytest.raises(OutputError, match=rf"\A{expected}\Z"), building(disk / "out") as work:
        writes(work / "mesh", bytes(2 << 20))
    assert list(disk.iterdir()) == []


def test_parents_that_others_use_stay(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    with pytest.raises(RuntimeError):
        half_a_run(tmp_path / "mine" / "out")
    with pytest.raises(RuntimeError):
        half_a_run(tmp_path / "a" / "b" / "c", meanwhile=tmp_path / "a" / "notes.txt")
    assert {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")} == {"mine", "a", "a/notes.txt"}


def test_parents_that_cannot_be_made_leave_nothing(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="cannot write to"), building(tmp_path / "file" / "a" / "b"):
        pass
    name = "x" * 300
    with pytest.raises(OutputError, match="cannot write to"), building(tmp_path / "a" / name / "b"):
        pass
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("existing", [True, False])
def test_the_next_run_clears_what_a_killed_one_left(tmp_path: Path, existing: bool) -> None:
    out = tmp_path / "out"
    if existing:
        out.mkdir()
    python(_KILLED, out)
    assert [path.read_text() for path in tmp_path.rglob("mesh.ply")] == ["half"]
    with building(out):
        assert not list(tmp_path.rglob("mesh.ply"))
    assert list(tmp_path.rglob("*")) == [out]


def test_a_run_that_is_at_work_is_left_alone(tmp_path: Path) -> None:
    with building(tmp_path / "out") as first:
        (first / "a.txt").write_text("first")
        with building(tmp_path / "out") as second:
            (second / "b.txt").write_text("second")
        assert (first / "a.txt").exists()
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"a.txt", "b.txt"}


@pytest.mark.skipif(not hasattr(os, "fork"), reason="forks")
def test_a_forked_child_that_ends_leaves_the_work_to_its_parent(tmp_path: Path) -> None:
    with ExitStack() as stack:
        work = stack.enter_context(building(tmp_path / "out"))
        (work / "run.json").write_text("whole")
        child = os.fork()
        if not child:
            try:
                stack.__exit__(SystemExit, SystemExit(), None)
            finally:
                os._exit(0)
        os.waitpid(child, 0)
    assert (tmp_path / "out" / "run.json").read_text() == "whole"


@pytest.fixture
def at_noon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty working folder; every run starts in the same second."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tsfusion.core.output_folder.time.strftime", lambda _: "2026-11-22_12-00-00")
    return tmp_path / "out"


def run(text: str, out: str | None = None, *, overwrite: bool = False) -> Path:
    """A run that leaves one file."""
    with results(out, overwrite=overwrite) as (work, folder):
        (work / "run.json").write_text(text)
    return folder


def test_every_run_has_a_folder_of_its_own(at_noon: Path) -> None:
    assert [str(run(text)) for text in "ab"] == ["out/2026-11-22_12-00-00", "out/2026-11-22_12-00-00-2"]
    assert (at_noon / "2026-11-22_12-00-00" / "run.json").read_text() == "a"
    assert (at_noon / "latest" / "run.json").read_text() == "b"
    assert os.readlink(at_noon / "latest") == "2026-11-22_12-00-00-2"
    assert len(list(at_noon.iterdir())) == 3


def test_runs_of_one_second_do_not_meet(at_noon: Path) -> None:
    with results(None) as (first, one):
        (first / "run.json").write_text("a")
        with results(None) as (second, two):
            (second / "run.json").write_text("b")
    assert [(folder / "run.json").read_text() for folder in (one, two)] == ["a", "b"]
    assert len(list(at_noon.iterdir())) == 3


def test_a_run_that_fails_leaves_no_dated_folder(at_noon: Path) -> None:
    with pytest.raises(IsADirectoryError), results(None) as (work, _):
        work.write_text("")
    assert not at_noon.exists()
    run("a")
    with pytest.raises(IsADirectoryError), results(None) as (work, _):
        work.write_text("")
    assert (at_noon / "latest" / "run.json").read_text() == "a"
    assert len(list(at_noon.iterdir())) == 2


def test_an_old_half_of_a_run_is_cleared_up(at_noon: Path) -> None:
    for name, age in (("old", 3600), ("new", 0)):
        (at_noon / f".partial-{name}").mkdir(parents=True)
        os.utime(at_noon / f".partial-{name}", (time.time() - age,) * 2)
    run("a")
    assert {path.name for path in at_noon.iterdir()} == {".partial-new", "2026-11-22_12-00-00", "latest"}


def test_without_links_there_is_the_folder_alone(at_noon: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise OSError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(Path, "symlink_to", refuse)
    assert (run("a") / "run.json").read_text() == "a"
    assert len(list(at_noon.iterdir())) == 1


def test_a_folder_called_latest_is_left_alone(at_noon: Path) -> None:
    (at_noon / "latest").mkdir(parents=True)
    (at_noon / "latest" / "mine").touch()
    run("a")
    assert {path.name for path in at_noon.iterdir()} == {"2026-11-22_12-00-00", "latest"}
    assert (at_noon / "latest" / "mine").exists()


def test_a_named_folder_is_not_overwritten_silently(at_noon: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    assert run("a", "empty") == Path("empty")
    with pytest.raises(OutputError, match=r"empty holds files already \(run.json\): .* --overwrite"):
        run("b", "empty")
    assert (tmp_path / "empty" / "run.json").read_text() == "a"
    run("b", "empty", overwrite=True)
    assert (tmp_path / "empty" / "run.json").read_text() == "b"
    assert not at_noon.exists()


@pytest.mark.parametrize("name", ["map.tsf", "MAP.TSF"])
def test_a_map_that_is_there_stays_unless_told(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(b"TSFMAP1\n and more")
    with pytest.raises(OutputError, match="a map is there"):
        check_writable(tmp_path / name, (".tsf",))
    check_writable(tmp_path / name, (".tsf",), overwrite=True)
