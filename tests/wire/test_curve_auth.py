# SPDX-License-Identifier: MIT
"""Access by keys, with real sockets, and the answers to clients that are turned away."""

import os
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from typing import Any

import pytest
import zmq
from curve_peer import Peer, property_of
from hypothesis import given, settings
from hypothesis import strategies as st
from keyframes_and_servers import until
from scripted_server import allowing
from zmq.utils import z85

from tsfusion.core.errors import NotAllowed, ServerUnreachable, TransportError
from tsfusion.gateway.ports import access_control
from tsfusion.gateway.ports.access_control import ZapHandler, sender_of
from tsfusion.wire.asking.queries import request
from tsfusion.wire.messages import messages
from tsfusion.wire.messages.messages import Command
from tsfusion.wire.sockets import sockets
from tsfusion.wire.sockets.connection_monitor import ConnectionMonitor
from tsfusion.wire.sockets.curve import ClientKeys, ServerKeys

Message = tuple[list[bytes], list[str | None]]  # frames, and the sender of each


def pair() -> tuple[str, str]:
    public, secret = zmq.curve_keypair()
    return public.decode(), secret.decode()


SERVER = ServerKeys(*pair())
ROBOT = ClientKeys(*pair(), server=SERVER.public)
STRANGER = ClientKeys(*pair(), server=SERVER.public)
MISLED = ClientKeys(ROBOT.public, ROBOT.secret, server=pair()[0])  # knows another server's key


class Door:
    """The two sockets of a server with a Zap, in a thread of their own. Commands are answered."""

    def __init__(self, keys: ServerKeys | None, allowed: dict[str, str], *, guarded: bool = True) -> None:
        self.allowed = allowed
        self.keyframes: list[Message] = []
        self.control: list[Message] = []
        self.dropping = threading.Event()
        self.silent = threading.Event()
        self._keys = keys
        self._context: zmq.Context[Any] = zmq.Context()
        self.zap = ZapHandler(self._context, allowing(allowed.get, lambda _: "revoked")) if guarded else None
        self._open()
        self.addresses = sockets.bind(self._pull, self._router, "tcp://127.0.0.1:0", None)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _open(self) -> None:
        self._pull = sockets.pull(self._context, 1 << 20, self._keys)
        self._router = sockets.router(self._context, self._keys)

    def _run(self) -> None:
        while not self._stopping.is_set():
            self._step()
            if self.dropping.is_set():
                self._drop()
                self.dropping.clear()
        self._shut()
        if self.zap is not None:
            self.zap.close()
        self._context.term()

    def _step(self) -> None:
        inboxes = {self._pull: self.keyframes, self._router: self.control}
        polled = [(one, zmq.POLLIN) for one in (*inboxes, *([self.zap.socket] if self.zap else []))]
        events = dict(zmq.zmq_poll(polled, 20))
        if self.zap is not None:
            self.zap.answer_all()
        for one, inbox in inboxes.items():
            if one in events:
                frames = one.recv_multipart(copy=False)
                inbox.append(([frame.bytes for frame in frames], [sender_of(frame) for frame in frames]))
                if one is self._router and not self.silent.is_set():
                    reply = messages.encode(messages.Reply(name="ping", version=messages.PROTOCOL_VERSION))
                    one.send_multipart([frames[0].bytes, reply])

    def _drop(self) -> None:
        """Cut every connection, as after a revocation."""
        self._shut()
        self._open()
        until(self._bound)

    def _bound(self) -> bool:
        """Ports are freed by a thread of ZeroMQ's."""
        at = self.addresses
        try:
            sockets.bind(self._pull, self._router, at.data, at.control)
        except TransportError:
            return False
        return True

    def _shut(self) -> None:
        for one in (self._pull, self._router):
            one.close()

    def close(self) -> None:
        self._stopping.set()
        self._thread.join()


def door(
    keys: ServerKeys | None = SERVER, allowed: dict[str, str] | None = None, *, guarded: bool = True
) -> "closing[Door]":
    return closing(Door(keys, {ROBOT.public: "robot1"} if allowed is None else allowed, guarded=guarded))


