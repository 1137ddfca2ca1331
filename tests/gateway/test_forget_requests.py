# SPDX-License-Identifier: MIT
"""Requests to forget: what is asked of the fuser, written and erased, in which order."""

from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from keyframes_and_servers import wall

from tsfusion import journal
from tsfusion.core.errors import JournalError
from tsfusion.fuser.fuser_messages import EXPIRED, Find, Found, FoundKeyframes, Save, Saved
from tsfusion.gateway.clients.client_routes import Sessions
from tsfusion.gateway.maps.forgetting import MOST_REQUESTS, ForgetRequest, Forgetting
from tsfusion.gateway.records.journaled_records import KeyframeIndex
from tsfusion.journal import Journal, Position
from tsfusion.journal.quarantine import Quarantine
from tsfusion.wire.messages.forget_messages import Forgotten, Selection
from tsfusion.wire.records import codec

SESSION = b"s" * 16
ALL = Selection(session=SESSION.hex())


class Asked:
    """A map's requests over a journal of three keyframes, with lists for a fuser and an index."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.journal = Journal(folder / "journal", 1 << 20)
        self.positions = [self._append(i) for i in range(3)]
        self.sent: list[Any] = []
        self.written: list[tuple[bytes, list[int]]] = []
        self.answers: list[Forgotten | str] = []
        self.refuses = False
        self.in_map = 3  # highest number that the fuser has answered
        self.map = self.forgetting(Quarantine(folder / "quarantine", 1 << 20))

    def forgetting(self, quarantine: Quarantine) -> Forgetting:
        index, sessions = KeyframeIndex(), Sessions()
        for place in self.positions:
            index.add(place, sessions.open(SESSION, "robot"), len(index) + 1, client="robot")
        records: Any = SimpleNamespace(
            folder=self.folder, journal=self.journal, quarantine=quarantine, index=index, sessions=sessions
        )
        return Forgetting("default", records, append=self._write, send=self._send)

    def _append(self, i: int) -> Position:
        frames = codec.encode(wall(i), session=SESSION, seq=i + 1, jpeg_quality=90)
        return self.journal.append(frames, session=SESSION, seq=i + 1)

    def _write(self, session: bytes, seqs: np.ndarray) -> None:
        if self.refuses:
            raise JournalError("the disk is full")
        self.written.append((session, seqs.tolist()))

    def _send(self, message: Any) -> bool:
        self.sent.append(message)
        return True

    def ask(self, **how: bool) -> None:
        self.map.add(ForgetRequest(ALL, self.answers.append, **how))
        self.step()

    def step(self, *, settled: bool = False, unavailable: int = 0) -> None:
        self.map.step(is_server_answered=settled, in_map=lambda _: self.in_map, unavailable=unavailable)

    def find(self, *seqs: int, forgotten: tuple[int, ...] = ()) -> None:
        """Answer what was asked last."""
        (number,) = [one.number for one in self.sent[-1:] if isinstance(one, Find)]
        self.map.on_found(Found(number, (self.keyframes(seqs, forgotten),)))

    def keyframes(self, seqs: tuple[int, ...], forgotten: tuple[int, ...] = ()) -> FoundKeyframes:
        places = [self.positions[seq - 1] for seq in seqs]
        rows = [
            (seq, one.segment, one.offset, seq in forgotten) for seq, one in zip(seqs, places, strict=True)
        ]
        return FoundKeyframes(SESSION, "robot", np.array(rows, np.int64).tobytes())

    @property
    def erased(self) -> list[int]:
        path = journal.segment_path(self.folder / "journal", 1)
        return [one.seq for one in journal.list_records(path)[0] if one.is_erased]


@pytest.fixture
def asked(tmp_path: Path) -> Iterator[Asked]:
    found = Asked(tmp_path)
    yield found
    found.journal.close()


def test_it_is_answered_when_the_record_is_written(asked: Asked) -> None:
    asked.ask()
    assert asked.answers == []
    asked.find(1, 2, 2, 3, forgotten=(3,))
    assert asked.written == [(SESSION, [1, 2])]
    (answer,) = asked.answers
    assert isinstance(answer, Forgotten)
    assert (answer.keyframes, answer.selected, answer.erased, asked.erased) == (2, 3, 0, [])


def test_a_dry_run_writes_nothing(asked: Asked) -> None:
    asked.ask(dry_run=True)
    asked.find(1, 2)
    assert (asked.written, len(asked.answers)) == ([], 1)


def test_nothing_is_erased_before_map_and_checkpoints_let_it_go(asked: Asked) -> None:
    asked.ask(erase=True)
    asked.find(1, 3)
    asked.step()
    assert not [one for one in asked.sent if isinstance(one, Save)]
    asked.step(settled=True)
    assert asked.sent[-1] == Save(alone=True)
    asked.map.on_saved(Saved(True))  # of another checkpoint, for the journal's limit
    asked.step(settled=True)
    assert asked.erased == []
    asked.map.on_saved(Saved(True, alone=True))
    asked.step(settled=True)
    assert asked.erased == [1, 3]
    (answer,) = asked.answers
    assert isinstance(answer, Forgotten)
    assert answer.erased == 2


def test_copies_in_quarantine_are_erased_too(asked: Asked) -> None:
    aside = Quarantine(asked.folder / "quarantine", 1 << 20)
    for seq in (1, 2, 3):
        frames = codec.encode(wall(seq), session=SESSION, seq=seq, jpeg_quality=90)
        assert aside.keep(frames, session=SESSION, seq=seq, reason="crash") is not None
    asked.map = asked.forgetting(aside)
    asked.ask(erase=True)
    asked.find(1, 3)
    asked.step(settled=True)
    assert len(aside) == 3
    asked.map.on_saved(Saved(True, alone=True))
    for _ in range(3):
        asked.step(settled=True)
    assert [int(path.name.split("-")[1]) for path in aside.folder.iterdir()] == [2]
    (answer,) = asked.answers
    assert isinstance(answer, Forgotten)
    assert (answer.erased, answer.quarantined) == (2, 2)


def test_nothing_is_erased_that_the_fuser_was_not_given_yet(asked: Asked) -> None:
    """The server's record may overtake keyframes of others that wait; a crash then would lose their count."""
    asked.in_map = 2
    asked.ask(erase=True)
    asked.find(1, 3)
    asked.step(settled=True)
    assert not [one for one in asked.sent if isinstance(one, Save)]
    asked.in_map = 3
    asked.step(settled=True)
    assert asked.sent[-1] == Save(alone=True)


