# SPDX-License-Identifier: MIT
"""The server that a verb starts for itself: its errors, and its end with the verb."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from keyframes_and_servers import DEADLINE, until
from saved_maps import make_map

from tsfusion.core.errors import MapError, TsfusionError
from tsfusion.core.folder_lock import owner_of
from tsfusion.journal import state_folder
from tsfusion.pipelines.maps.private_server import open_state
from tsfusion.wire.messages.forget_messages import Selection

CHANGES = """
import sys
from pathlib import Path
from tsfusion.pipelines.maps.private_server import open_state
with open_state(Path(sys.argv[1])):
    print("open", flush=True)
    sys.stdin.read()
"""
SHOWS = """
import sys
from pathlib import Path
from tsfusion.pipelines.shown.viewed_maps import open_feed
from tsfusion.wire.asking.map_events import SurfaceUpdate
feed = open_feed(Path(sys.argv[1]))
while not any(isinstance(one, SurfaceUpdate) for one in feed.events(1.0)):
    pass
print("open", flush=True)
sys.stdin.read()
"""


@pytest.mark.parametrize(
    ("program", "number"),
    [(CHANGES, signal.SIGKILL), (CHANGES, signal.SIGTERM), (CHANGES, signal.SIGINT), (SHOWS, signal.SIGKILL)],
)
def test_the_server_ends_with_the_verb_and_leaves_nothing(
    program: str, number: signal.Signals, tmp_path: Path
) -> None:
    state, scratch = tmp_path / "state", tmp_path / "scratch"
    folder = make_map(state / "maps/default", range(2))
    scratch.mkdir()
    before = {path: path.read_bytes() for path in folder.rglob("*.*") if path.is_file()}
    with subprocess.Popen(
        [sys.executable, "-c", program, state],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
        env=os.environ | {"TMPDIR": str(scratch)},
    ) as verb:  # fmt: skip
        assert verb.stdout is not None
        assert verb.stdout.readline() == b"open\n"
        assert list(scratch.iterdir())
        assert (owner_of(state) is not None) == (program == CHANGES)
        verb.send_signal(number)
        assert verb.wait(DEADLINE) != 0
    until(lambda: owner_of(state) is None and owner_of(folder, name=state_folder.LOCK_FILE) is None)
    until(lambda: not list(scratch.iterdir()))
    assert {path: path.read_bytes() for path in before} == before


def cut(folder: Path) -> None:
    file = folder / state_folder.MAP_FILE
    file.write_bytes(file.read_bytes()[:-7])


@pytest.mark.parametrize(
    ("spoil", "problem"),
    [(cut, "damaged|cut"), (lambda folder: (folder / state_folder.MAP_FILE).unlink(), "has no saved map")],
)
def test_a_map_that_cannot_be_opened_is_named(
    spoil: Callable[[Path], object], problem: str, tmp_path: Path
) -> None:
    spoil(make_map(tmp_path / "maps/default", range(1)))
    with pytest.raises(TsfusionError, match=problem), open_state(tmp_path):
        pass


def test_a_server_that_dies_is_named_at_once(tmp_path: Path) -> None:
    scratch: list[str] = []
    make_map(tmp_path / "maps/default", range(1))

    def forget_without_a_server() -> None:
        with open_state(tmp_path) as opened:
            scratch.append(opened._scratch)
            assert Path(scratch[0]).is_dir()
            opened._process.kill()
            opened.forget(Selection(client="anna"))

    with pytest.raises(MapError, match="has ended with status -9"):
        forget_without_a_server()
    assert not Path(scratch[0]).exists()
