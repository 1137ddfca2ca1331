# SPDX-License-Identifier: MIT
"""Rejections are told to their sender at once, or when it is back; a full map is a problem."""

from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest

from tsfusion.fuser.fuser_messages import Done, Ready
from tsfusion.gateway.clients.client_routes import ClientRoutes, Sessions
from tsfusion.gateway.health.metrics import Metrics
from tsfusion.gateway.maps.map_records import KeyframeOutcomes, MapRecords
from tsfusion.gateway.ports.ports import OutgoingAnswer
from tsfusion.gateway.records.journaled_records import KeyframeIndex
from tsfusion.journal import Position
from tsfusion.journal.quarantine import Quarantine
from tsfusion.wire.messages.messages import Ack, Nack, ToClient

SESSION = bytes(range(16))


class Map:
    """The outcomes of a map that robot sends keyframes to, and what it is told."""

    def __init__(self, folder: Path) -> None:
        self._out: list[OutgoingAnswer] = []
        self.routes = ClientRoutes(self._out)
        self._index, self._sessions = KeyframeIndex(), Sessions()
        self._session = self._sessions.open(SESSION, "robot")
        records = SimpleNamespace(
            index=self._index,
            sessions=self._sessions,
            journal=SimpleNamespace(folder=folder / "journal"),
            quarantine=Quarantine(folder / "quarantine", 1 << 20),
        )
        self.outcomes = KeyframeOutcomes("yard", cast(MapRecords, records), self.routes, Metrics())

    @property
    def told(self) -> list[ToClient]:
        return [one.message for one in self._out]

    def nacks(self) -> list[tuple[int, str, str]]:
        """Number, stage and reason of every refusal that the client was told."""
        return [(one.seq, one.stage, one.reason) for one in self.told if isinstance(one, Nack)]

    def reject(self, reason: str, message: str = "") -> None:
        seq = len(self._index) + 1
        index = self._index.add(Position(1, seq), self._session, seq)
        self.outcomes.on_done(Done(index, 1, 2, reason, message))


@pytest.fixture
def here(tmp_path: Path) -> Map:
    return Map(tmp_path)


def test_a_rejection_is_said_at_once(here: Map) -> None:
    here.routes.connect(SESSION, "yard", b"1", "robot")
    here.reject("MapFull")
    assert [type(one) for one in here.told] == [Nack, Ack]
    assert here.nacks() == [(1, "map", "MapFull")]
    here.outcomes.tell_untold(SESSION)
    assert len(here.nacks()) == 1


def test_who_was_away_is_told_when_it_is_back(here: Map) -> None:
    here.reject("MapFull")
    route = here.routes.connect(SESSION, "yard", b"1", "robot")
    route.left = True
    here.reject("memory")
    assert here.nacks() == []
    here.routes.connect(SESSION, "yard", b"2", "robot")
    here.outcomes.tell_untold(SESSION)
    here.outcomes.tell_untold(SESSION)
    assert here.nacks() == [(1, "map", "MapFull"), (2, "map", "memory")]


def test_who_is_silent_is_told_before_the_acknowledgement_and_again_when_it_is_heard(here: Map) -> None:
    """A silent client may only stand still; what is acknowledged first, it counts as fused."""
    here.routes.connect(SESSION, "yard", b"1", "robot").last_message -= 10.0
    here.reject("MapFull")
    assert [type(one) for one in here.told] == [Nack, Ack]
    here.outcomes.tell_untold(SESSION)
    assert here.nacks() == [(1, "map", "MapFull")] * 2


def test_what_waits_to_be_said_is_bounded(here: Map) -> None:
    for _ in range(200):
        here.reject("crash")
    here.routes.connect(SESSION, "yard", b"1", "robot")
    here.outcomes.tell_untold(SESSION)
    assert [seq for seq, _, _ in here.nacks()] == list(range(137, 201))


@pytest.mark.parametrize(
    ("reason", "notice"),
    [
        ("MapFull", "it is full, keyframes that need more room are rejected: raise max_blocks"),
        ("memory", "it is full"),
        ("MapQuota", "client robot has used up its share of the map's room"),
        ("KeyframeTooLarge", ""),
    ],
)
def test_a_full_map_is_a_problem_until_it_may_have_more_room(here: Map, reason: str, notice: str) -> None:
    for _ in range(3):
        here.reject(reason, "the map may hold at most 5 blocks")
    assert len(here.outcomes.notices) == bool(notice)
    assert notice in "".join(here.outcomes.notices.values())
    here.outcomes.on_ready(Ready({}))
    assert not here.outcomes.notices
