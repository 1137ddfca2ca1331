# SPDX-License-Identifier: MIT
"""Corrections move the map: settled, it is the one that its keyframes make at their final poses."""

import errno
from collections.abc import Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec
import numpy as np
import pytest
from corrected_maps import final_keyframes, fresh_map
from formula_scenes import free_space, volume_of
from hypothesis import settings as given_settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, rule, run_state_machine_as_test
from keyframes_and_servers import VOLUME, pose, wall
from test_fuser import Link, is_due, opened

from tsfusion import Keyframe, Volume, journal
from tsfusion.core.config import SERVER_SESSION
from tsfusion.fuser import fuser_messages
from tsfusion.fuser.fuser import Fuser
from tsfusion.gateway.clients.client_routes import Sessions
from tsfusion.gateway.records.journaled_records import KeyframeIndex
from tsfusion.journal import Journal, Position
from tsfusion.wire.messages.forget_messages import Selection
from tsfusion.wire.records import codec, corrections

SESSIONS = (b"a" * 16, b"b" * 16)


class Recorded:
    """A journal, and the orders to fuse it."""

    def __init__(self, state: Path, segment_bytes: int = 1 << 20) -> None:
        self.state = state
        self.journal = Journal(state / "journal", segment_bytes)
        self.orders: list[fuser_messages.Fuse] = []
        self.keyframes: dict[bytes, list[int]] = {session: [] for session in SESSIONS}
        self._seqs = dict.fromkeys(SESSIONS, 0)

    def add(self, session: bytes = SESSIONS[0]) -> None:
        keyframe = wall(sum(map(len, self.keyframes.values())))
        encode = partial(codec.encode, keyframe, jpeg_quality=90)
        self.keyframes[session].append(self._append(session, encode))

    def correct(
        self,
        moves: dict[int, Any],
        removed: tuple[int, ...] = (),
        T: Any = None,
        session: bytes = SESSIONS[0],
    ) -> None:
        correction = corrections.checked(moves, removed=removed, T_map_odometry=T)
        self._append(session, partial(corrections.encode, correction))

    def forget(self, session: bytes, seqs: Any) -> None:
        """Write what the gateway writes for keyframes that are to be forgotten."""
        content = corrections.forgetting(session, np.array(seqs, np.int64))
        self._append(SERVER_SESSION, partial(corrections.encode, content))

    def _append(self, session: bytes, encode: Any) -> int:
        self._seqs[session] = seq = self._seqs.get(session, 0) + 1
        position = self.journal.append(encode(session=session, seq=seq), session=session, seq=seq)
        self.orders.append(fuser_messages.Fuse(len(self.orders), position, session, seq, ""))
        return seq

    def fresh(self) -> Volume:
        return fresh_map(self.state / "journal", VOLUME.voxel_size)


def find(fuser: Fuser, link: Link, **selection: Any) -> fuser_messages.Found:
    """The keyframes of a selection."""
    index, sessions, folder = KeyframeIndex(), Sessions(), fuser._folder / "journal"
    for number in journal.segments(folder):
        index.recover(journal.list_records(journal.segment_path(folder, number))[0], sessions)
    fuser.handle(index.select(7, Selection(**selection), sessions))
    while is_due(fuser, "search"):
        fuser.chores["search"].do()
    found = link.last()
    assert isinstance(found, fuser_messages.Found)
    return found


def found_numbers(found: fuser_messages.Found) -> dict[bytes, list[int]]:
    """The numbers that were found and are not forgotten, by session."""
    return {one.session: one.new.tolist() for one in found.sessions}


def positions(found: fuser_messages.Found) -> list[Position]:
    """Where the records are that were found."""
    return [place for one in found.sessions for place in one.positions]


def settle(fuser: Fuser) -> int:
    """Move what waits; the number of moves."""
    moves = 0
    while is_due(fuser, "move"):
        fuser.chores["move"].do()
        moves += 1
    return moves


def progress(link: Link) -> fuser_messages.CorrectionProgress:
    return [message for message, _ in link.sent if isinstance(message, fuser_messages.CorrectionProgress)][-1]


@pytest.fixture
def recorded(tmp_path: Path) -> Iterator[Recorded]:
    found = Recorded(tmp_path)
    for _ in range(4):
        found.add()
    yield found
    found.journal.close()


def fused(recorded: Recorded, first: int = 0, **begin: Any) -> tuple[Fuser, Link]:
    fuser, link = opened(recorded.state, **begin)
    for order in recorded.orders[first:]:
        fuser.handle(order)
    return fuser, link


