# SPDX-License-Identifier: MIT
"""News of each keyframe for viewers: its pose at once, its picture as it came, as long as there is room."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from keyframes_and_servers import CAMERA, SHAPE, secured, wall
from served_gateway import Served, hosting, record

from tsfusion.gateway.people import scan_updates
from tsfusion.gateway.people.scan_updates import ScanUpdates
from tsfusion.wire.keys import key_folder
from tsfusion.wire.messages import questions
from tsfusion.wire.messages.messages import Command
from tsfusion.wire.messages.questions import ANSWER_BYTES, Scanned, Scans, ScansFound
from tsfusion.wire.records.record_header import unpack_keyframe


def found(served: Served, known: ScansFound | None = None, client: str = "") -> ScansFound:
    """The next keyframes, for a viewer that knows so many."""
    question = Scans(wait_s=1.0)
    if known is not None:
        question = Scans(since=known.until, epoch=known.epoch, wait_s=1.0)
    reply = served.ask(Command(name="ask", question=question, timeout_s=20.0), client=client)
    return questions.scans_of(questions.unpack(reply.answer, served.frames))


def test_a_keyframe_is_told_with_its_picture_as_it_came(served: Served) -> None:
    served.take(record(1))  # nobody watches yet
    served.step()
    first = found(served)
    assert (first.scans, first.missed) == ((), False)
    sent = record(2)
    served.take(sent)
    served.take(sent)  # once more, on its way
    second = found(served, first)
    (scanned,) = second.scans
    assert scanned.picture == sent[2]
    assert scanned.picture[:2] == b"\xff\xd8"
    assert (scanned.session, scanned.seq, scanned.client) == (bytes(16), 2, "")
    assert (scanned.intrinsics, scanned.shape, scanned.late) == (CAMERA, SHAPE, False)
    np.testing.assert_array_equal(scanned.pose, wall(2).T_world_camera[:3].ravel())
    assert found(served, second).scans == (), "its wait is over"
    served.take(record(3))
    assert [one.seq for one in found(served, second).scans] == [3]
    assert [one.seq for one in found(served, first).scans] == [2, 3]


class Updates:
    """A viewer that asks for keyframes, at times of the test's own."""

    def __init__(self) -> None:
        self.scans, self.known, self.number = ScanUpdates(), ScansFound("", 0), 0

    def note(self, seq: int, session: bytes = bytes(16)) -> None:
        head, *frames = record(seq, session=session)
        self.scans.note("default", unpack_keyframe(head), [head, *frames], "")

    def ask(self, wait_s: float = 0.0, most_bytes: int = ANSWER_BYTES) -> None:
        self.number += 1
        asked = Scans(self.known.until, self.known.epoch, wait_s, most_bytes)
        self.scans.ask(self.number, "default", asked)

    def told(self) -> tuple[Scanned, ...] | None:
        """The answer to the last question; None while it waits."""
        answers = dict(self.scans.step())
        if self.number in answers:
            self.known = answers[self.number]
            return self.known.scans
        return None


@contextmanager
def stopped_clock(monkeypatch: pytest.MonkeyPatch) -> Iterator[SimpleNamespace]:
    clock = SimpleNamespace(now=0.0, monotonic=lambda: clock.now, monotonic_ns=lambda: 7)
    monkeypatch.setattr(scan_updates, "time", clock)
    yield clock


def test_pictures_take_so_many_bytes_and_the_newest_comes_late(monkeypatch: pytest.MonkeyPatch) -> None:
    largest = max(len(record(seq)[2]) for seq in range(1, 9))
    monkeypatch.setattr(scan_updates, "PICTURE_BYTES", 4 * largest)  # a second; two at once
    with stopped_clock(monkeypatch) as clock:
        updates = Updates()
        updates.ask()
        assert updates.told() == ()
        for seq in range(1, 9):
            updates.note(seq)
        clock.now = 0.01
        updates.ask(1.0)
        assert updates.told() is None, "viewers that wait are answered together"
        clock.now = 0.11
        got = updates.told()
        assert got is not None
        assert [one.seq for one in got] == [*range(1, 9)]
        assert [one.seq for one in got if one.picture] == [1, 2]
        clock.now = 1.0
        updates.ask(1.0)
        (last,) = updates.told() or ()
        assert (last.seq, last.late, last.picture) == (8, True, record(8)[2])
        updates.ask(1.0)
        assert updates.told() is None
        clock.now = 2.0
        assert updates.told() == ()


def test_who_was_away_for_long_is_told_so_and_old_pictures_go(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scan_updates, "_KEPT", 5)
    monkeypatch.setattr(scan_updates, "_KEPT_PICTURES", 2)
    with stopped_clock(monkeypatch) as clock:
        updates = Updates()
        updates.ask()
        assert updates.told() == ()
        for seq in range(1, 5):
            updates.note(seq)
        clock.now = 1.0
        updates.ask()
        got = updates.told()
        assert got is not None
        assert [one.seq for one in got if one.picture] == [3, 4]
        for seq in range(5, 12):
            updates.note(seq)
        clock.now = 2.0
        updates.ask()
        assert (updates.told(), updates.known.missed) == ((), True)
        clock.now = 100.0  # nobody has asked for long: no picture is kept
        updates.note(12)
        updates.ask()
        assert [one.picture for one in updates.told() or ()] == [b""]


def test_nothing_of_a_forgotten_keyframe_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scan_updates, "PICTURE_BYTES", 2 * len(record(1)[2]))  # one at once
    with stopped_clock(monkeypatch) as clock:
        updates = Updates()
        updates.ask()
        assert updates.told() == ()
        updates.note(1)
        updates.note(2)
        updates.scans.forget("default")
        clock.now = 5.0  # there is room for the picture that waited
        updates.ask()
        assert (updates.told(), updates.known.missed) == ((), True)
        updates.note(3)
        clock.now = 6.0
        updates.ask()
        assert [(one.seq, bool(one.picture)) for one in updates.told() or ()] == [(3, True)]


def test_pictures_of_an_answer_have_a_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scan_updates, "SCANS_BYTES", len(record(1)[2]) + 9)
    with stopped_clock(monkeypatch) as clock:
        updates = Updates()
        updates.ask()
        assert updates.told() == ()
        for seq in (1, 1, 1):
            updates.note(seq)
        for _ in range(3):
            clock.now += 1.0
            updates.ask()
            assert len(updates.told() or ()) == 1
        updates.note(2)
        clock.now += 1.0
        updates.ask(most_bytes=len(record(2)[2]) - 1)
        assert [(one.seq, one.picture) for one in updates.told() or ()] == [(2, b"")]


def test_a_key_for_another_map_hears_nothing(tmp_path: Path) -> None:
    given, guest = secured(tmp_path / "keys"), tmp_path / "guest"
    public = key_folder.create_pair(guest, "guest").public
    key_folder.allow(Path(given.server["keys"]), "guest", public, maps=["theirs"])
    with hosting(tmp_path / "state", **given.server) as served:
        first = found(served, client="robot")
        reply = served.ask(Command(name="ask", question=Scans(wait_s=0.0)), client="guest")
        assert (reply.answer, served.frames) == (None, [])
        assert "may not use map default" in (reply.error or "")
        served.take(record(1), client="robot")
        assert [one.client for one in found(served, first, "robot").scans] == ["robot"]
