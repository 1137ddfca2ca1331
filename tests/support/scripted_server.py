# SPDX-License-Identifier: MIT
"""A server without Taichi, journal or mercy: raw sockets, and a script of what it does with keyframes."""

import secrets
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import zmq

from tsfusion.core.errors import TransportError
from tsfusion.gateway.ports.access_control import ZapHandler
from tsfusion.wire.messages import messages
from tsfusion.wire.records import codec
from tsfusion.wire.records.record_header import KeyframeHeader
from tsfusion.wire.sockets import sockets
from tsfusion.wire.sockets.curve import ServerKeys


def number(header: KeyframeHeader) -> int:
    """Which of `wire.wall(i)` this is."""
    return header.timestamp_ns - 10**9


def allowing(allow: Callable[[str], str | None], why_not: Callable[[str], str] = lambda _: "unknown") -> Any:
    """As much of an `AccessControl` as a `ZapHandler` uses."""
    return SimpleNamespace(name_of=allow, why_not=why_not, refused=Counter[str]())


@dataclass
class Session:
    """Progress of one client's stream."""

    key: bytes
    durable: int = 0
    fused: int = 0


class ScriptedServer:
    """Call `start`, change what it does at any time, `stop`; a second `start` is another life of it.

    Attributes:
        taking: it reads keyframes.
        fuse_to: the map has what is journaled up to this number, at once; None = everything.
        silent: it acknowledges nothing (but in Welcome and Pong, unless `deaf`).
        deaf: it answers nothing at all.
        hold: what it answers a keyframe with, once each, instead of taking it.
        denial: what it answers a Hello with.
        keys, allowed: its own keys, and whom it knows by theirs; None = no keys.
        window, max_frame_bytes: its terms, as it says them in Welcome.
        same_epoch: a second `start` is the same process: only the connections were cut.
        clock: its own, nanoseconds.
        refuses: whether a keyframe is turned away at the door.
        taken: (session, number) of every journaled keyframe, in order; it outlives `stop`.
        corrections: numbers of the journaled corrections, in order.
        refused, hellos, pings: what came.
    """

    def __init__(self) -> None:
        self.taking = True
        self.silent = self.deaf = False
        self.fuse_to: int | None = None
        self.hold: tuple[float, str, str] | None = None
        self.denial: tuple[str, str] | None = None
        self.refuses: Callable[[KeyframeHeader], bool] = lambda header: False
        self.keys: ServerKeys | None = None
        self.allowed: dict[str, str] = {}
        self.same_epoch = False
        self.epoch = ""
        self.clock = time.monotonic_ns
        self.window = 8
        self.max_frame_bytes = 1 << 20
        self.taken: list[tuple[bytes, int]] = []
        self.corrections: list[int] = []
        self.refused: list[int] = []
        self.hellos: list[messages.Hello] = []
        self.pings: list[messages.Ping] = []
        self.held = 0
        self.address = self.control = "tcp://127.0.0.1:0"
        self.sessions: dict[bytes, Session] = {}
        self._identities: dict[bytes, bytes] = {}
        self._stopping = threading.Event()

    @property
    def numbers(self) -> list[int]:
        """Which keyframes are journaled."""
        return [number for _, number in self.taken]

    def start(self) -> "ScriptedServer":
        """Listen, where the last life listened."""
        self._stopping.clear()
        self.epoch = self.epoch if self.same_epoch and self.epoch else secrets.token_hex(4)
        self._context: zmq.Context[Any] = zmq.Context()
        self._zap = ZapHandler(self._context, allowing(self.allowed.get))
        self._data = sockets.pull(self._context, 1 << 20, self.keys)
        self._router = sockets.router(self._context, self.keys)
        for made, address in ((self._data, self.address), (self._router, self.control)):
            bind(made, address)
        self.address = self._data.getsockopt_string(zmq.LAST_ENDPOINT)
        self.control = self._router.getsockopt_string(zmq.LAST_ENDPOINT)
        self._thread = threading.Thread(target=self._run)
        self._thread.start()
        return self

    def stop(self) -> None:
        """Vanish, with all that was read into memory and not journaled."""
        self._stopping.set()
        self._thread.join()
        self._data.close()
        self._router.close()
        self._zap.close()
        self._context.term()

    def _run(self) -> None:
        while not self._stopping.is_set():
            polled = [(self._router, zmq.POLLIN), (self._zap.socket, zmq.POLLIN)]
            polled += [(self._data, zmq.POLLIN)] * self.taking
            events = dict(zmq.zmq_poll(polled, 5))
            self._zap.answer_all()
            if self._router in events:
                self._on_control(*self._router.recv_multipart())
            if self._data in events:
                self._on_keyframe(self._data.recv_multipart())
            for session in self.sessions.values():
                fused = session.durable if self.fuse_to is None else min(self.fuse_to, session.durable)
                if session.fused < fused:
                    session.fused = fused
                    self._ack(session)

    def _on_control(self, identity: bytes, frame: bytes) -> None:
        message = messages.decode_to_server(frame)
        if isinstance(message, messages.Hello):
            self.hellos.append(message)
            self._identities[message.session] = identity
            if self.denial is not None:
                self._say(message.session, messages.Denied(message.session, *self.denial))
                return
            session = self.sessions.get(message.session, Session(message.session))
            self._say(
                message.session,
                messages.Welcome(
                    self.epoch,
                    messages.PROTOCOL_VERSION,
                    session.durable,
                    session.fused,
                    self.window,
                    16 << 20,
                    self.max_frame_bytes,
                ),
            )
        elif isinstance(message, messages.Ping):
            self.pings.append(message)
            self._identities[message.session] = identity
            session = self.sessions.get(message.session, Session(message.session))
            now = self.clock()
            pong = messages.Pong(self.epoch, message.sent_ns, now, now, session.durable, session.fused)
            self._say(message.session, pong)

    def _on_keyframe(self, frames: list[bytes]) -> None:
        header = codec.check(frames)
        session = self.sessions.setdefault(header.session, Session(header.session))
        # What tsfusion.sessions promises, said once more: in order, once, declared gaps only.
        new, gap = header.seq > session.durable, header.previous > session.durable
        if self.hold is not None:
            self.held += 1
            self._say(header.session, messages.Hold(header.session, *self.hold))
        elif new and not gap and isinstance(header, KeyframeHeader) and self.refuses(header):
            self.refused.append(number(header))
            nack = messages.Nack(header.session, header.seq, "door", "values", "it will not do")
            self._say(header.session, nack)
        else:
            if new and not gap:
                session.durable = header.seq
                if isinstance(header, KeyframeHeader):
                    self.taken.append((header.session, number(header)))
                else:
                    self.corrections.append(header.seq)
            self._ack(session, resend=new and gap)

    def _ack(self, session: Session, *, resend: bool = False) -> None:
        if not self.silent:
            ack = messages.Ack(session.key, session.durable, session.fused, (), resend)
            self._say(session.key, ack)

    def _say(self, session: bytes, message: messages.ToClient) -> None:
        if not self.deaf and session in self._identities:
            self._router.send_multipart([self._identities[session], messages.encode(message)])


def bind(made: sockets.AnySocket, address: str) -> None:
    """Listen where another socket may just have listened."""
    deadline = time.monotonic() + 10
    while True:
        try:
            sockets.bind_socket(made, address)
            return
        except TransportError:  # the last life has not quite gone
            if time.monotonic() > deadline:
                raise
            time.sleep(0.01)


@contextmanager
def scripted(**settings: Any) -> Iterator[ScriptedServer]:
    """A running one, gone afterwards whatever happens."""
    server = ScriptedServer()
    for name, value in settings.items():
        setattr(server, name, value)
    server.start()
    try:
        yield server
    finally:
        if not server._stopping.is_set():
            server.stop()
