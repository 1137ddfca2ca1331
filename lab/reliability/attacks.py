# SPDX-License-Identifier: MIT
"""Attacks of strangers on a server, each some seconds long, in one process; bounded, loopback only.

python lab/reliability/attacks.py TARGET

It reads lines of seconds and the name of an attack, and answers each with `begun`, and in the end how many
messages, connections or bytes it came to.
"""

import contextlib
import itertools
import os
import resource
import socket
import struct
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import zmq

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "support"))
sys.path.append(str(Path(__file__).parents[2]))  # lab is not installed
from hostile_messages import Frames, bad_values, bombs, hostile_corrections, lies
from keyframes_and_servers import wall

from lab.reliability import costly_keyframes, odd_askers, odd_clients
from lab.reliability.attack_target import Access, Target
from tsfusion.wire.messages import messages
from tsfusion.wire.messages.messages import PROTOCOL_VERSION, Command
from tsfusion.wire.records import codec, corrections
from tsfusion.wire.sockets import sockets
from tsfusion.wire.sockets.curve import ClientKeys
from tsfusion.wire.sockets.sockets import parse_address

_HALF_OPEN = 36_000
_UNFINISHED = 400  # parts
_PART_BYTES = 900_000
_LORISES = 50
_READERS, _DEAF = 16, 16
_PAUSE = 0.002  # between hostile messages: they shall be checked, not only queued


def _push(target: Target, made: Callable[[], Iterator[Frames]]) -> int:
    sent = 0
    with target.data_link() as push:
        while not target.over:
            for frames in made():
                if target.over or not push.poll(1000, zmq.POLLOUT):
                    break
                push.send_multipart(frames)
                sent += 1
                time.sleep(_PAUSE)
    return sent


def oversized(target: Target) -> int:
    """Frames larger than a server takes, each on a new connection: the last one was closed for it."""
    sent, huge = 0, bytes(33 << 20)
    while not target.over:
        with target.data_link() as push:
            if push.poll(1000, zmq.POLLOUT):
                push.send_multipart([b"TSF\x01", huge], copy=False)
                sent += 1
                time.sleep(0.05)
    return sent


def _push_costly(target: Target, made: Callable[[int], Frames], interval: float) -> int:
    """Keyframes at intervals."""
    sent = 0
    with target.data_link() as push:
        while push.poll(1000, zmq.POLLOUT):
            push.send_multipart(costly_keyframes.following(target, made(sent), sent))
            sent += 1
            time.sleep(interval)
            if target.over:
                break
    return sent


# --- control ---


def rubbish(target: Target) -> int:
    """Deep, wrong and lying msgpack, and greetings of nobody."""
    hello = messages.encode(messages.Hello(bytes(16), PROTOCOL_VERSION))
    wrong = [
        b"", b"\xc1" * 1000, b"\x91" * 60_000, b"\x81" * 60_000, b"\xdf\xff\xff\xff\xff",
        b"\xdd\xff\xff\xff\xff",
        b"\xdb\xff\xff\xff\xffx", b"\xc6\xff\xff\xff\xff", hello[:-3], hello + b"\0", os.urandom(60_000),
        messages.encode(Command(name="ping"))[:-1], msgspec.msgpack.encode({"type": "ping", "session": 7}),
        msgspec.msgpack.encode({"type": "command", "name": "mesh", "map": "../x"}),
        msgspec.msgpack.encode({"type": "hello", "session": bytes(16), "version": 1, "map": "a" * 60_000}),
        msgspec.msgpack.encode({"type": "ping", "session": b"", "sent_ns": 1 << 63, "skipped": {"a": -1}}),
        messages.encode(messages.Ping(bytes(16), 1, skipped={f"r{i}": 1 << 62 for i in range(16)})),
    ]  # fmt: skip
    sent = 0
    with target.control_link() as link:
        for message in itertools.cycle(wrong):
            if target.over or not link.poll(1000, zmq.POLLOUT):
                break
            link.send_multipart([message, b"x"] if sent % 7 == 0 else [message])
            sent += 1
            time.sleep(_PAUSE / 2)
    return sent


def wrong_corrections(target: Target) -> int:
    """Corrections that are none; and good ones as fast as they go, now and then huge."""
    session, sent = os.urandom(16), 0
    many = corrections.checked({1 + i: np.eye(4) for i in range(corrections.MAX_KEYFRAMES)})
    few = corrections.checked({1 + i: np.eye(4) for i in range(20)})
    seq = corrections.MAX_KEYFRAMES
    keyframe = codec.encode(wall(), session=session, seq=seq, previous=0, jpeg_quality=90)
    with target.data_link() as push:
        if push.poll(1000, zmq.POLLOUT):
            push.send_multipart(keyframe)
        while True:
            seq += 1
            content = many if seq % 10 == 0 else few
            good = corrections.encode(content, session=session, seq=seq, previous=0)
            for frames in [*(frames for _, _, frames in hostile_corrections(session, seq, 0)), good]:
                if target.over or not push.poll(1000, zmq.POLLOUT):
                    return sent
                push.send_multipart(frames)
                sent += 1
                time.sleep(_PAUSE)


