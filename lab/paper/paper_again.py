# SPDX-License-Identifier: MIT
"""The keyframes of a live run, sent once more by other ways: the map in the end must be the same.

python lab/paper/paper_again.py ORDERS.json        a robot that sends its share of them
python lab/paper/paper_again.py STATE VOLUME.json  the hash of the map that they make, fused here at once
"""

import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import msgspec
from msgspec import Struct

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "support"))
sys.path.append(str(Path(__file__).parents[2]))  # lab is not installed
from bad_network import Proxy
from keyframes_and_servers import lasting_address

from lab.paper.paper_outcome import Outcome, write
from lab.paper.paper_runs import Limits, Run
from tsfusion.core import process
from tsfusion.core.config import DEFAULT_MAP, ClientConfig, ServerConfig, VolumeConfig
from tsfusion.core.errors import TransportError, TsfusionError
from tsfusion.journal import state_folder
from tsfusion.journal.journaled_keyframes import JournaledKeyframes
from tsfusion.pipelines.runs import target_server
from tsfusion.pipelines.runs.target_server import ServerChild
from tsfusion.wire.asking.queries import fetch_health, fetch_status

_PATIENCE_S = 300.0
_POLL_S = 0.05
Tell = Callable[[str], None]


class Sending(Struct, frozen=True, kw_only=True):
    """Orders for a robot: which of the keyframes in `state` it sends, and where to."""

    state: str
    address: str
    spool: str
    first: int = 0
    step: int = 1


def conduct(
    run: Run, source: Outcome, folder: Path, *, state: Path, limits: Limits, tell: Tell, settings: str
) -> Outcome:
    """Send the keyframes of a live run again.

    Args:
        source: of the run whose journal is in `state`.
        settings: fingerprint of this run.
    """
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    started = time.monotonic()
    notes: list[str] = []
    with ExitStack() as stack:
        server = ServerConfig(listen=lasting_address(), state=str(folder / "state"))
        begin = _serve(run, server, folder)
        child = stack.enter_context(begin())
        address, lost = stack.enter_context(_link(run, limits, child))
        half = _half(source) if run.mode == "killed-server" else None
        robots = 2 if run.mode == "two-robots" else 1
        sent = stack.enter_context(_robots(state, folder, address, robots))
        if half is not None:
            _until(lambda: _durable(child.listen) >= half, sent)
            child.kill()
            tell("the server is killed")
            child = stack.enter_context(begin())
            notes.append(f"killed with {half} keyframes or more on its disk")
        _until(lambda: all(robot.poll() is not None for robot in sent), sent)
        status = fetch_status(child.listen, control=child.control, map_name=DEFAULT_MAP, timeout=60.0)
        if lost():
            notes.append(f"{lost()} packets were lost")
    shutil.rmtree(folder / "state")
    outcome = Outcome(
        name=run.name, world=run.world.name, mode=run.mode, map=run.map, number=run.number,
        machine=run.machine.described, settings=settings, seconds=round(time.monotonic() - started, 1),
        planned=source.planned, sent=source.fused, fused=status.keyframes_fused, drained=True,
        map_hash=status.map_hash, expected_hash=source.map_hash if source.drained else "", notes=notes,
    )  # fmt: skip
    write(outcome, folder)
    return outcome


def _serve(run: Run, server: ServerConfig, folder: Path) -> Callable[[], Any]:
    """Starts the server; again, after it was killed."""

    def begin() -> Any:
        return target_server.serving(server, run.volume, folder)

    return begin


@contextmanager
def _link(run: Run, limits: Limits, child: ServerChild) -> Iterator[tuple[str, Callable[[], int]]]:
    """The server's address, and how many packets were lost on the way to it."""
    if run.mode != "lost-packets":
        yield child.listen, lambda: 0
        return
    with Proxy() as proxy:
        proxy.target(child.listen, child.control)
        proxy.lose(limits.lost_share)
        yield proxy.address, lambda: proxy.lost


@contextmanager
def _robots(state: Path, folder: Path, address: str, count: int) -> Iterator[list["subprocess.Popen[bytes]"]]:
    """Processes that send all keyframes together; killed at the end of the block, if they still run."""
    found: list[subprocess.Popen[bytes]] = []
    try:
        for number in range(count):
            orders = folder / f"robot-{number + 1}.json"
            told = Sending(
                state=str(state), address=address, spool=str(folder / f"spool-{number + 1}"),
                first=number, step=count,
            )  # fmt: skip
            orders.write_bytes(msgspec.json.encode(told))
            found.append(subprocess.Popen([sys.executable, __file__, str(orders)], **process.OWN_GROUP))
        yield found
    finally:
        for robot in found:
            robot.kill()
            robot.wait()


def _until(reached: Callable[[], bool], robots: list["subprocess.Popen[bytes]"]) -> None:
    """Wait; raise TransportError when a robot fails, or it takes too long."""
    deadline = time.monotonic() + _PATIENCE_S
    while not reached():
        if any(robot.poll() for robot in robots):
            raise TransportError("a robot could not send all of its keyframes")
        if time.monotonic() > deadline:
            raise TransportError(f"the keyframes were not sent within {_PATIENCE_S:.0f} s")
        time.sleep(_POLL_S)


def _half(source: Outcome) -> int:
    return max(source.fused // 2, 1)


def _durable(address: str) -> int:
    """Keyframes on the server's disk; 0 while it does not say."""
    try:
        found = fetch_health(address, timeout=1.0).maps.get(DEFAULT_MAP)
    except TsfusionError:
        return 0
    return 0 if found is None else found.keyframes_durable


def send(orders: Sending) -> None:
    """Send a share of the keyframes, and wait until all of them are in the map."""
    from tsfusion.client import Client

    keyframes = JournaledKeyframes(state_folder.find_journal(Path(orders.state)))
    config = ClientConfig(policy="spool_all")
    with Client(orders.address, spool=orders.spool, config=config, world="") as client:
        for index in range(orders.first, len(keyframes), orders.step):
            client.send(keyframes[index].keyframe)
        client.flush(_PATIENCE_S)
        client.wait_fused(_PATIENCE_S)


def fresh_hash(state: Path, volume: VolumeConfig) -> str:
    """The hash of the map that a journal's keyframes make at their newest poses, fused once, elsewhere."""
    settings = state.with_name("volume.json")
    settings.write_bytes(msgspec.json.encode(volume))
    command = [sys.executable, __file__, str(state), str(settings)]
    done = subprocess.run(command, capture_output=True, text=True, check=True, timeout=_PATIENCE_S)
    return done.stdout.strip().splitlines()[-1]


def _print_hash(state: Path, settings: Path) -> None:
    from tsfusion.pipelines.maps import journal_fusion
    from tsfusion.tsdf.volume import Volume

    config = msgspec.json.decode(settings.read_bytes(), type=VolumeConfig)
    keyframes = JournaledKeyframes(state_folder.find_journal(state))
    print(journal_fusion.fuse(keyframes, Volume(config)).volume.map_hash())


if __name__ == "__main__":
    process.on_parent_end(signal.SIGKILL)
    if len(sys.argv) == 3:
        _print_hash(Path(sys.argv[1]), Path(sys.argv[2]))
    else:
        send(msgspec.json.decode(Path(sys.argv[1]).read_bytes(), type=Sending))
