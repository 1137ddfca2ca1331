# SPDX-License-Identifier: MIT
"""A follower of a map ends with the map's own surface, whatever is lost, late, moved, forgotten or restarted.

Both ends run here, without sockets.
"""

import random
import time
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
from keyframes_and_servers import VOLUME, wall
from watched_surfaces import Held, farthest, fresh

from tsfusion import Keyframe, Volume
from tsfusion.core.config import Surface, override
from tsfusion.core.errors import DecodeError
from tsfusion.fuser import live_mesh, watched_map
from tsfusion.fuser.fuser_messages import FuserQuestion
from tsfusion.fuser.live_mesh import LiveMesh, TouchedBy
from tsfusion.fuser.watched_map import WatchedMap
from tsfusion.journal.ledger import Ledger
from tsfusion.tsdf.surface import changed_cells
from tsfusion.wire.asking.followed_map import FollowedMap
from tsfusion.wire.messages import questions
from tsfusion.wire.messages.messages import Command
from tsfusion.wire.messages.questions import Answer, Cells, MapVersion

SESSIONS = bytes(16), bytes([1] * 16)
STEPS = ("integrate", "retract", "mesh", "refine", "lose", *4 * ["ask"])


class Process:
    """A map, and what the fuser's process answers about it."""

    def __init__(self, volume: Volume, epoch: str) -> None:
        self.volume, self.epoch = volume, epoch
        self.touched_by = TouchedBy()
        self.noted = 0  # times that the gateway was told of changes
        self.live = LiveMesh(volume, interval=0.0, sparing=nullcontext, send=self._note)
        self.answers = WatchedMap(volume, Ledger(), self.touched_by, self.live, epoch)

    def _note(self, _meshed: Any) -> None:
        self.noted += 1

    def add(self, keyframe: Keyframe, session: bytes = SESSIONS[0]) -> None:
        self.touched_by.note(self.volume.version + 1, session)
        self.volume.integrate(keyframe)
        self.live.note_answer()

    def take_away(self, keyframe: Keyframe, session: bytes = SESSIONS[0]) -> None:
        self.touched_by.note(self.volume.version + 1, session)
        self.volume.retract(keyframe)
        self.live.note_move()

    def answer(self, question: Cells) -> tuple[str, dict[str, Any]]:
        """The answer, as it comes over the wire."""
        assert question.problem([]) == ""
        layouts, frames, crc, *_ = self.answers.cells(question, compress=True)
        answer = Answer(arrays=layouts, state=MapVersion(keyframes=0, epoch=self.epoch), crc=crc)
        decoded = msgspec.msgpack.decode(msgspec.msgpack.encode(answer), type=Answer)
        return self.epoch, questions.unpack(decoded, frames)

    def keep(self, number: int, question: Cells, wait_s: float = 1e9) -> bool:
        """Ask as a viewer that waits; True if it does."""
        asked = Command(name="ask", question=msgspec.structs.replace(question, wait_s=wait_s))
        return self.answers.keep_waiting(FuserQuestion(number, asked, time.monotonic_ns(), 1 << 62))

    def due(self) -> list[int]:
        """The questions of viewers that wait and have an answer now."""
        return [one.number for one in self.answers.take_due()]

    def note(self) -> None:
        """Do what the fuser does after a keyframe."""
        if self.live.wait(idle=True) == 0:
            self.live.update()

    def refine(self) -> bool:
        """Refine some cells, if some lack it, as long as a viewer waits."""
        self.live.is_held = True
        waits = self.live.refine_wait() is not None
        if waits:
            self.live.refine()
        return waits


class Follower:
    """Somebody who follows the map of a process."""

    def __init__(self) -> None:
        self.map, self.held = FollowedMap("default"), Held()

    def ask(self, process: Process) -> bool:
        """Ask one question. True if another one has an answer at once."""
        answer = process.answer(self.map.question())
        self.held.take(self.map.on_cells(*answer))
        return bool(answer[1]["more"])

    def catch_up(self, process: Process) -> None:
        """Let nothing happen for a while."""
        process.note()
        while True:
            while self.ask(process):
                pass
            if not process.refine():
                return


def opened(surface: Surface, epoch: str = "a") -> Process:
    return Process(Volume(override(VOLUME, surface=surface)), epoch)


def check(held: Held, volume: Volume) -> None:
    """What is held is the map's surface, as its settings say."""
    expected = fresh(volume)
    assert not held.raw
    assert held.voxel_size == volume.config.voxel_size
    if volume.model.surface == "field":  # solved in other batches
        assert farthest(held.surfaces, expected) < 0.1 * volume.config.voxel_size
    else:
        assert held.surfaces == expected


