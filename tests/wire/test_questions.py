# SPDX-License-Identifier: MIT
"""Questions on their way, and at the door of a server: whatever they ask, it finds a reason or none."""

import random

import fake_server
import msgspec
import numpy as np
import odd_questions
import pytest

from tsfusion.core.errors import AnswerLate
from tsfusion.geometry.map_questions import Slice
from tsfusion.wire.asking.map_client import MapClient
from tsfusion.wire.asking.queries import CommandRefused
from tsfusion.wire.messages.messages import Command, Reply
from tsfusion.wire.messages.questions import Question


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


def test_a_server_is_greeted_once_and_again_where_it_does_not_answer() -> None:
    pings: list[Command] = []
    told: list[Reply | None] = [Reply(name="ask", error="no")] * 3
    with (
        fake_server.serving(lambda one: _numbered(told.pop(0), one), pings) as (control, asked),
        MapClient("tcp://127.0.0.1:1", control=control, timeout=10.0) as client,
    ):
        for _ in range(3):
            with pytest.raises(CommandRefused):
                client.sample(np.zeros((1, 3)))
        assert (len(asked), len(pings)) == (3, 1)
        told += [None]
        with pytest.raises(AnswerLate):
            client.sample(np.zeros((1, 3)), timeout=0.2)
        assert len(pings) == 2, "it is there, and its map is late"


def _numbered(reply: Reply | None, command: Command) -> Reply | None:
    return None if reply is None else msgspec.structs.replace(reply, number=command.number)
