# SPDX-License-Identifier: MIT
"""A gateway in this process, without sockets, where time passes by its steps; or one that listens."""

import contextlib
import errno
import itertools
import os
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar
from unittest import mock

import zmq
from idle_fuser import answer_of
from keyframes_and_servers import until, wall

from tsfusion.core.config import ServerConfig, VolumeConfig
from tsfusion.fuser import fuser_messages
from tsfusion.gateway import loop
from tsfusion.gateway.fusers import fuser_supervisor
from tsfusion.gateway.gateway import Gateway
from tsfusion.gateway.health.metrics import Metrics
from tsfusion.gateway.loop import GatewayLoop
from tsfusion.gateway.ports.access_control import AccessControl
from tsfusion.gateway.ports.ports import Incoming
from tsfusion.wire.messages import messages
from tsfusion.wire.records import codec
from tsfusion.wire.records.record_header import with_fields
from tsfusion.wire.sockets.sockets import Addresses

_MOST_STEPS = 10_000
_MOST_STEPS = 10_000
LINK = b"link"  # identity of a connection


class Ended(Exception):
    """A fuser's process ends, with this status."""


class QuietFuser:
    """As much of a `FuserProcess` as a gateway uses, without a process: it takes keyframes and fuses none.

    `work` does something else with a message. It may yield seconds in which it does nothing, and raise
    `Ended`.

    Attributes:
        is_refused: the system can start no process.
        unread: what it was sent and has not looked at.
    """

    is_refused: ClassVar[bool] = False
    _NUMBERS = itertools.count(1 << 23)  # process ids that no process has
    _SILENT, _ = os.pipe()
    socket: Any = _SILENT  # which a loop may poll

    def __init__(self, name: str = "", *, waits: bool = False) -> None:
        self.has_started, self.is_closed = False, False
        self.pid, self.state = 0, "S"
        self.status: int | None = None
        self.working_file, self.current_keyframe = "", fuser_messages.NOT_WORKING
        self.unread: list[fuser_messages.ToFuser] = []
        self._said: list[fuser_messages.ToGateway] = []
        self._doing: Iterator[float] | None = None
        self._busy_until = 0.0
        if not waits:
            self.start()

    def start(self) -> None:
        if self.is_refused:
            raise OSError(errno.EAGAIN, os.strerror(errno.EAGAIN))
        self.pid = next(self._NUMBERS)
        self.say(fuser_messages.Started())

    def say(self, message: fuser_messages.ToGateway) -> None:
        self._said.append(message)

    def work(self, message: fuser_messages.ToFuser) -> Iterator[float]:
        """Handle a message."""
        if isinstance(message, fuser_messages.Finish):
            raise Ended(0)
        if (answer := answer_of(message)) is not None:
            self.say(answer)
        yield from ()

    def send(self, message: fuser_messages.ToFuser, _frames: Sequence[Any] = ()) -> bool:
        self.unread.append(message)
        return True

    def receive(self) -> tuple[fuser_messages.ToGateway, Sequence[zmq.Frame]] | None:
        self._go_on()
        return (self._said.pop(0), ()) if self._said else None

    def _go_on(self) -> None:
        while self.status is None and time.monotonic() >= self._busy_until:
            if self._doing is None:
                if not self.unread:
                    return
                self._doing = self.work(self.unread.pop(0))
            try:
                self._busy_until = time.monotonic() + next(self._doing)
            except StopIteration:
                self._doing = None
            except Ended as ended:
                self.status = ended.args[0]

    def note_start(self) -> None:
        self.has_started = True

    def clear_current_keyframe(self) -> None:
        self.current_keyframe = fuser_messages.NOT_WORKING

    def kill(self) -> None:
        self.status = -9 if self.status is None else self.status

    def close(self, _timeout: float = 0.0, *, wait: bool = True) -> None:
        self.kill()
        self.is_closed = True


class Served:
    """A gateway whose messages come and go by calls. Call `until` or `heard` instead of waiting."""

    def __init__(self, gateway: Gateway, clock: "Clock") -> None:
        self.gateway, self.clock = gateway, clock
        self.frames: list[bytes] = []  # of the last message that was heard

    def step(self) -> None:
        self.gateway.intake.finish()
        self.gateway.step()
        self.clock.now += 0.02

    @property
    def durable(self) -> int:
        """Keyframes in the journal."""
        return self.gateway.health().maps["default"].keyframes_durable

    @property
    def refused(self) -> dict[str, int]:
        return self.gateway.health().refused

    def until(self, reached: Callable[[], Any]) -> None:
        """Step until that is true."""
        for _ in range(_MOST_STEPS):
            if reached():
                return
            self.step()
        raise AssertionError("deadline")

    def take(self, frames: Sequence[Any], *, client: str = "", connection: int = 1) -> None:
        """Let a message to the data socket come."""
        self.gateway.intake.handle(Incoming(client, [*map(memoryview, frames)], connection=connection))

    def say(self, message: messages.ToServer | bytes, link: bytes = LINK, *, client: str = "") -> None:
        """Let a message to the control socket come."""
        content = message if isinstance(message, bytes) else messages.encode_sealed(message)
        self.gateway.on_control(Incoming(client, [memoryview(content)], link))

    def greet(self, map_name: str = "default", session: bytes = bytes(16), link: bytes = LINK) -> Any:
        """The answer to a greeting."""
        self.say(messages.Hello(session, messages.PROTOCOL_VERSION, map_name), link)
        return self.heard(messages.Welcome, messages.Denied, link=link)

    def ask(self, command: messages.Command, link: bytes = LINK, *, client: str = "") -> Any:
        """The reply to a command."""
        self.say(command, link, client=client)
        return self.heard(messages.Reply, link=link)

    def heard(self, *kinds: type, link: bytes = LINK) -> Any:
        """The next message of these kinds to a connection, as it arrives there."""
        while True:
            self.until(lambda: any(one.identity == link for one in self.gateway.out))
            one = next(one for one in self.gateway.out if one.identity == link)
            self.gateway.out.remove(one)
            if isinstance(message := messages.decode_to_client(messages.encode_sealed(one.message)), kinds):
                self.frames = [bytes(frame) for frame in one.frames]
                return message


