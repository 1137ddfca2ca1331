# SPDX-License-Identifier: MIT
"""Where keyframes are, as one follows it: page by page, again when they moved, never too often."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from health_snapshots import map_health
from keyframes_and_servers import CAMERA, SHAPE, pose, wall

from tsfusion.core.errors import DecodeError
from tsfusion.fuser.live_mesh import TouchedBy
from tsfusion.fuser.watched_map import WatchedMap
from tsfusion.geometry.up_direction import SensorPosture
from tsfusion.journal import Position
from tsfusion.journal.ledger import Ledger
from tsfusion.wire.asking.followed_map import FollowedPaths, PathsFound, ScannerSeen
from tsfusion.wire.messages import questions
from tsfusion.wire.messages.questions import Keyframes, Scanned, Scans, ScansFound
from tsfusion.wire.records import corrections
from tsfusion.wire.records.corrections import Correction

ONE, TWO, THREE = (bytes([i] * 16) for i in (1, 2, 3))
HELD = SensorPosture(range(12))
HELD_MAP: Any = SimpleNamespace(held=HELD)


def ledger_of(counts: dict[bytes, int]) -> Ledger:
    ledger = Ledger()
    for session, count in counts.items():
        for i in range(count):
            ledger.add(session, 2 * i + 1, Position(1, 8 * i), wall(i))
    return ledger


def asked(ledger: Ledger, follower: FollowedPaths, now: float = 0.0) -> tuple[PathsFound, int]:
    """All paths, and how many answers they took."""
    answers = WatchedMap(HELD_MAP, ledger, TouchedBy(), None, "a")  # type: ignore[arg-type]
    for count in range(1, 100):
        question = follower.question(now)
        assert question is not None
        if events := follower.on_keyframes("a", answers.keyframes(question)):
            (found,) = events
            assert isinstance(found, PathsFound)
            assert found.held is not None
            assert found.held.numbers == HELD.numbers
            return found, count
    raise AssertionError("no end")


@pytest.mark.parametrize("most", [1, 3, 5, 100])
def test_pages_make_all_paths(monkeypatch: pytest.MonkeyPatch, most: int) -> None:
    monkeypatch.setattr(questions, "KEYFRAMES_AT_ONCE", most)
    ledger = ledger_of({TWO: 5, ONE: 3, THREE: 2})
    ledger.forget(ONE, np.array([3]))
    ledger.set_fused(ONE, 3)
    found, _ = asked(ledger, FollowedPaths())
    assert {key: seqs.tolist() for key, (seqs, _) in found.paths.items()} == {
        ONE: [1, 5],
        TWO: [1, 3, 5, 7, 9],
        THREE: [1, 3],
    }
    np.testing.assert_array_equal(found.paths[TWO][1][4], pose(0.12))


def test_paths_are_asked_for_again_but_not_too_often(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(questions, "KEYFRAMES_AT_ONCE", 1)
    follower, ledger = FollowedPaths(), ledger_of({ONE: 4})
    follower.on_health(map_health())
    _, answers = asked(ledger, follower)
    assert answers == 4
    follower.on_health(map_health())
    assert follower.question(99.0) is None
    follower.on_health(map_health(keyframes_moved=1))
    assert follower.question(99.0) is not None
    asked(ledger, follower, 99.0)
    follower.on_health(map_health(keyframes_moved=2))
    assert follower.question(99.0 + 7.0) is None  # the last time took four answers
    assert follower.question(99.0 + 8.0) is not None


def test_small_pages_are_no_reason_to_wait_for_longer() -> None:
    """A slow link gets small pages; paths that moved are asked for as soon as over a fast one."""
    ledger = ledger_of({ONE: 100})
    answers: Any = WatchedMap(HELD_MAP, ledger, TouchedBy(), None, "a")  # type: ignore[arg-type]
    follower, pages = FollowedPaths(), 0
    for now in (0.0, 2.0, 4.0):
        follower.on_scans(ScansFound("e", 7, missed=True))
        while (question := follower.question(now, 4 * 256)) is not None:
            pages += 1
            follower.on_keyframes("a", answers.keyframes(question))
    assert pages == 3 * 25


def test_scanners_are_shown_where_their_keyframes_come_to_be() -> None:
    follower, ledger = FollowedPaths(), ledger_of({ONE: 2})
    moved = corrections.checked({1: pose(5)}, T_map_odometry=pose(1))
    assert isinstance(moved, Correction)
    ledger.correct(ONE, moved)
    asked(ledger, follower)
    rows = tuple(pose(0.5)[:3].ravel().tolist())
    assert follower.scans_question(7) == Scans(wait_s=1.0, most_bytes=7)
    scanned = Scanned(ONE, 5, rows, CAMERA, SHAPE, "robot", b"jpeg")
    (seen,) = follower.on_scans(ScansFound("e", 7, (scanned,)))
    assert isinstance(seen, ScannerSeen)
    assert follower.scans_question(8) == Scans(7, "e", 1.0, 8)
    assert (seen.session, seen.seq, seen.picture, seen.client, seen.shape) == (
        ONE,
        5,
        b"jpeg",
        "robot",
        SHAPE,
    )
    np.testing.assert_array_equal(seen.T_world_camera, pose(1.5))
    assert follower.question(99.0) is None
    late = Scanned(TWO, 9, rows, picture=b"jpeg", late=True)
    follower.on_scans(ScansFound("e", 9, (Scanned(TWO, 9, rows), late)))
    assert follower.question(99.0) is None
    assert follower.on_scans(ScansFound("e", 400, missed=True)) == []
    assert follower.question(99.0) is not None


def test_keyframes_that_come_from_the_journal_alone_are_asked_for() -> None:
    """After a server's crash the map gets back what no checkpoint had, and no scanner sends it."""
    follower, rows = FollowedPaths(), tuple(pose(0.5)[:3].ravel().tolist())
    follower.on_health(map_health(keyframes_fused=2, waiting=5))
    asked(ledger_of({ONE: 2}), follower)
    follower.on_health(map_health(keyframes_fused=4, waiting=3))
    assert follower.question(99.0) is None, "more will come"
    follower.on_health(map_health(keyframes_fused=7, waiting=0))
    found, _ = asked(ledger_of({ONE: 7}), follower, 99.0)
    assert len(found.paths[ONE][0]) == 7
    follower.on_health(map_health(keyframes_fused=7, waiting=0))
    assert follower.question(199.0) is None
    late = Scanned(ONE, 22, rows, picture=b"jpeg", late=True)
    follower.on_scans(ScansFound("e", 4, (Scanned(ONE, 21, rows), Scanned(ONE, 22, rows), late)))
    follower.on_health(map_health(keyframes_fused=9, waiting=0))
    assert follower.question(199.0) is None, "they were seen"
    follower.on_health(map_health(keyframes_fused=10, waiting=0))
    assert follower.question(199.0) is not None


