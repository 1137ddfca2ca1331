# SPDX-License-Identifier: MIT
"""Maps in folders as a server leaves them: a journal, and a checkpoint of it."""

from collections.abc import Sequence
from pathlib import Path

from keyframes_and_servers import VOLUME, wall

from tsfusion import VolumeConfig
from tsfusion.fuser.map_checkpoints import MapCheckpoints
from tsfusion.fuser.messages import SessionProgress
from tsfusion.journal import Journal, state_folder
from tsfusion.wire import codec
from tsfusion.wire.codec import decode_keyframe

ANNA, BOB = b"a" * 16, b"b" * 16


def make_map(
    folder: Path,
    views: Sequence[int],
    *,
    session: bytes = ANNA,
    client: str = "",
    world: str = "",
    behind: int = 0,
    config: VolumeConfig = VOLUME,
) -> Path:
    """The folder of a map with `wall(i)` for each of these views.

    Args:
        behind: number of the last keyframes that the checkpoint is without.
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
            saved.volume.integrate(keyframe)
            saved.poses.add(session, seq, position, keyframe)
            saved.done[session] = SessionProgress(seq, client, world)
    journal.close()
    assert saved.save()
    return folder
