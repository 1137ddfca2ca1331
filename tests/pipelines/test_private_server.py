# SPDX-License-Identifier: MIT
"""The server that a verb starts for itself: its errors, and its end with the verb."""

import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
from keyframes_and_servers import DEADLINE, until
from saved_maps import make_map, spoil_journal
from served_gateway import QuietFuser

from tsfusion.core.config import ServerConfig, VolumeConfig
from tsfusion.core.errors import InvalidConfig, MapError, TsfusionError
from tsfusion.core.folder_lock import owner_of
from tsfusion.gateway.fusers.fuser_supervisor import FuserSupervisor
from tsfusion.gateway.fusers.spare_fusers import SpareFusers
from tsfusion.journal import state_folder
from tsfusion.pipelines.maps import private_server, saved_maps
from tsfusion.pipelines.maps.private_server import open_state
from tsfusion.wire.messages.forget_messages import Selection
from tsfusion.wire.sockets.curve import ClientKeys
from tsfusion.wire.sockets.sockets import Addresses

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
from tsfusion.wire.asking.followed_map import SurfaceUpdate
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


def test_a_map_without_a_journal_is_asked_what_to_forget(tmp_path: Path) -> None:
    """As `map resume` brings it: its keyframes cannot be taken out."""
    shutil.rmtree(make_map(tmp_path / "maps/default", range(1)) / state_folder.JOURNAL_FOLDER)
    with open_state(tmp_path, changes=False) as opened:
        assert opened.forget(Selection(client="anna"), dry_run=True).selected == 0
    assert not (tmp_path / "maps/default" / state_folder.JOURNAL_FOLDER).exists()


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


def test_an_engine_that_is_none_is_named_before_a_fuser_starts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    make_map(tmp_path / "maps/default", range(1))
    monkeypatch.setenv("TSFUSION_ENGINE", "opengl")
    capfd.readouterr()  # what the first start of Taichi prints
    with pytest.raises(InvalidConfig, match="must be taichi or quadrants"), open_state(tmp_path):
        pass
    assert capfd.readouterr().err == ""


def test_damage_is_told_once_and_of_the_users_file(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, capfd: pytest.CaptureFixture[str]
) -> None:
    folder = make_map(tmp_path / "maps/default", range(4), behind=3)
    spoil_journal(folder)
    capfd.readouterr()
    with saved_maps.opened(saved_maps.find(tmp_path)) as (_, left_out):
        assert list(left_out.values()) == [1]
    (line,) = [one.getMessage() for one in caplog.records if "damaged" in one.getMessage()]
    assert line.startswith(str(folder))
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize(
    ("has_forgotten", "problem"), [(False, "brought up to date in .*: is it full"), (True, "next server")]
)
def test_a_map_that_cannot_be_saved_is_named(
    has_forgotten: bool, problem: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = make_map(tmp_path / "maps/default", range(1))
    answers = [
        private_server._Listening(Addresses("tcp://a", "tcp://b"), ClientKeys.drawn("k" * 40), ""),
        private_server._SettledState("", False, {}),
    ]
    lines = [msgspec.json.encode(one).decode() for one in answers]
    program = f"for line in {lines!r}: input(); print(line, flush=True)"
    monkeypatch.setattr(private_server, "_COMMAND", (sys.executable, "-c", program))
    served = private_server.ServedMaps([private_server._map_of(made)])
    with closing(private_server.PrivateServer(served)) as opened:
        opened.is_changed = has_forgotten
        with pytest.raises(MapError, match=problem):
            opened.save()


def settings_in(folder: Path) -> ServerConfig:
    return private_server._settings(private_server.ServedMaps([]), folder, folder, "error")


def test_no_limit_keeps_a_verb_from_a_map_that_a_server_took(tmp_path: Path) -> None:
    chosen = settings_in(tmp_path)
    assert (chosen.min_free_bytes, chosen.quota_map) == (0, 1.0)


@pytest.mark.parametrize(("is_private", "is_said"), [(True, False), (False, True)])
def test_a_fuser_that_compiles_its_first_kernels_is_let(
    is_private: bool, is_said: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    server = settings_in(tmp_path) if is_private else ServerConfig(state=str(tmp_path))
    start: Any = QuietFuser
    link = FuserSupervisor(SpareFusers(start, server), tmp_path, server, VolumeConfig(), waits=True)
    monkeypatch.setattr(FuserSupervisor, "_at_keyframe", True)
    monkeypatch.setattr(link, "_silence", SimpleNamespace(stopped=0.0, disk=0.0, working=120.0))
    assert ("still at the same keyframe" in link.problem) == is_said


def test_a_system_that_starts_no_process_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_map(tmp_path / "maps/default", range(1))
    monkeypatch.setattr(private_server, "_COMMAND", (str(tmp_path / "missing"),))
    problem = "no server can be started for the map: No such file"
    with pytest.raises(MapError, match=problem), open_state(tmp_path):
        pass
