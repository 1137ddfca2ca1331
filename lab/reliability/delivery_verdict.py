# SPDX-License-Identifier: MIT
"""Check journal, map and counts after a run: walls 0 to n - 1 and the corrections, each once."""

import functools
from pathlib import Path

from keyframes_and_servers import NUMBERED_NS, wall
from sum_map import SumMap, hash_of

from lab.reliability.scanner_process import Report, correction_number, journals
from tsfusion import journal
from tsfusion.core.config import SERVER_SESSION
from tsfusion.wire.messages.health import Status
from tsfusion.wire.records.record_header import unpack_keyframe

VOXEL_SIZE = 0.04  # as `wire.Server`'s map


def server_problems(status: Status, keyframes: int, forgotten: int = 0) -> list[str]:
    problems = []
    counted = (status.keyframes_durable, status.keyframes_fused, status.keyframes_forgotten)
    if counted != (wanted := (keyframes, keyframes - forgotten, forgotten)):
        problems.append(f"durable, fused and forgotten are {counted}, not {wanted}")
    if status.keyframes_rejected or set(status.messages_refused) - {"gap", "held"}:
        problems.append(f"rejected {status.keyframes_rejected}, refused {status.messages_refused}")
    if status.journal_damaged:
        problems.append(f"{status.journal_damaged} records are damaged")
    return problems


def client_problems(report: Report) -> list[str]:
    lost = {**report.refused, **report.rejected, **report.skipped}
    return [f"the scanner counts lost keyframes: {lost}"] if lost else []


def verify(
    state: Path, keyframes: int, map_hash: str, correct_every: int = 0, *, sums: bool = False
) -> list[str]:
    """List what is wrong with the files and the map that a stopped server left.

    Args:
        correct_every: as in `scanner_process.Plan`.
        sums: the map is a `SumMap`.
    """
    problems = []
    corrected: list[int] = []
    last: dict[bytes, tuple[int, int]] = {}
    found, erased = [], 0
    for folder in journals(state):
        for number in journal.segments(folder):
            path = journal.segment_path(folder, number)
            entries, damaged = journal.list_records(path)
            erased += sum(entry.is_erased for entry in entries)
            if damaged:
                problems.append(f"{damaged} damaged records in {path.name}")
            for record in journal.records(path):
                if record.session == SERVER_SESSION:
                    continue
                if record.is_correction:
                    i = correction_number(record)
                    corrected.append(i)
                    if not erased and i != last.get(record.session, (0, i))[1]:
                        problems.append(f"correction {i} does not follow its keyframe")
                    continue
                i = unpack_keyframe(record.frames[0]).timestamp_ns - NUMBERED_NS
                before = last.get(record.session, (0, -1))
                if (record.seq, i) <= before or i < before[1]:
                    problems.append(f"keyframe {i} (seq {record.seq}) comes after {before}")
                last[record.session] = (record.seq, i)
                found.append(i)
    if len(found) + erased != keyframes or len(set(found)) != len(found):
        missing = sorted(set(range(keyframes)) - set(found))
        twice = sorted({i for i in found if found.count(i) > 1})
        counts = f"{len(found)} keyframes and {erased} erased"
        problems.append(f"the journal has {counts}: missing {missing}, twice {twice}")
    due = list(range(0, keyframes, correct_every)) if correct_every else []
    if sorted(corrected) != due:
        problems.append(f"the journal has the corrections {sorted(corrected)}, not {due}")
    return problems + _map_problems(state, keyframes, map_hash, corrected=correct_every > 0, sums=sums)


def _map_problems(state: Path, keyframes: int, map_hash: str, *, corrected: bool, sums: bool) -> list[str]:
    (path,) = [*state.glob("maps/*/map.tsf"), *state.glob("map.tsf")]
    (folder,) = journals(state)
    if sums:
        from corrected_maps import final_keyframes

        saved = SumMap.load(path).map_hash()
        wanted = hash_of(final_keyframes(folder) if corrected else map(wall, range(keyframes)))
    else:
        from corrected_maps import fresh_map

        from tsfusion import Volume

        saved = Volume.load(path).map_hash()
        wanted = fresh_map(folder, VOXEL_SIZE).map_hash() if corrected else undisturbed_hash(keyframes)
    hashes = {"undisturbed": wanted, "told": map_hash, "saved": saved}
    return [] if len(set(hashes.values())) == 1 else [f"the map's hashes differ: {hashes}"]


@functools.cache
def undisturbed_hash(keyframes: int) -> str:
    """Hash of the map of an undisturbed run."""
    from formula_scenes import volume_of

    return volume_of(map(wall, range(keyframes)), voxel_size=VOXEL_SIZE, threads=1).map_hash()
