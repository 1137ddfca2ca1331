# SPDX-License-Identifier: MIT
"""Problems as a person names them: told while they last, and since when; logged at begin and end."""

import logging
import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from health_snapshots import map_health
from keyframes_and_servers import pose
from served_gateway import Served, hosting, record

from tsfusion.core import process
from tsfusion.gateway.clients import client_routes
from tsfusion.gateway.clients.client_routes import ClientRoute, RecentFates
from tsfusion.gateway.fusers import fuser_supervisor
from tsfusion.gateway.fusers.fuser_supervisor import FuserSilence
from tsfusion.gateway.health.problems import Problem, ProblemTimes, span
from tsfusion.gateway.maps import map_condition


class Clock:
    """A clock that stands until it is moved."""

    now = 1000.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """The clock of what measures here."""
    made = Clock()
    for module in (client_routes, fuser_supervisor):
        monkeypatch.setattr(module.time, "monotonic", made)
    return made


# --- their times ---


def test_a_problem_is_logged_when_it_begins_and_when_it_ends(caplog: pytest.LogCaptureFixture) -> None:
    clock = Clock()
    times = ProblemTimes(clock)
    caplog.set_level(logging.INFO)

    def stalled(waiting: int) -> Problem:
        return Problem(f"{waiting} keyframes wait", "yard-2")

    other = Problem("no disk", "yard-3", is_logged=True)
    for second in range(90):
        found = [stalled(second), *([other] if second > 30 else [])]
        times.note(found)
        clock.now += 1.0
    assert times.lines(found) == (
        "map yard-2: 89 keyframes wait (for 90 s)",
        "map yard-3: no disk (for 59 s)",
    )
    clock.now += 110.0
    times.note([other])
    times.note([])
    assert [(record.levelname, record.getMessage()) for record in caplog.records] == [
        ("WARNING", "problem: 0 keyframes wait"),
        ("INFO", "no longer a problem, after 3 min: 89 keyframes wait"),
    ]


@pytest.mark.parametrize(
    ("seconds", "words"),
    [(0.4, "0 s"), (119.0, "119 s"), (7100.0, "118 min"), (9000.0, "2 h"), (2e5, "2 days")],
)
def test_spans_are_short(seconds: float, words: str) -> None:
    assert span(seconds) == words


# --- a client of which nothing comes into the map ---


def test_next_to_all_turned_away_for_a_minute(clock: Clock) -> None:
    fates = RecentFates()
    fates.turned_away("too far")
    fates.turned_away("too far")
    assert fates.problem() == "", "two may be chance"
    fates.turned_away("too far")
    assert fates.problem() == "none of its 3 keyframes of the last minute came into the map: too far"
    fates.fused()
    assert fates.problem() == ""
    for _ in range(20):
        clock.now += 1.0
        fates.turned_away("too far")
    assert fates.problem().startswith("next to none of its 24 keyframes")
    clock.now += 61.0
    assert fates.problem() == "", "it sends nothing any more"


def test_few_turned_away_among_many_are_no_problem(clock: Clock) -> None:
    fates = RecentFates()
    for _ in range(100):
        clock.now += 0.5
        fates.turned_away("no samples")
        fates.fused()
    assert fates.problem() == ""


def test_all_held_off_for_a_while(clock: Clock) -> None:
    route = ClientRoute(bytes(16), "yard", b"c", "robot1")
    for _ in range(12):
        route.fates.held()
        route.hold_reason, route.hold_message = "quota", "the server takes 1 keyframe a second"
        clock.now += 1.0
    problem = route.problem
    assert problem is not None
    assert problem.line == (
        "map yard: client robot1, session 00000000: every keyframe is held off: the server takes 1 keyframe "
        "a second"
    )
    route.hold_reason = "disk"
    assert route.problem is None, "its map tells that already"
    route.hold_reason = "quota"
    route.fates.taken()
    assert route.problem is None


def test_a_client_of_which_everything_is_refused_is_a_problem_and_the_server_ready(tmp_path: Path) -> None:
    def send(served: Served, seqs: range, z: float) -> list[str]:
        for seq in seqs:
            served.take(record(seq, previous=0, T_world_camera=pose(z=z)))
        served.step()
        served.until(lambda: served.gateway.maps.drained)
        return [one for one in served.gateway.health().problems if "a sensor may be" in one]

    with hosting(tmp_path, quota_extent=1.0) as served:  # for sensors within a metre
        served.greet()
        (line,) = send(served, range(1, 6), 5.0)
        assert line.startswith("map default: client at an unknown address, session 00000000: none of its 5")
        assert served.gateway.health().ready
        assert send(served, range(6, 7), 0.0) == []


@pytest.mark.parametrize(("problems", "blocked"), [(["", "stuck"], False), (["stuck"], True), ([], False)])
def test_a_server_with_a_good_map_is_ready(problems: list[str], blocked: bool) -> None:
    maps = {f"map{number}": map_health(problem=problem) for number, problem in enumerate(problems)}
    assert map_condition.all_blocked(maps) == blocked


# --- a fuser that does nothing ---


def test_only_time_in_which_it_could_work_is_a_processes_own(clock: Clock) -> None:
    fuser: Any = SimpleNamespace()
    silence = FuserSilence()

    def pass_time(seconds: int, state: str, *, owes: bool = True) -> tuple[float, float, float]:
        fuser.state = state
        for _ in range(4 * seconds):
            clock.now += 0.25
            silence.look(fuser, owes=owes)
        return silence.working, silence.stopped, silence.disk

    assert pass_time(3, "S") == (3.0, 0.0, 0.0)
    assert pass_time(5, "T") == (3.0, 5.0, 0.0)
    assert pass_time(2, "D") == (3.0, 0.0, 2.0)
    clock.now += 3600.0  # a suspended machine
    assert pass_time(1, "R") == (3.0 + 1.0 + 0.75, 0.0, 2.0)
    assert pass_time(1, "S", owes=False) == (0.0, 0.0, 0.0)
    assert pass_time(1, "t", owes=False) == (0.0, 1.0, 0.0)
    silence.answered()
    assert pass_time(0, "R") == (0.0, 0.0, 0.0)


def test_the_system_tells_a_processes_state() -> None:
    assert process.state(os.getpid()) in ("R", "S")
    assert process.state(2**22 + 1) == ""
