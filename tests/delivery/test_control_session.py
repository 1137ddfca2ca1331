# SPDX-License-Identifier: MIT
"""The client's side of the control socket: each message of a server and its effect."""

import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from keyframes_and_servers import wall

from tsfusion.delivery.control_session import ControlSession, RefusedRecords
from tsfusion.delivery.outbox import Outbox
from tsfusion.delivery.spool import Spool
from tsfusion.wire.messages import messages
from tsfusion.wire.messages.messages import Ack, Denied, Nack, Pong, ToClient, Welcome
from tsfusion.wire.records import codec


class Side:
    """A client with three keyframes, numbered from 1, of which two are on their way."""

    def __init__(self, folder: Path) -> None:
        self.outbox = Outbox(Spool(folder, 1 << 20))
        self.said: list[bytes] = []
        refused = RefusedRecords(self.outbox)
        self.control = ControlSession(
            self.outbox, refused, self.said.append, address="tcp://nobody", map_name="default"
        )
        for i in range(3):
            frames = codec.encode(wall(i), session=self.key, seq=self.outbox.spool.next_seq, jpeg_quality=90)
            self.outbox.add(self.outbox.spool.write(frames), wall(i))
        for _ in range(2):
            claimed = self.outbox.claim(8, 1 << 20)
            assert claimed is not None
            self.outbox.sent(claimed[0], 1)

    @property
    def key(self) -> bytes:
        return self.outbox.spool.session

    @property
    def waiting(self) -> list[int]:
        return [entry.seq for entry in self.outbox.spool.waiting]

    def hear(self, message: ToClient) -> None:
        self.control.receive([messages.encode_sealed(message)])

    def welcome(self) -> None:
        self.hear(Welcome("epoch", messages.PROTOCOL_VERSION, 0, 0, 8, 1 << 20, 1 << 20))

    def pong(self, epoch: str) -> None:
        now = time.monotonic_ns()
        self.hear(Pong(epoch, now, now, now))


@pytest.fixture
def side(tmp_path: Path) -> Iterator[Side]:
    made = Side(tmp_path)
    yield made
    made.outbox.close()


def test_answers_to_another_session_mean_nothing(side: Side) -> None:
    side.welcome()
    other = bytes(16)
    side.hear(Ack(other, 2, 2))
    side.hear(Nack(other, 1, "door", "quota", "no"))
    assert side.waiting == [1, 2, 3]
    side.hear(Ack(side.key, 2, 0))
    assert side.waiting == [3]


def test_an_answer_of_before_waits_for_the_welcome(side: Side) -> None:
    side.hear(Ack(side.key, 2, 0))
    assert side.waiting == [1, 2, 3]


def test_who_is_let_in_anew_sends_again_what_is_not_acknowledged(side: Side) -> None:
    assert side.outbox.outstanding == 2
    side.welcome()
    assert side.outbox.outstanding == 0


def test_only_what_was_sent_can_be_refused(side: Side) -> None:
    side.welcome()
    for seq in (2, 3, 99):
        side.hear(Nack(side.key, seq, "door", "quota", "no"))
    assert side.waiting == [1, 3]


def test_a_rejection_that_is_told_twice_is_said_once(side: Side, caplog: pytest.LogCaptureFixture) -> None:
    for seq in (1, 1, 2):
        side.hear(Nack(side.key, seq, "map", "MapFull", "it is full"))
    said = [record.getMessage().partition(":")[0] for record in caplog.records]
    assert said == [f"keyframe {seq} is not in the map (MapFull)" for seq in (1, 2)]
    assert "more that are not" not in caplog.text


def test_a_server_of_another_version_gets_nothing(side: Side) -> None:
    side.hear(Welcome("epoch", messages.PROTOCOL_VERSION + 1, 2, 0, 8, 1 << 20, 1 << 20))
    assert (side.outbox.link_state.kind, side.control.terms) == ("refused", None)
    assert side.waiting == [1, 2, 3]


def test_nothing_is_sent_before_the_clocks_are_compared_nor_to_another_server(side: Side) -> None:
    side.welcome()
    assert side.control.terms is None
    side.pong("epoch")
    assert side.control.terms is not None
    side.pong("another")  # in its place: what was under way is lost, and its clock is another one
    assert (side.control.terms, side.control.welcome, side.control.clock.count) == (None, None, 0)


def test_a_gap_that_every_keyframe_reports_is_filled_once(side: Side) -> None:
    side.welcome()
    claimed = side.outbox.claim(8, 1 << 20)
    assert claimed is not None
    side.outbox.sent(claimed[0], 1)
    side.hear(Ack(side.key, 0, 0, resend=True))
    side.control.tick(side.control._rewound + 0.01)
    assert side.outbox.outstanding == 1
    side.control.tick(side.control._rewound + 1.0)
    assert side.outbox.outstanding == 0


def test_a_server_that_says_twice_where_to_go_sends_it_there_once(side: Side) -> None:
    for _ in range(3):  # answers to greetings, of which it had several while it was busy
        side.hear(Denied(side.key, "moved", "it moved", address="tcp://there", control="tcp://there"))
    assert side.control.take_move() == ("tcp://there", "tcp://there")
    assert side.control.take_move() is None
    side.control.follow("tcp://there", after=0.0)
    assert side.control._hello_due <= time.monotonic()
    side.control.follow("tcp://there", after=2.0)
    assert side.control._hello_due > time.monotonic() + 1
