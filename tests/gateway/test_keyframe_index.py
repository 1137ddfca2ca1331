# SPDX-License-Identifier: MIT
"""Journaled keyframes: admitted to their sessions, indexed, handed to the fuser in turn, and their delays."""

from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from tsfusion.fuser.fuser_messages import Done, Fuse
from tsfusion.gateway.clients.client_routes import ClientRoutes, RecentFates, Session, Sessions
from tsfusion.gateway.fusers.fuser_supervisor import FuserSupervisor
from tsfusion.gateway.health.metrics import Metrics
from tsfusion.gateway.maps.map_records import DelayStatistics, KeyframeOutcomes, MapRecords
from tsfusion.gateway.records.journaled_records import FuserBacklog, FuserTime, KeyframeIndex
from tsfusion.geometry.sample_ranges import NO_SAMPLES
from tsfusion.journal import Position, RecordEntry
from tsfusion.journal.quarantine import Quarantine
from tsfusion.wire.messages.forget_messages import Selection
from tsfusion.wire.messages.messages import Stamps

SESSION = bytes(range(16))


def index_of(*records: tuple[int, int, bytes, int]) -> tuple[KeyframeIndex, Sessions]:
    index, sessions = KeyframeIndex(), Sessions()
    index.recover([RecordEntry(Position(a, b), key, seq, "", 0) for a, b, key, seq in records], sessions)
    return index, sessions


def test_recovery_counts_a_keyframe_once() -> None:
    other = bytes(16)
    index, sessions = index_of(
        (1, 42, SESSION, 1), (1, 90, other, 1), (1, 140, SESSION, 2), (2, 42, SESSION, 2)
    )
    entries = [index[i] for i in range(len(index))]
    places = [(1, 1), (1, 1), (1, 2), (2, 2)]  # the copy is there to be forgotten
    assert [(entry.position.segment, entry.stamps.seq) for entry in entries] == places
    assert (sessions.open(SESSION).durable, sessions.open(SESSION).keyframes) == (2, 2)
    assert [index.after(sessions.open(SESSION), seq) for seq in (0, 1, 2, 9)] == [0, 1, 2, 2]
    assert index.segment(2) == 1


def test_an_erased_keyframe_is_known_and_not_taken_again() -> None:
    index, sessions = KeyframeIndex(), Sessions()
    erased = RecordEntry(Position(1, 8), bytes(16), 5, "robot", 100, is_erased=True, is_clear=True)
    index.recover([erased], sessions)
    assert (len(index), sessions.progress(bytes(16))[0]) == (0, 5)
    assert sessions.admit(bytes(16), 5, 4) == "duplicate"
    session = sessions.get(bytes(16))
    assert session is not None
    assert (session.client, session.world, session.keyframes) == ("robot", None, 0)


def test_a_selection_has_every_copy_of_a_keyframe_until_its_bytes_are_deleted() -> None:
    """Copies, and records at whose erasing a server was killed, are only there to be erased."""
    index, sessions = KeyframeIndex(), Sessions()
    places = [Position(1, 8), Position(1, 90), Position(2, 8), Position(2, 90), Position(3, 8)]
    entry = partial(RecordEntry, session=SESSION, nbytes=100)
    index.recover(
        [
            entry(places[0], seq=1, client="", logged_ns=30),
            entry(places[1], seq=2, client="robot", is_erased=True),
            entry(places[2], seq=3, client="robot", logged_ns=20),  # the clock was set back
            entry(places[3], seq=4, client="robot", logged_ns=40, is_correction=True),
            entry(places[4], seq=3, client="robot", logged_ns=50),
        ],
        sessions,
    )

    def selected(**how: Any) -> list[Position]:
        found = index.select(1, Selection(**how), sessions)
        return [place for one in found.sessions for place in one.positions]

    assert list(sessions.open(SESSION).entries) == [0, 2, 3]
    assert selected() == [places[0], places[1], places[2], places[4]]
    assert selected(client="robot", numbers=((2, 3),)) == [places[1], places[2], places[4]]
    assert selected(client="nobody") == selected(session="ff") == []
    assert selected(since_ns=20, until_ns=30) == [places[0], places[2]]
    assert selected(since_ns=-10) == [places[4]]
    assert [index.select(1, Selection(since_ns=ns), sessions).reaches_back for ns in (29, 30)] == [
        True,
        False,
    ]
    index.set_erased([places[2], places[1]])
    assert selected() == [places[0], places[4]]


