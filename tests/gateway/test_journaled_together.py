# SPDX-License-Identifier: MIT
"""Records that come together are journaled by one wait for the disk, and held together when it refuses."""

import errno
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from failures import refuse
from served_gateway import Served, hosting, record

from tsfusion.wire.messages import messages

SESSIONS = [bytes([i]) * 16 for i in (1, 2, 3)]


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    """A gateway that knows three sessions, of one keyframe each."""
    with hosting(tmp_path) as made:
        for session in SESSIONS:
            made.take(record(1, session=session))
        made.until(lambda: made.durable == len(SESSIONS))
        yield made


def test_what_came_together_waits_for_the_disk_together(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    waits, real = [], os.fdatasync
    monkeypatch.setattr(os, "fdatasync", lambda descriptor: (waits.append(1), real(descriptor)))
    for seq in (2, 3, 4):
        for session in SESSIONS:
            served.take(record(seq, session=session))
    served.until(lambda: served.durable == 12)
    assert len(waits) == 1
    for session in SESSIONS:
        assert served.gateway.maps.progress("default", session)[0] == 4


def test_a_gap_behind_what_was_just_taken_is_told_from_there(served: Served) -> None:
    served.greet("default", SESSIONS[0])
    for seq in (2, 4, 2):  # 3 is lost, and 2 comes twice
        served.take(record(seq, session=SESSIONS[0]))
    while not (ack := served.heard(messages.Ack)).resend:
        pass
    assert ack.durable == 2
    served.until(lambda: served.gateway.health().duplicates == 1)
    assert served.durable == len(SESSIONS) + 1


def test_a_disk_that_refuses_holds_every_client_and_loses_nothing(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    for session in SESSIONS:
        served.greet("default", session)
    with monkeypatch.context() as broken:
        broken.setattr(os, "fdatasync", refuse(errno.EIO))
        for session in SESSIONS:
            served.take(record(2, session=session))
        holds = [served.heard(messages.Hold) for _ in SESSIONS]
    (hosted,) = served.gateway.maps
    assert {one.session for one in holds} == set(SESSIONS)
    assert {(one.reason, one.message) for one in holds} == {("disk", hosted.records.disk.problem)}
    assert os.strerror(errno.EIO) in hosted.records.disk.problem
    assert served.durable == len(SESSIONS)
    hosted.records.disk._until = 0.0
    for route in served.gateway._routes:
        route.held_until = 0.0
    for session in SESSIONS:
        served.take(record(2, session=session))
    served.until(lambda: served.durable == 2 * len(SESSIONS))
