# SPDX-License-Identifier: MIT
"""A map that fills its memory is stopped, killed and opened again, and is the same map.

In every run: `test_a_map_that_outgrows_its_memory_refuses_keyframes_and_lives`.
"""

import os
import signal
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from clients_and_spools import deliver
from command_processes import alive
from keyframes_and_servers import DEADLINE, VOLUME, Server, map_hash, serving, until

from tsfusion import Client, Keyframe
from tsfusion.wire.asking.queries import CommandRefused, fetch_health, fetch_mesh, fetch_status
from tsfusion.wire.messages.health import MapHealth

LEAST = 1 << 28  # bytes, the smallest `fuser_memory_bytes`
PATIENCE = 10 * DEADLINE  # seconds to read or write gigabytes on a busy machine
_STEP = 0.4  # metres: a point is in blocks of its own


def far_points(first: int, count: int) -> Keyframe:
    """Points far from one another, so that each needs some blocks of its own."""
    number = np.arange(first, first + count)
    points = (np.stack([number % 50, number // 50 % 50, number // 2500], axis=-1) * _STEP).astype(np.float32)
    origins = points - np.array([0, 0, 0.3], np.float32)
    return Keyframe(points=points, origins=origins, T_world_camera=np.eye(4), timestamp_ns=first + 1)


def fill(server: Server, most: int, reason: str) -> list[Keyframe]:
    """Send keyframes until not even the smallest fits any more; those that the map has."""
    fused, first, count = [], 0, most
    with Client(server.address, policy="spool_all") as client:
        while count > most // 256:
            keyframe = far_points(first, count)
            rejected = client.stats.rejected.get(reason, 0)
            deliver(client, [keyframe])
            if client.stats.rejected.get(reason, 0) == rejected:
                fused.append(keyframe)
                first += count
            else:
                count //= 2
    return fused


def state(server: Server) -> tuple[str, int, dict[str, int], int]:
    """Hash, counts and size of the map, once it is open and has the whole journal."""
    until(lambda: health(server).state == "idle", PATIENCE)
    status = fetch_status(server.address, timeout=PATIENCE)
    return status.map_hash, status.keyframes_fused, status.keyframes_rejected, status.map_bytes


def health(server: Server) -> MapHealth:
    return fetch_health(server.address).maps["default"]


def kill_fuser(server: Server) -> None:
    """SIGKILL for the fuser, and wait for the next one."""
    restarts, pid = health(server).fuser_restarts, server.fuser_pid()
    os.kill(pid, signal.SIGKILL)
    until(lambda: not alive(pid) and health(server).fuser_restarts > restarts, PATIENCE)


def stop(server: Server) -> int:
    """SIGTERM, and the exit status when the checkpoint is on the disk."""
    server.process.terminate()
    return server.process.wait(PATIENCE)


def check_reopening(folder: Path, memory: int, most: int, disk: int | None = None) -> None:
    """Fill a map of so many bytes, in memory or on the disk, then stop, kill and open it again and again."""
    settings = {"fuser_memory_bytes": memory, "fuser_disk_bytes": disk, "checkpoint_every": 7}
    reason = "memory" if disk is None else "MapFull"
    with serving(folder, **settings) as server:
        fused = fill(server, most, reason)
        full = state(server)
        assert full[3] >= 0.99 * (disk or memory)
        assert full[2][reason] >= 8
        kill_fuser(server)
        assert state(server) == full
        assert stop(server) == 0
    with serving(folder, **settings) as server:
        assert state(server) == full
        again, too_much = fused[0], far_points(1_000_000, most)
        with Client(server.address, policy="spool_all") as client:
            deliver(client, [again, too_much, again])
            assert client.stats.rejected == {reason: 1}
        more = state(server)
        assert more[0] == map_hash([*fused, again, again], VOLUME)
        assert (more[1], more[2][reason]) == (full[1] + 2, full[2][reason] + 1)
        server.kill()
    with serving(folder, **settings) as server:
        assert state(server) == more
        with suppress(CommandRefused):  # a mesh that there is no memory for costs nobody anything
            fetch_mesh(server.address, timeout=PATIENCE)
        assert state(server) == more
        assert (health(server).fuser_restarts, health(server).problem) == (0, "")
        assert stop(server) == 0


@pytest.mark.nightly
def test_a_full_map_is_opened_again(tmp_path: Path) -> None:
    check_reopening(tmp_path, LEAST, 2048)


@pytest.mark.nightly
def test_a_map_that_has_filled_its_disk_is_opened_again(tmp_path: Path) -> None:
    check_reopening(tmp_path, LEAST, 2048, disk=3 * LEAST)


@pytest.mark.nightly
def test_a_full_map_of_gigabytes_is_opened_again(tmp_path: Path) -> None:
    check_reopening(tmp_path, 3 << 30, 16384)
