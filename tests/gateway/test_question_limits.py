# SPDX-License-Identifier: MIT
"""Questions and meshes at the gateway: how many may be under way, and that none stays without a reply."""

import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import pytest
import zmq
from keyframes_and_servers import until
from served_gateway import QuietFuser, hosting

from tsfusion.fuser.fuser_messages import FuserAnswer, FuserQuestion
from tsfusion.gateway.health.metrics import Metrics
from tsfusion.gateway.maps.map_records import QuestionCounts
from tsfusion.gateway.people import requests
from tsfusion.gateway.people.requests import MOST_OF_A_CLIENT, MOST_UNREAD, MOST_WAITING, Requests
from tsfusion.gateway.people.scan_updates import ScanUpdates
from tsfusion.gateway.ports.connections import PendingReplies
from tsfusion.gateway.ports.ports import OutgoingAnswer
from tsfusion.geometry.map_questions import Field, Raycast
from tsfusion.wire.messages import messages
from tsfusion.wire.messages.forget_messages import Selection
from tsfusion.wire.messages.health import MeshLayout
from tsfusion.wire.messages.messages import Command
from tsfusion.wire.messages.questions import Answer, Cells, Keyframes, MapVersion, Scans

LOOK = Raycast(intrinsics=(1, 1, 0, 0), pose=(1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1), shape=(1, 1))


