# SPDX-License-Identifier: MIT
"""Sessions: each keyframe is admitted once and in order; there is a limit to them."""

import pytest

from tsfusion.gateway.sessions import Sessions

SESSION = bytes(range(16))


def test_each_keyframe_is_admitted_once_and_in_order() -> None:
    sessions = Sessions()
    assert sessions.admit(SESSION, 1, 0) == "next"
    sessions.open(SESSION).durable = 5
    assert [sessions.admit(SESSION, seq, seq - 1) for seq in (5, 6, 7)] == ["duplicate", "next", "gap"]
    assert sessions.admit(SESSION, 9, 5) == sessions.admit(SESSION, 9, 0) == "next"  # 6 to 8 were dropped
    assert sessions.admit(SESSION, 9, 6) == "gap"


def test_sessions_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tsfusion.gateway.sessions._MAX_SESSIONS", 2)
    sessions = Sessions()
    for key in (SESSION, bytes(16)):
        assert sessions.room_for(key)
        sessions.open(key)
    assert not sessions.room_for(b"s" * 16)
    assert sessions.room_for(SESSION)
