# SPDX-License-Identifier: MIT
"""Who may connect, with real sockets and keys, and what the others are told."""

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import zmq
from wire import until

from tsfusion.errors import NotAllowed
from tsfusion.transport import Addresses, Command, messages, request, sockets
from tsfusion.transport.curve import ClientKeys, ServerKeys
from tsfusion.transport.monitor import Monitor
from tsfusion.transport.zap import Zap, sender_of

Message = tuple[list[bytes], list[str | None]]  # frames, and the sender of each


def pair() -> tuple[str, str]:
    public, secret = zmq.curve_keypair()
    return public.decode(), secret.decode()


SERVER = ServerKeys(*pair())
ROBOT = ClientKeys(*pair(), server=SERVER.public)
STRANGER = ClientKeys(*pair(), server=SERVER.public)
MISLED = ClientKeys(ROBOT.public, ROBOT.secret, server=pair()[0])  # knows another server's key


class Door:
    """The three sockets of a server with a Zap, in a thread of their own. Commands are answered."""

    def __init__(self, keys: ServerKeys | None, allowed: dict[str, str], *, guarded: bool = True) -> None:
        self.allowed = allowed
        self.keyframes: list[Message] = []
        self.control: list[Message] = []
        self.subscriptions: list[Message] = []
        self._context: zmq.Context[Any] = zmq.Context()
        self.zap = Zap(self._context, allowed.get, lambda _: "revoked") if guarded else None
        self._pull = sockets.pull(self._context, 1 << 20, keys)
        self._router = sockets.router(self._context, keys)
        self._publish = sockets.publisher(self._context, keys)
        self.addresses: Addresses = sockets.bind(
            self._pull, self._router, self._publish, "tcp://127.0.0.1:0", None
        )
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        inboxes = {
            self._pull: self.keyframes, self._router: self.control, self._publish: self.subscriptions
        }  # fmt: skip
        polled = [(one, zmq.POLLIN) for one in (*inboxes, *([self.zap.socket] if self.zap else []))]
        while not self._stopping.is_set():
            events = dict(zmq.zmq_poll(polled, 20))
            if self.zap is not None:
                self.zap.answer_all()
            for socket, inbox in inboxes.items():
                if socket in events:
                    frames = socket.recv_multipart(copy=False)
                    inbox.append(([frame.bytes for frame in frames], [sender_of(frame) for frame in frames]))
                    if socket is self._router:
                        reply = messages.encode(messages.Reply(name="ping"))
                        socket.send_multipart([frames[0].bytes, reply])
        for socket in inboxes:
            socket.close()
        if self.zap is not None:
            self.zap.close()
        self._context.term()

    def close(self) -> None:
        self._stopping.set()
        self._thread.join()


@contextmanager
def door(
    keys: ServerKeys | None = SERVER, allowed: dict[str, str] | None = None, *, guarded: bool = True
) -> Iterator[Door]:
    made = Door(keys, {ROBOT.public: "robot1"} if allowed is None else allowed, guarded=guarded)
    try:
        yield made
    finally:
        made.close()


class Caller:
    """One connecting socket and its monitor."""

    def __init__(self, kind: Callable[..., sockets.AnySocket], address: str, keys: ClientKeys | None) -> None:
        self._context: zmq.Context[Any] = zmq.Context()
        self.socket = kind(self._context, keys)
        self.monitor = Monitor(self.socket, address, keys)
        self.said: str | None = None
        self.socket.connect(address)

    def heard(self) -> str | None:
        """The last thing the monitor said."""
        news = self.monitor.problem()
        self.said = self.said if news is None else news
        return self.said

    def close(self) -> None:
        self.monitor.close()
        self.socket.close()
        self._context.term()


@contextmanager
def calling(
    kind: Callable[..., sockets.AnySocket], address: str, keys: ClientKeys | None
) -> Iterator[Caller]:
    made = Caller(kind, address, keys)
    try:
        yield made
    finally:
        made.close()


def ask(at: Door, keys: ClientKeys | None, timeout: float = 5.0) -> messages.Reply:
    return request(at.addresses.control, Command(name="ping"), timeout=timeout, keys=keys)[0]


# --- in ---


