# SPDX-License-Identifier: MIT
"""Attacks of clients that ask a map, watch it, or have keyframes forgotten: for much, too often, unheard."""

import itertools
import os
import random
import time
from collections.abc import Callable
from contextlib import ExitStack
from functools import cache
from typing import Any

import numpy as np
import odd_questions
import zmq
from hostile_messages import Frames
from keyframes_and_servers import CAMERA, pose

from lab.reliability.attack_target import Target
from lab.reliability.costly_keyframes import following, rays
from lab.reliability.odd_clients import drain, send, small_buffer
from tsfusion import Keyframe
from tsfusion.geometry import map_questions
from tsfusion.geometry.map_questions import MOST_POINTS, Field, Raycast, Sample
from tsfusion.wire.messages import messages, questions
from tsfusion.wire.messages.forget_messages import Selection
from tsfusion.wire.messages.messages import Command
from tsfusion.wire.messages.questions import Cells, Keyframes, Question, Scans
from tsfusion.wire.records import codec
from tsfusion.wire.sockets import sockets

_LINKS = 24
_FEW_RAYS = 3000
_SPREAD_M = 60.0
_PICTURE = (480, 640)
_WHOLE = tuple(np.eye(4).ravel().tolist())


def _ask(link: sockets.AnySocket, question: Question, frames: list[Any], timeout_s: float) -> int:
    command = Command(name="ask", question=question, timeout_s=timeout_s)
    return send(link, [messages.encode(command), *frames])


def _askers(target: Target, made: Callable[[int], tuple[Question, list[Any]]], timeout_s: float) -> int:
    """Questions over a few connections, whose answers are read."""
    sent = 0
    with ExitStack() as stack:
        links = [stack.enter_context(target.control_link()) for _ in range(4)]
        while not target.over:
            for link in links:
                drain(link)
                sent += _ask(link, *made(sent), timeout_s)
            time.sleep(0.004)
    return sent


def odd(target: Target) -> int:
    """Questions whose numbers are at the edge of what numbers can say."""
    rng = random.Random(1)
    return _askers(target, lambda _: odd_questions.drawn(rng), 0.2)


def scattered(target: Target) -> int:
    """Points and views all over a map that was spread out first: a piece of the surface each."""
    with target.data_link() as push:
        if push.poll(1000, zmq.POLLOUT):
            spread = codec.encode(rays(_FEW_RAYS, _SPREAD_M), session=bytes(16), seq=1, jpeg_quality=90)
            push.send_multipart(following(target, spread, 0))
            time.sleep(0.2)
    rng = np.random.default_rng(2)

    def made(sent: int) -> tuple[Question, list[Any]]:
        weight = float(rng.uniform(0, 0.01))  # nothing that was kept for the one before is of use
        if sent % 2:
            view = Raycast(
                intrinsics=(10.0, 10.0, 320.0, 240.0), pose=_WHOLE, shape=(480, 640),
                min_weight=weight, surface="field",
            )  # fmt: skip
            return view, []
        points = rng.normal(0, _SPREAD_M / 3, (MOST_POINTS, 3)).astype(np.float32)
        frames = questions.point_frames(points)
        return Sample(MOST_POINTS, map_questions.crc_of(frames), weight, "field"), frames

    return _askers(target, made, 20.0)


def pieces(target: Target) -> int:
    """Cells and keyframes of the map, from anywhere on, as a viewer asks for them that knows nothing."""
    known = Cells(since=7, epoch="old", wait_s=1.0)
    kinds = (Cells(), Cells(wait_s=1.0), known, Scans(wait_s=1.0), Keyframes())
    return _askers(target, lambda sent: (kinds[sent % len(kinds)], []), 1.0)


def unread_fields(target: Target) -> int:
    """The largest answers there are, over many connections that never read one."""
    large = Field(box=(-3.0, -3.0, -2.0, 3.0, 3.0, 2.0), max_distance=0.1)
    sent = 0
    with ExitStack() as stack:
        links = [stack.enter_context(small_buffer(target, target.control)) for _ in range(_LINKS)]
        while not target.over:
            for link in links:
                sent += _ask(link, large, [], 20.0)
            time.sleep(0.02)
    return sent


@cache
def _pictured(seed: int) -> Frames:
    rng = np.random.default_rng(seed)
    one = Keyframe(
        depth=np.full(_PICTURE, 1200, np.uint16),
        color=rng.integers(0, 256, (*_PICTURE, 3), dtype=np.uint8),
        intrinsics=CAMERA,
        T_world_camera=pose(),
    )
    return codec.encode(one, session=bytes(16), seq=1, jpeg_quality=100)


def late_viewers(target: Target) -> int:
    """Viewers that read nothing, each begun a little later, while large pictures come: none waits for what
    another has."""
    sent = 0
    with ExitStack() as stack:
        push = stack.enter_context(target.data_link())
        while not target.over:
            link = stack.enter_context(small_buffer(target, target.control))
            link.poll(200, zmq.POLLOUT)
            sent += _ask(link, Cells(wait_s=1.0), [], 20.0) + _ask(link, Scans(wait_s=1.0), [], 20.0)
            for _ in range(8):
                if push.poll(100, zmq.POLLOUT):
                    sent += send(push, following(target, _pictured(sent % 4), sent))
                time.sleep(0.01)
    return sent


def forgetting(target: Target) -> int:
    """Searches for keyframes that would be forgotten, without end."""
    far = (-1e6, -1e6, -1e6, 1e6, 1e6, 1e6)
    kinds = itertools.cycle(
        [
            Selection(box=far),
            Selection(session="00"),
            Selection(numbers=tuple((i, i + 1) for i in range(1, 40, 2))),
            Selection(since_ns=-1),
            Selection(since_ns=0, until_ns=(1 << 63) - 1),
            Selection(client=os.urandom(8).hex()),
        ]
    )
    sent = 0
    with target.control_link() as link:
        while not target.over:
            command = Command(name="forget", selection=next(kinds), dry_run=True)
            sent += send(link, [messages.encode(command)])
            drain(link)
    return sent


ATTACKS: dict[str, Callable[[Target], int]] = {
    "odd questions": odd,
    "scattered": scattered,
    "pieces": pieces,
    "unread fields": unread_fields,
    "late viewers": late_viewers,
    "forgetting": forgetting,
}