def test_times_count_back_from_the_newest_record_that_has_one() -> None:
    """A server was killed while it erased the first keyframe, and the only ones of the newest segment."""
    index, sessions = KeyframeIndex(), Sessions()
    entry = partial(RecordEntry, session=SESSION, client="", nbytes=100)
    index.recover(
        [
            entry(Position(1, 8), seq=1, is_erased=True),
            entry(Position(1, 90), seq=2, logged_ns=50),
            entry(Position(1, 200), seq=3, logged_ns=100),
            entry(Position(2, 8), seq=4, is_erased=True),
        ],
        sessions,
    )
    found = index.select(1, Selection(since_ns=-10), sessions)
    assert [one.columns[0].tolist() for one in found.sessions] == [[3]]
    assert index.select(1, Selection(since_ns=20), sessions).reaches_back
    assert not index.select(1, Selection(since_ns=60), sessions).reaches_back


def test_a_selection_keeps_the_records_of_each_session_together_and_in_order() -> None:
    other = bytes(16)
    index, sessions = index_of((1, 1, other, 5), (1, 2, SESSION, 1), (1, 3, other, 6), (2, 1, SESSION, 2))
    found = index.select(1, Selection(), sessions).sessions
    assert [(one.session, one.columns[0].tolist()) for one in found] == [(other, [5, 6]), (SESSION, [1, 2])]


def test_keyframes_are_counted_and_corrections_are_not() -> None:
    """A scanner that was restarted goes on with numbers far above: they are no counts."""
    index, sessions = index_of((1, 1, SESSION, 1), (1, 2, SESSION, 5_641_760))
    session = sessions.open(SESSION)
    index.add(Position(1, 3), session, 5_641_761, is_correction=True)
    index.add(Position(1, 4), session, 5_641_762)
    assert (session.keyframes, session.corrections) == (3, 1)
    assert [index.keyframes_up_to(session, seq) for seq in (0, 1, 5_641_761, 5_641_762)] == [0, 1, 2, 3]


def test_keyframes_whose_segments_are_gone_are_forgotten() -> None:
    other = bytes(16)
    index, sessions = index_of(
        *((1, 1, SESSION, 1), (1, 2, other, 5), (2, 1, SESSION, 2), (2, 2, SESSION, 3), (3, 1, other, 6))
    )
    first, second = sessions.open(SESSION), sessions.open(other)
    first.handed, second.handed = 2, 1
    before = {i: index[i] for i in range(2, 5)}
    index.forget(1, sessions)
    assert len(index) == 5
    index.forget(3, sessions, needed=[4, 1])  # not meshed yet
    assert (len(index), list(first.entries), first.handed) == (4, [2, 3], 1)
    index.forget(3, sessions)
    assert (len(index), list(first.entries), first.handed) == (2, [3], 0)  # 3 is to be handed out
    assert (list(second.entries), second.handed) == ([4], 0)
    assert {i: index[i] for i in (3, 4)} == {i: before[i] for i in (3, 4)}
    assert [index.after(first, seq) for seq in (1, 2, 3)] == [0, 0, 1]
    assert (index.segment(3), index.segment(4)) == (2, 3)
    assert index.add(Position(3, 2), second, 7) == 5
    index.set_fused(5, 8, 9)
    assert (index[5].stamps.seq, index[5].stamps.fused_ns, list(second.entries)) == (7, 9, [4, 5])
    first.handed = second.handed = 1
    index.forget(9, sessions)
    assert (len(index), list(first.entries), list(second.entries), second.handed) == (1, [], [5], 0)


def test_the_index_keeps_stamps() -> None:
    index, sessions = KeyframeIndex(), Sessions()
    index.add(Position(1, 42), sessions.open(SESSION), 1, captured_ns=5, received_ns=6, durable_ns=7)
    index.set_fused(0, 8, 9)
    assert index[0].stamps == Stamps(1, 6, 7, 8, 9, 0)
    assert index[0].captured_ns == 5


