# SPDX-License-Identifier: MIT
"""Keyframes that come faster than the map takes them: what each policy keeps, skips and tells."""

import json
import os
import signal
import subprocess
import sys
import threading
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from clients_and_spools import NOBODY, joined, send_all
from keyframes_and_servers import DEADLINE, pose, serving, until, wall
from repository import ROOT
from scripted_server import scripted

from tsfusion import Client
from tsfusion.core.config import ClientConfig
from tsfusion.core.errors import TransportError
from tsfusion.wire.queries import fetch_status

# --- policies ---


def test_thin_leaves_no_hole_however_far_behind(tmp_path: Path) -> None:
    """Nobody answers: 1 of 1, 2, 3, then 4, at 8, 16 and 24 in the spool."""
    with Client(NOBODY, spool=tmp_path) as client:
        taken = send_all(client, range(100))
        stats = client.stats
    assert taken[:8] == [*range(8)]
    gaps = [b - a for a, b in pairwise(taken)]
    assert gaps == sorted(gaps)
    assert [gaps.count(n) for n in (1, 2, 3)] == [7, 8, 8]
    assert set(gaps[23:]) == {4}
    assert stats.sent == stats.waiting == len(taken)
    assert stats.skipped == {"thinned": 100 - len(taken)}
    with scripted() as server, joined(server, spool=tmp_path) as client:
        client.flush(DEADLINE)
        assert server.numbers == taken
        assert send_all(client, range(100, 103)) == [100, 101, 102]  # no longer behind


def test_thin_looks_at_the_map_as_well(tmp_path: Path) -> None:
    """Journaled at once, fused slowly: the delay would grow without bound."""
    with scripted(fuse_to=0) as server, joined(server, spool=tmp_path) as client:
        taken = send_all(client, range(8))
        client.flush(DEADLINE)
        assert (client.stats.waiting, taken) == (0, [*range(8)])
        assert send_all(client, range(8, 12)) == [9, 11]
        server.fuse_to = None
        client.wait_fused(DEADLINE)
        assert send_all(client, range(12, 16)) == [12, 13, 14, 15]
        client.wait_fused(DEADLINE)
        assert server.numbers == [*range(8), 9, 11, 12, 13, 14, 15]
        assert client.stats.fused == 14


def test_block_waits_for_the_map(tmp_path: Path) -> None:
    with scripted(fuse_to=0) as server, joined(server, policy="block") as client:
        assert len(send_all(client, range(8))) == 8
        late = threading.Thread(target=client.send, args=(wall(8),))
        late.start()
        client.flush(DEADLINE)
        until(lambda: len(server.pings) > 2)
        assert late.is_alive()
        server.fuse_to = 1
        late.join(DEADLINE)
        client.flush(DEADLINE)
        server.fuse_to = None
        assert len(send_all(client, range(9, 30))) == 21
        client.wait_fused(DEADLINE)
        assert (server.numbers, client.stats.skipped) == ([*range(30)], {})


def test_who_is_blocked_can_be_stopped() -> None:
    """By closing the client, and by Ctrl-C."""
    failed: list[str] = []

    def send() -> None:
        try:
            client.send(wall(1))
        except TransportError as error:
            failed.append(str(error))

    # Left by an error, too, it is closed: a thread that is blocked would keep the tests from ending.
    with Client(NOBODY, policy="block", config=ClientConfig(backlog=1)) as client:
        client.send(wall())
        blocked = threading.Thread(target=send)
        blocked.start()
        timer = threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT))
        timer.start()
        with pytest.raises(KeyboardInterrupt):
            client.send(wall(2))
        assert blocked.is_alive()
        client.close()
        blocked.join(DEADLINE)
        assert failed == ["the client is closed"]


def test_drop_oldest_keeps_the_newest_and_says_so(tmp_path: Path) -> None:
    with Client(NOBODY, spool=tmp_path, policy="drop_oldest") as client:
        assert send_all(client, range(30)) == [*range(30)]
        stats = client.stats
    assert (stats.sent, stats.waiting, stats.skipped) == (30, 8, {"dropped": 22})
    with scripted() as server, joined(server, spool=tmp_path) as client:
        client.flush(DEADLINE)  # the gap is declared: nothing is asked for again
        assert server.numbers[-8:] == [*range(22, 30)]


def test_drop_oldest_never_drops_what_may_be_journaled(tmp_path: Path) -> None:
    """The server takes keyframes and says nothing: dropping one that it has would count it twice."""
    with (
        scripted(silent=True, window=4) as server,
        joined(server, spool=tmp_path, policy="drop_oldest") as client,
    ):
        client.connect(DEADLINE)
        server.deaf = True
        send_all(client, range(6))
        until(lambda: len(server.taken) == 4)
        send_all(client, range(6, 40))
        stats = client.stats
        assert (stats.waiting, stats.skipped) == (8, {"dropped": 32})
        server.deaf = server.silent = False
        client.flush(DEADLINE)
        assert client.stats.durable + client.stats.skipped["dropped"] == 40
    assert server.numbers == [*range(4), *range(36, 40)]


