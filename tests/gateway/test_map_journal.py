# SPDX-License-Identifier: MIT
"""Records that may leave a journal: those that two checkpoints hold, whatever became of who wrote them."""

from typing import Any, cast

from tsfusion.fuser import fuser_messages
from tsfusion.gateway.clients.client_routes import Session, Sessions
from tsfusion.gateway.fusers.fuser_supervisor import FuserSupervisor
from tsfusion.gateway.maps.map_journal import JournalRetention
from tsfusion.gateway.records.journaled_records import KeyframeIndex
from tsfusion.journal import Journal, Position


class Folder:
    """A journal of ten segments that is always too large; notes what may go."""

    nbytes, first, segment = 1 << 40, 1, 11

    def __init__(self) -> None:
        self.below = 0

    def retire(self, below: int, limit: int) -> int:
        assert limit == 1
        self.below = below
        return 0


class Fuser:
    """Takes what it is told."""

    ready = True
    in_flight: tuple[int, ...] = ()

    def __init__(self) -> None:
        self.asked: list[Any] = []

    def send(self, message: Any) -> bool:
        self.asked.append(message)
        return True


def ten_segments() -> tuple[JournalRetention, Folder, Session]:
    """One session of ten keyframes, a segment each."""
    sessions, index, folder = Sessions(), KeyframeIndex(), Folder()
    session = sessions.open(bytes(16))
    for seq in range(1, 11):
        index.add(Position(seq, 8), session, seq)
    return JournalRetention(cast(Journal, folder), index, sessions, 1), folder, session


def let_go(retention: JournalRetention, folder: Folder, fuser: Fuser) -> int:
    retention.step(cast(FuserSupervisor, fuser), ())
    return folder.below


def test_a_map_that_forgets_lets_keyframes_go_before_their_segment_goes() -> None:
    retention, folder, session = ten_segments()
    fuser = Fuser()
    retention.on_ready()
    session.in_map = 10

    def step(window_from: int) -> int:
        retention.step(cast(FuserSupervisor, fuser), (), window_from=window_from)
        return folder.below

    assert step(3) == 0
    assert step(3) == 0
    assert [one for one in fuser.asked if isinstance(one, fuser_messages.Expire)] == [
        fuser_messages.Expire(4)
    ]
    for window_from, may_go in ((4, 0), (6, 4), (0, 6)):
        step(window_from)
        retention.on_saved(fuser_messages.Saved(True))
        assert step(window_from) == may_go


def test_what_two_checkpoints_hold_may_go() -> None:
    retention, folder, session = ten_segments()
    fuser = Fuser()
    retention.on_ready()
    assert let_go(retention, folder, fuser) == 0
    assert fuser.asked == [fuser_messages.Save()]
    session.in_map = 4
    retention.on_saved(fuser_messages.Saved(written=True))
    assert let_go(retention, folder, fuser) == 1  # the checkpoint before this one was empty
    session.in_map = 7
    retention.on_saved(fuser_messages.Saved(written=False))
    assert let_go(retention, folder, fuser) == 1  # nothing was written
    retention.on_saved(fuser_messages.Saved(written=True))
    assert let_go(retention, folder, fuser) == 5


def test_a_keyframe_that_somebody_asks_for_stays_in_the_index() -> None:
    """The segment of a keyframe may go while the fuser is at it, or while no mesh shows it yet."""
    retention, folder, session = ten_segments()
    session.handed, folder.first = 10, 11
    fuser = Fuser()
    fuser.in_flight = (6,)
    for needed, first in (([3], 3), ([8], 6)):
        retention.step(cast(FuserSupervisor, fuser), needed)
        assert session.entries[0] == first
        assert retention._index[first].stamps.seq == first + 1


def test_what_a_dead_fuser_had_covers_nothing() -> None:
    """A fuser that fused all ten is ended; the checkpoint has four, and the next fuser begins there."""
    retention, folder, session = ten_segments()
    retention.on_ready()
    session.in_map = 4
    retention.on_saved(fuser_messages.Saved(written=True))
    session.in_map = session.fused = 10
    session.in_map = 4  # as the next fuser says
    retention.on_ready()
    session.in_map = 5
    retention.on_saved(fuser_messages.Saved(written=True))
    assert let_go(retention, folder, Fuser()) == 5


def test_a_checkpoint_that_a_dead_fuser_was_asked_for_is_asked_for_again() -> None:
    retention, folder, _ = ten_segments()
    fuser = Fuser()
    for asked in (1, 1):
        let_go(retention, folder, fuser)
        assert len(fuser.asked) == asked
    retention.on_ready()
    let_go(retention, folder, fuser)
    assert len(fuser.asked) == 2
