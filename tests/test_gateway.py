# SPDX-License-Identifier: MIT
"""The gateway with fusers that misbehave, in this process; and real scans by file and by socket."""

import sys
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path

import pytest
import zmq
from wire import DEADLINE, Server, serving, until

import tsfusion
from tsfusion import Client, Keyframe, VolumeConfig, fuser_link
from tsfusion.client import fetch_status
from tsfusion.config import ServerConfig
from tsfusion.datasets import open_dataset
from tsfusion.errors import InvalidConfig, MapError
from tsfusion.fuser_link import FuserLink
from tsfusion.gateway import Gateway
from tsfusion.journal import Journal
from tsfusion.ports import Ports

_FAKE = """
import sys, zmq
from tsfusion.journal import Position
from tsfusion.transport import sockets, work

link = sockets.pair(zmq.Context())
link.connect(sys.argv[1])

def say(message):
    link.send(work.encode(message))

say(work.Started())
while True:
    message = work.to_fuser.decode(link.recv())
    {body}
"""
_CRASHES_ON_2 = """
    if isinstance(message, work.Begin):
        say(work.Ready(Position(0, 0)))
    if isinstance(message, work.Fuse):
        if message.index == 2 and message.skip is None:
            sys.exit(7)
        say(work.Done(message.index, 1, 2, message.skip))
"""
_DIES = "sys.exit(9)"
_FAILS = "say(work.Failed('InvalidConfig', 'no such setting')); link.recv()"
_CANNOT_COME_BACK = """
    import pathlib
    mark = pathlib.Path(message.state if isinstance(message, work.Begin) else "/") / "once"
    if mark.exists():
        sys.exit(9)
    mark.touch()
    say(work.Ready(Position(0, 0)))
    link.recv()
    sys.exit(7)
"""

Start = Callable[[str], Gateway]


@pytest.fixture
def start(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Start]:
    """A gateway over five journaled records, with a fuser that runs the given lines on each message."""
    with ExitStack() as stack:

        def begin(body: str) -> Gateway:
            command = (sys.executable, "-c", _FAKE.format(body=body))
            monkeypatch.setattr(fuser_link, "COMMAND", command)
            monkeypatch.setattr(fuser_link, "_END_DEADLINE", 0.1)
            journal = Journal(tmp_path / "journal", 1 << 20)
            for i in range(5):
                journal.append([b"head", b"body"], session=bytes(16), seq=i + 1)
            journal.close()
            journal = Journal(tmp_path / "journal", 1 << 20)
            server = ServerConfig(state=str(tmp_path))
            context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
            stack.callback(context.term)
            ports = Ports(context, server)
            stack.callback(ports.close)
            fuser = FuserLink(context, server, VolumeConfig())
            stack.callback(fuser.close)
            return Gateway(server, ports, journal, fuser)

        yield begin


def stepped(gateway: Gateway, reached: Callable[[], bool]) -> None:
    def step() -> bool:
        gateway.step()
        return reached()

    until(step)


def test_a_keyframe_that_kills_the_fuser_twice_is_skipped(
    start: Start, caplog: pytest.LogCaptureFixture
) -> None:
    gateway = start(_CRASHES_ON_2)
    stepped(gateway, lambda: gateway.drained)
    assert gateway.fuser.restarts == 2
    assert "keyframe 2 is not in the map (crash)" in caplog.text


def test_a_fuser_that_cannot_start_is_one_clear_error(start: Start) -> None:
    gateway = start(_DIES)
    with pytest.raises(MapError, match="ended with status 9 before it was ready"):
        stepped(gateway, lambda: gateway.warm)


def test_why_the_map_cannot_be_opened_is_passed_on(start: Start) -> None:
    gateway = start(_FAILS)
    with pytest.raises(InvalidConfig, match="no such setting"):
        stepped(gateway, lambda: gateway.warm)


def test_a_fuser_that_does_not_come_back_ends_the_server(start: Start) -> None:
    gateway = start(_CANNOT_COME_BACK)
    with pytest.raises(MapError, match="before it was ready"):
        stepped(gateway, lambda: gateway.fuser.restarts > 5)


# --- real scans ---


def by_file(volume: VolumeConfig, keyframes: list[Keyframe]) -> str:
    fused = tsfusion.Volume(volume)
    for keyframe in keyframes:
        fused.integrate(keyframe)
    return fused.map_hash()


def by_socket(server: Server, keyframes: list[Keyframe]) -> str:
    with Client(server.address) as client:
        for keyframe in keyframes:
            client.send(keyframe)
        client.flush(timeout=DEADLINE)
        client.wait_fused(timeout=DEADLINE)
    return fetch_status(server.address).map_hash


@pytest.mark.parametrize(
    ("name", "options", "volume"),
    [
        ("7scenes/redkitchen", {}, VolumeConfig(voxel_size=0.04)),
        (
            "kitti_odometry",
            {"sequence": "00", "modality": "lidar"},
            VolumeConfig(voxel_size=0.5, sensor="lidar"),
        ),
    ],
    ids=["7scenes", "kitti-lidar"],
)
def test_a_real_scan_makes_the_same_map_by_file_and_by_socket(
    data: Callable[[str], Path], tmp_path: Path, name: str, options: dict[str, str], volume: VolumeConfig
) -> None:
    dataset = open_dataset(data(name), **options)
    keyframes = [dataset[i] for i in range(0, min(len(dataset), 40), 8)]
    with serving(tmp_path, volume) as server:
        assert by_socket(server, keyframes) == by_file(volume, keyframes)
        assert server.terminate() == 0