def test_corrected_keyframes_are_fused_where_they_were_taken(recorded: Recorded) -> None:
    recorded.correct({1: pose(0.5), 3: pose(-0.2)}, removed=(2,), T=pose(0.1))
    recorded.add()
    fuser, link = fused(recorded)
    assert (progress(link).waiting, progress(link).keyframes) == (3, 4)
    assert settle(fuser) == 3
    last = progress(link)
    assert (last.waiting, last.keyframes, last.removed, last.moved) == (0, 4, 1, 3)
    assert fuser._volume.map_hash() == recorded.fresh().map_hash()
    assert fuser._volume.color_hash() == recorded.fresh().color_hash()
    assert free_space(fuser._volume) == free_space(recorded.fresh())
    assert is_due(fuser, "mesh")


def test_what_was_removed_comes_back_where_a_later_correction_says(recorded: Recorded) -> None:
    recorded.correct({}, removed=(1, 2))
    fuser, link = fused(recorded)
    settle(fuser)
    recorded.correct({2: pose(0.3)})
    fuser.handle(recorded.orders[-1])
    settle(fuser)
    assert progress(link).removed == 1
    assert fuser._volume.map_hash() == recorded.fresh().map_hash()


def test_what_is_removed_twice_is_one_move(recorded: Recorded) -> None:
    recorded.correct({3: pose(1.0)}, removed=(2,))
    recorded.correct({}, removed=(2,))
    fuser, _ = fused(recorded)
    pending = fuser._mover.pending
    assert sum(pending._is_valid(entry) for entry in pending._heap) == 2
    settle(fuser)
    assert fuser._volume.map_hash() == recorded.fresh().map_hash()


def test_the_farthest_move_first_and_none_that_is_none(recorded: Recorded) -> None:
    recorded.correct({1: wall(0).T_world_camera, 2: pose(0.05), 3: pose(3.0), 4: pose(1.0)})
    fuser, _ = fused(recorded)
    order = []
    while (move := fuser._mover.pending.next()) is not None:
        order.append(move.seq)
        fuser.chores["move"].do()
    assert order == [3, 4, 2]


def test_a_checkpoint_knows_where_each_keyframe_was_fused(recorded: Recorded) -> None:
    recorded.correct({1: pose(0.5), 2: pose(0.7), 4: pose(-0.4)}, removed=(3,), T=pose(0, 1.0))
    fuser, _ = fused(recorded)
    fuser.chores["move"].do()
    fuser.handle(fuser_messages.Save())
    fuser.chores["move"].do()  # this one is lost
    recorded.add()
    again, _ = fused(recorded, first=5)
    assert again.ready().moves is not None
    assert again.ready().moves.waiting == 3
    assert settle(again) == 3
    assert again._volume.map_hash() == recorded.fresh().map_hash()


