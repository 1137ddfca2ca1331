# SPDX-License-Identifier: MIT
"""A scanner that sends some walls, each until `send` returns a number.

It tells in the end which files it has open, and what the server calls a problem."""

import os
import sys
import time
from collections import Counter
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from keyframes_and_servers import SHAPE, pose, wall
from msgspec import Struct
from sum_map import TOO_MUCH

from tsfusion import Client, Keyframe
from tsfusion.core.config import ClientConfig
from tsfusion.core.errors import TsfusionError
from tsfusion.wire.asking.queries import fetch_health

CONFIG = ClientConfig(policy="spool_all", stall_timeout=0.5, segment_bytes=1 << 16)
REFUSED, REJECTED = 6, 8  # walls too far away for the server, and too much for the map
NOISY = (2 * SHAPE[0], 2 * SHAPE[1])
_AGAIN = 0.05  # seconds until a keyframe that was skipped is sent once more
_PATIENCE = 25.0


class Orders(Struct, kw_only=True):
    """Numbers of the walls to send, where; `log` has a line for each that `send` returned a number for."""

    address: str
    spool: str
    log: str
    first: int
    end: int
    waits: bool  # for the map


def noisy_wall(i: int) -> Keyframe:
    """Wall number i, with so much noise that three fill a file of 64 kB."""
    wrong: dict[int, dict[str, Any]] = {
        REFUSED: {"T_world_camera": pose(9e5)},
        REJECTED: {"captured_ns": TOO_MUCH},
    }
    plain = wall(i, **wrong.get(i, {}))
    assert plain.depth is not None
    noise = np.random.default_rng(i).integers(0, 256, (*NOISY, 3), np.uint8)
    return replace(plain, depth=np.tile(plain.depth, (2, 2)), color=noise)


def taken(log: Path) -> list[int]:
    """The walls that `send` returned a number for."""
    return [int(line) for line in log.read_text().split()] if log.exists() else []


def open_files(pid: int, folder: str) -> list[str]:
    """Files in a folder that a process has open."""
    found = []
    for one in Path(f"/proc/{pid}/fd").iterdir():
        with suppress(OSError):
            found.append(os.readlink(one))
    return sorted(link for link in found if link.startswith(f"{folder}/"))


def scan(orders: Orders) -> None:
    """Send the walls that were not taken yet."""
    log = Path(orders.log)
    left = [i for i in range(orders.first, orders.end) if i not in taken(log)]
    with (
        log.open("a", buffering=1) as note,
        Client(orders.address, spool=orders.spool, config=CONFIG) as client,
    ):
        end = time.monotonic() + _PATIENCE
        for i in left:
            while client.send(noisy_wall(i)) is None:
                if time.monotonic() > end:
                    sys.exit(f"wall {i} is still skipped: {client.stats.skipped}")
                time.sleep(_AGAIN)
            note.write(f"{i}\n")
        if orders.waits:
            client.wait_fused(_PATIENCE)
        files = Counter(open_files(os.getpid(), orders.spool))
    if orders.waits:
        with suppress(TsfusionError):  # it may be starting again
            sys.stdout.writelines(f"{problem}\n" for problem in fetch_health(orders.address).problems)
    sys.stdout.write(f"{[file for file, count in files.items() if count > 1]}\n")
    sys.stdout.write(f"skipped {sum(client.stats.skipped.values())}\n")
