# SPDX-License-Identifier: MIT
"""A server that reads a long journal when it starts: alive from the first second on, ready at the end."""

import re
import socket
from contextlib import closing, suppress
from pathlib import Path

import pytest
from http_requests import get
from keyframes_and_servers import Server, until
from quick_fusers import SUMS

from tsfusion.journal import Journal, list_records, state_folder

_RECORDS = 300
# A disk that takes 10 ms a read, until a file appears.
_SLOW_DISK = """
import os, time, sys
from tsfusion.journal.segments import SegmentFile
_pread = SegmentFile._pread
def slow(self, at, count):
    if not os.path.exists(%r):
        time.sleep(0.01)
    return _pread(self, at, count)
SegmentFile._pread = slow
from tsfusion.core import logs
from tsfusion import server
server._LOG_INTERVAL = 0.2
logs.configure("text", "info")
"""


@pytest.fixture
def journal(tmp_path: Path) -> Journal:
    """A journal of two segments."""
    folder = state_folder.map_folder(tmp_path, "default") / state_folder.JOURNAL_FOLDER
    with closing(Journal(folder, 1 << 20, sync=False)) as made:
        for i in range(_RECORDS):
            if i == _RECORDS // 2:
                made.rotate()
            made.append([b"head", b"body"], session=bytes(16), seq=i + 1)
    return made


def test_alive_while_it_reads_and_ready_behind_that(journal: Journal, tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as drawn:
        page = f"127.0.0.1:{drawn.getsockname()[1]}"
    go = tmp_path / "go"
    seen: list[tuple[int, str]] = []  # percent, and what /livez says

    def progress() -> bool:
        with suppress(OSError):
            alive, words = get(page, "/livez")[:2]
            ready, why = get(page, "/readyz")[:2]
            assert (alive, ready) == (200, 503)
            if found := re.search(
                r"^reading the journal of map default: (\d+) % of \d+ MB, \d+ records$", why
            ):
                seen.append((int(found[1]), words))
        return len({percent for percent, _ in seen}) >= 3

    with closing(Server(tmp_path, wait=False, code=_SLOW_DISK % str(go), fuser=SUMS, metrics=page)) as server:
        until(progress)
        assert [percent for percent, _ in seen] == sorted(percent for percent, _ in seen)
        assert seen[-1][1].startswith("alive: reading the journal of map default")
        go.touch()
        until(lambda: get(page, "/readyz")[1] in ("map default is being opened\n", "ready\n"))
        assert server.wait_ready()
        until(lambda: get(page, "/readyz")[0] == 200)
        server.kill()
        assert "INFO: reading the journal of map default: " in server.stderr_text()


def test_a_stop_does_not_wait_for_the_whole_journal(journal: Journal, tmp_path: Path) -> None:
    code = _SLOW_DISK % str(tmp_path / "never")
    code = code.replace("time.sleep(0.01)", "print('reads', flush=True), time.sleep(1.0)")
    with closing(Server(tmp_path, wait=False, code=code, fuser=SUMS)) as server:
        assert server.process.stdout.readline() == "reads\n"
        assert server.terminate() == 0


def test_reading_a_damaged_segment_is_reported_too(journal: Journal, tmp_path: Path) -> None:
    """A search for the next whole record may take long, in which no record comes."""
    (path, _) = sorted(journal.folder.iterdir())
    content = bytearray(path.read_bytes())
    for at in range(1000, len(content), 100):
        content[at] ^= 0xFF
    path.write_bytes(content)
    told: list[tuple[int, int]] = []
    found, lost = list_records(path, lambda at, records: told.append((at, records)))
    assert lost
    assert len(told) > len(found)
    assert told == sorted(told)
