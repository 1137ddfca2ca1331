# SPDX-License-Identifier: MIT
"""Maps in folders as a server leaves them: a journal, and a checkpoint of it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from keyframes_and_servers import VOLUME, wall

from tsfusion import Keyframe, VolumeConfig
from tsfusion.core.config import SERVER_SESSION
from tsfusion.fuser.fuser_messages import SessionProgress
from tsfusion.fuser.map_checkpoints import MapCheckpoints
from tsfusion.journal import Journal, state_folder
from tsfusion.wire.records import codec, corrections
from tsfusion.wire.records.codec import decode_keyframe

ANNA, BOB = b"a" * 16, b"b" * 16


def make_map(
    folder: Path,
    views: Sequence[int],
    *,
    session: bytes = ANNA,
    client: str = "",
    world: str = "",
    behind: int = 0,
    refused: Sequence[int] = (),
    config: VolumeConfig = VOLUME,
) -> Path:
    """The folder of a map with `wall(i)` for each of these views.

    Args:
        behind: number of the last keyframes that the checkpoint is without.
        refused: numbers of keyframes that the map did not take.
    """
    folder.mkdir(parents=True, exist_ok=True)
    journal = Journal(folder / state_folder.JOURNAL_FOLDER, 1 << 20, sync=False)
    saved = MapCheckpoints(folder, config, keep_previous=False)
    start = saved.done[session].seq if session in saved.done else 0
    for seq, view in enumerate(views, start + 1):
        frames = codec.encode(wall(view), session=session, seq=seq, jpeg_quality=90, world=world)
        position = journal.append(frames, session=session, seq=seq, client=client)
        if seq <= start + len(views) - behind:
            keyframe = decode_keyframe(frames)
            if seq not in refused:
                saved.volume.integrate(keyframe)
                saved.ledger.add(session, seq, position, keyframe)
            saved.done[session] = SessionProgress(seq, client, world)
    journal.close()
    assert saved.save()
    return folder


def correct(
    folder: Path, session: bytes, seq: int, moves: dict[int, Any], removed: Sequence[int] = ()
) -> None:
    """Write a correction to a map's journal, of which no checkpoint has anything."""
    _append(folder, session, seq, corrections.checked(moves, removed=removed))


def forget(folder: Path, session: bytes, seqs: Sequence[int], number: int) -> None:
    """Write to a map's journal, as its `number`-th record of that kind, that keyframes are forgotten."""
    _append(folder, SERVER_SESSION, number, corrections.forgetting(session, np.array(seqs, np.int64)))


def _append(folder: Path, session: bytes, seq: int, correction: corrections.Correction) -> None:
    journal = Journal(folder / state_folder.JOURNAL_FOLDER, 1 << 20, sync=False)
    journal.append(corrections.encode(correction, session=session, seq=seq), session=session, seq=seq)
    journal.close()


def spoil_journal(folder: Path) -> None:
    """Overwrite bytes of a keyframe in the middle of a map's journal."""
    file = folder / state_folder.JOURNAL_FOLDER / "000001.mcap"
    content = bytearray(file.read_bytes())
    middle = len(content) // 2
    content[middle : middle + 100] = bytes(100)
    file.write_bytes(content)


def decoded(keyframe: Keyframe) -> Keyframe:
    """A keyframe as it comes out of a journal."""
    return decode_keyframe(codec.encode(keyframe, session=ANNA, seq=1, jpeg_quality=90))
