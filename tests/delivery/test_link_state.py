# SPDX-License-Identifier: MIT
"""The ways from one state of the link to another."""

import pytest

from tsfusion.delivery.link_state import LinkKind, LinkState

STATES: list[LinkState] = [
    LinkState(),
    LinkState("connecting", "no route"),
    LinkState("connected"),
    LinkState("held", "the disk is full"),
    LinkState("opening", "the map is being opened"),
    LinkState("refused", "another version"),
    LinkState("locked_out", "no such key"),
    LinkState("silent"),
]


@pytest.mark.parametrize("state", STATES, ids=str)
def test_a_server_that_lets_us_in_and_answers_is_connected(state: LinkState) -> None:
    assert state.welcomed().answered() == LinkState("connected")


@pytest.mark.parametrize("state", STATES, ids=str)
def test_who_is_refused_stays_so_until_a_welcome(state: LinkState) -> None:
    for refused in (state.refused("why"), state.locked_out("why")):
        assert refused.is_refused
        for next_one in (refused.answered(), refused.held("x"), refused.moved(), refused.silent()):
            assert next_one == refused
    assert state.locked_out("why").reachable("why") == LinkState()
    assert state.refused("why").reachable("another problem") == LinkState("refused", "why")


def kinds_after(event: str, *arguments: str) -> list[LinkKind]:
    return [getattr(state, event)(*arguments).kind for state in STATES]


def test_silence_a_hold_and_progress() -> None:
    assert kinds_after("silent") == [
        *("connecting", "connecting", "silent", "silent", "silent", "refused", "locked_out", "silent")
    ]
    assert kinds_after("held", "slower") == [*["held"] * 5, "refused", "locked_out", "held"]
    assert kinds_after("moved") == [
        *("connecting", "connecting", "connected", "connected", "opening", "refused", "locked_out", "silent")
    ]
    assert kinds_after("answered") == [
        *("connected", "connected", "connected", "held", "opening", "refused", "locked_out", "connected")
    ]


def test_only_connected_and_held_servers_count_as_connected() -> None:
    assert [state.kind for state in STATES if state.is_connected] == ["connected", "held"]
    assert LinkState("connecting", "no route").misunderstood("noise").why == "no route"
    assert LinkState().misunderstood("noise") == LinkState("connecting", "noise")