class Caller:
    """One connecting socket and its monitor."""

    def __init__(self, kind: Callable[..., sockets.AnySocket], address: str, keys: ClientKeys | None) -> None:
        self._context: zmq.Context[Any] = zmq.Context()
        self.socket = kind(self._context, keys)
        self.monitor = ConnectionMonitor(self.socket, address, keys)
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


def ask(at: Door, keys: ClientKeys | None, timeout: float = 5.0) -> messages.Reply:
    control = at.addresses.control
    return request(control, Command(name="ping"), control=control, timeout=timeout, keys=keys)[0]


# --- in ---


def test_an_allowed_key_is_the_sender_of_every_part() -> None:
    with door() as at:
        with closing(Caller(sockets.push, at.addresses.data, ROBOT)) as robot:
            until(lambda: robot.heard() == "")
            robot.socket.send_multipart([b"head", b"depth" * 1000, b"color" * 1000])
            until(lambda: bool(at.keyframes))
        with closing(Caller(sockets.dealer, at.addresses.control, ROBOT)) as robot:
            until(lambda: robot.heard() == "")
            robot.socket.send(b"hello")
            until(lambda: bool(at.control))
        for frames, senders in (*at.keyframes, *at.control):
            assert senders == [ROBOT.public] * len(frames)
        assert at.keyframes[0][0][0] == b"head"


def test_without_keys_the_link_is_as_before() -> None:
    with door(None, guarded=False) as at:
        assert ask(at, None).name == "ping"
        assert at.control[0][1] == [None, None]


def test_two_robots_are_told_apart() -> None:
    with door(allowed={ROBOT.public: "a", STRANGER.public: "b"}) as at:
        for keys in (ROBOT, STRANGER):
            ask(at, keys)
        assert [*dict.fromkeys(senders[1] for _, senders in at.control)] == [ROBOT.public, STRANGER.public]


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
        with closing(Caller(kind, address, keys)) as stranger:
            until(lambda: words in (stranger.heard() or ""))
            with pytest.raises(zmq.Again):
                stranger.socket.send(b"hello", zmq.NOBLOCK)
            assert stranger.monitor.refused == stranger.monitor.gave_up == (keys is not MISLED)
            assert (stranger.monitor.connected, stranger.monitor.lost) == (False, 0)
        assert not at.keyframes
        assert not at.control


def test_who_is_kept_out_for_a_while_is_told_so(monkeypatch: pytest.MonkeyPatch) -> None:
    """ZeroMQ does not tell the client: it looks like a server that is stuck, or has another key."""
    with door(allowed={}) as at:
        monkeypatch.setattr(at.zap._access, "why_not", lambda _: "kept out")
        with closing(Caller(sockets.dealer, at.addresses.control, ROBOT)) as robot:
            until(lambda: bool(robot.heard()))
            assert "it keeps this client out for a minute (its log says why)" in str(robot.said)
            assert (robot.monitor.refused, robot.monitor.gave_up) == (False, False)


def test_keys_for_a_server_without_are_told_so() -> None:
    with (
        door(None, guarded=False) as at,
        closing(Caller(sockets.dealer, at.addresses.control, ROBOT)) as robot,
    ):
        until(lambda: "was started without" in (robot.heard() or ""))
        assert robot.monitor.gave_up
        assert not at.control


def test_other_ways_in_are_closed() -> None:
    with door() as at:
        context: zmq.Context[Any] = zmq.Context()
        made = sockets.dealer(context)
        made.setsockopt_string(zmq.PLAIN_USERNAME, "robot1")
        made.setsockopt_string(zmq.PLAIN_PASSWORD, ROBOT.public)
        monitor = ConnectionMonitor(made, at.addresses.control)
        made.connect(at.addresses.control)
        until(lambda: monitor.problem() is not None and monitor.gave_up)
        monitor.close()
        made.close()
        context.term()
        assert not at.control


def test_without_a_handler_nobody_gets_in() -> None:
    """libzmq alone would let in whoever has any key at all."""
    with door(guarded=False) as at, closing(Caller(sockets.dealer, at.addresses.control, ROBOT)) as robot:
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
        assert at.zap._access.refused == {"revoked": 3}
    assert len(caplog.records) == 1  # the same thing is not said three times
    assert f"is refused (revoked): key {ROBOT.public}" in caplog.text


