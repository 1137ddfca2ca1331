# SPDX-License-Identifier: MIT
"""The client's stamps: one row a keyframe, memory of one size, whatever a server says."""

import numpy as np
import pytest

from tsfusion.delivery.outcomes import CAPACITY, ClockOffset, KeyframeTimesTable, TakingRate
from tsfusion.wire.messages.messages import KeyframeTimes, Stamps


def test_a_row_fills_up_as_news_come() -> None:
    times = KeyframeTimesTable()
    times.add(5, timestamp_ns=1, captured_ns=2)
    times.sent(5, 3)
    times.stamp(Stamps(5, 110, 120), 100, 7)
    times.stamp(Stamps(5, 111, 121, 130, 140), 100, 6)  # the first of each counts, with its larger bound
    assert times.copy() == [
        KeyframeTimes(
            seq=5, timestamp_ns=1, captured_ns=2, sent_ns=3, received_ns=10, durable_ns=20, fuse_start_ns=30,
            fused_ns=40, clock_bound_ns=7,
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


def test_the_maps_rate_is_what_it_took_while_it_had_work() -> None:
    rate, now = TakingRate(), 0.0
    for _ in range(20):  # each is there before the next comes: nobody knows how many it could take
        now += 1.0
        rate.note(now, 1, is_more_waiting=False)
    assert rate.per_second is None
    for taken in (1, 1, 2, 1, 1, 2, 1, 1, 2):
        assert rate.per_second is None
        now += 0.125 * taken
        rate.note(now, taken, is_more_waiting=True)
    assert rate.per_second == pytest.approx(8.0)
    rate.note(now + 60.0, 1, is_more_waiting=True)  # a fuser that was stuck, and replaced
    assert rate.per_second == pytest.approx(8.0)
    rate.forget()
    assert rate.per_second is None


@pytest.mark.parametrize("seed", range(5))
def test_the_clock_estimate_stays_within_its_bound(seed: int) -> None:
    """Asymmetric jitter, as on Wi-Fi: the truth lies within half the best round trip."""
    rng = np.random.default_rng(seed)
    true_offset, clock = 3_217_000_000, ClockOffset()
    assert (clock.offset_ns, clock.bound_ns, clock.count) == (None, 0, 0)
    for i in range(40):
        there, work, back = (int(1e6 * value) for value in rng.exponential((2.0, 0.1, 0.5)) + 0.05)
        sent = i * 10**8
        clock.add(
            sent, sent + there + true_offset, sent + there + work + true_offset, sent + there + work + back
        )
        assert clock.offset_ns is not None
        assert abs(clock.offset_ns - true_offset) <= clock.bound_ns
    assert clock.count == 16
