# SPDX-License-Identifier: MIT
"""Findings when a map is opened: its journal, and whether its checkpoint fits it."""

import glob
import logging
from pathlib import Path

from tsfusion.core import logs
from tsfusion.core.config import ServerConfig
from tsfusion.core.readable_numbers import count_of
from tsfusion.fuser.fuser_messages import Ready
from tsfusion.gateway.clients.sessions import Sessions
from tsfusion.journal import Journal, ReadingWatcher, state_folder

log = logging.getLogger(__name__)

_SEGMENTS_KEPT = 4  # a journal with a limit is deleted in quarters of that limit
_LONGEST_WAIT = 0.2  # seconds of a step, for a segment of the journal that is put back


def open_journal(folder: Path, server: ServerConfig, watch: ReadingWatcher) -> Journal:
    """The map's journal, in segments small enough to keep it to its limit."""
    segment_bytes = server.segment_bytes
    if server.journal_bytes is not None:
        segment_bytes = min(segment_bytes, server.journal_bytes // _SEGMENTS_KEPT)
    return Journal(
        folder / state_folder.JOURNAL_FOLDER,
        segment_bytes,
        min_free_bytes=server.min_free_bytes,
        longest_wait=_LONGEST_WAIT,
        watch=watch,
    )


def warn_of_old_corrections(folder: Path) -> None:
    """Log that corrections of an early version are not read."""
    old = folder / "corrections"
    if glob.glob("*.tsc", root_dir=old):  # nothing where the disk does not say
        log.warning(
            "%s holds corrected poses as an earlier development version kept them: they are not read; "
            "delete the folder to silence this",
            old,
        )


def compare(name: str, journal: Journal, sessions: Sessions, ready: Ready) -> None:
    """Log that a journal, of which nothing was deleted on purpose, ends before the checkpoint does."""
    shorter = [key for key, done in ready.done.items() if sessions.progress(key)[0] < done.seq]
    if shorter and journal.first == 1:
        log.warning(
            "its checkpoint holds keyframes of %s that its journal %s lacks: was the journal "
            "deleted, or is its disk not mounted? The map cannot be built again from it",
            count_of(len(shorter), "session"),
            journal.folder,
            extra=logs.about(map=name),
        )


def contents(ready: Ready, waiting: int) -> str:
    """Contents of a map, for the log.

    Args:
        waiting: keyframes of its journal that are not in it.
    """
    if not ready.done and not waiting:
        return "a new map is open"
    rest = f"; {waiting} more are fused from its journal" if waiting else ""
    return f"the map is open, with {count_of(ready.keyframes, 'keyframe')}{rest}"


def loss(name: str, journal: Journal, ready: Ready) -> str:
    """Loss of records that neither a checkpoint nor the journal has, which is logged; empty = none."""
    if ready.done or journal.first <= 1:
        return ""
    found = f"its checkpoints are lost, and with them what was journaled before segment {journal.first}"
    log.error("%s", found, extra=logs.about(map=name))
    return found
