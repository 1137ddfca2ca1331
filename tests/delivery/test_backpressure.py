# SPDX-License-Identifier: MIT
"""Keyframes that come faster than the map takes them: what each policy keeps, skips and tells."""

import json
import logging
import os
import re
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from clients_and_spools import NOBODY, joined, send_all
from keyframes_and_servers import DEADLINE, lasting_address, pose, serving, until, wall
from quick_fusers import SUMS
from repository import ROOT
from scripted_server import scripted

from tsfusion import Client, Keyframe
from tsfusion.core.config import ClientConfig
from tsfusion.core.errors import TransportError
from tsfusion.delivery.backpressure import Backpressure
from tsfusion.delivery.outbox import LinkState, Outbox
from tsfusion.delivery.spool import Spool
from tsfusion.wire.asking.queries import fetch_status

# --- policies ---


def test_a_server_that_restarts_costs_no_keyframe() -> None:
    with scripted() as server, joined(server) as client:
        taken = send_all(client, range(10))
        client.wait_fused(DEADLINE)
        for first in (10, 35):
            server.stop()
            taken += send_all(client, range(first, first + 20))
            server.start()
            taken += send_all(client, range(first + 20, first + 25))
        client.wait_fused(DEADLINE)
        assert (client.stats.fused, client.stats.skipped) == (60, {})
        assert server.numbers == taken == [*range(60)]


class Sensor:
    """A client's way into the spool, and a link and a map that take what they are told, on one clock."""

    def __init__(self, folder: Path, **settings: Any) -> None:
        self.now = 0.0
        self.outbox = Outbox(Spool(folder, 1 << 16), clock=lambda: self.now)
        self.outbox.change_link_state(LinkState("connected"))
        self.pressure = Backpressure(self.outbox, ClientConfig(min_free_bytes=0, **settings))
        self.kept: list[bool] = []

    def sense(self, count: int, rate: float, *, fused: float = 0.0) -> list[bool]:
        """Take so many keyframes, so many a second; the map takes `fused` a second, one by one."""
        point, done = np.zeros((1, 3), np.float32), self.now
        kept = []
        for _ in range(count):
            self.now += 1 / rate
            kept.append(self.pressure.put(Keyframe(points=point, T_world_camera=np.eye(4))) is not None)
            while fused and done + 1 / fused <= self.now and self.outbox.behind:
                done += 1 / fused
                stats = self.outbox.stats()
                self.outbox.acknowledge(self.outbox.spool.next_seq - 1, stats.fused + 1)
        self.kept += kept
        return kept


@pytest.fixture
def sensor(tmp_path: Path) -> Iterator[Callable[..., Sensor]]:
    """A maker of sensors; their spools are closed."""
    made: list[Sensor] = []

    def make(**settings: Any) -> Sensor:
        made.append(Sensor(tmp_path / str(len(made)), **settings))
        return made[-1]

    yield make
    for one in made:
        one.outbox.close()


def longest_hole(kept: list[bool]) -> int:
    """The most keyframes in a row that were left out."""
    return max((len(list(run)) for is_kept, run in groupby(kept) if not is_kept), default=0)


def test_thin_waits_until_the_map_is_seconds_behind(
    sensor: Callable[..., Sensor], caplog: pytest.LogCaptureFixture
) -> None:
    """10 a second for a map that takes 6.25: nothing goes before it is `catch_up` behind, and then 1 of 2."""
    caplog.set_level(logging.INFO)
    slow = sensor(catch_up=10.0)
    assert all(slow.sense(100, 10, fused=6.25))
    assert not caplog.records
    slow.sense(1000, 10, fused=6.25)
    assert 30 < slow.outbox.behind < 66
    assert longest_hole(slow.kept) == 1
    assert sum(slow.kept) == pytest.approx(1100 * 0.625 + slow.outbox.behind, rel=0.02)  # all it can take
    begin = caplog.records[0]
    assert (begin.levelname, caplog.records[1].levelname) == ("WARNING", "INFO")
    assert re.match(
        r"keyframes are left out from here on, 1 of 2 is kept: the map is 10.* s behind \(6\d keyframes "
        r"wait, it takes 6\.\d a second, 10\.0 come; catch_up = 10 s\)",
        begin.getMessage(),
    )
    assert re.match(r"every keyframe is kept again; \d+ were left out", caplog.records[1].getMessage())


def test_a_map_that_is_very_slow_is_followed_too(sensor: Callable[..., Sensor]) -> None:
    slow = sensor(catch_up=10.0)
    slow.sense(2000, 10, fused=1.2)
    assert slow.outbox.behind < 30
    assert 4 < longest_hole(slow.kept) <= 16


def test_a_link_that_is_down_is_no_slow_map(sensor: Callable[..., Sensor]) -> None:
    """A minute without it, and what comes when it is back."""
    cut = sensor(catch_up=20.0)
    cut.sense(100, 10, fused=9)
    assert cut.outbox.lag.rate == pytest.approx(9, rel=0.1)
    cut.outbox.change_link_state(LinkState("silent"))
    cut.sense(600, 10)
    assert cut.outbox.lag.rate is None
    cut.outbox.change_link_state(LinkState("connected"))
    cut.outbox.welcome(0, 8)
    cut.sense(100, 10, fused=40)
    assert all(cut.kept)