def greetings(target: Target) -> int:
    """Sessions without end, for maps without end."""
    sent = 0
    with target.control_link() as link:
        while not target.over and link.poll(1000, zmq.POLLOUT):
            link.send(messages.encode(messages.Hello(os.urandom(16), PROTOCOL_VERSION, f"map{sent % 1000}")))
            sent += 1
            time.sleep(_PAUSE / 4)
    return sent


def sessions(target: Target) -> int:
    """Sessions without end for the map that is open: each would be told how it is doing."""
    sent = 0
    with target.control_link() as link:
        while not target.over and link.poll(1000, zmq.POLLOUT):
            link.send(messages.encode(messages.Hello(os.urandom(16), PROTOCOL_VERSION)))
            while link.poll(0):
                link.recv()
            sent += 1
    return sent


def mesh_flood(target: Target) -> int:
    """Meshes asked for over many connections: some read theirs and ask again, some never read."""
    question = messages.encode(Command(name="mesh", min_weight=0.0))
    asked = 0
    with ExitStack() as stack:
        readers = [stack.enter_context(target.control_link()) for _ in range(_READERS)]
        deaf = [stack.enter_context(contextlib.closing(raw(target.control, b"DEALER"))) for _ in range(_DEAF)]
        while not target.over:
            for one in deaf:
                with contextlib.suppress(OSError):
                    one.setblocking(False)
                    one.send(b"\x00" + bytes([len(question)]) + question)
                    asked += 1
            for link in readers:
                while link.poll(0):
                    link.recv_multipart()
                with contextlib.suppress(zmq.Again):
                    link.send(question, zmq.NOBLOCK)
                    asked += 1
            time.sleep(0.02)
    return asked


def tiny(target: Target) -> int:
    """Small messages on both ports, as many as go through."""
    sent = 0
    with (
        target.data_link() as push,
        target.control_link() as link,
    ):
        while not target.over and sent < 2_000_000:
            for one in (push, link):
                with contextlib.suppress(zmq.Again):
                    for _ in range(100):
                        one.send(b"x", zmq.NOBLOCK)
                        sent += 1
    return sent


def knocking(target: Target) -> int:
    """Connections made and left at once, with keys that nobody knows where keys are asked for."""
    knocks = 0
    context: zmq.Context[Any] = zmq.Context()
    while not target.over:
        links = []
        for address, kind in ((target.data, sockets.push), (target.control, sockets.dealer)):
            keys = None
            if target.server_key:
                public, secret = (half.decode() for half in zmq.curve_keypair())
                keys = ClientKeys(public, secret, target.server_key)
            link = kind(context, keys)
            link.connect(address)
            links.append(link)
        time.sleep(10 * _PAUSE)  # long enough to be turned away
        for link in links:
            link.close()
            knocks += 1
    context.term()
    return knocks


# --- below the messages: ZMTP 3.1 by hand, where there are no keys ---

_GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x01" + b"NULL".ljust(20, b"\0") + bytes(32)


def _command(name: bytes, body: bytes) -> bytes:
    content = bytes([len(name)]) + name + body
    return b"\x04" + bytes([len(content)]) + content


def _property(name: bytes, value: bytes) -> bytes:
    return bytes([len(name)]) + name + struct.pack(">I", len(value)) + value


def raw(address: str, kind: bytes) -> socket.socket:
    """A connection over which a handshake as a socket of this kind was made."""
    host, _, port = address.removeprefix("tcp://").rpartition(":")
    made = socket.create_connection((host, int(port)), timeout=5.0)
    answer = b""
    ready = _property(b"Socket-Type", kind) + _property(b"Identity", b"")
    with contextlib.suppress(ConnectionError):  # it is cut off where the server wants keys
        made.sendall(_GREETING + _command(b"READY", ready))
        while b"READY" not in answer and (got := made.recv(4096)):  # what comes earlier may be cut off
            answer += got
    return made


def part(content: bytes) -> bytes:
    """A frame after which more are to come."""
    return b"\x03" + struct.pack(">Q", len(content)) + content


def _parts(target: Target, address: str, kind: bytes, *, most: int, size: int, links: int) -> int:
    """So many parts of that many messages that never end; who is cut off begins anew."""
    sent, content, open_links = 0, part(bytes(size)), list[socket.socket]()
    while not target.over and sent < most:
        try:
            if len(open_links) < links:
                open_links.append(raw(address, kind))
            open_links[sent % len(open_links)].sendall(content)
            sent += 1
        except OSError:
            while open_links:
                open_links.pop().close()
        time.sleep(_PAUSE / 4)
    while not target.over:
        time.sleep(0.05)
    for link in open_links:
        link.close()
    return sent


def unfinished(target: Target) -> int:
    """Messages that go on and on: ZeroMQ keeps their parts until the last one comes."""
    return _parts(target, target.data, b"PUSH", most=_UNFINISHED, size=_PART_BYTES, links=4)


