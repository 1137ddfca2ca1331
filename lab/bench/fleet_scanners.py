# SPDX-License-Identifier: MIT
"""Simulated scanners: many sessions that speak the protocol from one thread, with keyframes encoded before.

A real client encodes each keyframe and keeps it on its disk. Hundreds of them on the server's own machine
would measure that. These keep to the server's credit, go back when it asks, and wait when it holds them off.
"""

import itertools
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import msgspec
import numpy as np
import zmq

from tsfusion import Intrinsics, Keyframe
from tsfusion.wire.messages import messages
from tsfusion.wire.records import codec, record_header
from tsfusion.wire.sockets import sockets

_CAMERA = Intrinsics(525.0, 525.0, 319.5, 239.5)
_SHAPE = (480, 640)
_PING_S = 0.5
_HELLO_S = 0.2
_WORLD = "fleet"
_APART = 6.0  # metres between two scanners of a map


def bodies(count: int, noise_mm: float = 2.2) -> list[list[bytes]]:
    """Encoded keyframes of a wavy wall, 640 × 480, some 150 kB each with that noise."""
    rng = np.random.default_rng(7)
    v, u = np.mgrid[: _SHAPE[0], : _SHAPE[1]]
    found = []
    for i in range(count):
        depth = 1500 + 60 * np.sin(u / 70 + i) + 40 * np.cos(v / 90) + rng.normal(0, noise_mm, _SHAPE)
        keyframe = Keyframe(depth=depth.astype(np.uint16), intrinsics=_CAMERA, T_world_camera=np.eye(4))
        found.append(codec.encode(keyframe, session=bytes(16), seq=1, jpeg_quality=90))
    return found


