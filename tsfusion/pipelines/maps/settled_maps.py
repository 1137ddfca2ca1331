# SPDX-License-Identifier: MIT
"""Bring the map of a state folder up to date with its journal, as a server does after a restart.

A private server does the work on links to the checkpoint and the journal. The state folder is not changed, so
another server may be running in it.
"""

from collections import Counter
from collections.abc import Iterator
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path
from typing import NamedTuple

from tsfusion import journal
from tsfusion.core.config import DEFAULT_MAP
from tsfusion.core.durable_files import size_of
from tsfusion.core.readable_numbers import OnProgress
from tsfusion.journal import state_folder
from tsfusion.pipelines.maps.private_server import PrivateMap, PrivateServer, ServedMaps
from tsfusion.tsdf.files import checkpoint, map_history


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
    header: checkpoint.CheckpointHeader,
    memory_bytes: int | None,
    watch: OnProgress = lambda _done, _all: None,
) -> Iterator[tuple[Path, dict[str, int]]]:
    """Yield a file with the settled map of a folder, valid during the block, and what was left out.

    Args:
        header: header of its checkpoint.
        memory_bytes: as for `PrivateServer`.
        watch: as of `PrivateServer.save`.

    Yields:
        The file, and a dict of reason → number of keyframes that the map could not take.

    Raises:
        TsfusionError: when the map cannot be opened, a record cannot be read, or there is no room.
    """
    map_ = PrivateMap(
        DEFAULT_MAP,
        str((folder / state_folder.MAP_FILE).resolve()),
        header.config,
        str((folder / state_folder.JOURNAL_FOLDER).resolve()),
    )
    with closing(PrivateServer(ServedMaps([map_], memory_bytes=memory_bytes))) as server:
        state, rejected = server.save(watch)
        left_out = rejected - Counter(header.meta.get("rejected", {}))
        yield state_folder.map_folder(state, DEFAULT_MAP) / state_folder.MAP_FILE, dict(left_out)
