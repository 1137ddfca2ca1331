# SPDX-License-Identifier: MIT
"""Attacks of clients that speak the protocol well: too often, to no end, or without listening."""

import contextlib
import itertools
import math
import os
import time
import zlib
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import cache
from typing import Any

import msgspec
import numpy as np
import zmq
from hostile_messages import Frames, good, with_depth, with_header
from keyframes_and_servers import CAMERA, connected, pose, wall

from lab.reliability.attack_target import Target
from lab.reliability.costly_keyframes import following, fresh
from tsfusion import Intrinsics, Keyframe
from tsfusion.wire.messages import messages
from tsfusion.wire.messages.messages import PROTOCOL_VERSION, Command, Hello, Ping
from tsfusion.wire.messages.questions import Cells
from tsfusion.wire.records import codec
from tsfusion.wire.records.record_header import unpack_keyframe
from tsfusion.wire.sockets import sockets
from tsfusion.wire.sockets.curve import ClientKeys

_PAUSE = 0.001
_DEAF = 40
_FLOOD_POINTS = 2_000_000


def send(link: sockets.AnySocket, frames: Frames) -> int:
    with contextlib.suppress(zmq.Again):
        link.send_multipart(frames, zmq.NOBLOCK)
        return 1
    time.sleep(_PAUSE)
    return 0


def drain(link: sockets.AnySocket) -> None:
    while link.poll(0):
        link.recv_multipart()


def _control_flood(target: Target, made: Callable[[int], Any]) -> int:
    """Good messages as fast as they go, whose answers are read."""
    sent = 0
    with target.control_link() as link:
        while not target.over:
            sent += send(link, [messages.encode(made(sent))])
            drain(link)
    return sent


def _data_flood(target: Target, made: Callable[[int], Frames], pause: float = 0.0) -> int:
    """Keyframes as fast as they go."""
    sent = 0
    with target.data_link() as link:
        while not target.over or not sent:
            if link.poll(200, zmq.POLLOUT):
                sent += send(link, made(sent))
            elif target.over:
                break
            time.sleep(pause)
    return sent


def pings(target: Target) -> int:
    """Signs of life."""
    return _control_flood(target, lambda sent: Ping(os.urandom(16), sent, skipped={"thinned": sent}))


def status_flood(target: Target) -> int:
    """Questions for the status: each hashes the whole map."""
    return _control_flood(target, lambda _: Command(name="status"))


def health_flood(target: Target) -> int:
    """Questions for the health."""
    return _control_flood(target, lambda _: Command(name="health"))


def new_maps(target: Target) -> int:
    """Questions for names of maps."""
    return _control_flood(target, lambda sent: Command(name="new_map", map=f"m{sent % 100}"))


def other_worlds(target: Target) -> int:
    """Greetings and keyframes of frames that the map has not."""
    frames, sent = good(), 0
    with target.control_link() as link, target.data_link() as push:
        while not target.over:
            hello = Hello(os.urandom(16), PROTOCOL_VERSION, world=f"w{sent}")
            sent += send(link, [messages.encode(hello)])
            sent += send(push, with_header(frames, session=hello.session, world=f"w{sent}"))
            drain(link)
    return sent


def deaf_askers(target: Target) -> int:
    """Questions for the health by connections that never read."""
    question = messages.encode(Command(name="health"))
    sent = 0
    with ExitStack() as stack:
        links = [stack.enter_context(small_buffer(target, target.control)) for _ in range(_DEAF)]
        while not target.over:
            for link in links:
                for _ in range(10):
                    sent += send(link, [question])
            time.sleep(0.01)
    return sent


@contextlib.contextmanager
def small_buffer(target: Target, address: str, kind: int = zmq.DEALER) -> Iterator[sockets.AnySocket]:
    """A connection that takes next to nothing before its other end has to keep it."""

    def make(context: "zmq.Context[Any]", keys: ClientKeys | None = None) -> sockets.AnySocket:
        made: sockets.AnySocket = context.socket(kind)
        for option, value in ((zmq.LINGER, 0), (zmq.RCVHWM, 1), (zmq.RCVBUF, 4096)):
            made.setsockopt(option, value)
        if keys:
            keys.secure(made)
        return made

    with connected(make, address, target.keys) as link:
        yield link


def deaf_viewers(target: Target) -> int:
    """Viewers of the mesh that read nothing, more and more of them; and some that come and go."""
    count = 0
    command = Command(name="ask", question=Cells(wait_s=1.0), timeout_s=20.0)
    with ExitStack() as stack:
        while not target.over:
            link = stack.enter_context(small_buffer(target, target.control))
            with small_buffer(target, target.control) as other:
                for one in (link, other):
                    one.poll(500, zmq.POLLOUT)
                    count += send(one, [messages.encode_sealed(command)])
            time.sleep(0.02)
    return count


def replays(target: Target) -> int:
    """One keyframe of one's own, again and again."""
    frames = fresh(good())
    return _data_flood(target, lambda _: frames)


