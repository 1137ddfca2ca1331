# SPDX-License-Identifier: MIT
"""The scanner's sending side: five lines for whoever brings a localiser of their own.

    with tsfusion.Client("tcp://127.0.0.1:5555", spool="spool-dir") as client:
        for keyframe in keyframes:
            client.send(keyframe)
        client.flush(timeout=10.0)

`send` encodes and writes to the spool; a thread of its own does the talking. Taichi is never imported.
"""

import atexit
import logging
import os
import threading
import time
from collections.abc import Callable
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tsfusion import codec
from tsfusion.config import ClientConfig
from tsfusion.errors import FlushTimeout, KeyframeRefused, ServerUnreachable, TransportError
from tsfusion.keyframe import Keyframe
from tsfusion.mesh import Mesh
from tsfusion.outbox import ClientStats, Outbox
from tsfusion.sender import Sender
from tsfusion.spool import Spool
from tsfusion.transport import (
    ClientKeys,
    Command,
    KeyframeTimes,
    Reply,
    Status,
    control_address,
    request,
    sockets,
)  # fmt: skip
from tsfusion.transport.messages import MeshLayout

__all__ = ["Client", "ClientStats", "fetch_mesh", "fetch_status"]

_ANSWER_TIMEOUT = 5.0  # seconds; the gateway is never busy, so who says nothing for so long is not there
_SILENCE = 1.0  # seconds; the server answers a ping every half second

log = logging.getLogger(__name__)


class Client:
    """Sends keyframes to a server and keeps each until the server has it on its disk.

    Args:
        address: the server's data address.
        spool: a folder for keyframes that are not acknowledged yet; what a dead client left there is sent
            first. None = a temporary one, gone with `close`.
        control: the server's control address; default the port after `address`.
        config: the rest of the settings; its own addresses are not used.

    Raises:
        InvalidConfig: for a malformed address.
        JournalError: when the spool cannot be used, or another client uses it.
    """

    def __init__(
        self,
        address: str = "tcp://127.0.0.1:5555",
        *,
        spool: str | os.PathLike[str] | None = None,
        control: str | None = None,
        config: ClientConfig | None = None,
    ) -> None:
        self._config = config or ClientConfig()
        address = sockets.target(address)
        self._control = sockets.target(control_address(address, control))
        self._outbox = Outbox(Spool(spool, self._config.segment_bytes))
        self._sender = Sender(address, self._control, self._outbox, self._config.stall_timeout)
        self._sending = threading.Lock()
        self._closed = False
        self._thread = threading.Thread(target=self._sender.run, name="tsfusion-client", daemon=True)
        self._thread.start()
        atexit.register(self.close)  # also who forgets to leaves no temporary spool behind

    def send(self, keyframe: Keyframe) -> int:
        """Take a keyframe; returns its number once it is in the spool. Never waits for the network.

        Raises:
            JournalError: when the spool's disk refuses it.
            TransportError: after `close`.
        """
        spool = self._outbox.spool
        with self._sending:
            if self._closed:
                raise TransportError("the client is closed")
            frames = codec.encode(
                keyframe,
                session=spool.session,
                seq=spool.next_seq,
                jpeg_quality=self._config.jpeg_quality,
            )
            entry = spool.write(frames)
            with self._outbox.changed:
                self._outbox.add(entry, keyframe)
        self._sender.wake()
        return entry.seq

    def connect(self, timeout: float | None = None) -> None:
        """Wait until the server has answered. Not needed before `send`.

        Raises:
            ServerUnreachable: when it has not within `timeout` seconds (default: the config's).
        """
        timeout = self._config.connect_timeout if timeout is None else timeout
        if not self._wait(lambda: self._outbox.connected, timeout):
            raise ServerUnreachable(f"{self._why()} (waited {timeout:g} s)")

    def flush(self, timeout: float = 10.0) -> None:
        """Wait until everything sent is on the server's disk.

        Raises:
            FlushTimeout: after `timeout` seconds; the rest stays in the spool and is still being sent.
            KeyframeRefused: when the server turned some away for good since the last flush.
        """
        box = self._outbox
        done = self._wait(lambda: not box.spool.waiting, timeout)
        with box.changed:
            refusals, box.refusals = box.refusals, []
        if refusals:
            more = f" (and {len(refusals) - 1} more)" if len(refusals) > 1 else ""
            raise KeyframeRefused(f"keyframe {refusals[0]}{more}")
        if not done:
            raise FlushTimeout(
                f"{len(box.spool.waiting)} keyframes are not acknowledged after {timeout:g} s: {self._why()}"
            )

    def wait_fused(self, timeout: float = 60.0) -> None:
        """Wait until the map has taken or rejected everything sent (`stats.rejected` says what).

        Raises:
            FlushTimeout: after `timeout` seconds.
        """
        box = self._outbox
        if not self._wait(lambda: not box.spool.waiting and not box.unfused, timeout):
            raise FlushTimeout(f"the map does not have every keyframe after {timeout:g} s: {self._why()}")

    def wait_meshed(self, timeout: float = 60.0) -> None:
        """Wait until the server's mesh shows everything sent.

        Raises:
            FlushTimeout: after `timeout` seconds.
        """
        box = self._outbox
        if not self._wait(lambda: not (box.spool.waiting or box.unfused or box.unmeshed), timeout):
            raise FlushTimeout(f"the mesh is not up to date after {timeout:g} s: {self._why()}")

    @property
    def records(self) -> list[KeyframeTimes]:
        """When each keyframe passed each stage, on this process's monotonic clock (the last 65536)."""
        with self._outbox.changed:
            return self._outbox.times()

    @property
    def stats(self) -> ClientStats:
        """Counts since this client began."""
        with self._outbox.changed:
            return self._outbox.stats()

    @property
    def connected(self) -> bool:
        """Whether the server answered and has not fallen silent."""
        return self._outbox.connected

    def close(self) -> None:
        """Stop sending. Call `flush` first: what a temporary spool still holds is lost (and logged)."""
        with self._sending:
            if self._closed:
                return
            self._closed = True
            atexit.unregister(self.close)
            self._sender.stop()
            self._thread.join()
            lost = len(self._outbox.spool.waiting) if self._outbox.spool.temporary else 0
            if lost:
                log.error("%d keyframes are lost: not acknowledged, and the spool was temporary", lost)
            self._outbox.spool.close()

    def __enter__(self) -> "Client":
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _wait(self, reached: Callable[[], bool], timeout: float) -> bool:
        deadline = time.monotonic() + timeout
        with self._outbox.changed:
            while not reached():
                if not self._thread.is_alive():
                    raise TransportError("the client is closed, or its sending thread has died")
                left = deadline - time.monotonic()
                if left <= 0:
                    return False
                self._outbox.changed.wait(min(left, 0.5))
        return True

    def _why(self) -> str:
        if self._outbox.problem:
            return self._outbox.problem
        heard = self._sender.heard
        silence = time.monotonic() - heard
        if not heard:
            return f"no server answers at {self._control}"
        why = "the server is behind"
        if silence > _SILENCE:
            why = f"nothing was heard from the server at {self._control} for {silence:.1f} s"
        return why if self._outbox.spool.temporary else f"{why}; they stay in {self._outbox.spool.folder}"