class Scanner:
    """One session. `due` is when its next keyframe is taken (`time.monotonic()`).

    Args:
        number: the scanner's, by which its place and session are found.
        rate: keyframes a second; None = as many as the server's credit allows.
    """

    def __init__(
        self,
        number: int,
        map_name: str,
        frames: list[list[bytes]],
        *,
        rate: float | None,
        begin: float,
        end: float,
    ) -> None:
        self.session = number.to_bytes(4, "big") + b"fleet-scan-\0"
        self.map_name = map_name
        self.captured_ns: list[int] = []  # by seq - 1
        self.durable_ns: dict[int, int] = {}  # by seq
        self.fused_ns: dict[int, int] = {}
        self.durable = self.refused = self.resent = 0
        self.welcome: messages.Welcome | None = None
        self.held_until = 0.0
        self._frames, self._rate, self._end = frames, rate, end
        self._headers = [record_header.unpack_keyframe(one[0]) for one in frames]
        self._next = 1  # seq that is sent next
        self._due = begin
        self._ping_due = self._hello_due = 0.0
        self._place = number * _APART

    def open(self, context: "zmq.Context[Any]", data: str, control: str) -> None:
        """Connect."""
        self.push, self.dealer = sockets.push(context), sockets.dealer(context)
        sockets.connect(self.push, data)
        sockets.connect(self.dealer, control)

    def close(self) -> None:
        """End both connections."""
        self.push.close()
        self.dealer.close()

    @property
    def is_done(self) -> bool:
        """True if everything captured is durable and fused, and nothing more is captured."""
        taken = len(self.captured_ns)
        return time.monotonic() >= self._end and self.durable >= taken <= len(self.fused_ns) + self.refused

    def step(self, now: float) -> float:
        """Send what is due; when to call this again."""
        if self.welcome is None and now >= self._hello_due:
            self._hello_due = now + _HELLO_S
            hello = messages.Hello(self.session, messages.PROTOCOL_VERSION, self.map_name, _WORLD)
            self._send_control(hello)
        if now >= self._ping_due:
            self._ping_due = now + _PING_S
            self._send_control(messages.Ping(self.session, time.monotonic_ns(), 0, 1000))
        self._capture(now)
        self._send_some(now)
        due = [self._ping_due, self._hello_due if self.welcome is None else self._ping_due]
        if now < self._end and self._rate is not None:
            due.append(self._due)
        return min(due)

    def _capture(self, now: float) -> None:
        """Take the keyframes that are due. Without a rate there is always one behind those that were sent."""
        if self._rate is None:
            if now < self._end and self._next > len(self.captured_ns):
                window = self.welcome.window_keyframes if self.welcome else 1
                self.captured_ns += [time.monotonic_ns()] * window
            return
        while self._due <= min(now, self._end - 1e-9):
            self.captured_ns.append(time.monotonic_ns())
            self._due += 1.0 / self._rate

    def _send_some(self, now: float) -> None:
        if self.welcome is None or now < self.held_until:
            return
        last = min(len(self.captured_ns), self.durable + self.welcome.window_keyframes)
        while self._next <= last:
            try:
                self.push.send_multipart(self._record(self._next), zmq.NOBLOCK, copy=False)
            except zmq.Again:
                return
            self._next += 1

    def _record(self, seq: int) -> list[bytes]:
        at = seq % len(self._frames)
        pose = list(self._headers[at].pose)
        pose[3], pose[7] = self._place + 0.02 * (seq % 100), 0.01 * (seq % 40)
        header = msgspec.structs.replace(
            self._headers[at],
            session=self.session, seq=seq, previous=seq - 1, map=self.map_name, world=_WORLD, same_frame=True,
            pose=tuple(pose), captured_ns=self.captured_ns[seq - 1], sent_ns=time.monotonic_ns(),
        )  # fmt: skip
        return [record_header.pack(header), *self._frames[at][1:]]

    def receive(self) -> None:
        """Take the server's messages."""
        while True:
            try:
                message = messages.decode_to_client(self.dealer.recv(zmq.NOBLOCK))
            except zmq.Again:
                return
            self._on(message)

    def _on(self, message: messages.ToClient) -> None:
        if isinstance(message, messages.Welcome):
            self.welcome = message
            self._go_back(message.durable)
        elif isinstance(message, messages.Ack):
            self.durable = max(self.durable, message.durable)
            for stamps in message.stamps:
                if stamps.durable_ns:
                    self.durable_ns.setdefault(stamps.seq, stamps.durable_ns)
                if stamps.fused_ns:
                    self.fused_ns.setdefault(stamps.seq, stamps.fused_ns)
            if message.resend:
                self._go_back(message.durable)
        elif isinstance(message, messages.Hold):
            self.held_until = time.monotonic() + message.seconds
            self._go_back(self.durable)
        elif isinstance(message, messages.Nack):
            self.refused += 1

    def _go_back(self, durable: int) -> None:
        self.durable = max(self.durable, durable)
        self.resent += max(self._next - self.durable - 1, 0)
        self._next = self.durable + 1

    def _send_control(self, message: messages.ToServer) -> None:
        try:
            self.dealer.send(messages.encode_sealed(message), zmq.NOBLOCK)
        except zmq.Again:
            self._hello_due = 0.0


@contextmanager
def connected(scanners: list[Scanner], data: str, control: str) -> Iterator[zmq.Poller]:
    """Connect the scanners, and disconnect them at the end of the block; what their control sockets hold."""
    context: zmq.Context[Any] = zmq.Context()
    context.set(zmq.MAX_SOCKETS, 4 * len(scanners) + 64)
    poller = zmq.Poller()
    try:
        for one in scanners:
            one.open(context, data, control)
            poller.register(one.dealer, zmq.POLLIN)
        yield poller
    finally:
        context.destroy(0)


def drive(scanners: list[Scanner], data: str, control: str, *, deadline: float) -> bool:
    """Let the scanners scan until all is fused; False when that was not so at the deadline."""
    with connected(scanners, data, control) as poller:
        by_socket = {one.dealer: one for one in scanners}
        due = dict.fromkeys(range(len(scanners)), 0.0)
        for turn in itertools.count():
            now = time.monotonic()
            if now > deadline:
                return False
            if turn % 64 == 0 and all(one.is_done for one in scanners):
                return True
            heard = set()
            for socket, _ in poller.poll(int(max(0.0, min(0.02, min(due.values()) - now)) * 1000)):
                by_socket[socket].receive()
                heard.add(by_socket[socket].session)
            now = time.monotonic()
            for number, one in enumerate(scanners):
                if now >= due[number] or one.session in heard or one.held_until > now - 1.0:
                    due[number] = one.step(now)
    raise AssertionError("the loop has no other end")
