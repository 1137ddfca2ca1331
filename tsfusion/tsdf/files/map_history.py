# SPDX-License-Identifier: MIT
"""Keyframes in a map, by session, as the fuser writes them into a checkpoint.

A session is one scanner's stream of numbered records. Its keyframes count once: maps that hold the same ones
must not be added. Its poses are in one coordinate frame, the session's world: maps of different worlds are
added only if the caller knows that they share a frame.
"""

from collections import Counter
from collections.abc import Iterable, Mapping, Set
from typing import Any

import msgspec
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from tsfusion.core.config import SERVER_SESSION
from tsfusion.core.errors import MapError
from tsfusion.core.readable_numbers import count_of
from tsfusion.geometry.origin import Origin
from tsfusion.geometry.up_direction import HeldSensor

HELD = "held"  # in a checkpoint's meta: how the sensors were held, as the fuser wrote it first
_POSE = 12  # numbers: the upper three rows
_PLACES = ("seqs", "segments", "offsets", "fused")  # columns of a session's keyframes


class SessionHistory(Struct, frozen=True, eq=False):
    """Keyframes of one session in a map.

    Attributes:
        session: 32 hex digits.
        client: name of its key; empty = it came without keys.
        world: its coordinate frame; empty = that of poses given from elsewhere.
        last: up to this number, each keyframe is in the map or will never be.
        unlisted: up to this number the list of keyframes is unknown; 0 = all are listed.
        seqs: (n,) int64 numbers of the others in the map, ascending.
        poses: (n, 12) float64: upper three rows of each one's `T_world_camera` in the map.
        positions: (n, 2) int64: segment of the journal and byte of each one's record.
        taken_out: (k,) int64 numbers of keyframes that corrections have taken out of the map.
        waiting: number of keyframes whose corrected pose is not fused yet.
    """

    session: str
    client: str
    world: str
    last: int
    unlisted: int
    seqs: NDArray[np.int64]
    poses: NDArray[np.float64]
    positions: NDArray[np.int64]
    taken_out: NDArray[np.int64]
    waiting: int


def sessions(meta: Mapping[str, Any]) -> list[SessionHistory]:
    """Sessions of a map; none of a map that no server saved."""
    saved = meta.get("poses") or {}
    listed = saved.get("sessions", {})
    waiting = [name for name, *_ in saved.get("waiting", ())]
    found = []
    for name, (last, client, *world) in meta.get("done", {}).items():
        # An unlisted keyframe is not in the map, or an earlier version fused it
        nothing = {**dict.fromkeys(_PLACES, b""), "unknown": 0 if saved else last}
        one: Mapping[str, Any] = listed.get(name, nothing)
        fused = np.frombuffer(one["fused"]).reshape(-1, _POSE)
        there = ~np.isnan(fused[:, 0])
        seqs, *positions = (np.frombuffer(one[column], np.int64) for column in _PLACES[:3])
        history = SessionHistory(
            session=name,
            client=client,
            world=world[0] if world else "",
            last=last,
            unlisted=one["unknown"],
            seqs=seqs[there],
            poses=fused[there],
            positions=np.stack(positions, axis=1)[there],
            taken_out=seqs[~there],
            waiting=waiting.count(name),
        )
        found.append(history)
    return found


def check_readable(meta: Mapping[str, Any]) -> None:
    """Raise a Python error unless the history has the form that a server writes."""
    sessions(meta)
    msgspec.convert(meta.get("rejected", {}), dict[str, int])
    HeldSensor(meta.get(HELD))


def of_clients(histories: Iterable[SessionHistory]) -> list[SessionHistory]:
    """Sessions of scanners: all but the server's own, in which it forgets keyframes."""
    return [one for one in histories if one.session != SERVER_SESSION.hex()]


def worlds(meta: Mapping[str, Any]) -> set[str]:
    """Coordinate frames of a map's keyframes; empty text = that of poses given from elsewhere.

    A map that no server made states its own as `world`.
    """
    return {one.world for one in of_clients(sessions(meta))} or {str(meta.get("world", ""))}


