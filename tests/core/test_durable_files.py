# SPDX-License-Identifier: MIT
"""A file is replaced whole or not at all, and is on the disk before it has its name."""

import os
import stat
from pathlib import Path

import pytest
from command_processes import python

from tsfusion.core.durable_files import replacing

_KILLED = """
import os, signal, sys
from pathlib import Path
from tsfusion.core.durable_files import replacing
with replacing(Path(sys.argv[1])) as file:
    file.write(b"half")
    file.flush()
    os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A file with an old content, alone in its folder."""
    path = tmp_path / "map.tsf"
    path.write_bytes(b"old")
    return path


def replace(path: Path, content: bytes, error: BaseException | None = None) -> None:
    with replacing(path) as file:
        file.write(content)
        if error is not None:
            raise error


def test_the_old_file_is_there_until_the_block_ends(path: Path) -> None:
    with replacing(path) as file:
        file.write(b"new")
        assert path.read_bytes() == b"old"
    assert path.read_bytes() == b"new"
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("error", [OSError("full"), KeyboardInterrupt(), ValueError()])
def test_an_error_leaves_the_old_file_and_no_part(path: Path, error: BaseException) -> None:
    with pytest.raises(type(error)):
        replace(path, b"half", error)
    assert path.read_bytes() == b"old"
    assert list(path.parent.iterdir()) == [path]


def test_a_killed_writer_leaves_the_old_file_and_the_next_one_clears_up(path: Path) -> None:
    assert python(_KILLED, path).returncode != 0
    assert path.read_bytes() == b"old"
    assert len(list(path.parent.iterdir())) == 2
    replace(path, b"new")
    assert path.read_bytes() == b"new"
    assert list(path.parent.iterdir()) == [path]


def test_bytes_reach_the_disk_before_the_name(path: Path, disk_calls: list[str]) -> None:
    replace(path, b"new")
    part = ".map.tsf.partial"
    assert disk_calls == [f"sync {part}", f"{part} > map.tsf", f"sync {path.parent.name}"]


def test_a_private_file_is_its_owners_alone_from_the_first_byte(path: Path) -> None:
    left = path.with_name(".map.tsf.partial")
    left.write_bytes(b"left by a killed process")
    left.chmod(0o666)
    before = os.umask(0)
    try:
        with replacing(path, private=True) as file:
            assert stat.S_IMODE(os.fstat(file.fileno()).st_mode) == 0o600
            file.write(b"secret")
    finally:
        os.umask(before)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert path.read_bytes() == b"secret"
