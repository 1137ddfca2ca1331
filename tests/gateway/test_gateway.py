# SPDX-License-Identifier: MIT
"""The gateway with fusers that misbehave, and with files that are away."""

import errno
import itertools
import os
import signal
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, ClassVar

import pytest
from failures import refuse
from served_gateway import Ended, QuietFuser, Served, hosting

from tsfusion import journal
from tsfusion.core import process
from tsfusion.core.errors import InvalidConfig, JournalError, MapError
from tsfusion.fuser import fuser_messages
from tsfusion.fuser.fuser_messages import Begin, Done, Fuse, FuserAnswer, Ready, Save, Saved
from tsfusion.gateway.fusers import fuser_supervisor
from tsfusion.journal import Journal, state_folder
from tsfusion.wire.messages.health import MapHealth

FOR_EVER = float("inf")
Script = Callable[["Scripted", Any], Iterator[float]]
Special = Callable[["Scripted", int], Iterator[float] | None]
Start = Callable[..., Served]


class Scripted(QuietFuser):
    """A fuser that does with each message what `script` says."""

    script: ClassVar[Script]
    begin: Begin

    def work(self, message: fuser_messages.ToFuser) -> Iterator[float]:
        if isinstance(message, Begin):
            self.begin = message
        return type(self).script(self, message)

    def at(self, index: int) -> None:
        self.current_keyframe = index


def fusing(
    special: Special = lambda _fuser, _index: None, ready: Ready | None = None, then: Special | None = None
) -> Script:
    """Return the script of a fuser: `special` at each keyframe, `then` once the keyframe is fused."""

    def script(fuser: Scripted, message: Any) -> Iterator[float]:
        if isinstance(message, Begin):
            fuser.say(ready or Ready({}))
        if isinstance(message, Fuse):
            if message.skip is None:
                fuser.at(message.index)
                yield from special(fuser, message.index) or ()
                fuser.at(-1)
            fuser.say(Done(message.index, 1, 2, message.skip))
            yield from (then and then(fuser, message.index)) or ()

    return script


def dying(*indices: int, status: int = 7, times: int = 1 << 30) -> Script:
    """A fuser that dies at these keyframes, so many times."""
    left = [times]

    def die(_: Scripted, index: int) -> None:
        if index in indices and left[0]:
            left[0] -= 1
            raise Ended(status)

    return fusing(die)


def busy(at: int, seconds: float, *, state: str = "S", times: int = 1 << 30) -> Script:
    """A fuser that does nothing for so long at a keyframe, so many times."""
    left = [times]

    def wait(fuser: Scripted, index: int) -> Iterator[float]:
        if index == at and left[0]:
            left[0] -= 1
            fuser.state = state
            yield seconds
            fuser.state = "S"

    return fusing(wait)


def once(fuser: Scripted, message: Any) -> Iterator[float]:
    """A fuser that is ready once, and then dies, as all that come after it."""
    mark = Path(fuser.begin.folder) / "once"
    if mark.exists():
        raise Ended(9)
    mark.touch()
    fuser.say(Ready({}))
    yield 0.0
    raise Ended(7)


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """A gateway over five journaled records, with a fuser that follows this script."""
    with ExitStack() as stack:

        def begin(script: Script, **settings: Any) -> Served:
            writer = Journal(state_folder.map_folder(tmp_path, "default") / "journal", 1 << 20)
            for i in range(5):
                writer.append([b"head", b"body"], session=bytes(16), seq=i + 1)
            writer.close()
            Scripted.script = script
            return stack.enter_context(hosting(tmp_path, fuser=Scripted, warm=False, **settings))

        yield begin


def drained(served: Served) -> Served:
    served.until(lambda: served.gateway.maps.drained)
    return served


def warm(served: Served) -> Served:
    served.until(lambda: served.gateway.maps.warm)
    return served


def default(served: Served) -> MapHealth:
    return served.gateway.health().maps["default"]


