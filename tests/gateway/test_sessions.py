# SPDX-License-Identifier: MIT
"""Sessions: each keyframe is admitted once, and clients take turns."""

import pytest

from tsfusion.gateway.keyframe_index import KeyframeIndex
from tsfusion.gateway.sessions import FairQueue, Session, Sessions
from tsfusion.journal import Position

SESSION = bytes(range(16))


def test_each_keyframe_is_admitted_once_and_in_order() -> None:
    session = Session(SESSION, 0)
    assert session.admit(1, 0) == "next"
    session.durable = 5
    assert [session.admit(seq, seq - 1) for seq in (5, 6, 7)] == ["duplicate", "next", "gap"]
    assert session.admit(9, 5) == session.admit(9, 0) == "next"  # the client dropped 6 to 8
    assert session.admit(9, 6) == "gap"


def test_sessions_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tsfusion.gateway.sessions._MAX_SESSIONS", 2)
    sessions = Sessions()
    for key in (SESSION, bytes(16)):
        assert sessions.room_for(key)
        sessions.open(key)
    assert not sessions.room_for(b"s" * 16)
    assert sessions.room_for(SESSION)


def test_the_fuser_takes_from_each_client_in_turn() -> None:
    """One that floods holds nobody up; each session keeps its order."""
    turns, sessions, index = FairQueue(), Sessions(), KeyframeIndex()
    flood, more, small = (sessions.open(bytes([i]) * 16, client) for i, client in enumerate("aab"))
    for seq in range(1, 7):
        for session in (flood, more):
            index.add(Position(1, seq), session, seq)
    for seq in (1, 2):
        index.add(Position(2, seq), small, seq)
    for session in (flood, more, small, flood):
        turns.add(session)
    served = []
    while (session := turns.next()) is not None:
        served.append((session.client, index[session.entries[session.handed]].stamps.seq))
        session.handed += 1
        turns.served()
    assert served[:4] == [("a", 1), ("b", 1), ("a", 1), ("b", 2)]
    assert len(served) == 14
    assert turns.next() is None