def test_a_spool_that_runs_short_is_thinned_before_it_is_full(
    sensor: Callable[..., Sensor], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    small = sensor(spool_bytes=1 << 20)
    small.outbox.change_link_state(LinkState("silent"))
    small.sense(6000, 10)
    skipped = small.outbox.stats().skipped
    assert set(skipped) == {"room", "spool"}
    assert small.kept.index(False) > sum(small.kept) / 2
    full = len(small.kept) - skipped["spool"]
    assert longest_hole(small.kept[:full]) < 16
    assert "1 of 2 is kept: the spool" in caplog.text
    assert [record.levelname for record in caplog.records] == ["WARNING", "ERROR"]


def test_a_spool_holds_so_many_records_and_no_more(
    sensor: Callable[..., Sensor], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Small ones would fill the memory before the disk."""
    monkeypatch.setattr("tsfusion.delivery.backpressure._MAX_WAITING", 3)
    everything = sensor(policy="spool_all")
    assert everything.sense(5, 10) == [True] * 3 + [False] * 2
    assert everything.outbox.stats().skipped == {"spool": 2}


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
    """The server hears how many keyframes wait and were left out; corrections do not count."""
    config = ClientConfig(stall_timeout=0.5, catch_up=1e-3)
    with scripted(fuse_to=0) as server, joined(server, spool=tmp_path, config=config) as client:
        send_all(client, range(24))
        client.flush(DEADLINE)
        for fused in range(1, 20):
            server.fuse_to = fused
            until(lambda fused=fused: client.stats.fused == fused)
        server.taking = False
        kept = len(send_all(client, range(24, 64)))
        assert 0 < kept < 40
        assert client.correct({1: pose(1)}) is not None
        until(lambda: server.pings[-1].waiting == client.stats.waiting - 1 > 0)
        until(lambda: server.pings[-1].skipped == {"thinned": 40 - kept})
        assert client.stats.waiting_bytes > 1000 * (client.stats.waiting - 1)
        until(lambda: 0 < server.pings[-1].bound_ns < 5e7)
        server.taking = True
        client.flush(DEADLINE)
        assert (client.stats.waiting, client.stats.waiting_bytes) == (0, 0)
        assert not any(ping.leaving for ping in server.pings)
        client.close()
        until(lambda: server.pings[-1].leaving)
        assert (server.pings[-1].waiting, server.pings[-1].skipped) == (0, {"thinned": 40 - kept})


def simulated(*arguments: object) -> dict[str, dict[str, Any]]:
    """The rows of lab/bench/backpressure.py, by policy."""
    command = [sys.executable, ROOT / "lab" / "bench" / "backpressure.py", "--json", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return {row["policy"]: row for row in map(json.loads, done.stdout.splitlines())}


def test_nothing_is_lost_where_the_map_can_catch_up() -> None:
    """Two restarts of two seconds, and a minute without the link."""
    for arguments in (("--seconds", 30, "--outage", 2, "--outages", 2), ("--seconds", 100, "--outage", 60)):
        row = simulated("--server", 12.5, "--policy", "thin", *arguments)["thin"]
        assert (row["fused_percent"], row["hole_s"]) == (100.0, 0.1)


def test_what_each_policy_is_for() -> None:
    """A sensor faster than the map, and a link that is down for a while."""
    rows = simulated("--seconds", 60, "--catch-up", 1)
    assert rows["spool_all"]["fused_percent"] == 100.0
    assert rows["spool_all"]["delay_p50_s"] > 10.0
    for policy, delay in (("thin", 5.0), ("block", 1.5), ("drop_oldest", 1.5)):
        assert rows[policy]["fused_percent"] > 50.0  # what the map can take
        assert rows[policy]["delay_p50_s"] < delay
    assert rows["thin"]["hole_s"] < 0.5 < 9.0 < rows["drop_oldest"]["hole_s"]
    assert rows["drop_oldest"]["delay_max_s"] < 2.0


# --- with a real map ---


def test_a_map_whose_server_is_killed_has_every_keyframe(tmp_path: Path) -> None:
    """More than twice `backlog` come while nobody answers: the map gets them all."""
    state = tmp_path / "state"
    with (
        serving(state, fuser=SUMS, listen=lasting_address()) as server,
        Client(server.address, spool=tmp_path / "spool") as client,
    ):
        assert len(send_all(client, range(4))) == 4
        server.kill()
        assert len(send_all(client, range(4, 28))) == 24
        with serving(state, fuser=SUMS, listen=server.address) as again:
            client.wait_fused(DEADLINE)
            assert (client.stats.durable, client.stats.skipped) == (28, {})
            assert fetch_status(again.address).keyframes_fused == 28
            assert again.terminate() == 0


@pytest.mark.nightly
def test_a_killed_server_and_drop_oldest(tmp_path: Path) -> None:
    """Every keyframe is in the map or was dropped, none is both."""
    config = ClientConfig(stall_timeout=0.5, backlog=4, policy="drop_oldest")
    with (
        serving(tmp_path, fuser=SUMS, listen=lasting_address()) as server,
        Client(server.address, config=config) as client,
    ):
        client.connect(DEADLINE)
        send_all(client, range(4))
        server.kill()
        send_all(client, range(4, 20))
        with serving(tmp_path, fuser=SUMS, listen=server.address) as again:
            client.wait_fused(DEADLINE)
            stats = client.stats
            assert stats.durable + stats.skipped["dropped"] == stats.sent == 20
            assert fetch_status(again.address).keyframes_fused == stats.durable
            assert again.terminate() == 0


def test_a_replay_that_blocks_loses_nothing(tmp_path: Path) -> None:
    with serving(tmp_path, fuser=SUMS) as server, Client(server.address, policy="block") as client:
        assert len(send_all(client, range(40))) == 40
        client.wait_fused(DEADLINE)
        assert (client.stats.fused, client.stats.skipped) == (40, {})
        assert server.terminate() == 0
