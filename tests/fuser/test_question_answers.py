# SPDX-License-Identifier: MIT
"""When a fuser answers questions: before all else, for a share of its time, and inside of long passes."""

import struct
import time
from collections import deque
from contextlib import nullcontext
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np
import pytest
import zmq
from keyframes_and_servers import CAMERA, SHAPE, VOLUME, wall

from tsfusion import Volume
from tsfusion.core.limits import Bucket
from tsfusion.fuser import question_answers
from tsfusion.fuser.fuser_messages import (
    NOT_WORKING,
    CurrentKeyframe,
    Finish,
    FuserAnswer,
    FuserQuestion,
    Save,
    encode,
)
from tsfusion.fuser.kept_answers import KeptSlices, KeptViews
from tsfusion.fuser.live_mesh import LiveMesh, TouchedBy
from tsfusion.fuser.question_answers import Inbox, QuestionAnswers
from tsfusion.fuser.watched_map import WatchedMap
from tsfusion.geometry import map_questions
from tsfusion.geometry.map_questions import Raycast, Sample, Slice
from tsfusion.journal.ledger import Ledger
from tsfusion.wire.messages import questions
from tsfusion.wire.messages.messages import Command
from tsfusion.wire.messages.questions import Cells, MapVersion

POINTS = np.array([[0, 0, 1.2], [0.1, 0.1, 1.25]], np.float32)
FRAMES = questions.point_frames(POINTS)
QUESTION = Sample(points=2, crc=map_questions.crc_of(FRAMES), surface="raw")


def asked(number: int, left_s: float = 60.0) -> FuserQuestion:
    now = time.monotonic_ns()
    return FuserQuestion(number, Command(name="ask", question=QUESTION), now, now + int(1e9 * left_s))


@pytest.fixture(scope="module")
def volume() -> Volume:
    found = Volume(VOLUME)
    for i in range(3):
        found.integrate(wall(i))
    found.sample(POINTS, surface="raw")  # its kernels are compiled
    return found


class Desk:
    """The answers to what is put into an inbox."""

    def __init__(self, volume: Volume, file: Path) -> None:
        file.write_bytes(struct.pack("<q", NOT_WORKING))
        self.at_work = CurrentKeyframe(str(file))
        self.context: zmq.Context[Any] = zmq.Context()
        self.gateway, link = (self.context.socket(zmq.PAIR) for _ in range(2))
        self.gateway.bind("inproc://desk")
        link.connect("inproc://desk")
        self.links = self.gateway, link
        self.inbox = Inbox(link)
        self.sent: list[FuserAnswer] = []
        self.watched = WatchedMap(volume, Ledger(), TouchedBy(), cast("Any", None), "a")
        self.answers = QuestionAnswers(
            volume,
            self.inbox,
            self.watched,
            state=lambda: MapVersion(keyframes=volume.keyframes),
            at_work=self.at_work,
            send=lambda message, _frames: self.sent.append(message),
        )

    def put(self, *messages: Any) -> None:
        for message in messages:
            frames = FRAMES if isinstance(message, FuserQuestion) else []
            self.gateway.send_multipart([encode(message), *frames])

    def give_all_the_time(self) -> None:
        """Let questions have more than their share: an answer may take long beside other work."""
        self.answers._share = Bucket(1.0, time.monotonic(), burst=1e6)

    @property
    def numbers(self) -> list[int]:
        return [one.number for one in self.sent if one.answer is not None]


@pytest.fixture
def desk(volume: Volume, tmp_path: Path) -> Any:
    made = Desk(volume, tmp_path / "working")
    yield made
    for link in made.links:
        link.close()
    made.context.term()


def test_questions_overtake_orders(desk: Desk) -> None:
    desk.give_all_the_time()
    desk.put(Save(), asked(1), Finish(), asked(2))
    desk.answers.give()
    assert desk.numbers == [1, 2]
    assert desk.inbox.orders == deque([Save(), Finish()])
    assert all(one.answer and one.answer.state.keyframes == 3 for one in desk.sent)


