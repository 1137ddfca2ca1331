# SPDX-License-Identifier: MIT
"""The index of journaled keyframes: filled by recovery, shortened by retention."""

from tsfusion.gateway.keyframe_index import KeyframeIndex
from tsfusion.gateway.sessions import Sessions
from tsfusion.journal import Position, RecordEntry
from tsfusion.wire.keyframe_times import Stamps

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
    assert [(entry.position.segment, entry.stamps.seq) for entry in entries] == [(1, 1), (1, 1), (1, 2)]
    assert sessions.open(SESSION).durable == 2
    assert [index.after(sessions.open(SESSION), seq) for seq in (0, 1, 2, 9)] == [0, 1, 2, 2]
    assert index.segment(2) == 1


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