def test_what_makes_no_sense_is_asked_for_again() -> None:
    follower = FollowedPaths()
    question = follower.question(0.0)
    answers = WatchedMap(HELD_MAP, ledger_of({ONE: 2}), TouchedBy(), None, "a")  # type: ignore[arg-type]
    assert question is not None
    good = answers.keyframes(question)
    for name in good:
        with pytest.raises(DecodeError):
            follower.on_keyframes("a", {key: one for key, one in good.items() if key != name})
    with pytest.raises(DecodeError):
        follower.on_keyframes("a", {**good, "seqs": good["seqs"][:1]})
    with pytest.raises(DecodeError):
        follower.on_keyframes("a", {**good, "session": good["session"] + 7})
    assert follower.question(0.0) == question
    (found,) = follower.on_keyframes("a", good)
    assert isinstance(found, PathsFound)
    assert len(found.paths[ONE][0]) == 2


def test_an_answer_has_as_many_keyframes_as_the_viewer_takes() -> None:
    """Over a slow link, a page of all of them would be so late that the server counts as silent."""
    asked = [FollowedPaths().question(0.0, most_bytes) for most_bytes in (1, 600, 1 << 30)]
    assert [one and one.count for one in asked] == [1, 2, 4096]
    assert Keyframes().count == 4096
