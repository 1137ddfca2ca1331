# SPDX-License-Identifier: MIT
"""The folder of a run: whole or not there, and no litter beside it."""

from pathlib import Path

import pytest
from command_processes import python

from tsfusion.core.errors import OutputError
from tsfusion.core.output_folder import building

_KILLED = """
import os, signal, sys
from tsfusion.core.output_folder import building
with building(sys.argv[1]) as work:
    (work / "mesh.ply").write_text("half")
    os.kill(os.getpid(), signal.SIGKILL)
"""


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
