# SPDX-License-Identifier: MIT
"""Control messages keep their bytes, and wrong ones raise one error."""

import errno
import math
from contextlib import closing
from typing import Any

import msgspec
import pytest
import zmq
from failures import raising

from tsfusion.core.errors import DecodeError, InvalidConfig, ServerUnreachable, TransportError
from tsfusion.wire.asking import queries
from tsfusion.wire.asking.map_watcher import MapWatcher
from tsfusion.wire.messages import messages
from tsfusion.wire.messages.forget_messages import Selection
from tsfusion.wire.messages.messages import (
    Ack,
    Command,
    Denied,
    Hello,
    Hold,
    Nack,
    Ping,
    Pong,
    Stamps,
    Welcome,
)

SESSION = bytes(range(16))


def test_control_messages_keep_their_bytes() -> None:
    """As others implement them: a change here is a new wire version."""
    key = "000102030405060708090a0b0c0d0e0f"
    golden = (
        (Hello(SESSION, 1), f"83a474797065a568656c6c6fa773657373696f6ec410{key}a776657273696f6e01"),
        (
            Hello(SESSION, 1, map="yard"),
            f"84a474797065a568656c6c6fa773657373696f6ec410{key}a776657273696f6e01a36d6170a479617264",
        ),
        (
            Hello(SESSION, 1, world="w", same_frame=True),
            f"85a474797065a568656c6c6fa773657373696f6ec410{key}a776657273696f6e01a5776f726c64a177"
            "aa73616d655f6672616d65c3",
        ),
        (Ping(b"", 5), "83a474797065a470696e67a773657373696f6ec400a773656e745f6e7305"),
    )
    for message, stored in golden:
        assert messages.encode(message).hex() == stored
        assert messages.decode_to_server(bytes.fromhex(stored)) == message
    for answer in (
        Welcome("e", 1, 3, 2, 8, 1, 1),
        Ack(SESSION, 3, 2, (Stamps(3, 1, 2, 3, 4, 5),), resend=True),
        Denied(SESSION, "map", "no room"),
        Denied(SESSION, "world", "another one", "yard-2"),
        Hold(SESSION, 1.5, "disk", "full"),
        Nack(SESSION, 3, "door", "crc", "damaged"),
        Pong("e", 1, 2, 3),
    ):
        assert messages.decode_to_client(messages.encode(answer)) == answer


@pytest.mark.parametrize(
    "frame",
    [
        *(b"", b"\xc1", b"\x80", b"hello", b"\x91" * 500, b"\xa5\xff\xff\xff\xff\xff"),
        msgspec.msgpack.encode({"type": "hello", "session": b"short", "version": 1}),
        msgspec.msgpack.encode({"type": "shutdown"}),
    ],
)
def test_bad_control_messages_raise_one_error(frame: bytes) -> None:
    with pytest.raises(DecodeError):
        messages.decode_to_server(frame)
    with pytest.raises(DecodeError):
        messages.decode_to_client(frame)


@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        ({"map": "a/b"}, "regex"),
        ({"map": "m\udcff"}, "surrogates not allowed"),
        ({"selection": Selection(numbers=((0, 4),))}, r"\$\.selection\.numbers"),
        ({"selection": Selection(numbers=((1, 1 << 63),))}, r"\$\.selection\.numbers"),
        ({"selection": Selection(numbers=((1, 1 << 64),))}, r"2\*\*64"),
        ({"selection": Selection(box=(0.0, 0.0, 0.0, 1.0, 1.0, math.nan))}, r"\$\.selection\.box\[5\]"),
    ],
)
def test_a_command_that_a_server_would_drop_is_refused_at_once(wrong: dict[str, Any], why: str) -> None:
    with pytest.raises(InvalidConfig, match=f"the command forget cannot be sent: .*{why}"):
        queries.request("tcp://127.0.0.1:1", Command(name="forget", **wrong), timeout=1e6)


def test_a_question_without_a_free_descriptor_is_one_clear_error(monkeypatch: pytest.MonkeyPatch) -> None:
    with closing(queries.Exchange("tcp://127.0.0.1:1")) as exchange:
        monkeypatch.setattr(zmq.Context, "socket", raising(zmq.ZMQError(errno.EMFILE)))
        monkeypatch.setattr(queries, "_PING_TIMEOUT", 0.1)
        with pytest.raises(TransportError, match="cannot open a socket: Too many open files"):
            exchange.ask(Command(name="health"), timeout=1.0)
        monkeypatch.undo()


def test_a_server_that_is_there_and_late_is_told_as_that(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(queries, "_PING_TIMEOUT", 0.1)
    with closing(queries.Exchange("tcp://127.0.0.1:1")) as exchange:
        monkeypatch.setattr(exchange, "_step", lambda *_: setattr(exchange, "is_there", True))
        with pytest.raises(
            ServerUnreachable, match=r"is there, but has not answered the command move within"
        ):
            exchange.ask(Command(name="move"), timeout=0.2)


def test_a_watcher_without_a_free_descriptor_is_one_clear_error(monkeypatch: pytest.MonkeyPatch) -> None:
    with closing(MapWatcher("tcp://localhost:1")) as watcher:
        monkeypatch.setattr(zmq.Context, "socket", raising(zmq.ZMQError(errno.EMFILE)))
        with pytest.raises(TransportError, match="cannot open a socket: Too many open files"):
            watcher.events(60.0)
        monkeypatch.undo()
