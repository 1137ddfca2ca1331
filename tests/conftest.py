# SPDX-License-Identifier: MIT
"""Fixtures of all tests; which tests are collected, and how they start."""

import atexit
import faulthandler
import fcntl
import logging
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest
import quick_fusers
import small_disks
from command_processes import QUICK_RUN, Here, tsfusion
from keyframes_and_servers import Server, serving

from tsfusion.cli import main
from tsfusion.core import logs
from tsfusion.core.errors import MissingDependency
from tsfusion.gateway.ports import fuser_process

os.environ["PYTHONPATH"] = os.pathsep.join(sys.path)  # programs that tests start find what tests find
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # of workers, which start later; as commands do
OPTIONAL = ("kiss_icp", "open3d", "pooch", "pyrealsense2", "rosbags", "scipy", "xatlas")
STDERR = pytest.StashKey[Any]()
PARENT = pytest.StashKey[int]()
Server.FUSER = fuser_process.COMMAND = quick_fusers.LAZY  # of servers that tests start, and in this process
BYTECODE = "TEST_BYTECODE"  # environment: folder of what the commands that tests start compile
DATA = Path(os.environ.get("TSFUSION_DATA", Path(__file__).parents[2] / "shared" / "data"))


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--nightly", action="store_true", help="also run the tests marked nightly (long)")


def pytest_configure(config: pytest.Config) -> None:
    """Let Ctrl-C reach the tests and the commands they start; keep a stderr for `deadline`.

    A shell starts its background jobs with SIGINT ignored, and their children inherit that.
    """
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    config.stash[STDERR] = os.fdopen(os.dup(2), "w")
    config.stash[PARENT] = os.getppid()
    if os.environ.get("PYTHONDONTWRITEBYTECODE") and BYTECODE not in os.environ:
        os.environ[BYTECODE] = tempfile.mkdtemp(prefix="tsfusion-bytecode-")
        atexit.register(shutil.rmtree, os.environ[BYTECODE], ignore_errors=True)


def pytest_collection_finish() -> None:
    """Let hundreds of commands compile their modules once, also where nothing may be left in the tree.

    Not this process, nor other workers: compiling an installed package may warn, which is an error here.
    """
    if BYTECODE in os.environ:
        os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
        os.environ["PYTHONPYCACHEPREFIX"] = os.environ[BYTECODE]


def pytest_unconfigure(config: pytest.Config) -> None:
    """End this process a minute after its last test, even if a thread of a failed one still waits.

    A worker first waits for the others' last tests, however long they take: until the controller has ended.
    """

    def end_soon() -> None:
        while hasattr(config, "workerinput") and os.getppid() == config.stash[PARENT]:
            time.sleep(1)
        faulthandler.dump_traceback_later(60, exit=True, file=config.stash[STDERR])

    threading.Thread(target=end_soon, daemon=True).start()


def pytest_timeout_set_timer(item: pytest.Item, settings: Any) -> None:
    """End a process whose test hangs in C, where no Python code can fail it, soon after the time limit."""
    faulthandler.dump_traceback_later(1.2 * settings.timeout, exit=True, file=item.config.stash[STDERR])


def pytest_timeout_cancel_timer() -> None:
    faulthandler.cancel_dump_traceback_later()


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    if config.getoption("--nightly"):
        return
    nightly = [item for item in items if item.get_closest_marker("nightly")]
    if nightly:
        config.hook.pytest_deselected(items=nightly)
        items[:] = [item for item in items if item not in nightly]


class SkippableModule(pytest.Module):
    """A test module that is skipped where Taichi or an optional package does not load."""

    def collect(self) -> Iterable[pytest.Item | pytest.Collector]:
        try:
            return super().collect()
        except MissingDependency as error:
            pytest.skip(str(error), allow_module_level=True)
        except self.CollectError as error:
            missing = getattr(error.__cause__, "name", None) or ""
            if missing.partition(".")[0] not in OPTIONAL:
                raise
            pytest.skip(f"{missing} does not load: {error.__cause__}", allow_module_level=True)


def pytest_pycollect_makemodule(module_path: Path, parent: pytest.Collector) -> pytest.Module:
    module: pytest.Module = SkippableModule.from_parent(parent, path=module_path)
    return module