def check_addable(here: Mapping[str, Any], there: Mapping[str, Any], *, same_frame: bool) -> None:
    """Raise MapError if two maps hold the same keyframes, or may be in different coordinate frames.

    Args:
        here, there: `meta` of each map.
        same_frame: the maps are in one frame, whatever their worlds.
    """
    ours, theirs = ({one.session: one for one in of_clients(sessions(meta))} for meta in (here, there))
    for name in ours:
        if name in theirs:
            _check_distinct(ours[name], theirs[name])
    check_worlds(worlds(here), worlds(there), same_frame=same_frame)


def check_worlds(here: Set[str], there: Set[str], *, same_frame: bool, name: str = "the other map") -> None:
    """Raise MapError if two sets of worlds are disjoint and not known to be in one frame."""
    if not here.isdisjoint(there):
        return
    origins = [one for each in (here, there) for world in sorted(each) if (one := Origin.of_world(world))]
    if len({one.position for one in origins}) > same_frame:
        first, places = ",".join(map(str, origins[0].position)), " and ".join(map(str, origins))
        raise MapError(f"{name} counts from another origin ({places}): give all one (--origin {first})")
    if not same_frame:
        raise MapError(
            f"{name} is of a scan that found its poses itself, in a coordinate frame of its own; they go "
            "together only if they are known to be in one (--same-frame, same_frame=True), or were aligned"
        )


def are_given(here: Mapping[str, Any], there: Mapping[str, Any]) -> bool:
    """True if only given poses say that two maps are in one frame: no world, no session."""
    ours, theirs = (of_clients(sessions(meta)) for meta in (here, there))
    worlds = [{one.world for one in each} or {""} for each in (ours, theirs)]
    names = [{one.session for one in each} for each in (ours, theirs)]
    return worlds[0] & worlds[1] == {""} and names[0].isdisjoint(names[1])


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
    """Listed poses of a map's keyframes; maps with a common pose likely share that keyframe."""
    return {row.tobytes() for one in sessions(meta) for row in one.poses}


def without_journal(meta: Mapping[str, Any]) -> dict[str, Any]:
    """Meta of a map that leaves its journal behind, or is no longer a sum of whole keyframes.

    None of its keyframes can be moved or listed any more. Keyframes with waiting corrections stay where they
    are.
    """
    if "done" not in meta:
        return dict(meta)
    saved = meta.get("poses") or {"removed": 0}
    listed = {}
    for name, (last, *_) in meta["done"].items():
        one = {"T": b"", "missed": (), **saved.get("sessions", {}).get(name, {})}
        waiting = {seq for session, seq, _ in saved.get("waiting", ()) if session == name}
        listed[name] = {
            **one,
            **dict.fromkeys(_PLACES, b""),
            "unknown": last,
            "missed": sorted(waiting.union(one["missed"])),
        }
    return {**meta, "poses": {**saved, "sessions": listed, "waiting": []}}


def added(here: Mapping[str, Any], there: Mapping[str, Any]) -> dict[str, Any]:
    """Meta of two maps' sum; each session continues from the later of its two states."""
    one, other = without_journal(here), without_journal(there)
    together = {**other, **one}
    if "done" not in together:
        return together
    for name, progress in other.get("done", {}).items():
        if progress[0] > together["done"].get(name, [0])[0]:
            together["done"] = {**together["done"], name: progress}
    poses = [each.get("poses", {}) for each in (one, other)]
    together["poses"] = {
        **_sums(*poses),
        "sessions": {
            name: _later([each["sessions"][name] for each in poses if name in each.get("sessions", ())])
            for name in together["done"]
        },
        "waiting": [],
    }
    for counts in ("rejected", "blocks"):
        together[counts] = _sums(*(each.get(counts, {}) for each in (one, other)))
    return together


def _sums(*parts: Mapping[str, Any]) -> dict[str, int]:
    counts = Counter[str]()
    for part in parts:
        counts.update({name: value for name, value in part.items() if isinstance(value, int)})
    return dict(counts)


def _later(parts: list[dict[str, Any]]) -> dict[str, Any]:
    """A session of one map, or the later state of a session of two."""
    if len(parts) == 1:
        return parts[0]
    latest = max(parts, key=lambda part: part["unknown"])
    missed = sorted({seq for part in parts for seq in part["missed"]})
    forgotten = [numbers for part in parts for numbers in part.get("forgotten", ())]
    return {**latest, "missed": missed, "forgotten": forgotten}