def test_each_keyframe_is_admitted_once_and_in_order() -> None:
    sessions = Sessions()
    assert sessions.admit(SESSION, 1, 0) == "next"
    sessions.open(SESSION).durable = 5
    assert [sessions.admit(SESSION, seq, seq - 1) for seq in (5, 6, 7)] == ["duplicate", "next", "gap"]
    assert sessions.admit(SESSION, 9, 5) == sessions.admit(SESSION, 9, 0) == "next"  # 6 to 8 were dropped
    assert sessions.admit(SESSION, 9, 6) == "gap"


def test_sessions_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tsfusion.gateway.clients.client_routes._MAX_SESSIONS", 2)
    sessions = Sessions()
    for key in (SESSION, bytes(16)):
        assert sessions.room_for(key)
        sessions.open(key)
    assert not sessions.room_for(b"s" * 16)
    assert sessions.room_for(SESSION)


class Fuser:
    """Takes a number of keyframes; `answer` ends the oldest that it has not answered."""

    def __init__(self, wanted: int) -> None:
        self.wanted = wanted
        self.orders: list[Fuse] = []
        self.answered = 0

    @property
    def wants_work(self) -> bool:
        return len(self.orders) < self.wanted

    def fuse(self, order: Fuse) -> bool:
        self.orders.append(order)
        return True

    def answer(self, backlog: FuserBacklog, seconds: float) -> None:
        backlog.on_done(self.orders[self.answered].index, seconds)
        self.answered += 1


def handed_out(backlog: FuserBacklog, wanted: int, **seconds: float) -> list[tuple[str, int]]:
    """The order in which keyframes go to a fuser that takes so many seconds for each of a client's."""
    fuser = Fuser(wanted)
    while True:
        backlog.hand_out(cast(FuserSupervisor, fuser))
        if fuser.answered == len(fuser.orders):
            return [(order.client, order.seq) for order in fuser.orders]
        fuser.answer(backlog, seconds.get(fuser.orders[fuser.answered].client, 0.02))


def backlog_of(**counts: int) -> tuple[FuserBacklog, KeyframeIndex, Sessions]:
    """So many keyframes of each client."""
    sessions, index = Sessions(), KeyframeIndex()
    backlog = FuserBacklog(index, sessions)
    for client, count in counts.items():
        for seq in range(1, count + 1):
            add(backlog, index, sessions.open(client.encode() * 16, client), seq)
    return backlog, index, sessions


def add(backlog: FuserBacklog, index: KeyframeIndex, session: Session, seq: int) -> None:
    index.add(Position(1, seq), session, seq)
    backlog.add(session)


def test_each_client_gets_its_turn() -> None:
    """A client that floods holds no other up; each session keeps its order."""
    sessions, index = Sessions(), KeyframeIndex()
    backlog = FuserBacklog(index, sessions)
    flood, more, small = (sessions.open(bytes([i]) * 16, client) for i, client in enumerate("aab"))
    for seq in range(1, 7):
        for session in (flood, more):
            add(backlog, index, session, seq)
    for seq in (1, 2):
        add(backlog, index, small, seq)
    assert (backlog.keyframes, backlog.corrections) == (14, 0)
    assert handed_out(backlog, 4) == [("a", 1), ("b", 1), ("a", 1), ("b", 2)]
    assert len(handed_out(backlog, 100)) == 10
    assert handed_out(backlog, 100) == []


def test_the_fusers_time_is_shared_out_not_its_keyframes() -> None:
    backlog, _, _ = backlog_of(a=20, b=200)
    order = [client for client, _ in handed_out(backlog, 110, a=1.0, b=0.1)]
    assert 9 <= order.count("a") <= 11  # half of the time
    between = "".join(order).strip("b").split("a")[1:-1]
    assert all(8 <= len(run) <= 12 for run in between[1:])


def test_who_was_away_has_saved_nothing_up() -> None:
    backlog, index, sessions = backlog_of(a=50, b=1)
    handed_out(backlog, 20)
    late = sessions.open(b"c" * 16, "c")
    for seq in range(1, 21):
        add(backlog, index, late, seq)
        add(backlog, index, sessions.open(b"b" * 16, "b"), seq + 1)
    order = "".join(client for client, _ in handed_out(backlog, 30))
    assert all(8 <= order.count(client) <= 12 for client in "abc")


