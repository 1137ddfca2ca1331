# SPDX-License-Identifier: MIT
"""The server's log: who comes and goes, a line a minute while keyframes come, nothing while none do."""

import logging
from collections.abc import Callable

import pytest
from health_snapshots import client, health, map_health

from tsfusion.gateway.maps.map_condition import ActivityLog
from tsfusion.wire.messages.health import Health, Spread

Told = Callable[[Health], list[str]]
YARD = map_health(keyframes_durable=0, keyframes_fused=0, state="opening", delay_ms=Spread())


class Clock:
    """A clock that moves a second a look."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock() -> Clock:
    return Clock()


@pytest.fixture
def told(clock: Clock, caplog: pytest.LogCaptureFixture) -> Told:
    """Lines that are logged of a snapshot, a second after the one before."""
    activity = ActivityLog(clock)
    caplog.set_level(logging.INFO)

    def note(snapshot: Health) -> list[str]:
        caplog.clear()
        clock.now += 1.0
        activity.note(snapshot)
        return [f"{record.levelname} {record.getMessage()}" for record in caplog.records]

    return note


def test_who_comes_and_goes_is_said_once(told: Told, caplog: pytest.LogCaptureFixture) -> None:
    here = client("cart", address="10.0.0.7", durable=30, fused=29)
    assert told(health()) == []
    assert told(health(here)) == ["INFO a client is connected from 10.0.0.7"]
    assert vars(caplog.records[0])["about"] == {"map": "default", "session": "1a2b3c4d", "client": "cart"}
    assert told(health(here)) == []
    fields = {"durable": 30, "fused": 29, "rejected": 1, "refused": 2, "waiting": 3}
    gone = client("cart", state="gone", skipped={"thinned": 22}, **fields)
    assert told(health(gone)) == [
        "WARNING a client leaves keyframes out: the map was too far behind",
        "INFO a client left: 30 keyframes received, 29 of them in the map, 1 rejected by it, 2 refused, "
        "3 still in its spool, left out by the client: 22 × thinned",
    ]
    assert told(health(gone)) == []
    assert told(health(here)) == ["INFO a client is back from 10.0.0.7"]
    assert told(health(client("cart", state="silent", heard_s=9.0))) == []
    assert told(health(client("cart", state="gone", heard_s=30.4))) == [
        "INFO a client was not heard for 30 s: 6 keyframes received, 6 of them in the map"
    ]


def test_who_was_there_for_a_moment_is_named_too(told: Told) -> None:
    assert told(health(client("cart", state="gone"))) == [
        "INFO a client is connected",
        "INFO a client left: 6 keyframes received, 6 of them in the map",
    ]


def test_a_line_a_minute_while_something_happens(told: Told) -> None:
    old = map_health(keyframes_durable=3000, keyframes_fused=2000)
    told(health(client(), maps={"yard": YARD, "shed": map_health(keyframes_durable=9, state="opening")}))
    assert told(health(client(), maps={"yard": YARD, "shed": old})) == []
    for second in range(57):
        counts = {"keyframes_durable": 10 * second, "keyframes_fused": 9 * second}
        assert told(health(client(), maps={"yard": map_health(**counts), "shed": old})) == []
    busy = map_health(keyframes_durable=612, keyframes_fused=600, waiting=12, checkpoints=1)
    assert told(health(client(), maps={"yard": busy, "shed": old})) == [
        "INFO working · behind by 12 keyframes, about 1 s · lost 2 keyframes; in 60 s: map yard: "
        "612 keyframes received, 600 fused (10.0/s), delay p50 20 ms, p95 28 ms, "
        "10 MB, checkpoint written; 1 client connected, gateway 63 MB"
    ]
    for _ in range(200):
        assert told(health(client(), maps={"yard": busy, "shed": old})) == []
