# SPDX-License-Identifier: MIT
"""A follower of a map ends with the map's own surface, whatever is lost, late, moved, forgotten or restarted.

Both ends run here, without sockets: what they say goes through a list from which messages are lost.
"""

import random
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from health_snapshots import map_health
from keyframes_and_servers import VOLUME, wall
from watched_surfaces import Held, farthest, fresh

from tsfusion import Keyframe, Volume
from tsfusion.core.config import Surface, override
from tsfusion.core.errors import DecodeError
from tsfusion.fuser import live_mesh
from tsfusion.fuser.live_mesh import LiveMesh, TouchedBy
from tsfusion.fuser.watched_map import WatchedMap
from tsfusion.geometry import map_questions
from tsfusion.journal.ledger import Ledger
from tsfusion.wire.asking.followed_map import FollowedMap
from tsfusion.wire.messages import mesh_updates, questions
from tsfusion.wire.messages.questions import Answer, MapVersion

SESSIONS = bytes(16), bytes([1] * 16)
STEPS = ("integrate", "retract", "mesh", "refine", "lose", *2 * ["read"], *3 * ["ask"], "health")


class Process:
    """A map and what the fuser's process says about it."""

    def __init__(self, volume: Volume, epoch: str, *, watched: bool) -> None:
        self.volume, self.epoch = volume, epoch
        self.touched_by = TouchedBy()
        self.sent: list[tuple[bytes, list[bytes]]] = []
        self.newest: mesh_updates.Meshed | None = None
        self.live = LiveMesh(
            volume,
            interval=0.0,
            sparing=nullcontext,
            send=self._send,
            touched_by=self.touched_by,
            epoch=epoch,
        )
        self.live.watch(watched)
        self.answers = WatchedMap(volume, Ledger(), self.touched_by, self.live)

    def _send(self, meshed: mesh_updates.Meshed, frames: list[Any] | None = None) -> None:
        self.newest = meshed
        if frames:  # as the gateway does it
            self.sent.append((mesh_updates.encode(meshed), [bytes(one) for one in frames]))

    def add(self, keyframe: Keyframe, session: bytes = SESSIONS[0]) -> None:
        self.touched_by.note(self.volume.version + 1, session)
        self.volume.integrate(keyframe)
        self.live.note_answer()

    def take_away(self, keyframe: Keyframe, session: bytes = SESSIONS[0]) -> None:
        self.touched_by.note(self.volume.version + 1, session)
        self.volume.retract(keyframe)
        self.live.note_move()

    def answer(self, question: Any) -> tuple[str, dict[str, Any]]:
        """The answer, as it comes over the wire."""
        assert question.problem([]) == ""
        layouts, frames = questions.pack(self.answers.answer(question), compress=True)
        answer = Answer(
            arrays=layouts, state=MapVersion(keyframes=0, epoch=self.epoch), crc=map_questions.crc_of(frames)
        )
        decoded = msgspec.msgpack.decode(msgspec.msgpack.encode(answer), type=Answer)
        return self.epoch, questions.unpack(decoded, frames)

    def settle(self) -> None:
        """Do what the fuser does while nothing comes."""
        if self.live.wait(idle=True) == 0:
            self.live.update()
        while self.live.refine_waits:
            self.live.refine()


class Follower:
    """Somebody who follows the map of a process."""

    def __init__(self) -> None:
        self.map, self.held, self.now = FollowedMap("default"), Held(), 0.0

    def read(self, process: Process, count: int | None = None) -> None:
        for head, frames in process.sent[:count]:
            self.held.take(self.map.on_update(mesh_updates.meshed_of(head), frames, self.now))
        del process.sent[:count]

    def see_health(self, process: Process, *, idle: bool, restarts: int = 0) -> None:
        update = process.newest.update if process.newest else None
        health = map_health(
            state="idle" if idle else "busy",
            fuser_restarts=restarts,
            mesh_epoch=update.epoch if update else "",
            mesh_number=update.number if update else 0,
        )
        self.map.on_health(health, "server", self.now)

    def ask(self, process: Process) -> bool:
        """Ask one question, if there is one."""
        question = self.map.question(self.now)
        if question is not None:
            self.held.take(self.map.on_cells(*process.answer(question)))
        return question is not None

    def catch_up(self, process: Process, restarts: int = 0) -> None:
        """Let nothing happen for a while."""
        process.settle()
        self.read(process)
        for _ in range(4):
            self.now += 3.0
            self.see_health(process, idle=True, restarts=restarts)
            while self.ask(process):
                pass


def opened(surface: Surface, epoch: str = "a", *, watched: bool = True) -> Process:
    return Process(Volume(override(VOLUME, surface=surface)), epoch, watched=watched)


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
    early.see_health(process, idle=True)
    assert early.ask(process)
    assert not early.ask(process)  # an empty map lacks nothing
    for i in range(4):
        process.add(wall(12 * i), SESSIONS[i % 2])
        process.live.update()
        early.read(process)
        assert early.held.surfaces == fresh(process.volume, "raw")
    assert {early.held.client[cell] for cell in early.held.surfaces} == {*SESSIONS}
    late.see_health(process, idle=False)
    while late.ask(process):
        pass
    assert late.held.surfaces == fresh(process.volume, "raw")
    known = {cell: early.held.client[cell] for cell in late.held.surfaces}
    assert known == {cell: late.held.client[cell] for cell in late.held.surfaces}
    early.catch_up(process)
    asked = early.held.cleared
    late.catch_up(process)
    check(early.held, process.volume)
    check(late.held, process.volume)
    assert asked == early.held.cleared == late.held.cleared == 1


