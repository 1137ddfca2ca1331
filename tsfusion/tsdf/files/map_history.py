# SPDX-License-Identifier: MIT
"""Read and combine a saved map's list of keyframes, by session, which the fuser writes into a checkpoint.

A session is one scanner's stream of numbered records. A keyframe must count once: maps with common keyframes
must not be added. All poses of a session are in one coordinate frame, its world. Maps of different worlds are
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
from tsfusion.geometry.keyframe_rows import COLUMNS, KeyframeRows
from tsfusion.geometry.origin import Origin
from tsfusion.geometry.up_direction import SensorPosture

HELD = "held"  # key of a checkpoint's meta: how the sensors were held


class SessionHistory(Struct, frozen=True, eq=False):
    """Keyframes of one session in a map.

    Attributes:
        session: 32 hex digits.
        client: name of the client's key; empty for a client without keys.
        world: coordinate frame of the poses; empty for poses given from elsewhere.
        last: every keyframe up to this number is in the map, or will never be.
        unlisted: up to this number the list of keyframes is unknown; 0 = all are listed.
        rows: the listed keyframes in the map, by ascending number, at their fused poses.
        taken_out: (k,) int64 numbers of keyframes that corrections have taken out of the map.
        waiting: number of keyframes whose corrected pose is not fused yet.
    """

    session: str
    client: str
    world: str
    last: int
    unlisted: int
    rows: KeyframeRows
    taken_out: NDArray[np.int64]
    waiting: int


def sessions(meta: Mapping[str, Any]) -> list[SessionHistory]:
    """Return the sessions in a map's `meta`; the list is empty for a map that no server saved."""
    saved = meta.get("poses") or {}
    listed = saved.get("sessions", {})
    waiting = [name for name, *_ in saved.get("waiting", ())]
    found = []
    for name, (last, client, *world) in meta.get("done", {}).items():
        # Such a keyframe is absent from the map, or was fused by an earlier version
        nothing = {**dict.fromkeys(COLUMNS, b""), "unknown": 0 if saved else last}
        one: Mapping[str, Any] = listed.get(name, nothing)
        rows = KeyframeRows.of_saved({bytes.fromhex(name): one})
        history = SessionHistory(
            session=name,
            client=client,
            world=world[0] if world else "",
            last=last,
            unlisted=one["unknown"],
            rows=rows[rows.in_map],
            taken_out=rows.seqs[~rows.in_map],
            waiting=waiting.count(name),
        )
        found.append(history)
    return found


def check_readable(meta: Mapping[str, Any]) -> None:
    """Raise a Python error unless the history in `meta` has the form that a server writes."""
    sessions(meta)
    msgspec.convert(meta.get("rejected", {}), dict[str, int])
    SensorPosture(meta.get(HELD))


def of_clients(histories: Iterable[SessionHistory]) -> list[SessionHistory]:
    """Return the scanners' sessions, without the server's own session (its records forget keyframes)."""
    return [one for one in histories if one.session != SERVER_SESSION.hex()]


def worlds(meta: Mapping[str, Any]) -> set[str]:
    """Return the worlds (coordinate frames) of a map's keyframes; "" stands for poses given from elsewhere.

    A map that no server made has its own frame as `world` in `meta`.
    """
    return {one.world for one in of_clients(sessions(meta))} or {str(meta.get("world", ""))}


def check_addable(here: Mapping[str, Any], there: Mapping[str, Any], *, same_frame: bool) -> None:
    """Raise MapError if two maps hold the same keyframes, or may be in different coordinate frames.

    Args:
        here, there: `meta` of each map.
        same_frame: the caller knows that the maps share a frame, even with different worlds.
    """
    ours, theirs = ({one.session: one for one in of_clients(sessions(meta))} for meta in (here, there))
    for name in ours:
        if name in theirs:
            _check_distinct(ours[name], theirs[name])
    check_worlds(worlds(here), worlds(there), same_frame=same_frame)


def check_worlds(here: Set[str], there: Set[str], *, same_frame: bool, name: str = "the other map") -> None:
    """Raise MapError if two maps have no coordinate frame in common, and are not known to share one."""
    if not here.isdisjoint(there):
        return
    origins = [one for each in (here, there) for world in sorted(each) if (one := Origin.of_world(world))]
    if len({one.position for one in origins}) > same_frame:
        first, places = ",".join(map(str, origins[0].position)), " and ".join(map(str, origins))
        raise MapError(f"{name} counts from another origin ({places}): give one to all (--origin {first})")
    if not same_frame:
        raise MapError(
            f"{name} is of a scan that found its poses itself, in a coordinate frame of its own: align the "
            "maps first, or, if they are known to share a frame, say so (--same-frame, same_frame=True)"
        )


def are_given(here: Mapping[str, Any], there: Mapping[str, Any]) -> bool:
    """Return True if two maps share no session and no world but that of poses given from elsewhere."""
    ours, theirs = (of_clients(sessions(meta)) for meta in (here, there))
    worlds = [{one.world for one in each} or {""} for each in (ours, theirs)]
    names = [{one.session for one in each} for each in (ours, theirs)]
    return worlds[0] & worlds[1] == {""} and names[0].isdisjoint(names[1])


def _check_distinct(ours: SessionHistory, theirs: SessionHistory) -> None:
    name = f"session {ours.session[:8]}" + (f" of {ours.client}" if ours.client else "")
    if ours.unlisted or theirs.unlisted:
        raise MapError(
            f"both maps have keyframes of {name}, but no complete list of them: some could count twice; "
            "merge the maps that these were made from, or fuse their journals"
        )
    shared = np.intersect1d(ours.rows.seqs, theirs.rows.seqs)
    if len(shared):
        raise MapError(
            f"both maps hold {count_of(len(shared), 'keyframe')} of {name} (first number {shared[0]}): they "
            "would count twice"
        )


def rows(meta: Mapping[str, Any]) -> KeyframeRows:
    """Return the listed keyframes in the map, at their fused poses."""
    saved = (meta.get("poses") or {}).get("sessions", {})
    done = [name for name in meta.get("done", {}) if name in saved]
    found = KeyframeRows.of_saved({bytes.fromhex(name): saved[name] for name in done})
    return found[found.in_map]


def poses(meta: Mapping[str, Any]) -> set[bytes]:
    """Return the listed poses of a map's keyframes, as bytes; two maps with a common pose likely share it."""
    return {pose.tobytes() for pose in rows(meta).poses}


def without_journal(meta: Mapping[str, Any]) -> dict[str, Any]:
    """Return `meta` for a map without its journal, or one that is no longer a sum of whole keyframes.

    Its keyframes can no longer be moved or listed. Keyframes with waiting corrections keep their poses.
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
            **dict.fromkeys(COLUMNS, b""),
            "unknown": last,
            "missed": sorted(waiting.union(one["missed"])),
        }
    return {**meta, "poses": {**saved, "sessions": listed, "waiting": []}}


def added(here: Mapping[str, Any], there: Mapping[str, Any]) -> dict[str, Any]:
    """Return `meta` for the sum of two maps; each session continues from the later of its two states."""
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
    """Return a session's only state, or the later one of its states in two maps."""
    if len(parts) == 1:
        return parts[0]
    latest = max(parts, key=lambda part: part["unknown"])
    missed = sorted({seq for part in parts for seq in part["missed"]})
    forgotten = [numbers for part in parts for numbers in part.get("forgotten", ())]
    return {**latest, "missed": missed, "forgotten": forgotten}