def fetch_status(
    address: str, *, control: str | None = None, timeout: float = 10.0, keys: ClientKeys | None = None
) -> Status:
    """How the server at a data address is doing.

    Args:
        keys: of `curve.client_keys`, for a server with keys.

    Raises:
        NotAllowed: when the server turns the connection away.
        ServerUnreachable: when nobody answers in `timeout` seconds.
        TransportError: when the server cannot say.
    """
    reply, _ = _ask(address, control, Command(name="status"), timeout, keys)
    if reply.status is None:
        raise TransportError(f"the server at {address} answered without a status")
    return reply.status


def fetch_mesh(
    address: str,
    *,
    control: str | None = None,
    min_weight: float | None = None,
    timeout: float = 60.0,
    keys: ClientKeys | None = None,
) -> Mesh:
    """The whole mesh of the server at a data address, as of now.

    Args:
        keys: of `curve.client_keys`, for a server with keys.

    Raises:
        NotAllowed: when the server turns the connection away.
        ServerUnreachable: when nobody is there (known after a few seconds), or the mesh takes longer than
            `timeout` seconds.
        TransportError: when the server cannot make it.
    """
    reply, frames = _ask(address, control, Command(name="mesh", min_weight=min_weight), timeout, keys)
    if reply.mesh is None:
        raise TransportError(f"the server at {address} answered without a mesh")
    return mesh_of(reply.mesh, frames)


def _ask(
    address: str, control: str | None, command: Command, timeout: float, keys: ClientKeys | None
) -> tuple[Reply, list[memoryview]]:
    """The fuser's answer. That takes its time, so it is asked first whether anybody is there."""
    address = control_address(sockets.target(address), control)
    if timeout > _ANSWER_TIMEOUT:
        request(address, Command(name="ping"), timeout=_ANSWER_TIMEOUT, keys=keys)
    return request(address, command, timeout=timeout, keys=keys)


def mesh_of(layout: MeshLayout, frames: list[memoryview]) -> Mesh:
    """A mesh from its frames (see `MeshLayout`).

    Raises:
        TransportError: when the frames are not what the layout says.
    """
    wanted: list[tuple[int, type]] = [
        (layout.vertices, np.float32), (layout.faces, np.int32), (layout.vertices, np.float32),
    ]  # fmt: skip
    if layout.colors:
        wanted.append((layout.vertices, np.uint8))
    sizes = [rows * 3 * np.dtype(dtype).itemsize for rows, dtype in wanted]
    if sizes != [frame.nbytes for frame in frames]:
        raise TransportError(f"a mesh of {sizes} bytes was announced, got {[f.nbytes for f in frames]}")
    arrays: list[NDArray[Any]] = [
        np.frombuffer(frame, dtype).reshape(-1, 3) for frame, (_, dtype) in zip(frames, wanted, strict=True)
    ]
    return Mesh(*arrays)
