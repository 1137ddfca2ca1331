# SPDX-License-Identifier: MIT
"""The client's stamps: one row a keyframe, memory of one size, whatever a server says."""

from tsfusion.delivery.timing import CAPACITY, KeyframeTimesTable
from tsfusion.wire.keyframe_times import KeyframeTimes, Stamps


def test_a_row_fills_up_as_news_come() -> None:
    times = KeyframeTimesTable()
    times.add(5, timestamp_ns=1, captured_ns=2)
    times.sent(5, 3)
    times.stamp(Stamps(5, 110, 120), 100, 7)
    times.stamp(Stamps(5, 111, 121, 130, 140), 100, 6)  # the first of each counts
    assert times.copy() == [
        KeyframeTimes(
            seq=5, timestamp_ns=1, captured_ns=2, sent_ns=3, received_ns=10, durable_ns=20, fuse_start_ns=30,
            fused_ns=40, clock_bound_ns=6,
        )
    ]  # fmt: skip


def test_strangers_and_removed_keyframes_have_no_row() -> None:
    times = KeyframeTimesTable()
    times.add(5, timestamp_ns=1, captured_ns=2)
    times.add(6, timestamp_ns=1, captured_ns=2)
    times.remove(5)
    for seq in (0, 5, 6 + CAPACITY, 1 << 62):
        times.sent(seq, 3)
        times.stamp(Stamps(seq, 1, 1, 1, 1, 1), 0, 0)
        times.remove(seq)
    assert times.copy() == [KeyframeTimes(seq=6, timestamp_ns=1, captured_ns=2)]


def test_the_oldest_rows_go_first() -> None:
    times = KeyframeTimesTable()
    for seq in range(1, CAPACITY + 101):
        times.add(seq, timestamp_ns=seq, captured_ns=0)
    kept = [row.seq for row in times.copy()]
    assert (kept[0], kept[-1], len(kept)) == (101, CAPACITY + 100, CAPACITY)


def test_impossible_stamps_do_no_harm() -> None:
    times = KeyframeTimesTable()
    times.add(1, timestamp_ns=0, captured_ns=0)
    times.stamp(Stamps(1, 1 << 64, -(1 << 63), 5, 1 << 63), 1 << 62, 1 << 70)
    (row,) = times.copy()
    assert row.fuse_start_ns == 5 - (1 << 62)
