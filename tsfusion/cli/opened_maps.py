# SPDX-License-Identifier: MIT
"""Open the maps that a verb reads, and show progress on stderr meanwhile."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import typer

from tsfusion.core.durable_files import size_of
from tsfusion.core.errors import IncompleteRun
from tsfusion.core.readable_numbers import count_of

JOURNAL = "reading the journal"
_LARGE_BYTES = 64 << 20  # of a file: reading it takes seconds
_lost = list[int]()  # keyframes lost to damage, of each map that this command has opened


def memory_for(file: Path, memory_bytes: int | None = None, *, maps: int = 1) -> int | None:
    """Return the bytes that a saved map may take in memory (the rest stays in files), or None if all fits.

    Args:
        memory_bytes: number that the user gave, if any.
        maps: number of maps that are open at the same time.
    """
    from tsfusion.pipelines.maps import saved_maps

    return saved_maps.memory_for(file, maps=maps) if memory_bytes is None else memory_bytes


@contextmanager
def opened(path: Path, map_name: str | None = None, *, quiet: bool) -> Iterator[Path]:
    """Yield the file of a map. That of a state folder is brought up to date in a copy, with progress shown.

    If damage in its journal has cost keyframes, the command ends with status 1, after its results.
    """
    from tsfusion.cli import progress
    from tsfusion.journal.journaled_keyframes import LOST
    from tsfusion.pipelines.maps import saved_maps

    with progress.shown(quiet=quiet) as display:

        def watch(done: int, total: int) -> None:
            if done == 1:
                display.stage(f"fusing what the checkpoint of {path} lacks")
            display.show_fused(done, done, total)

        read = partial(display.show_bytes, JOURNAL)
        with saved_maps.opened(saved_maps.find(path, map_name), watch, read) as (file, left_out):
            note_lost(left_out.pop(LOST, 0))
            for reason, count in left_out.items():
                typer.echo(f"left out {count_of(count, 'keyframe')}: {reason}", err=True)
            if size_of(file) > _LARGE_BYTES:
                display.stage(f"reading {path}")
            yield file


def note_lost(keyframes: int) -> None:
    """Remember how many keyframes damage has cost a map that this command reads."""
    _lost.append(keyframes)


def begin() -> None:
    """Forget the lost keyframes that an earlier command in this process has counted."""
    _lost.clear()


def end() -> None:
    """Raise IncompleteRun if damage has cost keyframes of a map that this command opened: its last line."""
    if any(_lost):
        from tsfusion.pipelines.report import shortfall

        raise IncompleteRun(shortfall.of_damage(sum(_lost)))
