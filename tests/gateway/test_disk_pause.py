# SPDX-License-Identifier: MIT
"""The time in which a map takes no keyframes: what ends it, and what a person is told meanwhile."""

import errno
from typing import cast

import pytest

from tsfusion.core.errors import JournalError
from tsfusion.gateway.maps import map_records
from tsfusion.gateway.maps.map_records import DiskPause
from tsfusion.journal import Journal


class Disk:
    """A journal whose disk may be known to refuse before anything is written."""

    problem = ""

    def check(self) -> None:
        if self.problem:
            raise JournalError(self.problem)


@pytest.fixture
def disk() -> Disk:
    return Disk()


@pytest.fixture
def pause(disk: Disk, monkeypatch: pytest.MonkeyPatch) -> DiskPause:
    monkeypatch.setattr(map_records, "_DISK_PAUSE", 0.0)
    return DiskPause(cast(Journal, disk), "yard")


def test_what_only_writing_shows_is_a_problem_until_something_is_written(
    pause: DiskPause, caplog: pytest.LogCaptureFixture
) -> None:
    """A look at a disk that fails at each write finds nothing wrong with it."""
    for _ in range(3):
        pause.begin(JournalError("cannot write: Input/output error", errno.EIO))
        pause.step()
        assert "Input/output error" in pause.problem
    assert len(caplog.records) == 1
    pause.end()
    assert not pause.problem


def test_a_problem_is_logged_once_whatever_its_figures(
    disk: Disk, pause: DiskPause, caplog: pytest.LogCaptureFixture
) -> None:
    """The room on a disk that others write to is another one at each look."""
    for free in ("0.1 MB", "12.7 MB", "3.0 MB"):
        disk.problem = f"its disk has {free} free, and 268.4 MB must stay so"
        pause.step()
        assert pause.problem == disk.problem
    pause.begin(JournalError("cannot write: Input/output error", errno.EIO))
    assert [one.getMessage() for one in caplog.records] == [
        "no keyframes are taken: its disk has 0.1 MB free, and 268.4 MB must stay so",
        "no keyframes are taken: cannot write: Input/output error",
    ]


def test_what_a_look_shows_is_over_when_the_next_one_shows_nothing(disk: Disk, pause: DiskPause) -> None:
    disk.problem = "its disk has 0.1 MB free"
    pause.step()
    assert pause.problem == disk.problem
    disk.problem = ""
    pause.step()
    assert not pause.problem


@pytest.mark.parametrize("code", [errno.ENOENT, None])
def test_what_a_look_would_show_is_over_without_a_keyframe(pause: DiskPause, code: int | None) -> None:
    """A folder that is away, or too little room: a fuser waits for the end of it, too."""
    pause.begin(JournalError("none of its segments is there", code))
    pause.step()
    assert (pause.problem, pause.is_away) == ("", False)