@pytest.mark.parametrize("surface", ["raw", "normal", "field"])
def test_early_and_late_followers_hold_the_same(surface: Surface) -> None:
    process = opened(surface)
    early, late = Follower(), Follower()
    assert not early.ask(process)
    assert (early.held.cleared, early.held.updates) == (1, 0)  # an empty map lacks nothing
    for i in range(4):
        process.add(wall(12 * i), SESSIONS[i % 2])
        process.note()
        while early.ask(process):
            pass
        assert early.held.surfaces == fresh(process.volume, "raw")
    assert {early.held.client[cell] for cell in early.held.surfaces} == {*SESSIONS}
    while late.ask(process):
        pass
    assert late.held.surfaces == fresh(process.volume, "raw")
    known = {cell: early.held.client[cell] for cell in late.held.surfaces}
    assert known == {cell: late.held.client[cell] for cell in late.held.surfaces}
    early.catch_up(process)
    late.catch_up(process)
    check(early.held, process.volume)
    check(late.held, process.volume)
    assert early.held.cleared == late.held.cleared == 1


def test_what_there_was_no_memory_to_note_comes_later(monkeypatch: pytest.MonkeyPatch) -> None:
    process, follower = opened("field"), Follower()
    follower.catch_up(process)

    def full(*_: Any, **__: Any) -> None:
        raise MemoryError

    with monkeypatch.context() as patched:
        patched.setattr(changed_cells.ChangedCells, "follow", full)
        process.add(wall(0))
        process.note()
    process.add(wall(40))
    process.note()
    follower.catch_up(process)
    check(follower.held, process.volume)


def test_a_question_waits_for_something_new() -> None:
    process, follower = opened("normal"), Follower()
    assert not process.keep(1, follower.map.question()), "who knows nothing gets the map at once"
    follower.ask(process)
    assert not process.live.is_held
    assert process.keep(2, follower.map.question())
    assert process.answers.wait() > 0
    assert process.due() == []
    process.add(wall(0))
    process.note()
    assert process.answers.wait() == 0
    assert process.due() == [2]
    assert not process.keep(3, follower.map.question()), "there is something new"
    follower.catch_up(process)
    assert process.keep(4, follower.map.question(), wait_s=0.0) is False
    assert process.keep(5, follower.map.question(), wait_s=1e-9)
    assert process.due() == [5], "its wait is over"
    over = Command(name="ask", question=follower.map.question())
    assert process.answers.keep_waiting(FuserQuestion(6, over, time.monotonic_ns(), time.monotonic_ns()))
    assert process.due() == [6], "nobody waits for it any more"
    check(follower.held, process.volume)


