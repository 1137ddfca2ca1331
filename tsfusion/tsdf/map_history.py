# SPDX-License-Identifier: MIT
"""What a map says of the keyframes that it holds, by session, as the fuser writes it into a checkpoint.

A session is one scanner's stream of numbered records. Its keyframes count once, so maps that hold the same
ones must not be added. Its poses are in one coordinate frame, the session's world: maps of different worlds
are not added either, unless somebody knows better.
"""

from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from tsfusion.core.counts import count_of
from tsfusion.core.errors import MapError

_COUNTS = ("removed", "forgotten")  # keyframes that were taken out of a map
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
    saved = meta.get("poses") or {}
    listed = saved.get("sessions", {})
    waiting = [name for name, *_ in saved.get("waiting", ())]
    found = []
    for name, (last, client, *world) in meta.get("done", {}).items():
        # Of one that is not listed nothing is in the map, or an earlier version fused it
        nothing = {"seqs": b"", "fused": b"", "unknown": 0 if saved else last}
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


def check_addable(here: Mapping[str, Any], there: Mapping[str, Any], *, same_frame: bool) -> None:
    """Raise MapError where two maps hold the same keyframes, or are not known to be in one coordinate frame.

    Args:
        here, there: `meta` of each map.
        same_frame: they are in one, whatever their worlds.
    """
    ours, theirs = ({one.session: one for one in sessions(meta)} for meta in (here, there))
    for name in ours:
        if name in theirs:
            _check_distinct(ours[name], theirs[name])
    worlds = [{one.world for one in each.values()} or {""} for each in (ours, theirs)]
    if not same_frame and worlds[0].isdisjoint(worlds[1]):
        raise MapError(
            "the maps are of scans that found their poses themselves, each in a coordinate frame of its own; "
            "merge them only if they are known to be in one (same_frame), or after they were aligned"
        )


def _check_distinct(ours: SessionHistory, theirs: SessionHistory) -> None:
    name = f"session {ours.session[:8]}" + (f" of {ours.client}" if ours.client else "")
    if ours.unlisted or theirs.unlisted:
        raise MapError(
            f"both maps have keyframes of {name}, and it is not known of all of them which: they could "
            "count twice; merge the maps that these were made from, or fuse their journals"
        )
    shared = np.intersect1d(ours.seqs, theirs.seqs)
    if len(shared):
        raise MapError(
            f"both maps hold {count_of(len(shared), 'keyframe')} of {name} (first number {shared[0]}): they "
            "would count twice"
        )


def poses(meta: Mapping[str, Any]) -> set[bytes]:
    """The poses of a map's keyframes, as far as they are listed: who has one of them is likely the same."""
    return {row.tobytes() for one in sessions(meta) for row in one.poses}


def without_journal(meta: Mapping[str, Any]) -> dict[str, Any]:
    """The meta of a map that leaves its journal behind, or no longer is the sum of whole keyframes.

    None of its keyframes can be moved or listed any more. Those whose corrections wait stay where they are.
    """
    if "done" not in meta:
        return dict(meta)
    saved = meta.get("poses") or {}
    waiting: dict[str, set[int]] = {}
    for name, seq, _ in saved.get("waiting", ()):
        waiting.setdefault(name, set()).add(seq)
    sessions = saved.get("sessions", {})
    listed = {
        name: {
            **dict.fromkeys(("seqs", "segments", "offsets", "fused"), b""),
            "T": sessions.get(name, {}).get("T", b""),
            "unknown": last,
            "missed": sorted(waiting.get(name, set()).union(sessions.get(name, {}).get("missed", ()))),
            "forgotten": sessions.get(name, {}).get("forgotten", []),
        }
        for name, (last, *_) in meta["done"].items()
    }
    counts = {name: saved.get(name, 0) for name in _COUNTS}
    return {**meta, "poses": {"sessions": listed, "waiting": [], **counts}}


def added(here: Mapping[str, Any], there: Mapping[str, Any]) -> dict[str, Any]:
    """The meta of two maps' sum; each session goes on from where it was later."""
    one, other = without_journal(here), without_journal(there)
    together = {**other, **one}
    if "done" not in together:
        return together
    for name, progress in other.get("done", {}).items():
        if progress[0] > together["done"].get(name, [0])[0]:
            together["done"] = {**together["done"], name: progress}
    parts = [each.get("poses", {}).get("sessions", {}) for each in (one, other)]
    together["poses"] = {
        "sessions": {
            name: _later([part[name] for part in parts if name in part]) for name in together["done"]
        },
        "waiting": [],
        **{name: sum(each.get("poses", {}).get(name, 0) for each in (one, other)) for name in _COUNTS},
    }
    for counts in ("rejected", "blocks"):
        together[counts] = dict(sum((Counter(each.get(counts, {})) for each in (one, other)), Counter[str]()))
    return together


def _later(parts: list[dict[str, Any]]) -> dict[str, Any]:
    """A session of two maps, as the one that is farther has it."""
    latest = max(parts, key=lambda part: part["unknown"])
    together = {name: [one for part in parts for one in part[name]] for name in ("missed", "forgotten")}
    return {**latest, **together, "missed": sorted(set(together["missed"]))}
