# SPDX-License-Identifier: MIT
"""Acknowledged records are read back, after any end of the process and beside any damage."""

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from corrected_maps import final_keyframes
from failures import refuse
from keyframes_and_servers import DEADLINE, pose, wall
from mcap.reader import make_reader
from saved_maps import ANNA, correct, forget, make_map

from tsfusion import journal
from tsfusion.core.errors import JournalError
from tsfusion.delivery.spool import Spool
from tsfusion.journal import (
    Journal,
    Position,
    Unwritten,
    mcap_layout,
    quarantine,
    segment_path,
    state_folder,
)
from tsfusion.journal.inspection import summarize
from tsfusion.journal.journaled_keyframes import JournalRecording
from tsfusion.journal.quarantine import Quarantine
from tsfusion.wire.records import codec

SESSION = bytes(16)
BIG = 1 << 30


def fill(log: Journal, count: int, first: int = 1) -> list[Position]:
    return [
        log.append([b"head", bytes([i]) * 1000, b""], session=SESSION, seq=first + i) for i in range(count)
    ]


def write(folder: Path, count: int) -> list[Position]:
    log = Journal(folder, BIG)
    positions = fill(log, count)
    log.close()
    return positions


def test_records_are_read_where_append_says(tmp_path: Path) -> None:
    log = Journal(tmp_path, BIG)
    for i, position in enumerate(fill(log, 5)):
        record = journal.read(tmp_path, position)  # while the segment is open
        assert (record.session, record.seq, record.position) == (SESSION, i + 1, position)
        assert [bytes(frame) for frame in record.frames] == [b"head", bytes([i]) * 1000, b""]
        assert record.nbytes == 1004
    log.close()


def test_records_that_are_written_together_wait_for_the_disk_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = Journal(tmp_path, BIG)
    fill(log, 1)
    waits, real = [], os.fdatasync
    monkeypatch.setattr(os, "fdatasync", lambda descriptor: (waits.append(1), real(descriptor)))
    positions = log.append_all([Unwritten([b"head", bytes([i])], SESSION, 2 + i) for i in range(8)])
    assert len(waits) == 1
    for i, position in enumerate(positions):
        record = journal.read(tmp_path, position)
        assert (record.seq, [bytes(frame) for frame in record.frames]) == (2 + i, [b"head", bytes([i])])
    log.close()
    assert [found.seq for found in Journal(tmp_path, BIG).found] == list(range(1, 10))


def test_of_records_that_are_written_together_all_count_or_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    log = Journal(tmp_path, BIG)
    fill(log, 2)
    together = [Unwritten([b"head", bytes(1000)], SESSION, 3 + i) for i in range(4)]
    with monkeypatch.context() as broken:
        broken.setattr(os, "fdatasync", refuse(errno.EIO))
        with pytest.raises(JournalError, match="cannot write"):
            log.append_all(together)
    log.append_all(together[:2])
    log.close()
    assert [found.seq for found in Journal(tmp_path, BIG).found] == [1, 2, 3, 4]


def test_a_new_start_finds_everything_and_begins_a_segment(tmp_path: Path) -> None:
    first = write(tmp_path, 3)
    log = Journal(tmp_path, BIG)
    assert [found.position for found in log.found] == first
    second = fill(log, 2, first=4)
    log.close()
    assert {position.segment for position in first} != {position.segment for position in second}
    assert [found.seq for found in Journal(tmp_path, BIG).found] == [1, 2, 3, 4, 5]
    assert sorted([*first, *second]) == [*first, *second]


def test_an_unused_journal_leaves_no_segment(tmp_path: Path) -> None:
    Journal(tmp_path, BIG).close()
    assert list(tmp_path.iterdir()) == []


def test_segments_rotate_and_can_be_forgotten(tmp_path: Path) -> None:
    log = Journal(tmp_path, 4000)
    positions = fill(log, 10)
    numbers = journal.segments(tmp_path)
    assert len(numbers) > 2
    assert log.nbytes == sum(path.stat().st_size for path in tmp_path.iterdir())
    log.forget(numbers[0])
    log.close()
    assert [found.position for found in Journal(tmp_path, BIG).found] == [
        position for position in positions if position.segment != numbers[0]
    ]


