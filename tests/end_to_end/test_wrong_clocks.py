# SPDX-License-Identifier: MIT
"""A wall clock that is wrong by years, before 1970, or jumps: ages in lists are wrong, nothing else is."""

import time
from pathlib import Path

import pytest
from clients_and_spools import NOBODY, joined, send_all
from idle_fuser import keeping
from keyframes_and_servers import DEADLINE, wall
from scripted_server import scripted

from tsfusion import Client, journal
from tsfusion.delivery import left_spools
from tsfusion.journal.quarantine import Quarantine
from tsfusion.journal.state_folder import find_journal
from tsfusion.wire.records import codec

YEAR = 365 * 86_400 * 10**9  # nanoseconds
CLOCKS = {"1970": 0, "before 1970": -5 * YEAR, "long ago": 10 * YEAR, "far ahead": 200 * YEAR}
SESSION = bytes(range(16))
_SHOWS = "import time; time.time_ns = lambda: {0}; time.time = lambda: {0} / 1e9\n"

wrong = pytest.mark.parametrize("shown", CLOCKS.values(), ids=CLOCKS)


def show(monkeypatch: pytest.MonkeyPatch, shown: int) -> None:
    monkeypatch.setattr(time, "time_ns", lambda: shown)
    monkeypatch.setattr(time, "time", lambda: shown / 1e9)


@wrong
def test_a_journal_that_began_at_another_time_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shown: int
) -> None:
    """Files of today, then those of a clock that is wrong, then those of today again."""
    clocks = [time.time_ns(), shown, time.time_ns()]
    for seq, clock in enumerate(clocks, start=1):
        show(monkeypatch, clock)
        opened = journal.Journal(tmp_path, 1 << 20)
        assert [record.seq for record in opened.found] == [*range(1, seq)]
        opened.append([b"head", b"body"], session=SESSION, seq=seq)
        opened.close()
    found = [record for number in journal.segments(tmp_path)
             for record in journal.records(journal.segment_path(tmp_path, number))]  # fmt: skip
    assert [record.seq for record in found] == [1, 2, 3]
    kept = Quarantine(tmp_path / "quarantine", 1 << 20)
    show(monkeypatch, shown)
    assert kept.keep([b"head", b"body"], session=SESSION, seq=4, reason="crc") is not None


@wrong
def test_a_scanner_delivers_at_any_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shown: int) -> None:
    with Client(NOBODY, spool=tmp_path, policy="spool_all") as client:
        send_all(client, range(3))
    show(monkeypatch, shown)
    with Client(NOBODY, spool=tmp_path, policy="spool_all") as client:
        send_all(client, range(3, 6))
    (left,) = left_spools.find(tmp_path)
    assert left.count()[:2] == (6, 0)
    with scripted() as server, joined(server, spool=tmp_path, policy="spool_all") as client:
        send_all(client, range(6, 9))
        client.flush(DEADLINE)
        assert server.numbers == [*range(9)]


def test_a_server_takes_keyframes_before_1970(tmp_path: Path) -> None:
    state, code = tmp_path / "state", _SHOWS.format(CLOCKS["before 1970"])
    for first, before in ((0, ""), (3, code)):
        with keeping(state, code=before) as server:
            with Client(server.address, policy="spool_all") as client:
                for number in range(first, first + 3):
                    client.send(wall(number))
                client.flush(DEADLINE)
            assert server.terminate() == 0
    records = [record for path in find_journal(state).files() for record in journal.records(path)]
    stamps = [codec.decode_keyframe(record.frames).timestamp_ns for record in records]
    assert stamps == [wall(number).timestamp_ns for number in range(6)]
