# SPDX-License-Identifier: MIT
"""`tsfusion journal`: what it finds, what it saves, its exit status, and that it changes nothing."""

import json
import os
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_processes import Here, end, read_until, tsfusion
from keyframes_and_servers import pose, wall
from mcap.reader import make_reader

from tsfusion import journal
from tsfusion.core.errors import JournalError
from tsfusion.geometry import se3
from tsfusion.journal import Journal, segment_path
from tsfusion.journal.journaled_keyframes import JournalRecording
from tsfusion.journal.state_folder import find_journal
from tsfusion.wire.records import codec, corrections

Run = Callable[..., tuple[int, str, str]]
ANNA, BOB = b"a" * 16, b"b" * 16


def fill(folder: Path, count: int = 6, segment_bytes: int = 2_500) -> Path:
    """Keyframes of two scanners in turn, in several segments."""
    log = Journal(folder, segment_bytes, sync=False)
    for i in range(count):
        session, client = ((ANNA, "anna"), (BOB, "bob"))[i % 2]
        seq = 1 + i // 2
        frames = codec.encode(wall(i), session=session, seq=seq, jpeg_quality=90)
        log.append(frames, session=session, seq=seq, client=client, logged_ns=10**18 + i)
    log.close()
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def damage(folder: Path, number: int, seq: int) -> int:
    """Flip a bit in a keyframe; where it starts."""
    path = segment_path(folder, number)
    record = next(one for one in journal.records(path) if one.seq == seq)
    content = bytearray(path.read_bytes())
    content[record.position.offset + 700] ^= 16
    path.write_bytes(content)
    return record.position.offset


def leave_open(folder: Path) -> None:
    """Take the index and half of the last record away, as a crash does."""
    path = segment_path(folder, journal.segments(folder)[-1])
    last = list(journal.records(path))[-1]
    path.write_bytes(path.read_bytes()[: last.position.offset + 900])


@pytest.fixture
def run(here: Here) -> Run:
    """Exit status, stdout and stderr of a `tsfusion journal` line."""

    def verb(*arguments: object) -> tuple[int, str, str]:
        done = here("journal", *arguments)
        return done.returncode, done.stdout, done.stderr

    return verb


@pytest.fixture
def state(tmp_path: Path) -> Path:
    """A state folder with one map; what is in it stays as it is."""
    folder = tmp_path / "state"
    fill(folder / "maps" / "hall" / "journal")
    (folder / "maps" / "hall" / "quarantine").mkdir()
    (folder / "maps" / "hall" / "quarantine" / "000001.mcap").write_bytes(bytes(100))
    return folder


# --- places ---


def test_a_journal_is_found_by_any_folder_above_it(state: Path) -> None:
    hall = state / "maps" / "hall"
    for path in (state, hall, hall / "journal"):
        place = find_journal(path)
        assert (place.path, place.quarantine) == (hall / "journal", hall / "quarantine")
    assert find_journal(state, "hall") == find_journal(state)
    assert find_journal(segment_path(hall / "journal", 1)).files() == [segment_path(hall / "journal", 1)]


def test_several_maps_must_be_told_apart(state: Path) -> None:
    fill(state / "maps" / "attic" / "journal", 2)
    with pytest.raises(JournalError, match=r"several maps \(attic, hall\): choose one, .*/maps/NAME"):
        find_journal(state)
    assert find_journal(state, "attic").path == state / "maps" / "attic" / "journal"
    with pytest.raises(JournalError, match=r"no map cellar; it has: attic, hall"):
        find_journal(state, "cellar")