class Desk:
    """Requests about a map whose fuser is this object, and the replies to them."""

    ready, failed, is_idle = True, "", True

    def __init__(self, most_bytes: int = 1 << 30, rate: float = 1e6) -> None:
        self.fuser = self
        self.questions = QuestionCounts()
        self.passed_on: list[FuserQuestion] = []
        self.out: list[OutgoingAnswer] = []
        self.refused: Counter[str] = Counter()
        self.unread = PendingReplies(most_bytes)
        self.asked = Requests(
            self.out,
            Metrics(),
            self.refused,
            self.unread,
            rate=rate,
            scans=ScanUpdates(),
        )

    def send(self, message: FuserQuestion, frames: Any = ()) -> bool:
        self.passed_on.append(message)
        return True

    def idle_since(self, since: float) -> bool:
        return self.is_idle

    @property
    def replies(self) -> list[messages.Reply]:
        """The replies, whose frames nobody reads."""
        return [cast("messages.Reply", one.message) for one in self.out]

    def ask_mesh(self, identity: bytes, client: str = "", map_name: str = "default") -> bool:
        """Whether the request was passed on."""
        before = len(self.passed_on)
        self.asked.submit(identity, Command(name="mesh", map=map_name), [], cast("Any", self), client)
        return len(self.passed_on) > before

    def make(self, nbytes: int) -> None:
        """The mesh that was asked for last."""
        layout = MeshLayout(vertices=0, faces=0, colors=False)
        frames = [zmq.Frame(bytes(nbytes // 2)), zmq.Frame(bytes(nbytes // 2))]
        self.asked.on_answer(FuserAnswer(self.passed_on[-1].number, mesh=layout), frames)

    def ask(self, identity: bytes, client: str = "", **fields: Any) -> bool:
        """Whether the question was passed on."""
        before = len(self.passed_on)
        command = Command(name="ask", **{"number": 3, "question": LOOK, **fields})
        self.asked.submit(identity, command, [], cast("Any", self), client)
        return len(self.passed_on) > before

    def answer(self, nbytes: int = 0) -> None:
        """The one that was passed on last."""
        answer = Answer(arrays=(), state=MapVersion(keyframes=1), crc=0)
        frames = [zmq.Frame(bytes(nbytes))] if nbytes else []
        self.asked.on_answer(FuserAnswer(self.passed_on[-1].number, answer), frames)

    @property
    def error(self) -> str:
        return self.replies[-1].error or ""


def test_a_client_has_a_few_under_way_over_all_its_connections() -> None:
    desk = Desk()
    assert all(desk.ask(b"%d" % i, "robot") for i in range(MOST_OF_A_CLIENT))
    assert not desk.ask(b"other", "robot")
    assert (desk.error, desk.replies[-1].retry) == (
        "4 questions of this client are under way; ask again",
        True,
    )
    assert desk.ask(b"other", "robot2")
    desk.passed_on.pop()
    desk.answer()
    assert desk.ask(b"other", "robot")
    assert desk.refused == {"question": 1}
    assert desk.questions.by_outcome == {"refused": 1, "answered": 1}
    assert desk.questions.delay_ms.count == 1


def test_all_clients_together_fill_no_fuser() -> None:
    desk = Desk()
    assert sum(desk.ask(b"%d" % (i // 2)) for i in range(2 * MOST_WAITING)) == MOST_WAITING
    assert desk.error == "too many questions at once; ask again"


def test_answers_that_nobody_reads_fill_no_memory() -> None:
    """Neither those of one client, nor those of many."""
    desk = Desk(most_bytes=1000)
    for _ in range(MOST_OF_A_CLIENT):
        assert desk.ask(b"slow")
        desk.answer(200)
    assert not desk.ask(b"slow")
    assert "of this client" in desk.error
    assert desk.ask(b"another")
    desk.answer(300)
    assert not desk.ask(b"third")
    assert "fill the memory" in desk.error


def test_a_claim_of_a_large_answer_takes_no_room_from_others() -> None:
    desk = Desk()
    assert not desk.ask(b"1", "robot", question=Keyframes(most_bytes=1 << 60))
    assert "an answer has 1 to 2097152 bytes, got most_bytes = 1152921504606846976" in desk.error
    assert desk.ask(b"1", "robot", question=Keyframes(most_bytes=1 << 21))
    assert desk.ask(b"2", "cart")


def test_small_answers_may_leave_late() -> None:
    """ZeroMQ says so after the client has read some, and asked on: seen on a machine with much to do."""
    desk = Desk(most_bytes=100_000)
    for _ in range(MOST_UNREAD):
        assert desk.ask(b"quick"), desk.error
        desk.answer(200)
    assert not desk.ask(b"quick")
    assert (desk.error, desk.replies[-1].retry) == (
        "64 answers of this client are not read yet; ask again",
        True,
    )


def test_answers_that_come_all_at_once_fill_no_memory() -> None:
    """The largest ones, asked for over many connections before the first of them is there."""
    large = Field(box=(0.0, 0.0, 0.0, 1.0, 1.0, 1.0), max_distance=1.0)
    desk = Desk(most_bytes=4 * large.most_bytes)
    assert sum(desk.ask(b"%d" % i, question=large) for i in range(20)) == 4
    assert "fill the memory" in desk.error
    assert desk.replies[-1].retry
    desk.answer(1000)
    assert not desk.ask(b"last", question=large)
    assert Desk(most_bytes=10).ask(b"one", question=large)


def test_a_mesh_in_the_making_holds_no_question_up() -> None:
    desk = Desk(most_bytes=1000)
    assert desk.ask_mesh(b"mesh")
    desk.make(1500)
    desk.unread = desk.asked._unread = PendingReplies(1000)  # all of it was read
    assert desk.ask_mesh(b"mesh")
    assert desk.ask(b"other")


def test_a_question_ends_with_its_time_or_with_the_fuser(monkeypatch: pytest.MonkeyPatch) -> None:
    desk = Desk()
    now = time.monotonic_ns()
    monkeypatch.setattr(requests.time, "monotonic_ns", lambda: now)
    assert desk.ask(b"1", timeout_s=0.5)
    assert desk.ask(b"1", timeout_s=5.0)
    now += 10**9
    desk.asked.step()
    assert [(one.late, one.number) for one in desk.replies] == [(True, 3)]
    desk.passed_on.pop()
    desk.answer()  # too late
    assert len(desk.replies) == 1
    desk.asked.give_up("default")
    assert desk.error == "the fuser restarts; ask again"
    desk.ready = False
    assert not desk.ask(b"1")
    assert desk.replies[-1].retry
    assert desk.questions.by_outcome == {"late": 1, "failed": 1, "refused": 1}


def test_the_rate_is_each_clients_own() -> None:
    desk = Desk(rate=1e-3)
    assert desk.ask(b"1", "robot")
    assert not desk.ask(b"2", "robot")
    assert "0.001 questions a second" in desk.error
    assert desk.ask(b"3", "cart")


def test_viewers_that_wait_take_no_share_of_others() -> None:
    """Each connection has one question for cells; a client's other questions do not count them."""
    desk = Desk()
    cells = Cells(wait_s=1.0)
    passed = [desk.ask(b"%d" % i, "robot", question=cells) for i in range(requests.MOST_VIEWERS + 1)]
    assert passed == [*requests.MOST_VIEWERS * [True], False]
    assert desk.error == "too many questions at once; ask again"
    assert desk.ask(b"1", "robot")
    desk.answer()
    assert desk.questions.by_outcome == {"answered": 1}
    assert desk.refused == {"question": 1}


def test_one_keys_viewers_make_room_for_those_of_another() -> None:
    """The longest-waiting of the key with most places yields; nobody yields to who has as many."""
    desk = Desk()
    cells = Cells(wait_s=1.0)
    assert all(desk.ask(b"a%d" % i, "robot", question=cells) for i in range(requests.MOST_VIEWERS))
    assert all(desk.ask(b"b%d" % i, "cart", question=cells) for i in range(requests.MOST_VIEWERS // 2))
    assert not desk.ask(b"more", "cart", question=cells)
    yielded = [one.identity for one in desk.out]
    assert yielded == [*(b"a%d" % i for i in range(requests.MOST_VIEWERS // 2)), b"more"]
    assert all(
        (one.error, one.retry) == ("too many questions at once; ask again", True) for one in desk.replies
    )


def test_one_viewer_takes_no_share_of_others() -> None:
    desk = Desk()
    assert sum(desk.ask(b"1", "robot", question=Cells(wait_s=1.0)) for _ in range(9)) == MOST_OF_A_CLIENT
    assert desk.ask(b"2", "robot", question=Cells(wait_s=1.0))


def test_a_viewer_of_an_earlier_version_is_told_so() -> None:
    desk = Desk()
    assert not desk.ask(b"1", question=Cells())
    assert "a viewer of an earlier version" in desk.error


def test_viewers_that_wait_hold_no_memory_but_what_they_leave_unread_does() -> None:
    """However many maps they watch; one key's viewers fill a share of it, so that all others see theirs."""
    cells = Cells(wait_s=1.0)
    desk = Desk(most_bytes=8 * cells.most_bytes)
    assert all(desk.ask(b"%d" % i, question=cells, map=f"map-{i // 10}") for i in range(100))
    desk = Desk(most_bytes=8000)
    waiting = [desk.ask(b"%d" % i, "robot", question=cells) for i in range(20)]
    assert all(waiting)
    for one in desk.passed_on:
        answer = Answer(arrays=(), state=MapVersion(keyframes=1), crc=0)
        desk.asked.on_answer(FuserAnswer(one.number, answer), [zmq.Frame(bytes(1000))])
    assert [one.answer is not None for one in desk.replies] == [*8 * [True], *12 * [False]]
    assert "fill the memory" in desk.error
    assert desk.replies[-1].retry
    assert not desk.ask(b"new", "robot", question=cells)
    assert "answers of this client are not read yet" in desk.error
    desk.out.clear()


def test_a_viewer_that_no_longer_listens_leaves_nothing_behind() -> None:
    """A question that waits ends with its time, at the gateway and where it waits."""
    desk = Desk()
    scans = desk.asked.scans
    asked = Scans(since=1, epoch=scans._epoch, wait_s=1.0)
    for i in range(50):
        desk.ask(b"%d" % i, question=asked, timeout_s=1e-9)
    desk.asked.step()
    assert (scans._waiting, desk.asked._waiting) == ([], {})


def test_what_waits_for_a_map_to_open_fills_no_memory(tmp_path: Path) -> None:
    """Many viewers wait, but few lists of keyframes to forget."""

    class Opening(QuietFuser):
        def work(self, _message: object) -> Iterator[float]:
            yield float("inf")

    listed = Selection(numbers=((1, 2), (4, 5)))
    with hosting(tmp_path, fuser=Opening, warm=False) as served:
        for i in range(40):
            served.say(Command(name="forget", selection=listed, number=i + 1, timeout_s=60.0), b"cart")
        assert [one.identity for one in served.gateway.out] == 8 * [b"cart"]
        served.gateway.out.clear()
        for i in range(100):
            served.say(Command(name="ask", question=Cells(wait_s=1.0), timeout_s=60.0), b"%d" % i)
        assert served.gateway.out == []


# --- meshes ---


def test_a_fuser_makes_one_mesh_at_a_time() -> None:
    desk = Desk()
    assert desk.ask_mesh(b"1")
    assert not desk.ask_mesh(b"2")
    assert desk.error == "another mesh is being made; ask again"
    assert desk.ask_mesh(b"3", map_name="yard")
    desk.asked.give_up("default")
    assert desk.ask_mesh(b"2")


def test_a_client_gets_one_mesh_at_a_time_over_all_its_connections() -> None:
    desk = Desk()
    assert desk.ask_mesh(b"1", "robot")
    assert not desk.ask_mesh(b"2", "robot", "yard")
    desk.make(100)
    assert not desk.ask_mesh(b"3", "robot", "yard")  # not read yet
    assert desk.ask_mesh(b"4", "cart", "yard")
    assert all(one.error is None or "still on its way" in one.error for one in desk.replies)


def test_after_a_mesh_it_is_the_keyframes_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    monkeypatch.setattr(time, "monotonic_ns", lambda: int(1e9 * now[0]))
    desk = Desk()
    desk.is_idle = False
    assert desk.ask_mesh(b"1")
    now[0] = 102.0
    desk.make(100)
    now[0] = 107.9
    assert not desk.ask_mesh(b"2")
    assert desk.error == "a mesh was just made, now it is the keyframes' turn; ask again"
    desk.is_idle = True  # nobody scans: nobody has to wait
    assert desk.ask_mesh(b"2")
    desk.make(100)
    desk.is_idle = False
    now[0] = 108.0
    assert desk.ask_mesh(b"3")


def test_meshes_that_nobody_reads_are_few() -> None:
    desk = Desk(most_bytes=1000)
    for identity in (b"1", b"2", b"3"):
        assert desk.ask_mesh(identity)
        desk.make(300)
    assert not desk.ask_mesh(b"4")
    assert "do not read" in desk.error
    assert desk.asked.nbytes == 900
    desk.out.clear()
    until(lambda: desk.asked.nbytes == 0)
    assert desk.ask_mesh(b"5")
    desk.make(5000)  # one may be larger than all should be
    assert desk.asked.nbytes == 5000
    assert not desk.ask_mesh(b"6")