def test_moves_wait_for_keyframes_and_take_a_part_of_the_time(
    recorded: Recorded, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorded.correct({1: pose(0.5), 2: pose(0.7)})
    fuser, _ = fused(recorded)
    now = 1000.0
    monkeypatch.setattr("tsfusion.fuser.pose_mover.time.monotonic", lambda: now)
    fuser.chores["move"].do()
    monkeypatch.setattr("tsfusion.fuser.pose_mover.time.monotonic", lambda: now + 100.0)
    assert is_due(fuser, "move", idle=False)


def test_a_keyframe_that_left_the_journal_stays_and_is_counted(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    recorded = Recorded(tmp_path, segment_bytes=1)
    for _ in range(4):
        recorded.add()
    recorded.correct({1: pose(0.5), 2: pose(0.6), 4: pose(0.7)})
    fuser, link = fused(recorded)
    recorded.journal.close()
    for number in (1, 2):
        (tmp_path / "journal" / f"{number:06d}.mcap").unlink()
    settle(fuser)
    last = progress(link)
    assert (last.waiting, last.unavailable, last.keyframes) == (0, 2, 4)
    assert caplog.text.count("stays where it was fused") == 1
    stays = volume_of(
        [wall(0), wall(1), wall(2), wall(3, T_world_camera=pose(0.7))], voxel_size=0.04, threads=1
    )
    assert fuser._volume.map_hash() == stays.map_hash()


def test_a_journal_folder_without_any_segment_is_waited_for_and_then_given_up(
    recorded: Recorded, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorded.correct({1: pose(0.5)})
    fuser, link = fused(recorded)
    for path in (recorded.state / "journal").iterdir():
        path.unlink()
    fuser.chores["move"].do()
    assert fuser._mover.waiting == 1
    monkeypatch.setattr("tsfusion.fuser.pose_mover._PATIENCE_S", 0.0)
    fuser.chores["move"].do()
    assert (progress(link).waiting, progress(link).unavailable) == (0, 1)


def test_what_the_journal_deleted_takes_no_room(tmp_path: Path) -> None:
    recorded = Recorded(tmp_path, segment_bytes=1)
    for _ in range(6):
        recorded.add()
    recorded.correct({1: pose(0.5), 2: pose(0.6)}, removed=(3,))
    fuser, link = fused(recorded)
    fuser.chores["move"].do()
    recorded.journal.close()
    for number in range(1, 5):
        (tmp_path / "journal" / f"{number:06d}.mcap").unlink()
    fuser.handle(fuser_messages.Save())
    assert fuser._map.ledger.fused().seqs.tolist() == [5, 6]
    last = progress(link)
    assert (last.waiting, last.unavailable, last.removed, fuser._mover.pending.next()) == (0, 2, 1, None)
    assert not is_due(fuser, "move")
    again, _ = opened(tmp_path)
    assert again.ready().moves == msgspec.structs.replace(progress(link), moved=0, seconds=0.0)
    ledger = again._map.ledger
    assert ledger.correct(SESSIONS[0], corrections.checked({4: pose(1.0), 5: pose(1.0)})) == [5]
    assert (len(ledger.wanted), ledger.unavailable) == (1, 3)


def test_a_journal_that_cannot_be_read_for_now_is_waited_for(
    recorded: Recorded, monkeypatch: pytest.MonkeyPatch
) -> None:
    from tsfusion import journal

    recorded.correct({1: pose(0.5)})
    fuser, link = fused(recorded)
    with monkeypatch.context() as patch:
        patch.setattr(
            journal.segments_module if hasattr(journal, "segments_module") else journal, "read", _eio
        )
        fuser.chores["move"].do()
    assert not is_due(fuser, "move")
    wait = fuser.chores["move"].wait(True)
    assert wait is not None
    assert 0 < wait < 1
    monkeypatch.setattr("tsfusion.fuser.pose_mover.RETRY_S", 0.0)
    fuser._mover._next = 0.0
    assert settle(fuser) == 1
    assert progress(link).unavailable == 0


def _eio(*_: object) -> Any:
    from tsfusion.core.errors import JournalError

    raise JournalError("cannot read", errno.EIO)


def test_a_full_map_keeps_the_keyframe_where_it_is(
    recorded: Recorded, caplog: pytest.LogCaptureFixture
) -> None:
    fuser, link = fused(recorded)
    before = fuser._volume.map_hash()
    fuser._volume.limit_memory(fuser._volume.stats().bytes)
    recorded.correct({1: pose(50.0)})
    fuser.handle(recorded.orders[-1])
    settle(fuser)
    assert (progress(link).waiting, progress(link).unavailable) == (0, 1)
    assert fuser._volume.map_hash() == before
    assert "stays where it was fused, though a correction moves it" in caplog.text


def test_an_earlier_version_did_not_write_down_where_keyframes_were_fused(recorded: Recorded) -> None:
    fuser, _ = fused(recorded)
    fuser._map.ledger.saved = lambda: None  # type: ignore[method-assign, assignment, return-value]
    fuser.handle(fuser_messages.Save())
    recorded.correct({1: pose(0.5), 2: pose(0.5)})
    recorded.add()
    recorded.correct({6: pose(0.5)})
    again, link = fused(recorded, first=4)
    settle(again)
    last = progress(link)
    assert (last.waiting, last.unavailable, last.moved) == (0, 2, 1)
    again.handle(fuser_messages.Save())
    assert opened(recorded.state)[0].ready().moves.unavailable == 2  # type: ignore[union-attr]


def test_a_forgotten_keyframe_never_comes_back(recorded: Recorded) -> None:
    recorded.forget(SESSIONS[0], [2, 3, 6, 7])
    recorded.correct({1: pose(0.2), 2: pose(0.3)})
    fuser, link = fused(recorded)
    assert progress(link).waiting == 3
    settle(fuser)
    recorded.add()  # number 6: it comes late
    recorded.correct({3: pose(0.4)})
    recorded.add()
    for order in recorded.orders[6:]:
        fuser.handle(order)
    assert settle(fuser) == 0
    last = fuser.ready().moves
    assert last is not None
    assert (last.keyframes, last.removed, last.forgotten, last.waiting, last.unavailable) == (3, 3, 3, 0, 0)
    assert fuser._volume.map_hash() == recorded.fresh().map_hash()
    assert fuser._map.ledger.fused().seqs.tolist() == [1, 4, 8]


def test_forgetting_takes_effect_before_its_keyframes_are_fused(recorded: Recorded) -> None:
    recorded.forget(SESSIONS[0], [1, 2])
    fuser, link = opened(recorded.state)
    for order in (recorded.orders[-1], *recorded.orders[:-1]):
        fuser.handle(order)
    assert (fuser._volume.keyframes, progress(link).removed, progress(link).forgotten) == (2, 2, 2)
    assert fuser._volume.map_hash() == recorded.fresh().map_hash()


def test_a_box_selects_by_the_newest_poses_and_by_nearly_all_points(recorded: Recorded) -> None:
    recorded.correct({2: pose(5.0)})
    fuser, link = fused(recorded)
    everything = (-9.0, -9.0, -9.0, 3.0, 9.0, 9.0)
    assert found_numbers(find(fuser, link, box=everything)) == {SESSIONS[0]: [1, 3, 4]}
    behind_the_wall = (3.0, 9.0, 1.0, -9.0, -9.0, -9.0)
    assert find(fuser, link, box=behind_the_wall).sessions == ()
    assert found_numbers(find(fuser, link, box=(-0.8, -9.0, -1.0, 9.0, 9.0, 9.0))) == {SESSIONS[0]: [2, 3, 4]}


def test_numbers_and_the_beginning_of_an_id_mean_one_session(recorded: Recorded) -> None:
    recorded.add(SESSIONS[1])
    fuser, link = fused(recorded)
    assert "several sessions have keyframes of these numbers" in find(fuser, link, numbers=((1, 2),)).error
    assert "several sessions begin with 6" in find(fuser, link, session="6").error
    assert found_numbers(find(fuser, link, session="61", numbers=((2, 3),))) == {SESSIONS[0]: [2, 3]}


def test_seconds_count_from_the_last_record_of_a_scanner(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recorded = Recorded(tmp_path, segment_bytes=1)
    for second in range(5):
        clock_ns = 10**18 + second * 10**9 if second < 4 else 2 * 10**18
        monkeypatch.setattr("tsfusion.journal.mcap_layout.wall_clock_ns", lambda ns=clock_ns: ns)
        if second < 4:
            recorded.add()
        else:
            recorded.forget(SESSIONS[0], [1])
    fuser, link = fused(recorded)
    assert found_numbers(find(fuser, link, since_ns=-(10**9))) == {SESSIONS[0]: [3, 4]}
    assert found_numbers(find(fuser, link, until_ns=-2 * 10**9)) == {SESSIONS[0]: [2]}


def test_keyframes_that_the_journal_lost_cannot_be_forgotten_and_that_is_said(tmp_path: Path) -> None:
    recorded = Recorded(tmp_path, segment_bytes=1)
    for _ in range(4):
        recorded.add()
    fuser, link = fused(recorded)
    recorded.journal.close()
    for number in (1, 2):
        (tmp_path / "journal" / f"{number:06d}.mcap").unlink()
    fuser.handle(fuser_messages.Save())
    found = find(fuser, link, session=SESSIONS[0].hex())
    assert found_numbers(found) == {SESSIONS[0]: [3, 4]}
    assert found.unavailable == ("61616161 up to number 2",)


def test_a_checkpoint_that_is_to_be_alone_replaces_the_one_before(recorded: Recorded) -> None:
    fuser, link = fused(recorded, keep_previous=True)
    fuser.handle(fuser_messages.Save())
    recorded.forget(SESSIONS[0], [1])
    fuser.handle(recorded.orders[-1])
    settle(fuser)
    previous = recorded.state / "map.previous.tsf"
    fuser.handle(fuser_messages.Save(alone=True))
    assert link.last() == fuser_messages.Saved(written=True, alone=True)
    assert previous.read_bytes() == (recorded.state / "map.tsf").read_bytes()
    recorded.add()
    fuser.handle(recorded.orders[-1])
    fuser.handle(fuser_messages.Save())
    assert opened(recorded.state)[0].ready().keyframes == 4
    previous.replace(recorded.state / "map.tsf")
    assert opened(recorded.state)[0].ready().keyframes == 3


def expired(link: Link) -> fuser_messages.Found | None:
    """The last message of keyframes that are too old or too far away."""
    found = [one for one, _ in link.sent if isinstance(one, fuser_messages.Found)]
    return next((one for one in reversed(found) if one.number == fuser_messages.EXPIRED), None)


def journal_expired(recorded: Recorded, fuser: Fuser, link: Link) -> None:
    """Do as the gateway does with keyframes that are to leave."""
    while is_due(fuser, "search"):
        before = len(link.sent)
        fuser.chores["search"].do()
        for found in (one for one, _ in link.sent[before:] if isinstance(one, fuser_messages.Found)):
            for session, seqs in found_numbers(found).items():
                recorded.forget(session, seqs)
                fuser.handle(recorded.orders[-1])
    settle(fuser)


@pytest.mark.parametrize(
    ("bound", "stay"),
    [
        ({"keep_keyframes": 3}, [4, 5, 6]),
        ({"keep_radius": 0.07}, [4, 5, 6]),
        ({"keep_seconds": 25.0}, [4, 5, 6]),
        ({"keep_keyframes": 5, "keep_radius": 0.04}, [5, 6]),
    ],
)
def test_a_map_of_what_is_now_keeps_a_window(
    tmp_path: Path, bound: dict[str, Any], stay: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    recorded = Recorded(tmp_path)
    for number in range(6):
        clock_ns = 10**18 + number * 10**10
        monkeypatch.setattr("tsfusion.journal.mcap_layout.wall_clock_ns", lambda ns=clock_ns: ns)
        recorded.add()
    fuser, link = fused(recorded, **bound)
    assert progress(link).waiting == 1  # nobody takes it for settled
    journal_expired(recorded, fuser, link)
    assert fuser._map.ledger.fused().seqs.tolist() == stay
    assert progress(link).waiting == 0
    assert fuser._volume.map_hash() == recorded.fresh().map_hash()
    fuser.handle(fuser_messages.Save())
    again, link = opened(tmp_path, **bound)
    journal_expired(recorded, again, link)
    assert expired(link) is None


def test_a_window_counts_all_sessions_and_goes_by_corrected_poses(recorded: Recorded) -> None:
    recorded.add(SESSIONS[1])
    fuser, link = fused(recorded, keep_radius=1.0)
    journal_expired(recorded, fuser, link)
    assert expired(link) is None
    recorded.correct({1: pose(3.0)})
    fuser.handle(recorded.orders[-1])
    journal_expired(recorded, fuser, link)
    assert found_numbers(expired(link) or fuser_messages.Found(0)) == {SESSIONS[0]: [1]}
    assert fuser._volume.map_hash() == recorded.fresh().map_hash()


def test_a_journal_at_its_limit_takes_the_oldest_from_the_window(tmp_path: Path) -> None:
    recorded = Recorded(tmp_path, segment_bytes=1)
    for _ in range(4):
        recorded.add()
    fuser, link = fused(recorded, keep_keyframes=100)
    journal_expired(recorded, fuser, link)
    assert (expired(link), progress(link).first_segment) == (None, 1)
    fuser.handle(fuser_messages.Expire(3))
    journal_expired(recorded, fuser, link)
    assert (progress(link).keyframes, progress(link).first_segment) == (2, 3)
    assert fuser._volume.map_hash() == recorded.fresh().map_hash()


OTHERS = [wall(40), wall(41)]  # of a map from elsewhere


def _hash(keyframes: list[Keyframe]) -> str:
    return volume_of(keyframes, voxel_size=VOLUME.voxel_size, threads=1).map_hash()


class Life(RuleBasedStateMachine):
    """A map whose server is killed and started again while keyframes come, are corrected and forgotten.

    In the end it is merged with another.
    """

    @initialize()
    def begin(self) -> None:
        self.stack = ExitStack()
        self.recorded = Recorded(Path(self.stack.enter_context(TemporaryDirectory())))
        self.stack.callback(self.recorded.journal.close)
        self.fuser, self.link = opened(self.recorded.state)

    def _fuse(self) -> None:
        self.fuser.handle(self.recorded.orders[-1])

    @rule(session=st.sampled_from(SESSIONS))
    def keyframe(self, session: bytes) -> None:
        if len(self.recorded.orders) < 30:
            self.recorded.add(session)
            self._fuse()

    @rule(session=st.sampled_from(SESSIONS), draw=st.data())
    def correct(self, session: bytes, draw: st.DataObject) -> None:
        known = self.recorded.keyframes[session]
        if not known:
            return
        fates = draw.draw(st.dictionaries(st.sampled_from(known), st.integers(-4, 12)))
        moves = {seq: pose(0.05 * fate, 0.02 * fate) for seq, fate in fates.items() if fate <= 9}
        T = draw.draw(st.sampled_from([None, pose(0.1), pose(0.0, -0.1)]))
        self.recorded.correct(moves, tuple(seq for seq in fates if seq not in moves), T, session)
        self._fuse()

    @rule(draw=st.data())
    def forget(self, draw: st.DataObject) -> None:
        found = self._find(draw)
        for session, seqs in found_numbers(found).items():
            self.recorded.forget(session, seqs)
            self._fuse()

    @rule(draw=st.data())
    def erase(self, draw: st.DataObject) -> None:
        found = self._find(draw)
        for session, seqs in found_numbers(found).items():
            self.recorded.forget(session, seqs)
            self._fuse()
        settle(self.fuser)
        self.fuser.handle(fuser_messages.Save(alone=True))
        if found.sessions:
            for _ in self.recorded.journal.erase(positions(found)):
                pass

    def _find(self, draw: st.DataObject) -> fuser_messages.Found:
        """Keyframes by one of the ways to select them, or by two."""
        logged = sorted(
            record.logged_ns
            for number in journal.segments(self.recorded.state / "journal")
            for record in journal.records(journal.segment_path(self.recorded.state / "journal", number))
        )
        numbers = st.integers(1, 12)
        times = st.sampled_from(logged or [0]) | st.just(-1)
        ways = {
            "session": st.sampled_from(SESSIONS).map(bytes.hex),
            "client": st.sampled_from(["", "nobody"]),
            "since_ns": times,
            "until_ns": times,
            "numbers": st.lists(numbers, min_size=1, max_size=3).map(
                lambda all_: tuple((n, n) for n in all_)
            ),
            "box": st.floats(-1.2, 0.2).map(lambda x: (x, -9.0, -9.0, 9.0, 9.0, 9.0)),
        }
        names = draw.draw(st.lists(st.sampled_from(sorted(ways)), min_size=1, max_size=2, unique=True))
        if "numbers" in names and "session" not in names:
            names.append("session")
        return find(self.fuser, self.link, **{name: draw.draw(ways[name]) for name in names})

    @rule(count=st.integers(1, 3))
    def move(self, count: int) -> None:
        for _ in range(count):
            if is_due(self.fuser, "move"):
                self.fuser.chores["move"].do()

    @rule()
    def save(self) -> None:
        self.fuser.handle(fuser_messages.Save())

    @rule(saved=st.booleans())
    def restart(self, saved: bool) -> None:
        if saved:
            self.fuser.handle(fuser_messages.Finish())
        self.fuser, self.link = opened(self.recorded.state)
        done = self.fuser.ready().done
        # Not in the journal's order: each session in its own.
        for order in sorted(self.recorded.orders, key=lambda one: one.session, reverse=saved):
            if order.session not in done or order.seq > done[order.session].seq:
                self.fuser.handle(order)

    def teardown(self) -> None:
        if not hasattr(self, "recorded"):
            return
        settle(self.fuser)
        assert self.fuser._volume.map_hash() == self.recorded.fresh().map_hash()
        assert self.fuser._volume.color_hash() == self.recorded.fresh().color_hash()
        assert free_space(self.fuser._volume) == free_space(self.recorded.fresh())
        final = final_keyframes(self.recorded.state / "journal")
        assert self.fuser._volume.keyframes == len(final)
        self.fuser.handle(fuser_messages.Finish())
        if (self.recorded.state / "map.tsf").exists():
            merged = Volume.load(self.recorded.state / "map.tsf")
            merged.merge(volume_of(OTHERS, voxel_size=VOLUME.voxel_size, threads=1))
            assert merged.map_hash() == _hash([*final, *OTHERS])
        self.stack.close()


@pytest.mark.parametrize(
    "examples", [20, pytest.param(600, marks=pytest.mark.nightly)], ids=["short", "nightly"]
)
def test_a_settled_map_is_that_of_the_final_poses(examples: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Volume, "warming_up", lambda _: iter(()))
    run_state_machine_as_test(
        Life, settings=given_settings(max_examples=examples, stateful_step_count=14, deadline=None)
    )
