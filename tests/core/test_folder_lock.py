# SPDX-License-Identifier: MIT
"""One process at a time in a folder."""

import errno
import fcntl
import os
import signal
import stat
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import pytest
from keyframes_and_servers import DEADLINE

from tsfusion.core.errors import JournalError, MapError
from tsfusion.core.folder_lock import hold, lock_folder, owner_of

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


def test_a_deleted_lock_file_lets_no_second_process_in(tmp_path: Path) -> None:
    lock = lock_folder(tmp_path, "state", "server")
    (tmp_path / "lock").unlink()
    assert owner_of(tmp_path) == "?"
    with pytest.raises(JournalError, match="in use by another server"):
        lock_folder(tmp_path, "state", "server")
    lock.close()
    assert owner_of(tmp_path) is None
    lock_folder(tmp_path, "state", "server").close()


def test_a_folder_that_is_away_is_not_made_in_its_place(tmp_path: Path) -> None:
    with pytest.raises(JournalError, match="No such file"):
        lock_folder(tmp_path / "map", "map", "fuser", make=False)
    assert list(tmp_path.iterdir()) == []


def test_a_file_system_that_locks_no_folders_has_the_file_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As NFS: it emulates these locks by those of byte ranges, which need a file open for writing."""
    real = fcntl.flock

    def files_only(descriptor: int, operation: int) -> None:
        if stat.S_ISDIR(os.fstat(descriptor).st_mode):
            raise OSError(errno.EBADF, os.strerror(errno.EBADF))
        real(descriptor, operation)

    monkeypatch.setattr(fcntl, "flock", files_only)
    lock = lock_folder(tmp_path, "spool", "scanner")
    assert owner_of(tmp_path) is not None
    with pytest.raises(JournalError, match="in use by another scanner"):
        lock_folder(tmp_path, "spool", "scanner")
    lock.close()
    assert owner_of(tmp_path) is None


@pytest.mark.skipif(not hasattr(os, "fork"), reason="forks")
def test_a_lock_ends_with_the_process_that_took_it_though_its_child_lives(tmp_path: Path) -> None:
    reading, writing = os.pipe()
    lock = lock_folder(tmp_path, "spool", "scanner")
    child = os.fork()
    if not child:
        os.close(writing)
        os.read(reading, 1)
        os._exit(0)
    try:
        with pytest.raises(JournalError, match="in use by another scanner"):
            lock_folder(tmp_path, "spool", "scanner")  # the child has not let go of its parent's
        lock.close()
        lock_folder(tmp_path, "spool", "scanner", wait=DEADLINE).close()
    finally:
        os.close(writing)
        os.waitpid(child, 0)
        os.close(reading)
