# SPDX-License-Identifier: MIT
"""Copy every intact record of a damaged journal into a new journal."""

import os
from contextlib import closing, suppress
from pathlib import Path

from msgspec import Struct

from tsfusion.core import durable_files
from tsfusion.core.errors import JournalError, OutputError, refusals_as
from tsfusion.core.output_folder import building
from tsfusion.core.readable_numbers import OnProgress
from tsfusion.journal.inspection import JournalFault, problem
from tsfusion.journal.record_scan import Damage, Erased
from tsfusion.journal.state_folder import JournalPlace
from tsfusion.journal.writer import Journal


class Recovery(Struct, kw_only=True):
    """Result of a recovery. `copies`: second copies in the old journal that were left out."""

    path: str
    keyframes: int
    corrections: int
    copies: int
    segments: int
    nbytes: int
    lost: int
    problems: list[JournalFault]


def recover(place: JournalPlace, out: Path, segment_bytes: int, watch: OnProgress) -> Recovery:
    """Write every intact record of a journal into the new folder `out`, in order, in closed segments.

    Erased records are left out. The journal itself is only read. `out` appears once all records are on the
    disk; after an error it does not appear.

    Raises:
        OutputError: `out` is not empty, lies inside the journal, or cannot be written.
        JournalError: no record can be saved, or the disk refuses.
    """
    _check(place, out)
    problems, copies, corrections, seen = [], 0, 0, set[tuple[bytes, int]]()
    with suppress(OSError):  # removes an empty folder: then one rename puts the new folder there
        out.rmdir()
    with building(out) as work, closing(Journal(work, segment_bytes, sync=False)) as new:
        for path, step in place.steps(watch):
            if isinstance(step, Erased):
                continue
            if isinstance(step, Damage):
                problems.append(problem(path, step))
            elif (step.session, step.seq) in seen:
                copies += 1
            else:
                seen.add((step.session, step.seq))
                corrections += step.is_correction
                new.append(
                    step.frames,
                    session=step.session,
                    seq=step.seq,
                    client=step.client,
                    logged_ns=step.logged_ns,
                )
        new.close()
        if not seen:
            raise JournalError(f"{place.path} holds no keyframe that could be saved")
        segments = _sync(work)
    durable_files.sync_folder(out.absolute().parent)
    return Recovery(
        path=str(out),
        keyframes=len(seen) - corrections,
        corrections=corrections,
        copies=copies,
        segments=segments,
        nbytes=new.nbytes,
        lost=sum(one.lost for one in problems),
        problems=problems,
    )


def _check(place: JournalPlace, out: Path) -> None:
    with refusals_as(OutputError, f"cannot write to {out}"):
        is_used = out.is_dir() and any(out.iterdir())
    if is_used:
        raise OutputError(f"cannot write to {out}: it is not empty; give a folder that does not exist yet")
    source = place.path.resolve()
    if out.resolve().is_relative_to(source if source.is_dir() else source / out.name):
        raise OutputError(f"cannot write to {out}: it is inside the journal that is read")


def _sync(folder: Path) -> int:
    """Wait until the files of a folder are on the disk; return their number."""
    files = list(folder.iterdir())
    for path in files:
        with path.open("rb") as file:
            os.fsync(file.fileno())
    durable_files.sync_folder(folder)
    return len(files)