def test_an_allowed_key_is_the_sender_of_every_part() -> None:
    with door() as at:
        with calling(sockets.push, at.addresses.data, ROBOT) as robot:
            until(lambda: robot.heard() == "")
            robot.socket.send_multipart([b"head", b"depth" * 1000, b"color" * 1000])
            until(lambda: bool(at.keyframes))
        with calling(sockets.dealer, at.addresses.control, ROBOT) as robot:
            until(lambda: robot.heard() == "")
            robot.socket.send(b"hello")
            until(lambda: bool(at.control))
        with calling(sockets.subscriber, at.addresses.publish, ROBOT) as robot:
            until(lambda: bool(at.subscriptions))
        for frames, senders in (*at.keyframes, *at.control):
            assert senders == [ROBOT.public] * len(frames)
        assert at.keyframes[0][0][0] == b"head"
        assert at.subscriptions[0][0] == [b"\x01mesh/default/"]


def test_without_keys_the_link_is_as_before() -> None:
    with door(None, guarded=False) as at:
        assert ask(at, None).name == "ping"
        assert at.control[0][1] == [None, None]


def test_two_robots_are_told_apart() -> None:
    with door(allowed={ROBOT.public: "a", STRANGER.public: "b"}) as at:
        for keys in (ROBOT, STRANGER):
            ask(at, keys)
        assert [senders[1] for _, senders in at.control] == [ROBOT.public, STRANGER.public]


# --- out ---


@pytest.mark.parametrize("kind", [sockets.push, sockets.dealer])
@pytest.mark.parametrize(
    ("keys", "words"),
    [
        (STRANGER, f"does not know this client's key {STRANGER.public} (or it was revoked)"),
        (MISLED, "the server's key is not the one given"),
        (None, "takes only connections with keys: make a pair by `tsfusion keys new NAME`"),
    ],
    ids=["unknown key", "wrong server key", "no key"],
)
def test_who_is_not_let_in_is_told_why(
    kind: Callable[..., sockets.AnySocket], keys: ClientKeys | None, words: str
) -> None:
    with door() as at:
        address = at.addresses.data if kind is sockets.push else at.addresses.control
        with calling(kind, address, keys) as stranger:
            until(lambda: words in (stranger.heard() or ""))
            with pytest.raises(zmq.Again):
                stranger.socket.send(b"hello", zmq.NOBLOCK)
            assert stranger.monitor.refused == stranger.monitor.gave_up == (keys is not MISLED)
            assert (stranger.monitor.connected, stranger.monitor.lost) == (False, 0)
        assert not at.keyframes
        assert not at.control


def test_keys_for_a_server_without_are_told_so() -> None:
    with door(None, guarded=False) as at, calling(sockets.dealer, at.addresses.control, ROBOT) as robot:
        until(lambda: "was started without" in (robot.heard() or ""))
        assert robot.monitor.gave_up
        assert not at.control


@pytest.mark.parametrize("mechanism", ["plain", "subscriber"])
def test_other_ways_in_are_closed(mechanism: str) -> None:
    with door() as at:
        context: zmq.Context[Any] = zmq.Context()
        made = sockets.dealer(context) if mechanism == "plain" else sockets.subscriber(context)
        if mechanism == "plain":
            made.setsockopt_string(zmq.PLAIN_USERNAME, "robot1")
            made.setsockopt_string(zmq.PLAIN_PASSWORD, ROBOT.public)
        address = at.addresses.control if mechanism == "plain" else at.addresses.publish
        monitor = Monitor(made, address)
        made.connect(address)
        until(lambda: monitor.problem() is not None and monitor.gave_up)
        monitor.close()
        made.close()
        context.term()
        assert not at.control
        assert not at.subscriptions


def test_without_a_handler_nobody_gets_in() -> None:
    """libzmq alone would let in whoever has any key at all."""
    with door(guarded=False) as at, calling(sockets.dealer, at.addresses.control, ROBOT) as robot:
        until(lambda: bool(robot.heard()))
        assert not robot.monitor.connected
        assert not at.control


def test_a_revoked_key_stays_out_and_the_log_says_so(caplog: pytest.LogCaptureFixture) -> None:
    with door() as at:
        ask(at, ROBOT)
        at.allowed.clear()
        for _ in range(3):
            with pytest.raises(NotAllowed, match="or it was revoked"):
                ask(at, ROBOT)
        assert at.zap is not None
        assert at.zap.refused == {"revoked": 3}
    assert len(caplog.records) == 1  # the same thing is not said three times
    assert f"is refused (revoked): key {ROBOT.public}" in caplog.text


def test_a_key_allowed_later_gets_in() -> None:
    """Not by libzmq's own reconnecting: it never tries again after a refusal."""
    with door(allowed={}) as at:
        with calling(sockets.dealer, at.addresses.control, ROBOT) as robot:
            until(lambda: bool(robot.heard()))
            at.allowed[ROBOT.public] = "robot1"
            assert robot.monitor.gave_up
        assert ask(at, ROBOT).name == "ping"
