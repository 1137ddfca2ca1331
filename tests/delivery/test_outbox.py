# SPDX-License-Identifier: MIT
"""The records of a client and what became of each: what may be dropped, and what counts once."""

import tracemalloc
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from interrupts import is_free_after_interrupts
from keyframes_and_servers import wall

from tsfusion.core.errors import InvalidKeyframe
from tsfusion.delivery import outcomes
from tsfusion.delivery.outbox import Outbox
from tsfusion.delivery.outcomes import NumberRuns
from tsfusion.delivery.spool import Spool, Waiting
from tsfusion.journal import Position
from tsfusion.wire.records import codec, corrections


def put(outbox: Outbox, count: int) -> None:
    for i in range(count):
        frames = codec.encode(
            wall(i), session=outbox.spool.session, seq=outbox.spool.next_seq, jpeg_quality=90
        )
        outbox.add(outbox.spool.write(frames), wall(i))


@pytest.fixture
def outbox(tmp_path: Path) -> Iterator[Outbox]:
    """Three keyframes, numbered from 1; none was sent."""
    outbox = Outbox(Spool(tmp_path, 1 << 20))
    put(outbox, 3)
    yield outbox
    outbox.close()


def send(outbox: Outbox) -> None:
    claimed = outbox.claim(8, 1 << 20)
    assert claimed is not None
    outbox.sent(claimed[0], 1)


def waiting(outbox: Outbox) -> list[int]:
    return [entry.seq for entry in outbox.spool.waiting]


def test_what_is_being_sent_is_not_dropped_unless_it_was_not(outbox: Outbox) -> None:
    assert outbox.claim(8, 1 << 20) is not None
    assert outbox.drop_oldest()
    assert waiting(outbox) == [1, 3]
    outbox.unclaim()
    assert outbox.drop_oldest()
    assert waiting(outbox) == [3]


def test_of_what_a_dead_scanner_left_a_windows_worth_may_be_journaled(outbox: Outbox, tmp_path: Path) -> None:
    outbox.close()
    again = Outbox(Spool(tmp_path, 1 << 20))
    assert not again.drop_oldest()  # any may have been sent
    again.welcome(durable=0, window_keyframes=2)
    assert again.drop_oldest()
    assert waiting(again) == [1, 2]
    again.close()


def test_what_the_server_has_no_more_is_lost(outbox: Outbox) -> None:
    put(outbox, 2)
    for _ in range(5):
        send(outbox)
    outbox.acknowledge(4, 3)
    before = outbox.stats()
    assert (before.durable, before.fused, before.refused) == (4, 3, {})
    assert outbox.welcome(durable=4, window_keyframes=8) == ""
    assert outbox.stats() == before
    assert outbox.welcome(durable=1, window_keyframes=8)  # of a server with an older copy of its state folder
    after = outbox.stats()
    assert (after.durable, after.fused, after.refused, after.settled) == (1, 1, {"lost": 3}, 4)
    assert outbox.behind == 1
    assert "3 keyframes that the server had on its disk are not there any more" in outbox.take_refusals()
    outbox.rewind()
    send(outbox)
    outbox.acknowledge(5, 5)
    assert (outbox.stats().durable, outbox.stats().fused, outbox.stats().settled) == (2, 2, 5)
    outbox.note_moves(5, 0)
    assert outbox.is_settled


def test_lost_corrections_and_rejected_keyframes_count_once(outbox: Outbox) -> None:
    correction = corrections.encode(
        corrections.checked({1: np.eye(4)}), session=outbox.spool.session, seq=outbox.spool.next_seq
    )
    outbox.add(outbox.spool.write(correction), None)
    for _ in range(4):
        send(outbox)
    outbox.acknowledge(4, 2)
    outbox.reject(2, "no_samples")  # told late
    outbox.reject(3, "no_samples")
    outbox.acknowledge(4, 4)
    before = outbox.stats()
    assert (before.durable, before.fused, before.rejected, before.settled) == (3, 1, {"no_samples": 2}, 3)
    assert "3 keyframes and 1 correction that the server had" in outbox.welcome(0, window_keyframes=8)
    after = outbox.stats()
    assert (after.durable, after.fused, after.refused, after.settled) == (0, 0, {"lost": 1}, 3)
    assert (after.corrections_acknowledged, after.corrections_refused) == (0, {"lost": 1})
    assert (outbox.behind, outbox.is_fused, outbox.is_settled) == (0, True, True)


def test_only_what_was_sent_can_be_corrected(outbox: Outbox, tmp_path: Path) -> None:
    """Between what a dead scanner left and what the next one sends, numbers are skipped."""
    outbox.close()
    again = Outbox(Spool(tmp_path, 1 << 20))
    put(again, 1)
    last = again.spool.next_seq - 1
    again.check_known(np.array([1, 3, last]))
    for never in (4, last - 1, last + 1):
        with pytest.raises(InvalidKeyframe, match=f"keyframe {never} was never sent by this client"):
            again.check_known(np.array([1, never]))
    again.close()


def test_a_rejection_counts_once_and_few_are_remembered(
    outbox: Outbox, monkeypatch: pytest.MonkeyPatch
) -> None:
    for _ in range(2):
        outbox.reject(1, "crash")
    assert outbox.stats().rejected == {"crash": 1}
    monkeypatch.setattr(outcomes, "_MOST_REMEMBERED", 2)
    for seq in range(2, 9):
        outbox.reject(seq, "crash")
    assert list(outbox._outcomes._rejected_seqs) == [7, 8]