def test_a_fuser_that_dies_is_asked_again(asked: Asked) -> None:
    asked.ask(erase=True)
    (first,) = asked.sent
    asked.map.on_ready()
    asked.step()
    asked.map.on_found(Found(first.number, (asked.keyframes((1, 2, 3)),)))  # too late
    assert asked.written == []
    asked.find(2)
    asked.step(settled=True)
    asked.map.on_ready()
    asked.map.on_saved(Saved(True, alone=True))
    asked.step()
    assert asked.erased == []
    asked.step(settled=True)
    asked.map.on_saved(Saved(True, alone=True))
    asked.step()
    assert asked.erased == [2]


def test_what_stands_in_the_way_is_answered(asked: Asked) -> None:
    asked.ask(erase=True)
    asked.find(1)
    asked.step(settled=True, unavailable=1)
    asked.ask(erase=True)
    asked.find(1)
    asked.step(settled=True)
    asked.map.on_saved(Saved(False, "no room", alone=True))
    asked.refuses = True
    asked.ask()
    asked.find(2)
    for number in range(MOST_REQUESTS + 1):
        asked.ask(dry_run=number % 2 == 0)
    asked.map.give_up("the fuser is gone")
    words = [answer for answer in asked.answers if isinstance(answer, str)]
    assert words == [
        "1 keyframe cannot be taken out of the map: the log says why; all that were selected are forgotten, "
        "and nothing was erased",
        "nothing was erased: no room",
        "nothing was forgotten: the disk is full",
        "too many requests to forget wait: ask again",
        *["the fuser is gone"] * MOST_REQUESTS,
    ]
    assert (asked.erased, asked.map.is_idle) == ([], True)


def test_what_is_too_old_is_written_without_a_request(asked: Asked) -> None:
    asked.map.on_found(Found(EXPIRED, (asked.keyframes((1,)),)))
    asked.refuses = True
    asked.map.on_found(Found(EXPIRED, (asked.keyframes((2,)),)))  # the disk is full: found again, later
    assert asked.written == [(SESSION, [1])]


def test_files_that_may_hold_something_are_named(asked: Asked) -> None:
    for name in ("map.damaged.tsf", "journal/000001.mcap.replaced"):
        (asked.folder / name).touch()
    asked.ask(erase=True)
    asked.find(1)
    asked.step(settled=True)
    asked.map.on_saved(Saved(True, alone=True))
    asked.step()
    (answer,) = asked.answers
    assert isinstance(answer, Forgotten)
    assert [Path(name).name for name in answer.remains] == ["map.damaged.tsf", "000001.mcap.replaced"]