def test_updates_alone_are_enough_for_who_misses_none() -> None:
    """And the surface that is refined needs no question."""
    process, follower = opened("normal"), Follower()
    follower.ask(process)
    for i in range(3):
        process.add(wall(i))
        process.settle()
        follower.read(process)
    follower.now = 99.0
    follower.see_health(process, idle=True)
    assert follower.map.question(follower.now) is None
    check(follower.held, process.volume)


def test_triangles_of_blocks_that_are_released_go() -> None:
    process, follower = opened("normal"), Follower()
    follower.ask(process)
    for i in (0, 20):
        process.add(wall(i))
        process.settle()
    process.take_away(wall(20))
    assert process.volume.release_empty()
    process.settle()
    follower.read(process)
    assert follower.held.surfaces == fresh(process.volume)


def test_the_last_update_that_is_lost_is_noticed() -> None:
    process, follower = opened("raw"), Follower()
    follower.ask(process)
    process.add(wall(0))
    process.live.update()
    process.sent.clear()
    follower.see_health(process, idle=True)
    assert not follower.ask(process)  # it may be on its way
    follower.now += 3.0
    follower.see_health(process, idle=True)
    assert follower.ask(process)
    check(follower.held, process.volume)


def test_what_nobody_watched_is_refined_for_who_comes_back() -> None:
    process, follower = opened("normal"), Follower()
    follower.ask(process)
    process.add(wall(0))
    process.live.update()
    follower.read(process)
    process.live.watch(False)  # the connection broke, and nobody else watches
    process.live.watch(True)
    process.add(wall(1))
    follower.catch_up(process)
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
@pytest.mark.parametrize("seed", range(3))
def test_whatever_is_lost_or_late_the_picture_is_right_in_the_end(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, surface: Surface, seed: int
) -> None:
    """Keyframes come, move, go; blocks are released; messages are lost; the process is another one."""
    monkeypatch.setattr("tsfusion.fuser.watched_map.CELLS_AT_ONCE", 9)
    monkeypatch.setattr("tsfusion.fuser.watched_map.REFINED_AT_ONCE", 5)
    monkeypatch.setattr(live_mesh, "_REFINED_AT_ONCE", 12)
    draw = random.Random(seed)
    process, follower, restarts = opened(surface, "0"), Follower(), 0
    inside: list[Keyframe] = []
    for _ in range(60):
        follower.now += draw.choice((0.01, 2.0))
        match draw.choice(STEPS):
            case "integrate":
                inside.append(wall(draw.randrange(40)))
                process.add(inside[-1], draw.choice(SESSIONS))
            case "retract" if inside:
                process.take_away(inside.pop(draw.randrange(len(inside))))
                if draw.random() < 0.5:
                    process.volume.release_empty()
            case "mesh":
                process.live.update()
            case "refine" if process.live.refine_waits:
                process.live.refine()
            case "lose":
                del process.sent[: draw.randrange(3)]
            case "read":
                follower.read(process, draw.randrange(3))
            case "ask":
                follower.ask(process)
            case "health":
                follower.see_health(process, idle=draw.random() < 0.5, restarts=restarts)
        if draw.random() < 0.02:
            restarts += 1
            late = process.sent
            process.volume.save(tmp_path / "map.tsf")
            process = Process(Volume.load(tmp_path / "map.tsf"), str(restarts), watched=True)
            process.sent = late  # of the process before, still on their way
    follower.catch_up(process, restarts)
    check(follower.held, process.volume)


def test_what_makes_no_sense_is_missed_and_asked_for() -> None:
    process, follower = opened("raw"), Follower()
    follower.ask(process)
    process.add(wall(0))
    process.live.update()
    ((head, frames),) = process.sent
    good = mesh_updates.meshed_of(head)
    assert good.update is not None
    for broken, with_frames in (
        (good, frames[:-1]),
        (good, [frames[0][:-4], *frames[1:]]),
        (good, [*frames[:2], np.full(3 * good.layout.faces, 1 << 30, np.int32).tobytes(), *frames[3:]]),
        (changed(good, first_face=good.update.first_face[:-4]), frames),
        (changed(good, first_face=bytes(len(good.update.first_face))), frames),
        (changed(good, client=np.full(len(frames[0]) // 12, 7, np.int32).tobytes()), frames),
        (changed(good, client=b"123"), frames),
    ):
        other = Follower()
        other.ask(opened("raw"))
        with pytest.raises(DecodeError):
            other.map.on_update(broken, with_frames, 0.0)
        assert other.map.question(0.0) is not None


def changed(meshed: mesh_updates.Meshed, **fields: Any) -> mesh_updates.Meshed:
    assert meshed.update is not None
    return msgspec.structs.replace(meshed, update=msgspec.structs.replace(meshed.update, **fields))