def test_a_rejection_behind_its_acknowledgement_counts_once(tmp_path: Path) -> None:
    """A session that was silent may hear how far it is, and then what was rejected of it."""
    spool = Spool(tmp_path, 1 << 20)
    outbox = Outbox(spool)
    for seq in range(1, 7):
        spool.add(Waiting(seq, Position(1, 0), 100, is_correction=seq == 4))
    outbox.acknowledge(6, 5)
    assert outbox.stats().fused == 4
    for _ in range(2):  # a server may tell it twice
        outbox.reject(2, "MapFull")
    outbox.reject(4, "MapFull")
    outbox.reject(6, "MapFull")
    outbox.acknowledge(6, 6)
    stats = outbox.stats()
    assert (stats.fused, stats.rejected, stats.corrections_refused) == (3, {"MapFull": 2}, {"MapFull": 1})
    assert outbox.is_fused
    outbox.close()


def test_numbers_of_fused_keyframes_take_no_room() -> None:
    runs = NumberRuns()
    for number in (1, 2, 3, 5, 6, 9):
        runs.append(number)
    assert [number in runs for number in range(11)] == [n in (1, 2, 3, 5, 6, 9) for n in range(11)]
    assert [list(runs.between(after, 6)) for after in (0, 2, 5, 6)] == [[1, 2, 3, 5, 6], [3, 5, 6], [6], []]
    assert [runs.count(most) for most in (0, 2, 3, 4, 5, 8, 9)] == [6, 4, 3, 3, 2, 1, 0]
    runs.keep_newest(1, after=2)  # none that is not answered
    assert len(runs) == 6
    runs.keep_newest(2, after=9)
    assert (len(runs), 3 in runs, 6 in runs) == (3, False, True)
    assert (runs.cut(5), len(runs), 5 in runs, 6 in runs) == ([6, 9], 1, True, False)
    runs.keep_newest(0, after=9)
    assert (len(runs), 5 in runs) == (0, False)


def test_what_the_map_has_not_answered_takes_no_room(tmp_path: Path) -> None:
    """The map may stand for a night: the client goes on, and knows of each keyframe in the end."""
    spool = Spool(tmp_path, 1 << 20)
    outbox, count = Outbox(spool), 20_000
    numbers = [seq for seq in range(1, count + 1) if seq % 5000]  # some were refused
    tracemalloc.start()
    for seq in numbers:
        spool.add(Waiting(seq, Position(1, 0), 100))
        outbox.acknowledge(seq, 0)
    held, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert held < 2 * count  # bytes; a queue of their numbers takes 8 to 40 for each
    assert (outbox.behind, outbox.is_fused) == (len(numbers), False)
    outbox.reject(7, "memory")
    outbox.acknowledge(count, 12_345)
    assert (outbox.behind, outbox.stats().fused) == (count - 12_345 - 2, 12_345 - 2 - 1)
    outbox.acknowledge(count, count)
    assert (outbox.behind, outbox.is_fused, outbox.is_meshed) == (0, True, False)
    outbox.note_meshed(count - 1)
    assert outbox.is_meshed
    outbox.close()


def test_credit_is_bytes_as_well_as_keyframes(outbox: Outbox) -> None:
    send(outbox)
    assert outbox.claim(1, 1 << 20) is None
    assert outbox.claim(8, 1) is None
    outbox.rewind()
    assert outbox.claim(0, 0) is not None  # one is always allowed


def test_what_is_acknowledged_is_on_its_way_no_more(outbox: Outbox) -> None:
    for _ in range(2):
        send(outbox)
    outbox.acknowledge(1, 0)
    assert outbox.outstanding == 1
    claimed = outbox.claim(2, 1 << 20)  # its credit is free again, for the one behind those on their way
    assert claimed is not None
    assert (claimed[0].seq, claimed[1]) == (3, 2)
    outbox.sent(claimed[0], 1)
    outbox.acknowledge(3, 0)
    assert outbox.outstanding == 0


def test_what_was_sent_behind_a_refused_record_is_sent_again(outbox: Outbox) -> None:
    for _ in range(3):
        send(outbox)
    entry = outbox.find_sent(2)
    assert entry is not None
    outbox.refuse(entry, "values", "a three")
    assert outbox.outstanding == 1
    claimed = outbox.claim(8, 1 << 20)
    assert claimed is not None
    assert (claimed[0].seq, claimed[1]) == (3, 1)  # the server saw a gap there


def test_an_interrupt_leaves_it_free_for_others(outbox: Outbox) -> None:
    """Ctrl-C may come when the lock is just taken: the sending thread must not wait for it for ever."""
    assert is_free_after_interrupts(lambda: outbox.keyframes_waiting)


def test_an_interrupt_while_the_lock_is_taken_again_stays_one(
    outbox: Outbox, monkeypatch: pytest.MonkeyPatch
) -> None:
    def wait(_timeout: float) -> None:
        outbox._lock.release()
        raise KeyboardInterrupt

    monkeypatch.setattr(outbox._changed, "wait", wait)
    with pytest.raises(KeyboardInterrupt):
        outbox.wait(lambda: False, 5.0, lambda: None)
    assert is_free_after_interrupts(lambda: outbox.keyframes_waiting)