def test_closed_segments_open_in_mcap_tools(tmp_path: Path) -> None:
    write(tmp_path, 4)
    with segment_path(tmp_path, 1).open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        messages, summary = list(reader.iter_messages("/keyframes")), reader.get_summary()
    assert [message.sequence for _, _, message in messages] == [1, 2, 3, 4]
    assert summary is not None
    assert all(schema.encoding for schema in summary.schemas.values() if schema.data)  # `mcap doctor`'s rule
    assert mcap_layout.segment_start_bytes() == 681  # as of the journals that earlier versions left


@pytest.mark.parametrize(
    ("at", "value", "message"),
    [
        (500, 4, "keyframe 3 of session 00000000 is damaged"),
        (5, 255, "nothing can be read here; 1 keyframe is lost"),
    ],
    ids=["a bit", "the length"],
)
def test_damage_costs_one_record_and_is_logged(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, at: int, value: int, message: str
) -> None:
    positions = write(tmp_path, 5)
    path = segment_path(tmp_path, 1)
    stored = bytearray(path.read_bytes())
    stored[positions[2].offset + at] ^= value
    path.write_bytes(stored)
    log = Journal(tmp_path, BIG)
    assert [found.seq for found in log.found] == [1, 2, 4, 5]
    assert log.damaged == 1
    assert f"byte {positions[2].offset}: {message}" in caplog.text
    with pytest.raises(JournalError):
        journal.read(tmp_path, positions[2])


@pytest.mark.parametrize("seed", range(8))
def test_garbage_is_survived(tmp_path: Path, seed: int) -> None:
    write(tmp_path, 6)
    rng = np.random.default_rng(seed)
    path = segment_path(tmp_path, 1)
    stored = np.frombuffer(path.read_bytes(), np.uint8).copy()
    stored[rng.integers(0, len(stored), 40)] = rng.integers(0, 256, 40)
    path.write_bytes(stored.tobytes())
    for found in Journal(tmp_path, BIG).found:
        record = journal.read(tmp_path, found.position)
        assert bytes(record.frames[1]) == bytes([found.seq - 1]) * 1000


def test_kill_9_loses_nothing_that_was_acknowledged(tmp_path: Path) -> None:
    code = f"""
from pathlib import Path
from tsfusion.journal import Journal
log = Journal(Path({str(tmp_path)!r}), 1 << 30)
for i in range(10**6):
    log.append([b"head", bytes(50_000)], session=bytes(16), seq=i + 1)
    print(i + 1, flush=True)
"""
    process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    acknowledged = [int(process.stdout.readline()) for _ in range(20)][-1]
    process.send_signal(signal.SIGKILL)
    acknowledged = max(
        [acknowledged, *(int(line) for line in process.communicate(timeout=DEADLINE)[0].split())]
    )
    found = [record.seq for record in Journal(tmp_path, BIG).found]
    assert found == list(range(1, len(found) + 1))
    assert len(found) >= acknowledged


def test_an_unwritable_folder_is_one_clear_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(JournalError, match=r"cannot create the journal .*file"):
        Journal(tmp_path / "file", BIG)


# --- recordings ---


def record(folder: Path, count: int) -> None:
    log = Journal(folder, 5_000)
    for i in range(count):
        frames = codec.encode(wall(i), session=SESSION, seq=i + 1, jpeg_quality=90)
        log.append(frames, session=SESSION, seq=i + 1)
        if i == 1:
            log.append(frames, session=SESSION, seq=i + 1)  # written twice by a crash
    log.close()


def test_a_journal_is_a_dataset_of_its_keyframes(tmp_path: Path) -> None:
    record(tmp_path / "journal", 6)
    recording = JournalRecording(tmp_path)
    assert len(recording) == 6
    for i, keyframe in enumerate(recording):
        assert np.array_equal(keyframe.depth, wall(i).depth)
    assert len(JournalRecording(tmp_path / "journal")) == 6
    assert 0 < len(JournalRecording(segment_path(tmp_path / "journal", 1))) < 6


