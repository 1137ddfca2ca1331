# SPDX-License-Identifier: MIT
"""Bring the map of a state folder up to date with its journal, as a server does after a restart.

The fuser does the work in a scratch folder with links to the checkpoint and the journal. The state folder
is not changed, so a server may be running in it.
"""

import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from tsfusion import journal
from tsfusion.core.config import ServerConfig, VolumeConfig
from tsfusion.core.durable_files import size_of
from tsfusion.core.errors import JournalError
from tsfusion.core.readable_numbers import OnProgress
from tsfusion.fuser import fuser_messages
from tsfusion.fuser.fuser import Fuser
from tsfusion.journal import state_folder
from tsfusion.tsdf.files import map_history

_POLL_S = 0.1


class Tail(NamedTuple):
    """Records of a journal that a checkpoint lacks, and losses by damage.

    Attributes:
        records: the records that the checkpoint lacks, in order.
        keyframes: number in the journal up to the checkpoint's last record; erased ones count, too.
        lost: keyframes (or more) destroyed by damage up to that record; `lost_behind` counts those after it.
    """

    records: list[journal.RecordEntry]
    keyframes: int
    lost: int
    lost_behind: int


class _Answers:
    """Receives the fuser's messages in place of the gateway, and counts keyframes that it could not take."""

    def __init__(self) -> None:
        self.left_out = Counter[str]()

    def send_multipart(self, frames: list[Any], copy: bool) -> None:
        message = fuser_messages.to_gateway.decode(frames[0])
        if isinstance(message, fuser_messages.Done) and message.reason is not None:
            self.left_out[message.message or message.reason] += 1


def records_after(
    folder: Path,
    histories: list[map_history.SessionHistory],
    reading: OnProgress = lambda _done, _all: None,
) -> Tail:
    """Return the records of a map's journal that a checkpoint with these sessions lacks.

    Args:
        reading: gets the number of bytes read, and of all. The CRC of each record is checked.

    Raises:
        JournalError: when the journal cannot be read.
    """
    last = {bytes.fromhex(one.session): one.last for one in histories}
    checkpointed = dict(last)
    found = []
    path = folder / state_folder.JOURNAL_FOLDER
    files = [
        journal.segment_path(path, number) for number in (journal.segments(path) if path.is_dir() else ())
    ]
    before, total = 0, sum(map(size_of, files))
    keyframes = there = lost = all_lost = 0
    # As in a backup: the checkpoint was copied, then segments were deleted, then the journal was copied
    gap = state_folder.gap_before(files[0], _newest_segment(histories)) if files else None
    behind = 0 if gap is None else gap.lost
    for number, file in enumerate(files):
        if number and (gap := state_folder.gap_before(file, journal.segment_number(files[number - 1]))):
            all_lost += gap.lost
        places: list[journal.Damage] = []
        records, _ = journal.list_records(file, partial(_add_to, reading, before, total), places.append)
        before += size_of(file)
        for record in records:
            while places and places[0].position < record.position:
                all_lost += places.pop(0).lost
            keyframes += not record.is_correction
            if record.seq <= checkpointed.get(record.session, 0):
                there, lost = keyframes, all_lost  # the checkpoint has this record
            if record.seq > last.get(record.session, 0) and not record.is_erased:
                last[record.session] = record.seq
                found.append(record)
        all_lost += sum(place.lost for place in places)
    return Tail(found, there, lost, all_lost - lost + behind)


def _newest_segment(histories: list[map_history.SessionHistory]) -> int:
    """Return the number of the segment with a checkpoint's newest record, or 0 if it is not known.

    A checkpoint has positions only of keyframes in the map, not of rejected keyframes or of corrections.
    """
    if not all(len(one.rows) and one.rows.seqs[-1] == one.last for one in histories):
        return 0
    return max((int(one.rows.segments.max()) for one in histories), default=0)


def _add_to(reading: OnProgress, before: int, total: int, at: int, _records: int) -> None:
    reading(before + at, total)


@contextmanager
def settled(
    folder: Path,
    records: list[journal.RecordEntry],
    config: VolumeConfig,
    watch: OnProgress = lambda _done, _all: None,
) -> Iterator[tuple[Path, dict[str, int]]]:
    """Yield a file with the settled map of a folder, valid during the block, and what was left out.

    Args:
        records: the records that its checkpoint lacks.
        config: settings of the checkpoint.

    Yields:
        The file, and a dict of reason → number of keyframes that the map could not take.

    Raises:
        JournalError: when a record cannot be read.
        TsfusionError: as the fuser, when it opens the map.
    """
    with tempfile.TemporaryDirectory(prefix="tsfusion-") as name:
        scratch, answers = Path(name), _Answers()
        for part in (state_folder.MAP_FILE, state_folder.JOURNAL_FOLDER):
            (scratch / part).symlink_to((folder / part).resolve())
        (scratch / "working").write_bytes(bytes(8))
        fuser = Fuser(answers, _begin(scratch, config))  # type: ignore[arg-type]
        _catch_up(fuser, records, watch)
        fuser.handle(fuser_messages.Finish())
        if fuser.exit_status != 0:
            raise JournalError(f"the map of {folder} cannot be brought up to date in {scratch}: is it full?")
        del fuser
        yield scratch / state_folder.MAP_FILE, dict(answers.left_out)


def _begin(scratch: Path, config: VolumeConfig) -> fuser_messages.Begin:
    server = ServerConfig()
    return fuser_messages.Begin(
        str(scratch),
        config,
        mesh_interval=0.0,
        checkpoint_every=0,
        working=str(scratch / "working"),
        keep_previous=False,
        memory_bytes=1 << 60,
        quota_cost=server.quota_cost,
        quota_map=1.0,
    )


def _catch_up(fuser: Fuser, records: list[journal.RecordEntry], watch: OnProgress) -> None:
    """Give the records to the fuser, then let it move the keyframes that corrections move."""
    for index, record in enumerate(records):
        place = (record.position, record.session, record.seq, record.client, record.world)
        fuser.handle(fuser_messages.Fuse(index, *place, is_correction=record.is_correction))
        while fuser.is_stuck and fuser.exit_status is None:
            time.sleep(_POLL_S)
            fuser.go_on()
        if fuser.exit_status is not None:
            raise JournalError(f"a record of session {record.session.hex()[:8]} cannot be read: try again")
        watch(index + 1, len(records))
    waiting = fuser.ready().moves
    total = moved = waiting.waiting if waiting is not None else 0
    move = fuser.chores["move"]
    while (wait := move.wait(True)) is not None:
        if wait:
            time.sleep(_POLL_S)
            continue
        move.do()
        moves = fuser.ready().moves
        moved = total - (moves.waiting if moves is not None else 0)
        watch(len(records) + moved, len(records) + total)