class Clock:
    """Time, which passes when it is told to."""

    def __init__(self) -> None:
        self.now = time.monotonic()

    def monotonic(self) -> float:
        return self.now

    def monotonic_ns(self) -> int:
        return int(1e9 * self.now)


@contextlib.contextmanager
def standing() -> Iterator[Clock]:
    """Let time stand still, for all gateways of a test alike."""
    if isinstance(before := getattr(time.monotonic, "__self__", None), Clock):
        yield before
        return
    clock = Clock()
    with (
        mock.patch.object(time, "monotonic", clock.monotonic),
        mock.patch.object(time, "monotonic_ns", clock.monotonic_ns),
    ):
        yield clock


@contextlib.contextmanager
def hosting(
    state: Path,
    *,
    fuser: type[QuietFuser] = QuietFuser,
    guest: str | None = None,
    later: tuple[str, ...] = (),
    warm: bool = True,
    **settings: Any,
) -> Iterator[Served]:
    """Make a gateway whose default map is open, and end it afterwards whatever happens.

    Args:
        later: further maps, whose fusers wait.
        warm: wait until its maps are open.
    """
    with contextlib.ExitStack() as stack:
        clock = stack.enter_context(standing())
        server = ServerConfig(state=str(state), **{"memory_bytes": 1 << 40, **settings})
        start: Any = fuser
        gateway = Gateway(start, server, AccessControl(server.keys, guest=guest), Metrics(server))
        stack.callback(gateway.maps.close)
        stack.callback(gateway.moves.close)
        gateway.maps.open_at_start(dict.fromkeys(("default", *later), VolumeConfig()), later=later)
        served = Served(gateway, clock)
        if warm:
            served.until(lambda: gateway.maps.warm)
            gateway.accept(Addresses("tcp://127.0.0.1:1", "tcp://127.0.0.1:2"))
        yield served


class Listening:
    """A gateway that listens at two ports. Call `until` instead of waiting."""

    def __init__(self, made: GatewayLoop) -> None:
        self.loop, self.gateway, self.ports = made, made.gateway, made.ports
        self.addresses = made.ports.bind()
        made.gateway.accept(self.addresses)

    def step(self) -> None:
        self.loop.step()

    @property
    def durable(self) -> int:
        """Keyframes in the journal."""
        return self.gateway.health().maps["default"].keyframes_durable

    def until(self, reached: Callable[[], Any]) -> None:
        """Step until that is true."""
        until(lambda: self.step() or reached())


@contextlib.contextmanager
def serving_here(state: Path, *, guest: str | None = None, **settings: Any) -> Iterator[Listening]:
    """Start a gateway that listens and whose default map is open, and end it afterwards whatever happens."""

    def start(_context: Any, _server: ServerConfig, name: str = "", *, waits: bool = False) -> QuietFuser:
        return QuietFuser(name, waits=waits)

    with contextlib.ExitStack() as stack:
        stack.enter_context(mock.patch.object(loop, "FuserProcess", start))
        stack.enter_context(mock.patch.object(loop, "_TICK_MS", 5))
        stack.enter_context(mock.patch.object(fuser_supervisor, "_END_DEADLINE", 0.0))
        settings = {"memory_bytes": 1 << 40, **settings}  # the tests of this process may hold much
        server = ServerConfig(listen="tcp://127.0.0.1:0", state=str(state), **settings)
        context: zmq.Context[Any] = zmq.Context()
        stack.callback(context.term)
        made = GatewayLoop(context, server, AccessControl(server.keys, guest=guest), Metrics(server))
        stack.callback(made.close)
        made.gateway.maps.open_at_start({"default": VolumeConfig()})
        until(lambda: made.step() or made.gateway.maps.warm)
        yield Listening(made)


def record(
    seq: int,
    map_name: str = "default",
    session: bytes = bytes(16),
    *,
    previous: int | None = None,
    **fields: Any,
) -> list[bytes]:
    """A keyframe as it is sent; `fields` of it that differ from a wall's."""
    frames = codec.encode(wall(seq, **fields), session=session, seq=seq, jpeg_quality=90)
    previous = seq - 1 if previous is None else previous
    return [with_fields(frames[0], previous=previous, sent_ns=1, map=map_name), *frames[1:]]
