# SPDX-License-Identifier: MIT
"""Questions at the door of a server: whatever they ask, it finds a reason or none, and raises nothing."""

import random

import msgspec
import odd_questions
import pytest

from tsfusion.wire.messages.questions import Question, Slice


@pytest.mark.parametrize("edge", [1e155, 1e300])
def test_a_cell_of_any_size_is_no_error_of_arithmetic(edge: float) -> None:
    """The square of its edge is beyond what numbers can say."""
    one = Slice(kind="occupancy", low=0, high=1, up=(0, 0, 1), box=(0, 0, 1, 1), resolution=edge)
    assert one.problem([]) == ""


@pytest.mark.parametrize("long", [0.0, 1e-7, 1e300])
def test_up_has_a_length_that_can_be_counted_with(long: float) -> None:
    one = Slice(kind="occupancy", low=0, high=1, up=(0, long, long))
    assert "must be a direction" in one.problem([])


def test_odd_questions_are_refused_or_passed_on() -> None:
    rng = random.Random(1)
    reasons = set()
    for _ in range(4000):
        one, frames = odd_questions.drawn(rng)
        came = msgspec.msgpack.decode(msgspec.msgpack.encode(one), type=Question)
        reasons.add(came.problem(frames)[:20])
    assert "" in reasons
    assert len(reasons) > 10