def test_drop_oldest_does_not_run_ahead_of_the_map() -> None:
    with scripted(fuse_to=0) as server, joined(server, policy="drop_oldest") as client:
        send_all(client, range(8))
        client.flush(DEADLINE)
        send_all(client, range(8, 40))
        until(lambda: server.pings[-1].waiting == 1)
        server.fuse_to = None
        client.wait_fused(DEADLINE)
        assert server.numbers == [*range(8), 39]


@pytest.mark.parametrize("policy", ["thin", "drop_oldest", "block"])
def test_corrections_are_never_thinned_dropped_or_held_up(tmp_path: Path, policy: Any) -> None:
    config = ClientConfig(policy=policy, backlog=2)
    with Client(NOBODY, spool=tmp_path, config=config) as client:
        first = client.send(wall(0))
        assert first is not None
        taken = [client.correct({first: pose(i)}) for i in range(20)]
        assert client.send(wall(1)) == 22
        stats = client.stats
        assert (stats.sent, stats.corrections_sent, stats.waiting) == (2, 20, 22)
        if policy == "drop_oldest":
            send_all(client, range(2, 9))
            assert client.stats.skipped == {"dropped": 7}
    with scripted() as server, joined(server, spool=tmp_path) as client:
        client.flush(DEADLINE)
        assert server.corrections == taken == [*range(2, 22)]
        assert client.stats.corrections_acknowledged == 20
        assert client.stats.durable == len(server.taken)


def test_spool_all_keeps_everything(tmp_path: Path) -> None:
    with Client(NOBODY, spool=tmp_path, policy="spool_all") as client:
        assert len(send_all(client, range(50))) == 50
    with scripted() as server, joined(server, spool=tmp_path) as client:
        client.flush(DEADLINE)
        assert server.numbers == [*range(50)]


def test_the_server_is_told(tmp_path: Path) -> None:
    with Client(NOBODY, spool=tmp_path) as client:
        send_all(client, range(20))
    with scripted(taking=False) as server, joined(server, spool=tmp_path) as client:
        thinned = 40 - len(send_all(client, range(40)))
        waiting = 14 + 40 - thinned
        until(lambda: bool(server.pings) and server.pings[-1].waiting == waiting)
        ping = server.pings[-1]
        assert (ping.skipped, client.stats.waiting) == ({"thinned": thinned}, waiting)
        assert client.stats.waiting_bytes > 1000 * waiting
        until(lambda: 0 < server.pings[-1].bound_ns < 5e7)
        server.taking = True
        client.flush(DEADLINE)
        assert (client.stats.waiting, client.stats.waiting_bytes) == (0, 0)


def test_what_each_policy_is_for() -> None:
    """scripts/backpressure.py: a sensor faster than the map, and a link that is down for a while."""
    script = ROOT / "scripts" / "backpressure.py"
    done = subprocess.run(
        [sys.executable, script, "--seconds", "60", "--json"], capture_output=True, text=True, check=True
    )
    rows = {row["policy"]: row for row in map(json.loads, done.stdout.splitlines())}
    assert rows["spool_all"]["fused_percent"] == 100.0
    assert rows["spool_all"]["delay_p50_s"] > 10.0
    for policy in ("thin", "block", "drop_oldest"):
        assert rows[policy]["fused_percent"] > 50.0  # what the map can take
        assert rows[policy]["delay_p50_s"] < 1.5
    assert rows["thin"]["hole_s"] < 0.5 < 9.0 < rows["drop_oldest"]["hole_s"]
    assert rows["drop_oldest"]["delay_max_s"] < 2.0


# --- with a real map ---


def test_a_link_that_was_down_costs_detail_and_no_exactness(tmp_path: Path) -> None:
    """Thinned while nobody answered; what was kept is in the map, and the counts add up."""
    spool = tmp_path / "spool"
    with Client(NOBODY, spool=spool) as client:
        kept = send_all(client, range(24))
        assert client.stats.skipped == {"thinned": 24 - len(kept)}
    with serving(tmp_path / "state") as server, Client(server.address, spool=spool) as client:
        client.wait_fused(DEADLINE)
        assert client.stats.durable == fetch_status(server.address).keyframes_fused == len(kept)
        assert server.terminate() == 0


def test_a_killed_server_and_drop_oldest(tmp_path: Path) -> None:
    """Every keyframe is in the map or was dropped, none is both."""
    config = ClientConfig(stall_timeout=0.5, backlog=4, policy="drop_oldest")
    with serving(tmp_path) as server, Client(server.address, config=config) as client:
        client.connect(DEADLINE)
        send_all(client, range(4))
        server.kill()
        send_all(client, range(4, 20))
        with serving(tmp_path, listen=server.address) as again:
            client.wait_fused(DEADLINE)
            stats = client.stats
            assert stats.durable + stats.skipped["dropped"] == stats.sent == 20
            assert fetch_status(again.address).keyframes_fused == stats.durable
            assert again.terminate() == 0


def test_a_replay_that_blocks_loses_nothing(tmp_path: Path) -> None:
    with serving(tmp_path) as server, Client(server.address, policy="block") as client:
        assert len(send_all(client, range(40))) == 40
        client.wait_fused(DEADLINE)
        assert (client.stats.fused, client.stats.skipped) == (40, {})
        assert server.terminate() == 0