@pytest.fixture(autouse=True)
def logging_as_it_was() -> Iterator[None]:
    """Undo the logging of a command that ran in this process; the stderr it wrote to is closed."""
    level, hook = logging.getLogger("tsfusion").level, sys.excepthook
    yield
    for handler in logging.root.handlers[:]:
        if isinstance(handler, logs.Stderr):
            handler.close()
            logging.root.removeHandler(handler)
    logging.getLogger("tsfusion").setLevel(level)
    sys.excepthook = hook


@pytest.fixture(scope="session")
def data() -> Callable[[str], Path]:
    """`data("7scenes/redkitchen")`: a folder of real sensor data, or a skip that says what is missing."""

    def find(name: str) -> Path:
        folder = DATA / name
        if not folder.exists():
            pytest.skip(f"no {name} in {DATA}: set TSFUSION_DATA to the folder of recorded datasets")
        return folder

    return find


@pytest.fixture
def here(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Here]:
    """Run a command line in this process, in an empty folder: quicker where no real process is needed."""
    monkeypatch.chdir(tmp_path)
    for name in [name for name in os.environ if name.startswith("TSFUSION_")]:
        monkeypatch.delenv(name)
    monkeypatch.setenv("TSFUSION_THREADS", "1")
    handler = signal.getsignal(signal.SIGTERM)

    def run(*arguments: object) -> "subprocess.CompletedProcess[str]":
        words = [str(argument) for argument in arguments]
        with pytest.raises(SystemExit) as ended:
            main(words)
        printed = capsys.readouterr()
        assert isinstance(ended.value.code, int)
        return subprocess.CompletedProcess(words, ended.value.code, printed.out, printed.err)

    yield run
    signal.signal(signal.SIGTERM, handler)


@pytest.fixture(scope="session")
def room_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A replay of the room's first six keyframes of 40, once for all workers: `out`, `state`, `stdout.json`.

    Tests read it, and change copies.
    """
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base) / "room_run"
    (folder / "out").mkdir(parents=True, exist_ok=True)
    with (folder / "lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "stdout.json").exists():
            (folder / "out" / "notes.txt").write_text("mine")
            done = tsfusion(
                "replay", "synthetic:room", "--max-frames", 6, "--voxel-size", 0.08, "--rate", 10,
                "--state", folder / "state", "--out", folder / "out", "--overwrite", "--json",
                command=QUICK_RUN,
            )  # fmt: skip
            assert done.returncode == 0, done.stderr
            (folder / "stdout.json").write_text(done.stdout)
    return folder


@pytest.fixture
def quick_servers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have runs in this process start quick fusers (`quick_fusers.LAZY`), and draw little."""
    quick_fusers.quicken_runs(quick_fusers.LAZY, monkeypatch.setattr)


@pytest.fixture
def sum_servers(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have runs in this process start fusers of sums (`quick_fusers.SUMS`): no surface is asked for."""
    quick_fusers.quicken_runs(quick_fusers.SUMS, monkeypatch.setattr)


@pytest.fixture
def hangs_up() -> Iterator[None]:
    """Processes notice when their terminal goes away, also where `nohup` has started the tests."""
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGHUP, before)


@pytest.fixture(scope="module")
def shared(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """One server for the tests of a module that leave it as it was or do not care what it holds.

    Its fuser is the module's `FUSER`, where it has one.
    """
    fuser = getattr(request.module, "FUSER", None)
    with serving(tmp_path_factory.mktemp("shared"), fuser=fuser) as server:
        yield server


@pytest.fixture
def disk_calls(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Calls that make files durable, in order: `sync NAME` of a file or folder, `OLD > NEW` of a rename."""
    calls: list[str] = []
    sync, rename = os.fsync, os.replace

    def synced(descriptor: int) -> None:
        calls.append(f"sync {Path(os.readlink(f'/proc/self/fd/{descriptor}')).name}")
        sync(descriptor)

    def renamed(old: Path, new: Path) -> None:
        calls.append(f"{Path(old).name} > {Path(new).name}")
        rename(old, new)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(os, "replace", renamed)
    return calls


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Callable[[int], Path]]:
    """`small_disk(24)`: mount a file system of 24 MiB, and give its folder."""
    folder = tmp_path / "disk"

    def mount(mib: int) -> Path:
        if reason := small_disks.mount(folder, mib):
            pytest.skip(reason)
        return folder

    yield mount
    small_disks.unmount(folder)