def test_a_path_without_a_journal_says_what_was_expected(state: Path, tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("")
    (tmp_path / "empty" / "maps").mkdir(parents=True)
    for path, name, message in (
        (tmp_path / "nothing", None, "does not exist; expected a state folder"),
        (tmp_path / "notes.txt", None, "is no journal"),
        (tmp_path / "empty", None, "has no map with a journal"),
        (state / "maps" / "hall", "hall", "--map has no effect"),
    ):
        with pytest.raises(JournalError, match=message):
            find_journal(path, name)


# --- info ---


def test_info_says_what_is_corrected(state: Path, run: Run) -> None:
    """By the newest pose of each keyframe."""
    turned = se3.exp(np.array([0, 0, 0, 0, 0, np.pi / 2]))
    correct(state, 4, {2: pose(50), 3: pose(0.12, 4.0)})
    correct(state, 5, {2: turned}, removed=[1])
    _, out, _ = run("info", state)
    assert "corrections 2" in out.splitlines()
    (anna,) = [line for line in out.splitlines() if " anna " in line]
    assert anna.endswith("2 corrected by up to 4 m, 90°, 1 removed (2 corrections)")
    assert "corrected" not in next(line for line in out.splitlines() if " bob " in line)


def correct(state: Path, seq: int, poses: dict[int, np.ndarray], removed: Sequence[int] = ()) -> None:
    """Append a correction of Anna's to the journal."""
    with closing(journal.Journal(state / "maps" / "hall" / "journal", 1 << 20)) as log:
        frames = corrections.encode(corrections.checked(poses, removed=removed), session=ANNA, seq=seq)
        log.append(frames, session=ANNA, seq=seq, client="anna")


def test_corrections_are_checked_and_recovered_but_no_keyframes(
    state: Path, run: Run, tmp_path: Path
) -> None:
    correct(state, 4, {2: pose(1)})
    status, out, _ = run("verify", state)
    assert (status, "6 keyframes and 1 correction in" in out) == (0, True)
    status, out, _ = run("recover", state, tmp_path / "out")
    assert (status, "6 keyframes and 1 correction in" in out) == (0, True)
    assert len(JournalRecording(tmp_path / "out")) == 6
    with closing(journal.Journal(state / "maps" / "hall" / "journal", 1 << 20)) as log:
        log.append([b"TSC\x01nonsense", b""], session=ANNA, seq=5)
    status, out, _ = run("verify", state)
    assert status == 1
    assert f"correction 5 of session {ANNA.hex()[:8]} is no correction" in out


def test_info_counts_what_is_there(state: Path, run: Run) -> None:
    before = contents(state)
    status, out, _ = run("info", state, "--json")
    found = json.loads(out)
    assert status == 0
    assert (found["keyframes"], found["lost"], found["problems"]) == (6, 0, [])
    folder = state / "maps" / "hall" / "journal"
    assert [one["name"] for one in found["segments"]] == [path.name for path in sorted(folder.iterdir())]
    assert found["nbytes"] == sum(path.stat().st_size for path in folder.iterdir())
    assert {one["state"] for one in found["segments"]} == {"closed"}
    assert found["sessions"] == [
        {
            "session": session.hex(), "client": client, "keyframes": 3, "first_seq": 1, "last_seq": 3,
            "first_logged_ns": 10**18 + first, "last_logged_ns": 10**18 + first + 4,
            "corrections": 0, "corrected": 0, "removed": 0, "forgotten": 0, "moved_m": 0.0, "turned_deg": 0.0,
        }
        for first, (session, client) in enumerate([(ANNA, "anna"), (BOB, "bob")])
    ]  # fmt: skip
    assert found["quarantined"] == [{"name": "000001.mcap", "bytes": 100}]
    assert contents(state) == before


def test_info_says_it_to_a_person(state: Path, run: Run) -> None:
    folder = state / "maps" / "hall" / "journal"
    damage(folder, 1, 1)
    leave_open(folder)
    status, out, _ = run("info", state)
    assert status == 0
    figures = ("4, ", "1 keyframe lost", "1…2", "2001-09-09")
    for text in (*figures, "closed", "open", "damaged", "torn", "anna", "bob", "quarantine"):
        assert text in out, text


# --- verify ---


def test_a_whole_journal_is_intact(state: Path, run: Run) -> None:
    before = contents(state)
    status, out, _ = run("verify", state)
    assert (status, "6 keyframes in " in out, "intact" in out) == (0, True, True)
    assert contents(state) == before


def test_a_torn_tail_is_told_and_is_no_damage(state: Path, run: Run) -> None:
    leave_open(state / "maps" / "hall" / "journal")
    status, out, _ = run("verify", state, "--json")
    verdict = json.loads(out)
    assert (status, verdict["intact"], verdict["keyframes"], verdict["lost"]) == (0, True, 5, 0)
    assert [one["kind"] for one in verdict["problems"]] == ["torn"]


def test_each_damaged_place_is_named(state: Path, run: Run) -> None:
    folder = state / "maps" / "hall" / "journal"
    offset = damage(folder, 1, 1)
    status, out, _ = run("verify", state, "--json")
    verdict = json.loads(out)
    assert (status, verdict["intact"], verdict["lost"]) == (1, False, 1)
    (found,) = verdict["problems"]
    assert {"kind": "damage", "segment": "000001.mcap", "offset": offset, "lost": 1}.items() <= found.items()
    status, out, _ = run("verify", state)
    assert status == 1
    assert f"damage  000001.mcap, byte {offset}: keyframe 1 of session" in out


def one_by_one(folder: Path, messages: list[tuple[bytes, int, list[bytes]]]) -> None:
    log = Journal(folder, 1 << 30, sync=False)
    for session, seq, frames in messages:
        log.append(frames, session=session, seq=seq)
    log.close()


def encoded(i: int, session: bytes = ANNA) -> list[bytes]:
    return codec.encode(wall(i), session=session, seq=i, jpeg_quality=90)


@pytest.mark.parametrize(
    ("messages", "status", "what"),
    [
        ([(ANNA, 1, encoded(1)), (ANNA, 1, encoded(1))], 0, "a second time"),
        ([(ANNA, 2, encoded(2)), (ANNA, 1, encoded(1))], 1, "comes after 2"),
        ([(ANNA, 1, encoded(1)), (ANNA, 2, [b"no", b"keyframe"])], 1, "is no keyframe"),
        ([(ANNA, 1, encoded(1)), (ANNA, 2, [])], 1, "is no keyframe"),
        ([(ANNA, 1, encoded(1)), (ANNA, 2, encoded(3))], 1, "says of itself that it is 3"),
        ([(ANNA, 1, encoded(1)), (BOB, 1, encoded(1))], 1, "says of itself"),
        ([(ANNA, 1, encoded(1)), (ANNA, 2, [*encoded(2)[:-1], bytes(5)])], 1, "announced with"),
    ],
)
def test_what_a_crc_does_not_see_is_found(
    tmp_path: Path, run: Run, messages: list[Any], status: int, what: str
) -> None:
    one_by_one(tmp_path / "journal", messages)
    done = run("verify", tmp_path)
    assert (done[0], what in done[1]) == (status, True), done


def test_a_missing_segment_is_damage(tmp_path: Path, run: Run) -> None:
    fill(tmp_path / "journal")
    segment_path(tmp_path / "journal", 2).unlink()
    status, out, _ = run("verify", tmp_path)
    assert (status, "1 segment before this one is missing" in out) == (1, True)
    assert JournalRecording(tmp_path).skipped == {"lost to damage": 1}
    assert run("recover", tmp_path, tmp_path / "saved")[0] == 1
    (tmp_path / "journal").rename(tmp_path / "spool")  # whose segments go as they are sent
    status, out, _ = run("verify", tmp_path / "spool")
    assert (status, "1 numbers before this one have no file" in out) == (0, True)
    segment_path(tmp_path / "spool", 1).unlink()
    (tmp_path / "spool").rename(tmp_path / "journal")
    assert run("verify", tmp_path)[0] == 0, "the oldest may be deleted"


def test_a_file_that_cannot_be_read_does_not_hide_the_others(tmp_path: Path, run: Run) -> None:
    folder = fill(tmp_path / "journal")
    segment_path(folder, 2).unlink()
    segment_path(folder, 2).mkdir()
    status, out, _ = run("verify", tmp_path, "--json")
    verdict = json.loads(out)
    assert status == 1
    assert verdict["keyframes"] > 2
    assert "Is a directory" in verdict["problems"][0]["what"]


def test_a_file_whose_content_nobody_saw_is_not_called_damaged(tmp_path: Path, run: Run) -> None:
    folder = fill(tmp_path / "journal")
    segment_path(folder, 2).unlink()
    os.mkfifo(segment_path(folder, 2))  # also nobody waits for somebody to write into it
    for verb in ("info", "verify"):
        status, out, err = run(verb, tmp_path)
        assert (status, out) == (1, "")
        assert err == f"tsfusion: cannot read {segment_path(folder, 2)}: it is a pipe, not a file\n"


@pytest.mark.parametrize(("deleted", "lost"), [((1, 2), 0), ((2,), 1)])
def test_a_segment_that_its_map_deletes_meanwhile_is_no_damage(
    tmp_path: Path, deleted: tuple[int, ...], lost: int
) -> None:
    folder = fill(tmp_path / "journal")
    (tmp_path / "fuser.lock").touch()
    steps = find_journal(tmp_path).steps()
    found = [next(steps)[1]]
    for number in deleted:
        segment_path(folder, number).unlink()
    found += [step for _, step in steps]
    assert len(found) > 2
    assert sum(isinstance(step, journal.Damage) for step in found) == lost


# --- recover ---


def test_what_is_whole_is_saved_in_order_into_closed_segments(state: Path, tmp_path: Path, run: Run) -> None:
    folder = state / "maps" / "hall" / "journal"
    damage(folder, 1, 1)
    leave_open(folder)
    before = contents(state)
    whole = [
        one for number in journal.segments(folder) for one in journal.records(segment_path(folder, number))
    ]
    status, out, _ = run("recover", state, tmp_path / "saved", "--json")
    done = json.loads(out)
    assert (status, done["keyframes"], done["lost"], done["copies"]) == (1, 4, 1, 0)
    assert sorted(one["kind"] for one in done["problems"]) == ["damage", "torn"]
    saved = [one for path in find_journal(tmp_path / "saved").files() for one in journal.records(path)]
    for old, new in zip(whole, saved, strict=True):
        for field in ("session", "seq", "client", "logged_ns"):
            assert getattr(old, field) == getattr(new, field)
        assert [bytes(frame) for frame in old.frames] == [bytes(frame) for frame in new.frames]
    for path in find_journal(tmp_path / "saved").files():
        with path.open("rb") as file:
            assert list(make_reader(file, validate_crcs=True).iter_messages())
    assert run("verify", tmp_path / "saved")[0] == 0
    keyframe = next(iter(JournalRecording(tmp_path / "saved")))
    assert np.array_equal(keyframe.depth, wall(1).depth)
    assert contents(state) == before


def test_a_whole_journal_is_saved_with_status_0_also_into_an_empty_folder(tmp_path: Path, run: Run) -> None:
    fill(tmp_path / "journal")
    (tmp_path / "saved").mkdir()
    status, out, _ = run("recover", tmp_path / "journal", tmp_path / "saved")
    assert (status, "6 keyframes" in out, "no keyframe is lost" in out) == (0, True, True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["journal", "saved"]


def test_a_keyframe_that_stands_there_twice_is_saved_once(tmp_path: Path, run: Run) -> None:
    one_by_one(tmp_path / "journal", [(ANNA, 1, encoded(1)), (ANNA, 1, encoded(1)), (ANNA, 2, encoded(2))])
    status, out, _ = run("recover", tmp_path, tmp_path / "saved", "--json")
    done = json.loads(out)
    assert (status, done["keyframes"], done["copies"]) == (0, 2, 1)


def test_what_is_saved_is_on_the_disk_before_it_has_its_name(
    tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    one_by_one(tmp_path / "journal", [(ANNA, 1, encoded(1)), (ANNA, 2, encoded(2))])
    happened: list[str] = []
    real = os.fsync

    def watched(descriptor: int) -> None:
        path = Path(os.readlink(f"/proc/self/fd/{descriptor}"))
        happened.append(path.name if path == tmp_path or path.is_file() else "folder")
        real(descriptor)

    monkeypatch.setattr(os, "fsync", watched)
    assert run("recover", tmp_path, tmp_path / "saved")[0] == 0
    assert happened[-3:] == ["000001.mcap", "folder", tmp_path.name]


def test_nothing_is_written_over_or_into_the_source(state: Path, tmp_path: Path, run: Run) -> None:
    folder = state / "maps" / "hall" / "journal"
    before = contents(state)
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine").write_text("mine")
    for out, message in (
        (tmp_path / "full", "it is not empty"),
        (folder, "it is not empty"),
        (folder / "saved", "inside the journal that is read"),
        (segment_path(folder, 1), "inside the journal that is read"),
    ):
        status, _, err = run("recover", folder, out)
        assert (status, message in err) == (1, True), err
    assert contents(state) == before
    assert contents(tmp_path / "full") == {"mine": b"mine"}


def test_where_nothing_can_be_saved_nothing_is_made(tmp_path: Path, run: Run) -> None:
    fill(tmp_path / "journal", 1)
    damage(tmp_path / "journal", 1, 1)
    status, _, err = run("recover", tmp_path, tmp_path / "saved")
    assert (status, "no keyframe that could be saved" in err) == (1, True)
    assert not (tmp_path / "saved").exists()


# The first record, a line, and no second one.
HALFWAY = """
import sys, threading
from tsfusion.cli import main
from tsfusion.journal.writer import Journal

append = Journal.append
def first_only(*arguments, **fields):
    append(*arguments, **fields)
    print("halfway", flush=True)
    while True:  # not for long at once: Python handles a signal that comes just before a wait after it
        threading.Event().wait(0.1)

Journal.append = first_only
main(sys.argv[1:])
"""


def test_ctrl_c_leaves_nothing(tmp_path: Path) -> None:
    folder = fill(tmp_path / "journal")
    command = [sys.executable, "-c", HALFWAY, "journal", "recover", str(folder), str(tmp_path / "saved")]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    read_until(process, "halfway")
    assert any(tmp_path.glob(".saved.partial-*/*.mcap"))
    assert end(process, signal.SIGINT) == 130
    assert [path.name for path in tmp_path.iterdir()] == ["journal"]


# --- all of them ---


def test_every_verb_has_a_help_that_teaches() -> None:
    for verb in ("info", "verify", "recover", "export"):
        text = tsfusion("journal", verb, "--help").stdout
        assert "xit status" in text
        assert "--json" in text


def test_export_is_one_file_with_every_topic(state: Path, tmp_path: Path, run: Run) -> None:
    pytest.importorskip("rosbags")
    status, out, _ = run("export", state, tmp_path / "out.mcap")
    assert status == 0
    assert "/anna/depth/image  3" in out
    assert "/bob/color/image/compressed  3" in out
    damage(state / "maps" / "hall" / "journal", 1, 1)
    status, out, _ = run("export", state, tmp_path / "out.mcap", "--json")
    assert (status, json.loads(out)["lost"]) == (1, 1)
    shutil.rmtree(state / "maps" / "hall" / "journal")
    (state / "maps" / "hall" / "journal").mkdir()
    status, _, err = run("export", state, tmp_path / "other.mcap")
    assert (status, "no journal in" in err) == (1, True)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["out.mcap", "state"]