def test_while_keyframes_come_viewers_that_wait_are_answered_together(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    clock = SimpleNamespace(now=100.0, monotonic=lambda: clock.now)
    for module in (live_mesh, watched_map):
        monkeypatch.setattr(module, "time", clock)
    monkeypatch.setattr(clock, "monotonic_ns", lambda: int(1e9 * clock.now), raising=False)
    process, follower = opened("raw"), Follower()
    follower.ask(process)
    process.keep(1, follower.map.question())
    process.add(wall(0))
    process.note()
    assert process.due() == [1]
    process.answers.rest(0.1)
    follower.ask(process)
    process.keep(2, follower.map.question())
    process.add(wall(1))
    process.note()
    assert process.due() == []
    assert process.answers.wait() == pytest.approx(0.3)
    late = Follower()
    late.ask(process)
    behind = msgspec.structs.replace(late.map.question(), since=late.map.question().since - 1)
    assert process.keep(4, behind), "whoever holds nearly all gets the same answer as others"
    clock.now += 0.31
    assert process.due() == [2, 4]
    follower.ask(process)
    process.keep(3, follower.map.question())
    process.add(wall(2))
    process.note()
    process.answers.rest(1.5)
    clock.now += 1.1
    assert process.due() == [3], "no keyframe is expected soon"


def test_many_viewers_cost_one_mesh(monkeypatch: pytest.MonkeyPatch) -> None:
    process = opened("normal")
    followers = [Follower() for _ in range(5)]
    for one in followers:
        one.ask(process)
    made = []
    since = changed_cells.ChangedCells.since
    monkeypatch.setattr(
        changed_cells.ChangedCells,
        "since",
        lambda *asked, refine: made.append(asked[1:]) or since(*asked, refine=refine),
    )
    process.add(wall(0))
    process.note()
    for one in followers:
        one.ask(process)
    assert len(made) == 1
    process.refine()
    for one in followers:
        one.catch_up(process)
        check(one.held, process.volume)


def test_a_cell_comes_again_only_when_it_is_refined() -> None:
    process, follower = opened("normal"), Follower()
    process.add(wall(0))
    process.note()
    follower.ask(process)
    assert follower.held.raw
    before = process.answer(follower.map.question())[1]
    assert len(before["cells"]) == 0
    follower.catch_up(process)
    check(follower.held, process.volume)
    again = process.answer(follower.map.question())[1]
    assert len(again["cells"]) == 0


def test_triangles_of_blocks_that_are_released_go(monkeypatch: pytest.MonkeyPatch) -> None:
    """The follower need not begin anew, unless too many have gone."""
    process, follower = opened("normal"), Follower()
    for i in (0, 20):
        process.add(wall(i))
        process.note()
        follower.catch_up(process)
    process.take_away(wall(20))
    assert process.volume.release_empty()
    follower.catch_up(process)
    check(follower.held, process.volume)
    assert follower.held.cleared == 1
    monkeypatch.setattr(changed_cells, "MOST_REMOVED", 3)
    process.take_away(wall(0))
    assert process.volume.release_empty() > 3
    follower.catch_up(process)
    assert (follower.held.surfaces, follower.held.cleared) == ({}, 2)


def test_what_nobody_watched_is_refined_for_who_comes_back() -> None:
    process, follower = opened("normal"), Follower()
    follower.ask(process)
    process.add(wall(0))
    process.note()
    follower.catch_up(process)
    process.add(wall(1))
    process.note()
    process.add(wall(2))
    process.note()
    follower.catch_up(process)
    check(follower.held, process.volume)


def test_answers_are_small_and_a_single_large_cell_comes_all_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(watched_map, "ANSWER_BYTES", 3000)
    process, follower = opened("raw"), Follower()
    process.add(wall(0))
    process.note()
    count = 1
    while follower.ask(process):
        count += 1
    assert count > 10
    check(follower.held, process.volume)


def test_a_map_that_is_gone_is_cleared() -> None:
    process, follower = opened("raw"), Follower()
    process.add(wall(0))
    follower.ask(process)
    assert follower.held.surfaces
    follower.held.take(follower.map.forget())
    assert (follower.held.surfaces, follower.held.cleared) == ({}, 2)
    assert follower.map.forget() == []
    follower.catch_up(process)
    check(follower.held, process.volume)


@pytest.mark.parametrize("surface", ["raw", "normal", "field"])
@pytest.mark.parametrize("seed", range(4))
def test_whatever_is_lost_or_late_the_picture_is_right_in_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, surface: Surface, seed: int
) -> None:
    """Keyframes come, move, go; blocks are released; answers are lost; the process is another one."""
    monkeypatch.setattr(watched_map, "CELLS_AT_ONCE", 9)
    monkeypatch.setattr(live_mesh, "_REFINED_AT_ONCE", 12)
    monkeypatch.setattr(changed_cells, "MOST_REMOVED", 40)
    draw = random.Random(seed)
    process, followers, restarts = opened(surface, "0"), [Follower(), Follower()], 0
    inside: list[Keyframe] = []
    for _ in range(60):
        match draw.choice(STEPS):
            case "integrate":
                inside.append(wall(draw.randrange(40)))
                process.add(inside[-1], draw.choice(SESSIONS))
            case "retract" if inside:
                process.take_away(inside.pop(draw.randrange(len(inside))))
                if draw.random() < 0.5:
                    process.volume.release_empty()
            case "mesh":
                process.note()
            case "refine":
                process.refine()
            case "lose":
                process.answer(followers[0].map.question())
            case "ask":
                draw.choice(followers).ask(process)
        if draw.random() < 0.02:
            restarts += 1
            process.volume.save(tmp_path / "map.tsf")
            process = Process(Volume.load(tmp_path / "map.tsf"), str(restarts))
    for follower in followers:
        follower.catch_up(process)
        check(follower.held, process.volume)


def test_what_makes_no_sense_is_asked_for_again() -> None:
    process, follower = opened("raw"), Follower()
    process.add(wall(0))
    process.note()
    question = follower.map.question()
    epoch, good = process.answer(question)
    for broken in (
        {name: array for name, array in good.items() if name != "until"},
        {name: array for name, array in good.items() if name != "is_refined"},
        {**good, "first_face": good["first_face"][:-1]},
        {**good, "first_face": np.zeros_like(good["first_face"])},
        {**good, "faces": np.full_like(good["faces"], 1 << 30)},
        {**good, "client": np.full_like(good["client"], 7)},
        {**good, "client": good["client"][:-1]},
        {**good, "cells": good["cells"][:, :2]},
        {**good, "begins": np.bool_(False)},
        {**good, "until": np.float64("inf")},
        {**good, "until": np.int64(-5)},
        {**good, "voxel_size": np.float64("nan")},
    ):
        with pytest.raises(DecodeError):
            follower.map.on_cells(epoch, broken)
        assert follower.map.question() == question
    follower.held.take(follower.map.on_cells(epoch, good))
    check(follower.held, process.volume)


@pytest.mark.parametrize(
    ("question", "why"),
    [
        (Cells(), "earlier version"),
        (Cells(wait_s=1.5), "may wait 1 s"),
        (Cells(wait_s=float("nan")), "may wait 1 s"),
        (Cells(since=-1, wait_s=1.0), "since is from 0"),
        (Cells(wait_s=1.0, most_bytes=0), "at least one byte"),
    ],
)
def test_a_question_that_no_server_takes(question: Cells, why: str) -> None:
    assert why in question.problem([])