def jumps(target: Target) -> int:
    """Sessions whose numbers jump to the last one there is, and go on from there."""
    last = (1 << 63) - 1
    frames = good()

    def made(sent: int) -> Frames:
        session = (sent // 4).to_bytes(16, "big")
        seq, previous = ((last - 1, 0), (last, last - 1), (last, 0), (1, 0))[sent % 4]
        return with_header(frames, session=session, seq=seq, previous=previous)

    return _data_flood(target, made, 0.02)


def flood(target: Target) -> int:
    """Good keyframes as fast as they go."""
    session = os.urandom(16)
    frames = [good()[:] for _ in range(8)]
    return _data_flood(
        target, lambda sent: with_header(frames[sent % 8], session=session, seq=sent + 1, previous=sent)
    )


def noise(target: Target) -> int:
    """Arrays of random bytes, with true checksums."""

    def made(sent: int) -> Frames:
        content = os.urandom(4000)
        kind = "png" if sent % 3 == 0 else "dzp+zstd"
        begin = (b"\x28\xb5\x2f\xfd", b"\x89PNG\r\n\x1a\n", b"")[sent % 3]
        return with_depth(begin + content, (48, 64), kind)

    return _data_flood(target, made, 0.005)


@cache
def _random_depth(seed: int) -> Frames:
    depth = np.random.default_rng(seed).integers(0, 65536, (480, 640), dtype=np.uint16)
    one = Keyframe(depth=depth, T_world_camera=pose(), intrinsics=Intrinsics(500.0, 500.0, 320.0, 240.0))
    return codec.encode(one, session=bytes(16), seq=1, jpeg_quality=90)


def random_depths(target: Target) -> int:
    """Depth images of random numbers."""
    return _data_flood(target, lambda sent: following(target, _random_depth(sent % 4), sent), 0.1)


@cache
def _one_point() -> Frames:
    points = np.tile(np.array([[0.0, 0.0, 1.2]], np.float32), (_FLOOD_POINTS, 1))
    one = Keyframe(points=points, T_world_camera=pose(), sensor="scanner")
    return codec.encode(one, session=bytes(16), seq=1, jpeg_quality=90)


def one_point(target: Target) -> int:
    """Two million equal points a keyframe, on the wall that the other scanner sees."""
    return _data_flood(target, lambda sent: following(target, _one_point(), sent), 0.3)


def cameras(target: Target) -> int:
    """Cameras and places at the edge of what numbers can say."""
    values = (1e-300, 1e-9, 1e-3, 1e3, 1e12, 1e300)
    changes: list[dict[str, Any]] = [{"intrinsics": Intrinsics(v, v, 31.5, 23.5)} for v in values]
    changes += [{"intrinsics": Intrinsics(40.0, -v, 31.5, 23.5)} for v in values]
    changes += [{"intrinsics": Intrinsics(40.0, 40.0, sign * v, 0.0)} for v in values for sign in (1, -1)]
    changes += [{"scale": v} for v in (1e-300, 1e-30, 1e30, 1e300)]
    for away in (99_999.0, 1e5, 1e6, 1e9):
        changes.append({"pose": tuple(pose(away, -away, 0.0)[:3].ravel().tolist())})
    changes += [{"sensor": name} for name in ("", "none", "lidar", "scanner", "x" * 32, "../..", "\0", "é")]
    changes += [{"timestamp_ns": (1 << 63) - 1}, {"captured_ns": (1 << 63) - 1}, {"sent_ns": (1 << 63) - 1}]
    assert math.isfinite(CAMERA.fx)
    frames = good()
    return _data_flood(
        target,
        lambda sent: following(target, with_header(frames, **changes[sent % len(changes)]), sent),
        0.02,
    )


def sizes(target: Target) -> int:
    """Images of one pixel, one row, and the largest ones; points of none."""
    shapes = ((1, 1), (1, 8192), (8192, 1), (2, 2), (3, 8192), (4096, 4096))
    made = []
    for shape in shapes:
        depth = np.full(shape, 1500, np.uint16)
        one = Keyframe(depth=depth, T_world_camera=pose(), intrinsics=CAMERA)
        made.append(codec.encode(one, session=bytes(16), seq=1, jpeg_quality=90))
    frames = good()
    header = unpack_keyframe(frames[0])
    first = msgspec.structs.replace(header.buffers[0], shape=(0, 0), bytes=0, crc32=zlib.crc32(b""))
    made.append(with_header([frames[0], b""], buffers=(first,)))
    made.append(codec.encode(wall(), session=bytes(16), seq=1, jpeg_quality=1))
    return _data_flood(target, lambda sent: following(target, made[sent % len(made)], sent), 0.1)


def refusals(target: Target) -> int:
    """Messages that are refused with a line in the log, as fast as they go."""
    frames = good()
    bad = [frames[0], b"\xff" + frames[1][1:], *frames[2:]]
    return _data_flood(target, lambda _: fresh(bad))


def hangers(target: Target) -> int:
    """Greetings of clients that connect anew each time, and are gone before the answer."""
    sent = 0
    for number in itertools.count():
        if target.over:
            return sent
        with target.control_link() as link:
            link.poll(200, zmq.POLLOUT)
            sent += send(link, [messages.encode(Hello(number.to_bytes(16, "big"), PROTOCOL_VERSION))])
    raise AssertionError("unreachable")


ATTACKS: dict[str, Callable[[Target], int]] = {
    "pings": pings,
    "status flood": status_flood,
    "health flood": health_flood,
    "new maps": new_maps,
    "other worlds": other_worlds,
    "deaf askers": deaf_askers,
    "deaf viewers": deaf_viewers,
    "hangers": hangers,
    "replays": replays,
    "refusals": refusals,
    "jumps": jumps,
    "noise": noise,
    "random depths": random_depths,
    "cameras": cameras,
    "sizes": sizes,
    "one point": one_point,
    "flood": flood,
}