def test_a_key_allowed_later_gets_in() -> None:
    """Not by libzmq's own reconnecting: it never tries again after a refusal."""
    with door(allowed={}) as at:
        with closing(Caller(sockets.dealer, at.addresses.control, ROBOT)) as robot:
            until(lambda: bool(robot.heard()))
            at.allowed[ROBOT.public] = "robot1"
            assert robot.monitor.gave_up
        assert ask(at, ROBOT).name == "ping"


# --- revoked in the middle ---


def test_a_revocation_cuts_who_is_connected_and_nobody_else() -> None:
    with (
        door(allowed={ROBOT.public: "a", STRANGER.public: "b"}) as at,
        closing(Caller(sockets.dealer, at.addresses.control, ROBOT)) as revoked,
        closing(Caller(sockets.dealer, at.addresses.control, STRANGER)) as other,
    ):
        until(lambda: (revoked.heard(), other.heard()) == ("", ""))
        del at.allowed[ROBOT.public]
        revoked.socket.send(b"still here")  # the connection lives on: who sent it must be looked up
        until(lambda: bool(at.control))
        assert at.allowed.get(at.control[0][1][1] or "") is None
        at.dropping.set()
        until(lambda: (revoked.heard() or "").startswith("the server at"))
        until(lambda: other.heard() == "" and other.monitor.lost == 1 and other.monitor.connected)
        assert (revoked.monitor.lost, revoked.monitor.gave_up, other.monitor.gave_up) == (1, True, False)
        other.socket.send(b"back again")
        until(lambda: len(at.control) == 2)
        assert at.control[1][0][1] == b"back again"


def test_connections_come_back_every_time() -> None:
    with door() as at, closing(Caller(sockets.dealer, at.addresses.control, ROBOT)) as robot:
        for turn in range(5):
            until(lambda: robot.heard() == "" and robot.monitor.connected)
            assert robot.monitor.lost == turn
            at.dropping.set()
            until(lambda turn=turn: robot.heard() is not None and robot.monitor.lost > turn)


def test_a_question_outlives_a_dropped_connection() -> None:
    with door() as at:
        at.silent.set()
        answers: list[messages.Reply] = []
        asking = threading.Thread(target=lambda: answers.append(ask(at, ROBOT, timeout=60.0)))
        asking.start()
        until(lambda: bool(at.control))
        at.dropping.set()
        until(lambda: not at.dropping.is_set())
        at.silent.clear()
        asking.join(60.0)
        assert [answer.name for answer in answers] == ["ping"]


# --- lies ---


def null_greeting() -> bytes:
    """ZMTP 3.0, without keys."""
    return b"\xff" + bytes(7) + b"\x01\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + bytes(32)


def test_nobody_can_speak_for_another() -> None:
    with door(allowed={ROBOT.public: "a", STRANGER.public: "b"}) as at:
        claims = {name: STRANGER.public.encode() for name in (b"User-Id", b"user-id", b"X-User-Id")}
        with closing(Peer(at.addresses.data, ROBOT, claims=claims)) as liar:
            assert liar.taken
            liar.send(b"hello")
            until(lambda: bool(at.keyframes))
        assert at.keyframes == [([b"hello"], [ROBOT.public])]
        with closing(Peer(at.addresses.data, STRANGER, claims={}, poses_as=ROBOT.public)) as liar:
            assert not liar.taken
        assert len(at.keyframes) == 1


def test_without_keys_a_sender_can_claim_to_be_anybody() -> None:
    """Why `sender_of` counts on sockets with keys only."""
    context: zmq.Context[Any] = zmq.Context()
    made = sockets.pull(context, 1024)
    port = made.bind_to_random_port("tcp://127.0.0.1")
    with socket.create_connection(("127.0.0.1", port), 10.0) as liar:
        ready = b"\x05READY" + property_of(b"Socket-Type", b"PUSH") + property_of(b"User-Id", b"king")
        liar.sendall(null_greeting() + b"\x04" + bytes([len(ready)]) + ready)
        theirs = b""
        while b"READY" not in theirs:
            theirs += liar.recv(1024)
        liar.sendall(b"\x00\x02hi")
        assert made.poll(10_000)
        assert sender_of(made.recv(copy=False)) == "king"
    made.close()
    context.term()