def test_copies_of_earlier_keyframes_hide_none_from_the_summary(tmp_path: Path) -> None:
    log = Journal(tmp_path / "journal", BIG)
    for seq in (1, 2, 3, 4, 1, 2, 3, 5, 6, 7, 8):
        frames = codec.encode(wall(seq), session=ANNA, seq=seq, jpeg_quality=90)
        log.append(frames, session=ANNA, seq=seq)
    log.close()
    correct(tmp_path, ANNA, 9, {seq: pose(9) for seq in range(1, 9)})
    (session,) = summarize(state_folder.find_journal(tmp_path), lambda *_: None).sessions
    assert (session.keyframes, session.corrected, session.last_seq) == (11, 8, 9)


def test_a_recording_is_at_its_final_poses(tmp_path: Path) -> None:
    folder = make_map(tmp_path / "state" / "maps" / "default", range(6))
    correct(folder, ANNA, 7, {1: pose(0.5), 4: pose(0.7)}, removed=(2,))
    forget(folder, ANNA, (3,), 1)
    recording = JournalRecording(tmp_path / "state")
    assert recording.skipped == {"forgotten": 1, "removed by corrections": 1}
    for keyframe, expected in zip(recording, final_keyframes(folder / "journal"), strict=True):
        assert np.array_equal(keyframe.depth, expected.depth)
        assert np.array_equal(keyframe.T_world_camera, expected.T_world_camera)


def test_a_recording_says_how_many_keyframes_damage_cost(tmp_path: Path) -> None:
    record(tmp_path / "journal", 6)
    assert JournalRecording(tmp_path).skipped == {}
    last = max((tmp_path / "journal").glob("*.mcap"))
    content = bytearray(last.read_bytes())
    content[mcap_layout.segment_start_bytes() + 200] ^= 1  # of the first keyframe there
    last.write_bytes(content)
    recording = JournalRecording(tmp_path)
    assert (len(recording), recording.skipped) == (5, {"lost to damage": 1})


def test_an_empty_recording_is_one_clear_error(tmp_path: Path) -> None:
    with pytest.raises(JournalError, match="no keyframes in"):
        JournalRecording(tmp_path)
    with pytest.raises(JournalError, match="does not exist"):
        JournalRecording(tmp_path / "nothing.mcap")


# --- spools ---


def put(spool: Spool, count: int) -> None:
    for _ in range(count):
        spool.add(spool.write([b"head", bytes(30_000)]))


def test_a_spool_gives_back_what_was_not_dropped(tmp_path: Path) -> None:
    spool = Spool(tmp_path, 100_000)
    put(spool, 10)
    assert [entry.seq for entry in spool.drop(7)] == [1, 2, 3, 4, 5, 6, 7]
    session = spool.session
    assert len(journal.segments(tmp_path)) <= 2
    spool.close()
    again = Spool(tmp_path, 100_000)
    assert again.session == session
    assert [entry.seq for entry in again.waiting][-3:] == [8, 9, 10]
    assert again.next_seq > 11  # no number is used twice, whatever a power cut took
    assert bytes(again.read(again.waiting[-1])[0]) == b"head"
    again.close()


def test_an_emptied_spool_starts_a_new_session(tmp_path: Path) -> None:
    spool = Spool(tmp_path, 100_000)
    put(spool, 5)
    spool.drop(5)
    session = spool.session
    spool.close()
    assert journal.segments(tmp_path) == []
    again = Spool(tmp_path, 100_000)
    assert (again.session != session, again.next_seq) == (True, 1)
    again.close()


def test_a_temporary_spool_goes_away() -> None:
    spool = Spool(None, 100_000)
    put(spool, 2)
    assert spool.folder.is_dir()
    spool.close()
    assert not spool.folder.exists()


def test_a_spool_has_one_user(tmp_path: Path) -> None:
    spool = Spool(tmp_path, 100_000)
    with pytest.raises(JournalError, match="in use by another scanner"):
        Spool(tmp_path, 100_000)
    spool.close()
    Spool(tmp_path, 100_000).close()