def unfinished_control(target: Target) -> int:
    """The same on the control port, whose frames are small."""
    return _parts(target, target.control, b"DEALER", most=10 * _UNFINISHED, size=60_000, links=1)


_EMPTY_FRAMES = 2_000_000


def empty_frames(target: Target) -> int:
    """Messages of millions of empty frames, on each port in turn; who is cut off begins anew."""
    if target.server_key:
        return _empty_frames_by_zmq(target)
    sent, message = 0, b"\x01\x00" * (_EMPTY_FRAMES - 1) + b"\x00\x00"
    ports = ((target.data, b"PUSH"), (target.control, b"DEALER"))
    for address, kind in itertools.cycle(ports):
        if target.over:
            break
        with contextlib.suppress(OSError), contextlib.closing(raw(address, kind)) as link:
            link.sendall(message)
            sent += 1
            until_cut_off(link)
    return sent


def _empty_frames_by_zmq(target: Target) -> int:
    """The same by a client of the library, which makes a tenth of them in the same time."""
    sent, content = 0, [b""] * (_EMPTY_FRAMES // 10)
    with target.data_link() as push, target.control_link() as dealer:
        while not target.over:
            for link in (push, dealer):
                if link.poll(1000, zmq.POLLOUT):
                    link.send_multipart(content)
                    sent += 1
                time.sleep(0.1)
    return sent


def until_cut_off(link: socket.socket) -> None:
    """Wait until the server has closed a connection; at most as long as the socket's timeout."""
    with contextlib.suppress(OSError):
        while link.recv(4096):
            pass


def half_open(target: Target) -> int:
    """Connections that say nothing, or the beginning of a greeting: as many as this user may have."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    most = min(_HALF_OPEN, hard - 100)
    ports = itertools.cycle(map(parse_address, (target.data, target.control)))
    links: list[socket.socket] = []
    while not target.over:
        for _ in range(min(100, most - len(links))):
            links.append(socket.socket())
            links[-1].setblocking(False)
            links[-1].connect_ex(next(ports))
        time.sleep(0.01)
        for number, link in enumerate(links[-100:]):
            with contextlib.suppress(OSError):  # it is not made yet, or it was cut off
                link.send(_GREETING[: number % 12])
    for link in links:
        link.close()
    return len(links)


def slow_loris(target: Target) -> int:
    """A byte now and then, for ever."""
    sent = 0
    with ExitStack() as stack:
        links = []
        for address in (target.data, target.control):
            host, _, port = address.removeprefix("tcp://").rpartition(":")
            for _ in range(_LORISES):
                links.append(stack.enter_context(socket.create_connection((host, int(port)), timeout=5.0)))
        for byte in _GREETING:
            if target.over:
                break
            for link in links:
                with contextlib.suppress(OSError):
                    link.send(bytes([byte]))
                    sent += 1
            time.sleep(min(1.0, max(target.end - time.monotonic(), 0)))
    return sent


ATTACKS: dict[str, Callable[[Target], int]] = {
    "bombs": lambda target: _push(target, bombs),
    "bad values": lambda target: _push(target, bad_values),
    "lies": lambda target: _push(target, lies),
    "oversized": oversized,
    "rubbish": rubbish,
    "corrections": wrong_corrections,
    "greetings": greetings,
    "sessions": sessions,
    "mesh flood": mesh_flood,
    "tiny": tiny,
    "unfinished": unfinished,
    "unfinished control": unfinished_control,
    "empty frames": empty_frames,
    "knocking": knocking,
    "half open": half_open,
    "slow loris": slow_loris,
    **odd_clients.ATTACKS,
    **odd_askers.ATTACKS,
    "crossings": lambda target: _push_costly(target, lambda _: costly_keyframes.crossings(), 2.0),
    "surplus idat": lambda target: _push_costly(target, lambda _: costly_keyframes.surplus_idat(), 0.5),
    "fill": lambda target: _push_costly(target, costly_keyframes.filling, 0.05),
}

# What gets as far as a server's keys; and what does so without any, so that no key helps with it.
AS_STRANGERS = ("lies", "tiny", "unfinished", "knocking", "half open", "slow loris")
_WITHOUT_KEYS = ("unfinished", "unfinished control", "half open", "slow loris")
ATTACKS_OF: dict[Access, tuple[str, ...]] = {
    "open": tuple(ATTACKS),
    "stranger": AS_STRANGERS,
    "allowed": tuple(name for name in ATTACKS if name not in _WITHOUT_KEYS),
}


def main() -> None:
    target = msgspec.json.decode(sys.argv[1], type=Target)
    for line in sys.stdin:
        seconds, name = line.strip().split(" ", 1)
        print("begun", flush=True)
        attacked = msgspec.structs.replace(target, end=time.monotonic() + float(seconds))
        print(ATTACKS[name](attacked), flush=True)


if __name__ == "__main__":
    main()