# --- the handler alone ---


@contextmanager
def handler(allow: Callable[[str], str | None]) -> Iterator[tuple[ZapHandler, sockets.AnySocket]]:
    """A ZapHandler, and a socket that asks it as libzmq does."""
    context: zmq.Context[Any] = zmq.Context()
    made = ZapHandler(context, allowing(allow))
    asker: sockets.AnySocket = context.socket(zmq.DEALER)
    asker.setsockopt(zmq.LINGER, 0)
    asker.connect("inproc://zeromq.zap.01")
    try:
        yield made, asker
    finally:
        asker.close()
        made.close()
        context.term()


def question(**changed: bytes) -> list[bytes]:
    parts = {
        "delimiter": b"", "version": b"1.0", "request": b"1", "domain": b"tsfusion", "address": b"127.0.0.1",
        "identity": b"", "mechanism": b"CURVE", "key": z85.decode(ROBOT.public),
    }  # fmt: skip
    return list({**parts, **changed}.values())


ASKED = question()


@pytest.mark.parametrize(
    ("frames", "verdict", "reason"),
    [
        (ASKED, b"200", None),
        (question(key=z85.decode(STRANGER.public)), b"400", "unknown"),
        (question(domain=b""), b"400", "domain"),
        (question(domain=b"*"), b"400", "domain"),
        (question(domain=b"tsfusion2"), b"400", "domain"),
        (question(mechanism=b"NULL"), b"400", "mechanism"),
        (question(mechanism=b"PLAIN"), b"400", "mechanism"),
        (question(key=b"short"), b"400", "malformed"),
        (question(key=ROBOT.public.encode()), b"400", "malformed"),
        (question(version=b"2.0"), b"400", "malformed"),
        (question(delimiter=b"x"), b"400", "malformed"),
        ([*ASKED, b"more"], b"400", "malformed"),
        *((ASKED[:count], b"400", "malformed") for count in range(3, 8)),
        *((ASKED[:count], None, "malformed") for count in (1, 2)),
        (question(address=b"\xff" * 5000), b"200", None),
    ],
)
def test_a_question_is_answered_or_dropped(
    frames: list[bytes], verdict: bytes | None, reason: str | None
) -> None:
    with handler({ROBOT.public: "robot1"}.get) as (made, asker):
        asker.send_multipart(frames)
        assert made.socket.poll(10_000)
        made.answer_all()
        assert made._access.refused == ({reason: 1} if reason else {})
        if verdict is None:
            assert not asker.poll(0)
            return
        assert asker.poll(10_000)
        delimiter, version, number, code, text, user, metadata = asker.recv_multipart()
        assert (delimiter, version, number, code, metadata) == (b"", b"1.0", frames[2], verdict, b"")
        assert (text, user) == ((reason or "").encode() or b"OK", b"" if reason else ROBOT.public.encode())


@given(st.lists(st.binary(max_size=64) | st.sampled_from(ASKED), min_size=1, max_size=12))
@settings(deadline=None, max_examples=200)
def test_no_question_raises(frames: list[bytes]) -> None:
    made, asker = FUZZED
    asker.send_multipart(frames)
    made.answer_all()
    while asker.poll(0):
        _, _, _, code, *_ = asker.recv_multipart()
        assert code == (b"200" if frames == ASKED else b"400")


@pytest.fixture(autouse=True, scope="module")
def fuzzed() -> Iterator[None]:
    """One handler for all of the above."""
    with handler({ROBOT.public: "robot1"}.get) as made:
        FUZZED[:] = made
        yield


FUZZED: list[Any] = []


def test_an_asker_that_is_gone_disturbs_nobody() -> None:
    with handler(lambda _: "anybody") as (made, asker):
        context = asker.context
        for _ in range(300):
            other = context.socket(zmq.DEALER)
            other.setsockopt(zmq.LINGER, 0)
            other.connect("inproc://zeromq.zap.01")
            other.send_multipart(ASKED)
            other.close()
        asker.send_multipart(ASKED)
        answered = threading.Event()

        def answer() -> bool:
            made.answer_all()
            return bool(asker.poll(0)) or answered.is_set()

        until(answer)
        assert asker.recv_multipart()[3] == b"200"


