# SPDX-License-Identifier: MIT
"""The map that a journal's keyframes make at their final poses, by the rules of corrections, from nothing."""

from dataclasses import replace
from pathlib import Path

from formula_scenes import volume_of

from tsfusion import Keyframe, Volume, journal
from tsfusion.wire.records import codec


def final_keyframes(folder: Path) -> list[Keyframe]:
    """The keyframes of a journal that nothing removed, each at its newest pose."""
    found: dict[tuple[bytes, int], Keyframe | None] = {}
    sent: dict[tuple[bytes, int], Keyframe] = {}
    T_map_odometry = {}
    forgotten: set[tuple[bytes, int]] = set()
    for number in journal.segments(folder):
        for record in journal.records(journal.segment_path(folder, number)):
            content, session = codec.decode(record.frames), record.session
            if isinstance(content, Keyframe):
                T = content.T_world_camera
                if session in T_map_odometry:
                    T = T_map_odometry[session] @ T
                sent[session, record.seq] = content
                found[session, record.seq] = replace(content, T_world_camera=T)
                continue
            if content.target is not None:
                forgotten.update((content.target, seq) for seq in content.removed.tolist())
                continue
            for seq, T in zip(content.seqs.tolist(), content.poses, strict=True):
                if (session, seq) in sent:  # it may have been erased
                    found[session, seq] = replace(sent[session, seq], T_world_camera=T)
            for seq in content.removed.tolist():
                found[session, seq] = None
            if content.T_map_odometry is not None:
                T_map_odometry[session] = content.T_map_odometry
    return [one for key, one in found.items() if one is not None and key not in forgotten]


def fresh_map(folder: Path, voxel_size: float) -> Volume:
    """The map of these."""
    return volume_of(final_keyframes(folder), voxel_size=voxel_size, threads=1)
