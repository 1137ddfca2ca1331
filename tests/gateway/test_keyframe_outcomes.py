# SPDX-License-Identifier: MIT
"""Statistics of the delay from capture to map."""

from tsfusion.gateway.keyframe_outcomes import DelayStatistics


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
