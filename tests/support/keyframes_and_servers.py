# SPDX-License-Identifier: MIT
"""Keyframes and server processes for the tests of the wire."""

import random
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import msgspec
import numpy as np
import quick_fusers
import zmq

from tsfusion import Intrinsics, Keyframe, journal
from tsfusion.core.config import ServerConfig, VolumeConfig
from tsfusion.journal import state_folder
from tsfusion.wire.keys import key_folder
from tsfusion.wire.records import codec
from tsfusion.wire.records.corrections import Correction
from tsfusion.wire.sockets import sockets
from tsfusion.wire.sockets.curve import ClientKeys, client_keys

DEADLINE = 120.0
CAMERA = Intrinsics(40.0, 40.0, 31.5, 23.5)
SHAPE = (48, 64)
VOLUME = VolumeConfig(voxel_size=0.04, threads=1)
NUMBERED_NS = 10**9  # `timestamp_ns` of `wall(0)`; that of `wall(i)` is i more
_SERVE = """
import sys, msgspec
from tsfusion import server
from tsfusion.core.config import ServerConfig, VolumeConfig
from tsfusion.core.errors import TsfusionError
config = msgspec.json.decode(sys.argv[1], type=ServerConfig)
volume = msgspec.json.decode(sys.argv[2], type=VolumeConfig)
try:
    sys.exit(server.run(config, volume, lambda a: print(a.data, a.control, flush=True)))
except TsfusionError as error:
    sys.exit(f"{type(error).__name__}: {error}")
"""


