# SPDX-License-Identifier: MIT
"""What a map says of the keyframes that it holds, by session, as the fuser writes it into a checkpoint.

A session is one scanner's stream of numbered records. Its keyframes count once, so maps that hold the same
ones must not be added. Its poses are in one coordinate frame, the session's world: maps of different worlds
are not added either, unless somebody knows better.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

_POSE = 12  # numbers: the upper three rows


class SessionHistory(Struct, frozen=True, eq=False):
    """The keyframes of one session in a map.

    Attributes:
        session: 32 hex digits.
        client: name of its key; empty = it came without keys.
        world: its coordinate frame; empty = that of poses given from elsewhere.
        last: up to this number, each keyframe is in the map or will never be.
        unlisted: up to this number it is not known which: 0 = it is known of all.
        seqs: (n,) int64 numbers of the others in the map, ascending.
        poses: (n, 12) float64: upper three rows of each one's `T_world_camera` in the map.
        waiting: number of keyframes whose corrected pose is not fused yet.
    """

    session: str
    client: str
    world: str
    last: int
    unlisted: int
    seqs: NDArray[np.int64]
    poses: NDArray[np.float64]
    waiting: int


def sessions(meta: Mapping[str, Any]) -> list[SessionHistory]:
    """The sessions of a map; of one that no server saved none is known."""
    poses = meta.get("poses") or {}
    listed = poses.get("sessions", {})
    waiting = [name for name, *_ in poses.get("waiting", ())]
    found = []
    for name, (last, client, *world) in meta.get("done", {}).items():
        # Of one that is not listed nothing is in the map, or an earlier version fused it
        nothing = {"seqs": b"", "fused": b"", "unknown": 0 if poses else last}
        one: Mapping[str, Any] = listed.get(name, nothing)
        fused = np.frombuffer(one["fused"]).reshape(-1, _POSE)
        there = ~np.isnan(fused[:, 0])
        history = SessionHistory(
            session=name,
            client=client,
            world=world[0] if world else "",
            last=last,
            unlisted=one["unknown"],
            seqs=np.frombuffer(one["seqs"], np.int64)[there],
            poses=fused[there],
            waiting=waiting.count(name),
        )
        found.append(history)
    return found
