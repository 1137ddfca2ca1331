# SPDX-License-Identifier: MIT
"""One process at a time in a folder."""

import signal
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import pytest
from keyframes_and_servers import DEADLINE

from tsfusion.core.errors import JournalError, MapError
from tsfusion.core.folder_lock import hold, lock_folder

_OTHER = """
import sys, time
from pathlib import Path
from tsfusion.core.folder_lock import lock_folder
lock_folder(Path(sys.argv[1]), "map", "fuser", name="fuser.lock")
print("held", flush=True)
time.sleep(600)
"""


def lock_map(folder: Path, wait: float) -> ExitStack:
    """As a fuser does it."""
    return lock_folder(folder, "map", "fuser", name="fuser.lock", wait=wait, error_type=MapError)


def test_a_map_has_one_fuser_for_as_long_as_it_lives(tmp_path: Path) -> None:
    command = [sys.executable, "-c", _OTHER, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        with pytest.raises(MapError, match=rf"in use by another fuser \(pid {other.pid}\): end that first"):
            lock_map(tmp_path, 0.1)
        other.send_signal(signal.SIGSTOP)  # stopped or not
        with pytest.raises(MapError, match="in use"):
            lock_map(tmp_path, 0.1)
        other.kill()
        lock_map(tmp_path, DEADLINE).close()


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(MapError, match=r"cannot write the map folder .*file/map: Not a directory"):
        lock_map(tmp_path / "file" / "map", 0.0)
    with pytest.raises(JournalError, match=r"cannot write the spool folder .*null"):
        lock_folder(tmp_path / "a\0b", "spool", "scanner")


@pytest.mark.parametrize("name", [None, "part"])
def test_a_lock_is_free_again_after_its_block(tmp_path: Path, name: str | None) -> None:
    (tmp_path / "part").write_bytes(b"half")
    with hold(tmp_path, name) as lock:
        with pytest.raises(BlockingIOError):
            hold(tmp_path, name)
        with pytest.raises(BlockingIOError):
            hold(tmp_path, name, wait=0.1)
    with hold(tmp_path, name):
        lock.close()  # a second time: it must not close the descriptor of somebody else
        with pytest.raises(BlockingIOError):
            hold(tmp_path, name)
    assert (tmp_path / "part").read_bytes() == b"half"