def test_a_keyframe_that_kills_the_fuser_twice_is_quarantined(
    start: Start, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    health = default(drained(start(dying(2))))
    assert (health.fuser_restarts, health.rejected, health.quarantined) == (2, {"crash": 1}, 1)
    assert (health.keyframes_fused, health.keyframes_durable) == (4, 5)
    said = caplog.records[-1]
    assert said.getMessage() == "a keyframe is not in the map: crash"
    assert {"map": "default", "seq": 3, "reason": "crash"}.items() <= vars(said)["about"].items()
    (kept,) = (state_folder.map_folder(tmp_path, "default") / "quarantine").iterdir()
    assert kept.name == "00000000-3-crash.mcap"
    (record,) = journal.records(kept)
    assert (record.seq, [bytes(frame) for frame in record.frames]) == (3, [b"head", b"body"])


def test_a_fuser_that_is_killed_is_not_the_keyframes_fault(start: Start) -> None:
    """Somebody kills it three times at the same keyframe: that says nothing about the keyframe."""
    served = drained(start(dying(2, status=-signal.SIGKILL, times=3)))
    health, (hosted,) = default(served), served.gateway.maps
    assert (health.fuser_restarts, health.rejected, health.keyframes_fused) == (3, {}, 5)
    assert hosted.fuser._blame == {}  # it is fused


def test_a_fuser_that_goes_on_for_long_is_steady_and_gets_few_keyframes_at_once(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fuser_supervisor, "_STEADY_AFTER", -1.0)
    served = start(fusing())
    (hosted,) = served.gateway.maps
    hosted.fuser._early_deaths = 3
    drained(served)
    assert hosted.fuser._early_deaths == 0
    assert hosted.fuser.wants_work
    hosted.fuser.in_flight.extend(range(4))
    assert not hosted.fuser.wants_work


def test_what_is_done_between_keyframes_may_take_longer(start: Start) -> None:
    """A mesh, a checkpoint."""

    def pause(fuser: Scripted, index: int) -> Iterator[float]:
        fuser.at(-1)
        yield 1.2 * (index == 1)

    assert default(drained(start(fusing(pause), fuser_timeout=0.6))).fuser_restarts == 0


def test_a_fuser_that_takes_all_memory_at_a_keyframe_crashes_at_it(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The system kills it, and counts that."""
    monkeypatch.setattr(process, "oom_kills", itertools.count().__next__)
    health = default(drained(start(dying(2, status=-signal.SIGKILL))))
    assert (health.fuser_restarts, health.rejected, health.keyframes_fused) == (2, {"crash": 1}, 4)


def test_a_fuser_that_is_stopped_is_not_the_keyframes_fault(start: Start) -> None:
    """Somebody stops it three times at the same keyframe, and never lets it go on."""
    served = start(busy(2, FOR_EVER, state="T", times=3), fuser_timeout=20.0)
    served.until(lambda: "is stopped from outside" in default(served).problem)
    assert not served.gateway.health().ready
    health = default(drained(served))
    assert (health.fuser_restarts, health.rejected, health.keyframes_fused) == (3, {}, 5)
    assert health.problem == ""


def test_a_stopped_fuser_that_goes_on_is_waited_for(start: Start) -> None:
    served = start(busy(2, 60.0, state="T"), fuser_timeout=600.0)
    (hosted,) = served.gateway.maps
    served.until(lambda: "is stopped" in hosted.fuser.problem)
    assert default(drained(served)).fuser_restarts == 0
    assert hosted.fuser.problem == ""


def test_time_in_which_the_server_stood_still_counts_for_nobody(start: Start) -> None:
    """A suspended machine or a paused container stops gateway and fuser alike."""
    served = start(busy(2, 3601.0), fuser_timeout=30.0)
    (hosted,) = served.gateway.maps
    served.until(lambda: hosted.fuser.process.current_keyframe == 2)
    served.clock.now += 3600.0
    assert default(drained(served)).fuser_restarts == 0


def test_a_death_between_keyframes_is_nobodys_fault(start: Start) -> None:
    left = [1]

    def die(_: Scripted, index: int) -> None:
        if index == 2 and left[0]:
            left[0] -= 1
            raise Ended(3)

    assert default(drained(start(fusing(then=die)))).rejected == {}


def test_a_fuser_that_hangs_at_a_keyframe_is_replaced(start: Start) -> None:
    health = default(drained(start(busy(1, FOR_EVER), fuser_timeout=2.0)))
    assert (health.fuser_restarts, health.rejected, health.keyframes_fused) == (2, {"crash": 1}, 4)


def test_a_fuser_that_does_not_die_yet_holds_nobody_up(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    """A killed process that waits for a disk ends when the disk answers: no other may begin before that."""
    killed: list[Scripted] = []
    served = start(busy(1, FOR_EVER), fuser_timeout=2.0)
    (hosted,) = served.gateway.maps
    with monkeypatch.context() as patched:
        patched.setattr(Scripted, "kill", lambda fuser: killed.append(fuser))  # noqa: PLW0108
        served.until(lambda: killed)
        served.step()
        assert (killed[0], default(served).fuser_restarts) == (hosted.fuser.process, 0)
    killed[0].kill()
    health = default(drained(served))
    assert (health.fuser_restarts, health.rejected, health.keyframes_fused) == (2, {"crash": 1}, 4)


def cannot_start(fuser: Scripted, message: Any) -> Iterator[float]:
    yield 0.0
    raise Ended(9)


def has_no_setting(fuser: Scripted, message: Any) -> Iterator[float]:
    fuser.say(fuser_messages.Failed("config", "no such setting"))
    yield from ()


@pytest.mark.parametrize(
    ("script", "error", "message"),
    [
        (cannot_start, MapError, "ended with status 9 before it was ready"),
        (has_no_setting, InvalidConfig, "no such setting"),
    ],
)
def test_why_a_fuser_cannot_start_is_one_clear_error(
    start: Start, script: Script, error: type[Exception], message: str
) -> None:
    served = start(script)
    with pytest.raises(error, match=message):
        warm(served)


def test_a_fuser_that_does_not_come_back_is_tried_ever_more_rarely(start: Start) -> None:
    """The gateway goes on receiving: what is in the journal is fused when the fuser can be mended."""
    served = start(once)
    served.until(lambda: default(served).state == "failed")
    assert default(served).fuser_restarts >= 2
    assert "its fuser process ended" in default(served).problem
    assert not served.gateway.health().ready
    Scripted.script = fusing()
    drained(served)
    assert default(served).problem == ""


def test_poison_costs_two_deaths_each(start: Start) -> None:
    health = default(drained(start(dying(1, 2, 3))))
    assert (health.fuser_restarts, health.rejected, health.quarantined) == (6, {"crash": 3}, 3)


def test_no_room_for_a_new_fuser_is_waited_out(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    served = start(dying(2))
    with monkeypatch.context() as full:
        full.setattr(QuietFuser, "is_refused", True)
        served.until(lambda: "cannot be started" in default(served).problem)
        served.step()
    assert default(drained(served)).problem == ""


# --- folders and files that are away ---


def journal_folder(state: Path) -> Path:
    return state_folder.map_folder(state, "default") / "journal"


def test_a_journal_that_is_away_is_said_although_no_keyframe_comes_until_it_is_back(
    start: Start, tmp_path: Path
) -> None:
    go: list[bool] = []

    def wait_and_die(_: Scripted, index: int) -> Iterator[float]:
        while index == 2 and not go:
            yield 0.1
        if index == 2:
            raise Ended(7)

    served = warm(start(fusing(wait_and_die)))
    journal_folder(tmp_path).rename(tmp_path / "aside")
    served.until(lambda: "No such file" in default(served).problem)
    go.append(True)
    assert not served.gateway.health().ready
    hosted = served.gateway.maps.get("default")
    assert hosted is not None
    served.until(hosted.fuser.ended)
    for _ in range(3):
        served.step()
    assert default(served).fuser_restarts == 0  # it would begin with an empty map
    assert not journal_folder(tmp_path).exists()
    assert hosted.ended  # a server that is to end does not wait for it
    (tmp_path / "aside").rename(journal_folder(tmp_path))
    served.until(lambda: not default(served).problem)
    assert default(drained(served)).keyframes_fused == 4


def test_nothing_is_deleted_from_a_journal_that_is_away(start: Start, tmp_path: Path) -> None:
    """With an empty folder in its place its segments would count as deleted, and nobody would miss them."""
    served = drained(start(fusing()))
    (hosted,) = served.gateway.maps
    journal_folder(tmp_path).rename(tmp_path / "aside")
    journal_folder(tmp_path).mkdir()
    served.until(lambda: hosted.records.disk.is_away)
    retention = hosted.records.retention
    retention._max_bytes, retention._in_previous = 1, 2
    served.step()
    assert hosted.records.journal.first == 1
    journal_folder(tmp_path).rmdir()
    (tmp_path / "aside").rename(journal_folder(tmp_path))
    served.until(lambda: hosted.records.journal.first == 2)


def test_segments_that_vanish_are_named_and_the_map_is_saved_at_once(start: Start, tmp_path: Path) -> None:
    served = drained(start(fusing()))
    (hosted,) = served.gateway.maps
    fuser: Any = hosted.fuser.process
    segment = journal.segment_path(journal_folder(tmp_path), 1)
    other = Journal(tmp_path / "other", 1 << 20)
    other.append([b"head"], session=bytes(16), seq=1)
    other.close()
    journal.segment_path(tmp_path / "other", 1).rename(journal.segment_path(journal_folder(tmp_path), 9))
    segment.rename(tmp_path / "aside")
    fuser._busy_until = FOR_EVER
    served.until(lambda: any(isinstance(one, Save) for one in fuser.unread))
    (problem,) = served.gateway.health().problems
    assert "map default: 1 segment of its journal is gone, first 000001.mcap" in problem
    (tmp_path / "aside").rename(segment)
    served.until(lambda: not served.gateway.health().problems)


@pytest.mark.parametrize("call", ["listdir", "fsync", "stat"])
def test_a_disk_that_fails_while_a_map_is_opened_for_a_client_is_said(
    start: Start, monkeypatch: pytest.MonkeyPatch, call: str
) -> None:
    served = warm(start(fusing()))
    maps = served.gateway.maps
    maps.end_start(("", ""))
    with monkeypatch.context() as patched:
        patched.setattr(os, call, refuse(errno.EIO))
        assert maps.open_for_client("yard") is None
        assert "error" in maps.why_not("yard")
        with suppress(JournalError):  # no name is guessed
            assert maps.free_name("yard") != "yard"
    served.clock.now += 60.0
    assert maps.open_for_client("yard") is not None


def test_a_gap_in_the_journal_is_said_from_the_start(start: Start, tmp_path: Path) -> None:
    begin = Journal(journal_folder(tmp_path), 1)
    for seq in range(10, 13):
        begin.append([b"head"], session=bytes(16), seq=seq)
    journal.segment_path(journal_folder(tmp_path), 2).unlink()
    served = warm(start(fusing()))
    assert (
        "map default: 1 segment of its journal was not there at the start"
        in served.gateway.health().problems[0]
    )


def test_a_checkpoint_that_cannot_be_written_is_a_problem_and_tried_again(start: Start) -> None:
    full = Saved(False, "No space left on device")
    fuses = fusing(then=lambda fuser, _: fuser.say(full))

    def script(fuser: Scripted, message: Any) -> Iterator[float]:
        if isinstance(message, Save):
            fuser.say(Saved(True))
        return fuses(fuser, message)

    served = start(script)
    served.until(lambda: served.gateway.health().problems)
    (problem,) = served.gateway.health().problems
    assert problem.startswith("map default: no checkpoint can be written: No space left on device")
    served.until(lambda: default(served).checkpoints > 0 and not served.gateway.health().problems)


def test_a_record_that_waits_for_its_folder_is_a_problem(start: Start) -> None:
    def stuck(fuser: Scripted, _: int) -> Iterator[float]:
        fuser.say(fuser_messages.Stuck("cannot read it"))
        yield 0.3

    served = start(fusing(stuck))
    served.until(lambda: default(served).problem == "cannot read it")
    assert default(drained(served)).problem == ""


def test_a_journal_that_ends_before_its_checkpoint_is_said(
    start: Start, caplog: pytest.LogCaptureFixture
) -> None:
    ready = Ready({bytes(16): fuser_messages.SessionProgress(9, "")})
    served = warm(start(fusing(ready=ready)))
    assert "its checkpoint holds keyframes of 1 session that its journal" in caplog.text
    assert served.gateway.maps.progress("default", bytes(16)) == (9, 9)  # they are not taken once more


def test_checkpoints_that_are_lost_with_what_only_they_held_are_said(start: Start, tmp_path: Path) -> None:
    begin = Journal(journal_folder(tmp_path), 1)
    for seq in (8, 9):
        begin.append([b"head"], session=bytes(16), seq=seq)
    journal.segment_path(journal_folder(tmp_path), 1).unlink()
    begin.close()
    served = warm(start(fusing()))
    (problem,) = served.gateway.health().problems
    assert "its checkpoints are lost, and with them what was journaled before segment 2" in problem


def test_the_last_words_of_a_dead_fuser_are_not_heard(start: Start) -> None:
    """They may be delivered late, when its keyframes are handed out anew."""
    served = start(once)
    (hosted,) = served.gateway.maps
    served.until(lambda: hosted.fuser._restart_at > served.clock.now + 0.5)
    fuser: Any = hosted.fuser.process
    fuser.say(Done(0, 1, 2))
    assert hosted.fuser.receive() is None
    served.step()


def dies_moving(fuser: Scripted, message: Any) -> Iterator[float]:
    if isinstance(message, Begin):
        waiting = 3 if message.moves else 0
        moves = fuser_messages.CorrectionProgress(0, 0, waiting, 3 - waiting, 0, 0.0)
        fuser.say(Ready({}, moves=moves))
    if isinstance(message, Fuse):
        fuser.say(Done(message.index, 1, 2))
        if fuser.begin.moves and message.index == 4:
            fuser.at(fuser_messages.MOVING)
            raise Ended(7)
    yield from ()


def test_corrections_that_kill_the_fuser_twice_are_given_up(
    start: Start, caplog: pytest.LogCaptureFixture
) -> None:
    health = default(drained(start(dies_moving)))
    assert (health.fuser_restarts, health.keyframes_fused, health.rejected) == (2, 5, {})
    assert (health.corrections_waiting, health.corrections_unavailable) == (0, 3)
    assert "they stay where they were fused until the server starts anew" in caplog.text


def test_an_answer_is_of_the_moment_at_which_it_was_given(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A map that is idle now was not, when its fuser answered before it fused the last keyframe."""
    served = start(fusing(lambda fuser, index: fuser.say(FuserAnswer(7)) if index == 4 else None))
    (hosted,) = served.gateway.maps
    passed: list[tuple[type, bool]] = []

    def note(answer: FuserAnswer, *_: object) -> None:
        passed.append((type(answer), hosted.drained))

    monkeypatch.setattr(served.gateway.requests, "on_answer", note)
    drained(served)
    assert passed == [(FuserAnswer, False)]


def test_orders_that_find_no_room_are_given_again(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    served = warm(start(fusing()))
    (hosted,) = served.gateway.maps
    order = fuser_messages.Fuse(7, journal.Position(1, 8), bytes(16), 9)
    drained(served)
    with monkeypatch.context() as full:
        full.setattr(Scripted, "send", lambda *_: False)
        assert not hosted.fuser.fuse(order)
        assert list(hosted.fuser.in_flight) == []
        hosted.fuser.finish()
        assert hosted.fuser.finishing
        assert not hosted.fuser._finish_sent
    hosted.fuser.finish()
    assert hosted.fuser._finish_sent