def test_a_question_whose_time_is_over_costs_nothing(desk: Desk) -> None:
    desk.put(asked(1, -1.0), asked(2))
    desk.answers.give()
    assert [(one.number, one.late) for one in desk.sent] == [(1, True), (2, False)]


def test_orders_that_wait_have_the_larger_share(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    """Questions stop when their share is used up, and go on when nothing else waits."""
    monkeypatch.setattr(question_answers, "answer_of", lambda *_: time.sleep(0.06) or {})
    desk.put(Save(), *map(asked, range(1, 9)))
    desk.answers.give()
    assert 1 <= len(desk.numbers) <= 2
    desk.inbox.orders.clear()
    desk.at_work.set(7)  # now a keyframe is under way: it has its share, too
    desk.answers.give()
    assert len(desk.numbers) < 8
    assert desk.at_work.is_set
    desk.at_work.set(NOT_WORKING)
    desk.answers.give()
    assert desk.numbers == list(range(1, 9))


def test_viewers_that_waited_leave_a_keyframe_its_turn(
    desk: Desk, volume: Volume, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All are answered together, unless that takes long and a keyframe has come."""
    desk.watched._live_mesh = LiveMesh(volume, interval=0.0, sparing=nullcontext, send=lambda _: None)
    newest = desk.watched._live_mesh.changes.newest
    viewer = Command(name="ask", question=Cells(since=newest, epoch="a", wait_s=1e-9))
    questions = [FuserQuestion(i, viewer, time.monotonic_ns(), 1 << 62) for i in range(9)]
    assert all(map(desk.watched.keep_waiting, questions))
    monkeypatch.setattr(
        desk.answers, "_find", lambda asked, _: time.sleep(0.06) or (FuserAnswer(asked.number), [])
    )
    desk.put(Save())
    desk.answers.give_news()
    assert 1 <= len(desk.sent) <= 4
    assert desk.watched.wait() > 0, "now it is the keyframe's turn"
    desk.inbox.orders.clear()
    while len(desk.sent) < 9:
        desk.answers.give_news()
    assert [one.number for one in desk.sent] == list(range(9))


def test_what_comes_during_an_answer_has_its_share(desk: Desk, monkeypatch: pytest.MonkeyPatch) -> None:
    def answer(*_: Any) -> Any:
        time.sleep(0.1)
        if not desk.inbox.orders:
            desk.put(Save())
        return {}

    monkeypatch.setattr(question_answers, "answer_of", answer)
    desk.put(*map(asked, range(1, 9)))
    desk.answers.give()
    assert desk.numbers == [1]
    assert len(desk.inbox.orders) == 1


def test_a_question_that_fails_is_answered_with_the_reason(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any) -> Any:
        raise MemoryError("much")

    monkeypatch.setattr(question_answers, "answer_of", fail)
    desk.put(asked(1))
    desk.answers.give()
    assert "fuser_memory_bytes" in desk.sent[0].error


def test_long_passes_stop_for_questions_and_give_the_same(desk: Desk, volume: Volume) -> None:
    """A mesh, hashes and a checkpoint, with views and samples asked for in the middle of each."""
    mesh, hashes = volume.extract_mesh(), (volume.map_hash(), volume.color_hash())
    asked_for = 0

    def ask() -> None:
        nonlocal asked_for
        volume.set_pause(lambda: None)
        volume.raycast(CAMERA, np.eye(4), SHAPE)
        volume.sample(POINTS)
        volume.set_pause(ask)
        asked_for += 1

    volume.set_pause(ask)
    try:
        paused = volume.extract_mesh()
        assert asked_for > 10
        assert (volume.map_hash(), volume.color_hash()) == hashes
    finally:
        volume.set_pause(lambda: None)
    for name in ("vertices", "faces", "normals", "colors"):
        np.testing.assert_array_equal(getattr(paused, name), getattr(mesh, name))


def test_an_answer_is_not_interrupted_by_another(desk: Desk, volume: Volume) -> None:
    """A question that itself is a long pass comes to the pause of long passes."""
    volume.set_pause(desk.answers.give_between)
    try:
        question = Sample(points=2, crc=QUESTION.crc, surface="field")
        field = FuserQuestion(1, Command(name="ask", question=question), 0, 1 << 62)
        desk.put(field, asked(2))
        desk.answers.give()
    finally:
        volume.set_pause(lambda: None)
    assert desk.numbers == [1, 2]


def long_pass(desk: Desk, steps: int) -> Any:
    """An answer in so many steps, behind each of which others may have their turn."""

    def answer(*_: Any) -> Any:
        for _step in range(steps):
            began = time.process_time()
            while time.process_time() - began < 0.003:
                pass
            desk.answers.give_between()
        return {}

    return answer


def test_an_answer_that_takes_long_is_given_up_for_keyframes(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ten thousand scattered points or a view of all of a large map would take a minute."""
    desk.give_all_the_time()
    monkeypatch.setattr(question_answers, "_LONGEST_S", 0.02)
    monkeypatch.setattr(question_answers, "_SHORTEST_S", 0.01)
    monkeypatch.setattr(question_answers, "answer_of", long_pass(desk, 20))
    desk.put(asked(1))
    desk.answers.give()
    assert desk.numbers == [1]
    desk.put(asked(2), Save())
    desk.answers.give()
    assert (desk.sent[-1].number, desk.sent[-1].late) == (2, True)
    assert "keyframes wait" in desk.sent[-1].error
    desk.inbox.orders.clear()
    desk.at_work.set(7)  # a keyframe is under way
    desk.put(asked(3))
    desk.answers.give()
    assert (desk.sent[-1].number, desk.sent[-1].late, desk.at_work.is_set) == (3, True, True)


def test_an_answer_is_given_up_sooner_where_the_share_is_used_up(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Between two keyframes nothing waits, and each would find a long answer that has just begun."""
    monkeypatch.setattr(question_answers, "_SHORTEST_S", 0.01)
    monkeypatch.setattr(question_answers, "answer_of", long_pass(desk, 20))
    desk.answers._share.spend(100.0)
    desk.put(asked(1))
    desk.answers.give()
    assert desk.numbers == [1]

    def answer(*_: Any) -> Any:
        desk.put(Save())  # it comes meanwhile
        return long_pass(desk, 20)()

    monkeypatch.setattr(question_answers, "answer_of", answer)
    desk.answers._share.spend(100.0)
    desk.put(asked(2))
    desk.answers.give()
    assert (desk.sent[-1].number, desk.sent[-1].late) == (2, True)


def test_an_answer_that_nobody_waits_for_any_more_is_given_up(
    desk: Desk, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(question_answers, "answer_of", long_pass(desk, 1 << 20))
    desk.put(asked(1, 0.05))
    desk.answers.give()
    assert [(one.number, one.late, one.error) for one in desk.sent] == [(1, True, questions.LATE)]


def test_a_slice_that_was_given_up_is_made_anew(volume: Volume) -> None:
    """Nothing is noted for it meanwhile, and nothing left out."""
    wanted = Slice(kind="occupancy", low=0.5, high=1.5, up=(0.0, 0.0, 1.0), box=(-0.5, -0.5, 0.5, 0.5))
    slices = KeptSlices(volume)
    expected = slices.get(wanted).occupancy().cells

    def fail() -> None:
        raise question_answers.AnswerGivenUp("it takes long")

    volume.integrate(wall(3))
    volume.set_pause(fail)
    try:
        with pytest.raises(question_answers.AnswerGivenUp):
            slices.get(wanted)
    finally:
        volume.set_pause(lambda: None)
        volume.retract(wall(3))
    np.testing.assert_array_equal(slices.get(wanted).occupancy().cells, expected)


def looked(max_age: float) -> Raycast:
    """The question what the first keyframe's camera sees."""
    keyframe = wall(0)
    assert keyframe.intrinsics is not None
    K, pose = keyframe.intrinsics, tuple(keyframe.T_world_camera.ravel().tolist())
    return Raycast(
        (K.fx, K.fy, K.cx, K.cy), pose, (keyframe.shape[0], keyframe.shape[1]), surface="raw", max_age=max_age
    )


class Growing:
    """A map that grows, the views that are kept of it, and what a fresh map would show."""

    def __init__(self) -> None:
        self.volume = Volume(VOLUME)
        self.views = KeptViews(self.volume, lambda: MapVersion(keyframes=self.volume.keyframes))

    def add(self, number: int) -> None:
        self.views.note_change()
        self.volume.integrate(wall(number))

    def prepare(self) -> None:
        deadline = time.monotonic() + 60
        while self.views.wait() is not None:
            assert time.monotonic() < deadline
            self.views.prepare()

    def assert_shows(self, max_age: float, keyframes: int) -> None:
        """A view is of so many keyframes, and says so."""
        view, state = self.views.get(looked(max_age))
        fresh = Volume(VOLUME)
        for number in range(keyframes):
            fresh.integrate(wall(number))
        question = looked(0)
        wanted = fresh.raycast(question.intrinsics, question.matrix, question.shape, surface="raw")
        assert state.keyframes == keyframes
        for name in ("depth", "normals", "colors"):
            assert np.array_equal(getattr(view, name), getattr(wanted, name)), name


def test_a_view_that_may_be_behind_is_of_one_whole_state() -> None:
    map_ = Growing()
    map_.add(0)
    map_.assert_shows(30.0, 1)
    map_.add(1)
    map_.assert_shows(30.0, 1)
    map_.views.prepare()  # not all of it, perhaps
    map_.prepare()
    map_.assert_shows(30.0, 2)
    map_.add(2)
    depth_alone = msgspec.structs.replace(looked(30.0), normals=False, colors=False)
    bare, state = map_.views.get(depth_alone)
    assert (bare.normals, bare.colors, state.keyframes) == (None, None, 2)
    map_.assert_shows(30.0, 2)
    map_.assert_shows(0.0, 3)  # nobody is shown an old state who did not ask for it


def test_a_view_is_no_older_than_it_may_be(monkeypatch: pytest.MonkeyPatch) -> None:
    map_ = Growing()
    map_.add(0)
    map_.assert_shows(1.0, 1)
    now = time.monotonic()
    monkeypatch.setattr(time, "monotonic", lambda: now + 100)  # quiet for long: it is the newest still
    map_.add(1)
    map_.assert_shows(1.0, 1)
    monkeypatch.setattr(time, "monotonic", lambda: now + 101.5)
    map_.assert_shows(1.0, 2)


def test_views_are_prepared_only_while_somebody_asks_for_such() -> None:
    map_ = Growing()
    map_.add(0)
    map_.assert_shows(0.0, 1)
    map_.add(1)
    assert map_.views.wait() is None
    map_.assert_shows(5.0, 1)
    assert map_.views.wait() is not None
    map_.volume.retract(wall(1))
    map_.volume.release_empty()  # blocks have gone: nothing is kept of before
    map_.assert_shows(5.0, 1)


def test_preparing_gives_way_to_a_question(desk: Desk, volume: Volume) -> None:
    desk.answers.views.get(looked(5.0))
    desk.answers.views.note_change()
    volume.integrate(wall(3))
    volume.set_pause(desk.answers.give_between)
    try:
        desk.put(asked(1))
        desk.answers.prepare()
        assert desk.answers.views.wait() is not None  # not done
        assert not desk.numbers
        desk.answers.give()
        assert desk.numbers == [1]
        while desk.answers.views.wait() is not None:
            desk.answers.prepare()
    finally:
        volume.set_pause(lambda: None)
        volume.retract(wall(3))