def pose(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> np.ndarray:
    T = np.eye(4)
    T[:3, 3] = x, y, z
    return T


def wall(i: int = 0, **fields: Any) -> Keyframe:
    """A wavy wall a good metre away, seen from a place that depends on `i`."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    depth = (1200 + 40 * np.sin(u / 9 + i) + 3 * v).astype(np.uint16)
    depth[:2] = 0
    color = np.dstack([u * 3, v * 4, np.full(SHAPE, (37 * i) % 256)]).astype(np.uint8)
    given = {"T_world_camera": pose(0.03 * i), "timestamp_ns": NUMBERED_NS + i, **fields}
    return Keyframe(depth=depth, color=color, intrinsics=CAMERA, **given)


def map_hash(keyframes: Iterable[Keyframe], config: VolumeConfig = VOLUME) -> str:
    """Hash of the map of these keyframes, fused in this process."""
    from tsfusion import Volume

    volume = Volume(config)
    for keyframe in keyframes:
        volume.integrate(keyframe)
    return volume.map_hash()


def journaled_corrections(state: Path, map_name: str = "default") -> list[Correction]:
    """The corrections in a map's journal, in its order."""
    folder = state_folder.map_folder(state, map_name) / state_folder.JOURNAL_FOLDER
    found = []
    for number in journal.segments(folder):
        for record in journal.records(journal.segment_path(folder, number)):
            if record.is_correction:
                decoded = codec.decode(record.frames)
                assert isinstance(decoded, Correction)
                found.append(decoded)
    return found


def until(reached: Callable[[], bool], deadline: float = DEADLINE) -> None:
    """Poll; fails the test when it is not reached in time."""
    end = time.monotonic() + deadline
    while not reached():
        assert time.monotonic() < end, "deadline"
        time.sleep(0.005)


def at_once(*calls: Callable[[], object]) -> None:
    """Call them in a thread each, and wait until all have ended."""
    threads = [threading.Thread(target=call) for call in calls]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


class Secured(NamedTuple):
    """Settings with which a server asks for keys and a client has them."""

    server: dict[str, str]  # settings
    client: dict[str, str]

    @property
    def keys(self) -> ClientKeys | None:
        """Keys of whoever asks the server questions."""
        return client_keys(self.client.get("key"), self.client.get("server_key"))


UNSECURED = Secured({}, {})


def secured(folder: Path) -> Secured:
    """A server's keys, and those of a robot that it lets in."""
    key_folder.create_pair(folder / "server", "server")
    key_folder.allow(folder / "server", "robot", key_folder.create_pair(folder / "robot", "robot").public)
    public = folder / "server" / "server.key"
    return Secured(
        {"keys": str(folder / "server")},
        {"key": str(folder / "robot" / "robot.key_secret"), "server_key": str(public)},
    )


class Server:
    """`server.run` in a process of its own.

    Args:
        wait: until it is ready; else call `wait_ready` before anything that needs its addresses.
        code: run before it, in its process.
        fuser: command of its fusers, one of `quick_fusers`; None = `FUSER`.

    Attributes:
        FUSER: command of fusers where none is chosen; None = the server's own. Tests set another one
            (tests/conftest.py), measurements do not.
    """

    FUSER: ClassVar[tuple[str, ...] | None] = None

    def __init__(
        self,
        state: Path,
        volume: VolumeConfig | None = None,
        *,
        wait: bool = True,
        code: str = "",
        fuser: tuple[str, ...] | None = None,
        **settings: Any,
    ) -> None:
        self.state = state
        config = ServerConfig(**{"listen": "tcp://127.0.0.1:0", "state": str(state), **settings})
        volume = volume or VOLUME
        arguments = [msgspec.json.encode(one).decode() for one in (config, volume)]
        self._words = tempfile.TemporaryFile("w+")  # noqa: SIM115  a pipe that nobody reads would fill up
        self.process = subprocess.Popen(
            [sys.executable, "-c", quick_fusers.chosen(fuser or self.FUSER) + code + _SERVE, *arguments],
            stdout=subprocess.PIPE,
            stderr=self._words,
            text=True,
        )
        self.address = self.control = ""
        if wait:
            self.wait_ready()

    def wait_ready(self) -> bool:
        """Wait until it prints where it listens; False when it ended instead."""
        self.address, self.control = (self.process.stdout.readline().split() or [""] * 2)[:2]
        return bool(self.address)

    def terminate(self) -> int:
        """SIGTERM; the exit status."""
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(DEADLINE)

    def kill(self) -> None:
        """SIGKILL, as the kernel does it when memory runs out."""
        self.process.kill()
        self.process.wait(DEADLINE)

    def stderr_text(self) -> str:
        """Text of its stderr, once it has ended."""
        self.process.wait(DEADLINE)
        self._words.seek(0)
        return self._words.read().strip()

    def close(self) -> None:
        """End it, if need be, and close its files."""
        if self.process.poll() is None:
            self.kill()
        self.process.stdout.close()
        self._words.close()

    def fuser_pid(self) -> int:
        """The fuser, its only child."""
        children = self.children()
        assert len(children) == 1, children
        return children[0]

    def children(self) -> list[int]:
        """The fusers, one for each map that is open."""
        pids = Path(f"/proc/{self.process.pid}/task/{self.process.pid}/children").read_text().split()
        return [int(pid) for pid in pids]


def lasting_address() -> str:
    """An address at which a server can start again: no program's own end of a connection gets such a port."""
    while True:
        port = random.randrange(10_000, 32_000, 4)  # the system gives out those from 32768
        with ExitStack() as stack, suppress(OSError):
            for each in range(port, port + 2):  # data, control
                stack.enter_context(socket.socket()).bind(("127.0.0.1", each))
            return f"tcp://127.0.0.1:{port}"


@contextmanager
def serving(state: Path, volume: VolumeConfig | None = None, **settings: Any) -> Iterator[Server]:
    """Start a server, and end it afterwards whatever happens."""
    server = Server(state, volume, **settings)
    try:
        if not server.address:
            raise RuntimeError(server.stderr_text())
        yield server
    finally:
        server.close()


@contextmanager
def connected(
    kind: Callable[..., sockets.AnySocket], address: str, keys: ClientKeys | None = None
) -> Iterator[sockets.AnySocket]:
    """Connect a socket of this kind, and close it afterwards."""
    context: zmq.Context[Any] = zmq.Context()
    made = kind(context, keys=keys) if keys else kind(context)
    try:
        made.connect(address)
        yield made
    finally:
        made.close()
        context.term()