def test_nobody_waits_in_the_fusers_queue_behind_what_takes_long() -> None:
    backlog, _, _ = backlog_of(a=10, b=10)
    assert len(handed_out(backlog, 4, a=1.5, b=0.01)) == 4  # now it is known what they take
    fuser = Fuser(4)
    backlog.hand_out(cast(FuserSupervisor, fuser))
    assert len(fuser.orders) == 1 or {order.client for order in fuser.orders} == {"b"}
    while "a" not in {order.client for order in fuser.orders}:
        fuser.answer(backlog, 0.01)
        fuser.wanted = fuser.answered + 4
        backlog.hand_out(cast(FuserSupervisor, fuser))
    assert fuser.answered == len(fuser.orders) - 1  # alone


def test_a_fuser_that_ended_owes_no_answers() -> None:
    backlog, _, _ = backlog_of(a=3)
    backlog.hand_out(cast(FuserSupervisor, Fuser(4)))
    backlog.restart({})
    assert handed_out(backlog, 9) == [("a", 1), ("a", 2), ("a", 3)]


def test_accounts_of_clients_are_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tsfusion.gateway.records.journaled_records._MAX_CLIENTS", 8)
    time = FuserTime()
    for index in range(100):
        time.charge(f"client {index}", index)
        time.settle(index, 0.01)
    assert len(time._accounts) == 8


def test_who_comes_anew_each_time_does_not_go_before_who_was_there() -> None:
    """Without keys a session counts as a client, and each of these sends one costly keyframe."""
    time = FuserTime()
    waiting = ["scanner"]
    seconds = {"scanner": 0.01}
    served: list[str] = []
    for index in range(60):
        if index % 3 == 0:  # as fast as one is served
            waiting = [name for name in waiting if name != "scanner"]
            waiting.append("scanner")
        waiting.append(f"stranger {index}")
        name = time.next_of(waiting)
        waiting.remove(name)
        time.charge(name, index)
        time.settle(index, seconds.get(name, 1.0))
        served.append(name)
    assert [at for at, name in enumerate(served) if name == "scanner"] == list(range(0, 60, 3))


def test_delays_are_published_with_their_bound() -> None:
    delays = DelayStatistics()
    assert (delays.summary().count, delays.bound_ms) == (0, 0.0)
    for delay_ns, bound_ns in ((5_000_000, 100_000), (7_000_000, 300_000)):
        delays.add(delay_ns, bound_ns)
    assert (delays.summary().mean, delays.bound_ms) == (6.0, 0.3)


def test_a_delay_that_cannot_be_does_not_count() -> None:
    delays = DelayStatistics()
    day = 86_400 * 10**9
    assert [delays.add(delay, 1000) for delay in (-1000, day, -1001, day + 1, -(1 << 62))] == [
        *(True, True, False, False, False)
    ]
    assert delays.summary().count == 2


class Told:
    """Routes to a client that is connected, which note what it is told."""

    def __init__(self) -> None:
        self.nacks: list[int] = []

    def get(self, session: bytes) -> Any:
        return SimpleNamespace(state=lambda _: "connected", left=False, fates=RecentFates())

    def send(self, session: bytes, message: Any) -> None:
        self.nacks += [message.seq] if hasattr(message, "reason") else []


def test_what_a_checkpoint_holds_of_rejected_keyframes_is_not_remembered(tmp_path: Path) -> None:
    index, sessions = index_of(*((1, seq, SESSION, seq) for seq in range(1, 5_001)))
    told = Told()
    quarantine, journal = Quarantine(tmp_path, 1 << 20), SimpleNamespace(folder=tmp_path)
    records = SimpleNamespace(index=index, sessions=sessions, journal=journal, quarantine=quarantine)
    outcomes = KeyframeOutcomes("default", cast("MapRecords", records), cast("ClientRoutes", told), Metrics())
    most = 0
    for at in range(len(index)):
        outcomes.on_done(Done(at, 1, 2, NO_SAMPLES))
        if at % 100 == 99:
            outcomes.on_checkpoint()
        remembered = [one for one in vars(outcomes).values() if isinstance(one, set)]
        most = max(most, sum(map(len, remembered)))
    assert most <= 201
    assert told.nacks == [*range(1, 5_001)]
    outcomes.on_done(Done(4_950, 1, 2, NO_SAMPLES))  # by a fuser that began with the one before
    assert len(told.nacks) == 5_000
