# SPDX-License-Identifier: MIT
"""The order in which a fuser gets the keyframes of several clients."""

from typing import cast

from tsfusion.fuser.messages import Fuse
from tsfusion.gateway.fuser_backlog import FuserBacklog
from tsfusion.gateway.fuser_supervisor import FuserSupervisor
from tsfusion.gateway.keyframe_index import KeyframeIndex
from tsfusion.gateway.sessions import Sessions
from tsfusion.journal import Position


class Fuser:
    """Takes a number of keyframes."""

    def __init__(self, wanted: int) -> None:
        self.wanted = wanted
        self.orders: list[Fuse] = []

    @property
    def wants_work(self) -> bool:
        return len(self.orders) < self.wanted

    def fuse(self, order: Fuse) -> bool:
        self.orders.append(order)
        return True


def handed_out(backlog: FuserBacklog, wanted: int) -> list[tuple[str, int]]:
    fuser = Fuser(wanted)
    backlog.hand_out(cast(FuserSupervisor, fuser))
    return [(order.client, order.seq) for order in fuser.orders]


def test_each_client_gets_its_turn() -> None:
    """One that floods holds nobody up; each session keeps its order."""
    sessions, index = Sessions(), KeyframeIndex()
    backlog = FuserBacklog(index, sessions)
    flood, more, small = (sessions.open(bytes([i]) * 16, client) for i, client in enumerate("aab"))
    for seq in range(1, 7):
        for session in (flood, more):
            index.add(Position(1, seq), session, seq)
            backlog.add(session)
    for seq in (1, 2):
        index.add(Position(2, seq), small, seq)
        backlog.add(small)
    assert (backlog.keyframes, backlog.corrections) == (14, 0)
    assert handed_out(backlog, 4) == [("a", 1), ("b", 1), ("a", 1), ("b", 2)]
    assert len(handed_out(backlog, 100)) == 10
    assert handed_out(backlog, 100) == []