def test_no_flood_of_connections_takes_a_whole_step(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(access_control, "_REQUESTS_A_STEP", 3)
    with handler(lambda _: None) as (made, asker):
        for _ in range(8):
            asker.send_multipart(ASKED)
        for answered in (3, 6, 8):
            made.answer_all()
            assert made._access.refused == {"unknown": answered}


def test_few_of_many_refused_keys_are_logged(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Keys cost nothing to make."""
    monkeypatch.setattr(access_control, "_LOGGED_AT_MOST", 2)
    with handler(lambda _: None) as (made, asker):
        for number in range(5):
            asker.send_multipart(question(key=bytes([number]) * 32))
        made.answer_all()
        assert made._access.refused == {"unknown": 5}
    assert len(caplog.records) == 2


# --- one-shot commands ---


def open_files() -> int:
    return len(os.listdir("/proc/self/fd"))


def test_requests_leave_no_file_open() -> None:
    """Monitors are sockets, too: each has its own pair of descriptors."""
    with door() as at:
        ask(at, ROBOT)
        before, threads = open_files(), threading.active_count()
        for index in range(15):
            keys = (ROBOT, STRANGER, None)[index % 3]
            if keys is ROBOT:
                ask(at, keys)
            else:
                with pytest.raises(NotAllowed):
                    ask(at, keys, timeout=60.0)
        with pytest.raises(ServerUnreachable, match="the server's key is not the one given"):
            ask(at, MISLED, timeout=0.5)
        until(lambda: open_files() <= before)
        assert threading.active_count() == threads


def test_monitors_leave_no_file_open() -> None:
    with door() as at:
        context: zmq.Context[Any] = zmq.Context()
        counts = []
        for _ in range(20):
            made = sockets.push(context, ROBOT)
            watched = ConnectionMonitor(made, at.addresses.data, ROBOT)
            made.connect(at.addresses.data)
            until(lambda watched=watched: watched.problem() == "")
            watched.close()
            made.close()
            counts.append(open_files())
        before = counts[2]
        until(lambda: open_files() <= before)
        context.term()


@contextmanager
def answering(words: bytes, *, to: bytes = b"", then: bytes = b"") -> Iterator[str]:
    """The address of a server that says this to whoever connects, hears `to`, says that, and hangs up."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        listening.settimeout(0.05)
        stopping = threading.Event()

        def serve() -> None:
            while not stopping.is_set():
                with suppress(OSError):
                    connection, _ = listening.accept()
                    with connection:
                        connection.sendall(words)
                        heard = b""
                        while to not in heard and (more := connection.recv(1024)):
                            heard += more
                        connection.sendall(then)
                        while then and connection.recv(1024):  # until they have read it
                            pass

        thread = threading.Thread(target=serve)
        thread.start()
        yield f"tcp://127.0.0.1:{listening.getsockname()[1]}"
        stopping.set()
        thread.join()


@pytest.mark.parametrize("keys", [ROBOT, None], ids=["keys", "no keys"])
@pytest.mark.parametrize("words", [b"HTTP/1.1 400 Bad Request\r\n\r\n", b"SSH-2.0-OpenSSH_9.2p1\r\n", b""])
def test_what_is_no_server_is_told(words: bytes, keys: ClientKeys | None) -> None:
    with answering(words) as address:
        with pytest.raises(TransportError, match=r"is no tsfusion server|ends the connection") as told:
            request(address, Command(name="ping"), control=address, timeout=0.6, keys=keys)
        assert not isinstance(told.value, NotAllowed)


def test_garbled_words_end_the_connection_for_good() -> None:
    """libzmq does not try again; the monitor notices."""
    ready = b"\x05READY" + property_of(b"Socket-Type", b"ROUTER")
    nonsense = b"\x02" + b"\xff" * 8  # a frame of 2⁶⁴ − 1 bytes
    words = null_greeting() + b"\x04" + bytes([len(ready)]) + ready
    with (
        answering(words, to=b"READY", then=nonsense) as address,
        closing(Caller(sockets.dealer, address, None)) as caller,
    ):
        until(lambda: caller.heard() is not None and caller.monitor.gave_up)
        assert caller.monitor.lost == 1
        assert "garbled on the way" in (caller.said or "")
