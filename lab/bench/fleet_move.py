# SPDX-License-Identifier: MIT
"""A live map that moves from one server to another while real clients send: how long nothing is taken."""

import threading
import time
from collections import Counter
from contextlib import ExitStack, closing
from pathlib import Path
from typing import Any

import numpy as np
from keyframes_and_servers import Server

from tsfusion import Client, Intrinsics, Keyframe, VolumeConfig, journal
from tsfusion.journal import state_folder
from tsfusion.wire.asking import queries

_CAMERA = Intrinsics(525.0, 525.0, 319.5, 239.5)
_PATIENCE = 120.0


def measure(folder: Path, count: int, rate: float, seconds: float, voxel_size: float) -> dict[str, Any]:
    """Let clients send for some seconds, move the map, and let them send as long again.

    Args:
        rate: keyframes a second of each client.
    """
    volume = VolumeConfig(voxel_size=voxel_size)
    with ExitStack() as stack:
        one, two = (stack.enter_context(closing(Server(folder / name, volume))) for name in ("one", "two"))
        clients = [
            stack.enter_context(
                closing(Client(one.address, spool=folder / f"spool-{i}", world="fleet", policy="spool_all"))
            )
            for i in range(count)
        ]
        stopping = threading.Event()
        threads = [
            threading.Thread(target=_send, args=(client, i, 1.0 / rate, stopping))
            for i, client in enumerate(clients)
        ]
        for thread in threads:
            stack.callback(thread.join)
            thread.start()
        stack.callback(stopping.set)
        time.sleep(seconds)
        moved = queries.move_map("default", one.address, two.address)
        time.sleep(seconds)
        stopping.set()
        for thread in threads:
            thread.join()
        for client in clients:
            client.wait_fused(_PATIENCE)
        sent = sum(client.stats.sent for client in clients)
        durable = [one_.durable_ns for client in clients for one_ in client.records]
        fused = [one_.fused_ns for client in clients for one_ in client.records]
        for server in (two, one):
            server.terminate()
    found = _journaled(folder / "two")
    return {
        "scanners": count, "rate": rate, "sent": sent, "lost": sent - len(found),
        "doubled": sum(found.values()) - len(found), "moved_mb": round(moved.nbytes / 1e6, 1),
        "move_s": moved.seconds, "frozen_s": moved.frozen_s,
        "longest_without_acknowledgement_s": _longest_gap(durable),
        "longest_without_fusing_s": _longest_gap(fused),
    }  # fmt: skip


def _send(client: Client, number: int, interval: float, stopping: threading.Event) -> None:
    rng = np.random.default_rng(number)
    v, u = np.mgrid[:480, :640]
    depths = [
        (1500 + 60 * np.sin(u / 70 + i) + 40 * np.cos(v / 90) + rng.normal(0, 2.2, (480, 640))).astype(
            np.uint16
        )
        for i in range(4)
    ]
    due, seq = time.monotonic(), 0
    while not stopping.wait(max(due - time.monotonic(), 0.0)):
        pose = np.eye(4)
        pose[:2, 3] = 6.0 * number + 0.02 * (seq % 100), 0.01 * (seq % 40)
        client.send(Keyframe(depth=depths[seq % 4], intrinsics=_CAMERA, T_world_camera=pose))
        due += interval
        seq += 1


def _longest_gap(stamps_ns: list[int]) -> float:
    """The longest time between two of these moments, seconds."""
    return round(float(np.diff(np.sort([at for at in stamps_ns if at])).max()) / 1e9, 3)


def _journaled(state: Path) -> Counter[tuple[bytes, int]]:
    place = state_folder.map_folder(state, "default") / state_folder.JOURNAL_FOLDER
    found: Counter[tuple[bytes, int]] = Counter()
    for number in journal.segments(place):
        records, _ = journal.list_records(journal.segment_path(place, number))
        found.update((record.session, record.seq) for record in records)
    return found