def test_an_entry_in_the_middle_can_be_removed(tmp_path: Path) -> None:
    spool = Spool(tmp_path, 100_000)
    put(spool, 3)
    spool.remove(1)
    assert [entry.seq for entry in spool.waiting] == [1, 3]
    spool.close()
    again = Spool(tmp_path, 100_000)
    assert [entry.seq for entry in again.waiting] == [1, 3]  # nor does the next scanner send it
    again.close()


def test_what_was_written_and_is_not_queued_yet_stays(tmp_path: Path) -> None:
    """One thread writes; what came before may be acknowledged to another one meanwhile."""
    spool = Spool(tmp_path, 100_000)
    put(spool, 1)
    entry = spool.write([b"head", b""])
    spool.drop(1)
    spool.add(entry)
    assert segment_path(tmp_path, 1).exists()
    spool.close()
    again = Spool(tmp_path, 100_000)
    assert [one.seq for one in again.waiting] == [1, 2]  # 1 comes again, and is known
    again.close()


def test_the_quarantine_keeps_to_its_limits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(quarantine, "_MAX_FILES", 5)

    def keep(kept: Quarantine, seq: int, size: int = 100) -> Path:
        path = kept.keep([bytes(size)], session=SESSION, seq=seq, reason="crc")
        assert path is not None
        os.utime(path, ns=(seq, seq))
        return path

    def seqs() -> list[int]:
        return sorted(int(path.name.split("-")[1]) for path in tmp_path.glob("*.mcap"))

    kept = Quarantine(tmp_path, 1 << 20)
    for seq in range(1, 9):
        keep(kept, seq)
    assert (len(kept), seqs()) == (5, [4, 5, 6, 7, 8])
    keep(kept, 4)  # again: now it is the newest
    os.utime(keep(kept, 4), ns=(9, 9))
    assert len(kept) == 5
    kept = Quarantine(tmp_path, 1 << 20)  # as a new process finds it
    assert len(kept) == 5
    keep(kept, 10)
    assert seqs() == [4, 6, 7, 8, 10]
    keep(kept, 11, (1 << 20) - 1000)
    assert seqs()[-1] == 11
    keep(kept, 12, 2 << 20)  # the newest stays, whatever its size
    assert (len(kept), seqs()) == (1, [12])


def test_a_keyframe_that_is_put_aside_again_counts_once(tmp_path: Path) -> None:
    kept = Quarantine(tmp_path, 35_000)
    for seq in (1, 2, 2, 2, 2):
        kept.keep([bytes(10_000)], session=SESSION, seq=seq, reason="crc")
    assert len(list(tmp_path.glob("*.mcap"))) == 2


def test_the_quarantine_does_not_look_at_every_file_for_each(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = Quarantine(tmp_path, 1 << 20)
    monkeypatch.setattr(Path, "glob", None)
    assert kept.keep([b"x"], session=SESSION, seq=1, reason="crc") is not None
    assert len(kept) == 1


def test_a_folder_of_quarantined_keyframes_opens_like_a_journal(tmp_path: Path) -> None:
    kept = Quarantine(tmp_path, 1 << 20)
    for seq in (2, 10, 9):
        frames = codec.encode(wall(seq), session=SESSION, seq=seq, jpeg_quality=90)
        kept.keep(frames, session=SESSION, seq=seq, reason="crc")
    found = [keyframe.timestamp_ns - 10**9 for keyframe in JournalRecording(tmp_path)]
    assert found == [2, 9, 10]


@pytest.mark.parametrize("reason", ["../../x", "a/b", "", "no\nsense", "x" * 300])
def test_no_reason_leads_out_of_the_folder(tmp_path: Path, reason: str) -> None:
    """A scanner's come from a server."""
    kept = Quarantine(tmp_path / "refused", 1 << 20).keep([b"x"], session=SESSION, seq=1, reason=reason)
    assert kept is not None
    assert list(tmp_path.rglob("*.mcap")) == [kept]
    assert quarantine.quarantined_files(tmp_path / "refused") == [kept]
