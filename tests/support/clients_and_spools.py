# SPDX-License-Identifier: MIT
"""Clients of a scripted server or of none, and keyframes for them."""

import time
from collections.abc import Iterable

import numpy as np
from keyframes_and_servers import CAMERA, DEADLINE, NUMBERED_NS, pose, wall
from scripted_server import ScriptedServer

from tsfusion import Client, Keyframe
from tsfusion.core.config import ClientConfig

NOBODY = "tcp://127.0.0.1:1"
QUICK = ClientConfig(stall_timeout=0.5)


def joined(server: ScriptedServer, **settings: object) -> Client:
    return Client(server.address, control=server.control, **{"config": QUICK, **settings})  # type: ignore[arg-type]


def noise(i: int) -> Keyframe:
    """Some 40 kB, whatever the codec does."""
    depth = np.random.default_rng(i).integers(0, 65536, (120, 160)).astype(np.uint16)
    return Keyframe(depth=depth, intrinsics=CAMERA, T_world_camera=pose(), timestamp_ns=NUMBERED_NS + i)


def send_all(client: Client, numbers: range) -> list[int]:
    """Send these walls; the numbers of those that the client took."""
    return [i for i in numbers if client.send(wall(i, captured_ns=time.monotonic_ns())) is not None]


def deliver(client: Client, keyframes: Iterable[Keyframe]) -> None:
    """Send these, and wait until the map has them."""
    for keyframe in keyframes:
        client.send(keyframe)
    client.flush(DEADLINE)
    client.wait_fused(DEADLINE)
