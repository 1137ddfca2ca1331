# SPDX-License-Identifier: MIT
"""Health and status of a server and its maps, as the server sends them to clients."""

from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from tsfusion.core.headline import Headline
from tsfusion.core.readable_numbers import count_of, span
from tsfusion.geometry.up_direction import Up


class Spread(Struct, frozen=True, kw_only=True):
    """Mean, percentiles and maximum of a duration over `count` keyframes, milliseconds; all 0 without any."""

    count: int = 0
    mean: float = 0.0
    p50: float = 0.0
    p95: float = 0.0
    p99: float = 0.0
    max: float = 0.0


def spread(values_ms: NDArray[np.float64]) -> Spread:
    """Return the statistics of the values, in milliseconds; NaN is left out."""
    known = values_ms[~np.isnan(values_ms)]
    if not len(known):
        return Spread()
    mean, p50, p95, p99, most = (
        round(float(x), 3) for x in (known.mean(), *np.percentile(known, (50, 95, 99)), known.max())
    )
    return Spread(count=len(known), mean=mean, p50=p50, p95=p95, p99=p99, max=most)


class MeshLayout(Struct, frozen=True, kw_only=True):
    """Row counts of a mesh's frames: vertices float32, faces int32, normals float32, colors uint8.

    `up` is the up direction, sent with whole maps only; None if not known.
    """

    vertices: int
    faces: int
    colors: bool
    up: Up | None = None


MapState = Literal["opening", "idle", "busy", "restarting", "failed"]


class Figure(NamedTuple):
    """Description of how a field of `MapHealth` becomes a figure of `/metrics`, for each map.

    Attributes:
        words: sentence that explains the figure.
        name: name without `tsfusion_`; empty takes the field's name.
        by: name of the label, for a field that counts by reason.
        grows: True for a counter: the figure never falls while the server runs.
        unit: factor from the field to the figure.
    """

    words: str
    name: str = ""
    by: str = ""
    grows: bool = False
    unit: float = 1.0


class MapCounts(Struct, frozen=True, kw_only=True):
    """Counts of one map: the fields that its health and its status have in common."""

    keyframes_durable: Annotated[int, Figure("Keyframes that were journaled.")]
    keyframes_fused: Annotated[int, Figure("Keyframes in the map.")]
    sessions: Annotated[int, Figure("Sessions that sent keyframes.")]
    journal_bytes: Annotated[int, Figure("Bytes of the journal.")]
    journal_damaged: Annotated[int, Figure("Records of the journal that could not be read.")]
    fuser_restarts: Annotated[int, Figure("Fusers that took over from a dead one.", grows=True)]
    blocks: Annotated[int, Figure("Blocks of 8³ voxels.", "map_blocks")]
    map_bytes: Annotated[int, Figure("Bytes of the map's blocks.")]
    delay_ms: Spread  # capture to fused, of the last 1024 keyframes
    # Half the best round trip of the worst client
    delay_bound_ms: Annotated[
        float, Figure("The total delays are right to within ±.", "delay_bound_seconds", unit=1e-3)
    ]
    # Keyframes whose newest pose is not fused yet; 0 if the map is settled
    corrections_waiting: Annotated[int, Figure("Keyframes not yet at their new pose.")] = 0
    # These keyframes stay where they were fused: the journal no longer has them
    corrections_unavailable: Annotated[int, Figure("Keyframes that a correction cannot move any more.")] = 0
    keyframes_moved: int = 0  # fused at a corrected pose, or taken out, since the fuser began
    moving_s: float = 0.0  # seconds of the fuser for that
    # By `tsfusion map forget` or a setting
    keyframes_forgotten: Annotated[int, Figure("Keyframes taken out of the map for good.")] = 0


class MapHealth(MapCounts, frozen=True, kw_only=True):
    """Health of one map, from what the gateway knows without asking the fuser."""

    state: MapState
    # Reason why keyframes are not accepted or not fused; empty without a problem
    problem: Annotated[str, Figure("Whether something keeps it from taking or fusing.", "map_problem")]
    waiting: Annotated[int, Figure("Keyframes journaled and not yet fused.", "keyframes_waiting")]
    rejected: Annotated[
        dict[str, int], Figure("Keyframes journaled, but not fusable.", "keyframes_rejected", "reason")
    ]
    quarantined: Annotated[int, Figure("Keyframes kept aside for inspection.", "keyframes_quarantined")]
    # Seconds since the last keyframe was journaled; None before the server's first one
    last_keyframe_s: float | None
    # Records of corrected poses: in the journal at the start, and journaled since
    corrections: Annotated[int, Figure("Corrections of keyframes' poses in the journal.", grows=True)] = 0
    checkpoints: int = 0  # written since the server began
    journal_missing: Annotated[int, Figure("Segments of the journal that are gone.")] = 0
    journal_put_back: int = 0  # times that the segment being written was removed, and written again
    fusing_s: float = 0.0  # seconds since the fuser's last answer, while it has keyframes to answer
    # By outcome: answered, refused, late, failed; since the map was opened
    questions: Annotated[
        dict[str, int], Figure("Questions to the map, by what became of them.", by="outcome", grows=True)
    ] = {}
    question_ms: Spread = Spread()  # from question to answer, in the server, of the newest 1024


ClientState = Literal["connected", "silent", "gone"]


class ClientHealth(Struct, frozen=True, kw_only=True):
    """Health of one session that has sent a message since the server began."""

    client: str  # name under which its key is allowed; empty without keys
    session: str  # first 8 hexadecimal digits of the session's id
    map: str
    heard_s: float  # seconds since its last message
    durable: int  # keyframes: in the journal when the server began, or journaled since
    fused: int  # of those, the keyframes in the map
    received_bytes: int
    waiting: int  # number of keyframes in its spool, as in its last Ping
    skipped: dict[str, int]  # number of keyframes that it never sent, by reason, as in its last Ping
    held: str  # reason why its keyframes are not accepted now; empty if they are
    corrections: int = 0  # in the journal
    # silent: nothing was heard for 5 s; gone: it said goodbye, or nothing was heard for 30 s
    state: ClientState = "connected"
    address: str = ""  # address of its machine; empty if not known
    refused: int = 0  # number of its keyframes and corrections that were refused for good, not journaled
    rejected: int = 0  # number of its keyframes that the map could not take, since the server began


class Health(Struct, frozen=True, kw_only=True):
    """Health of a server, answered at once even while its fusers are busy. Counts begin with its start.

    `ready`: the server accepts, journals and fuses keyframes, into at least one map. A server with three good
    maps and a bad one is ready, for clients of the good maps. A server is not ready while it starts or ends,
    while nobody can connect to it, or while every map has a `MapHealth.problem`.

    `problems`: reasons why the server is not ready, and other problems that a person can solve. Examples: a
    map without progress, a fuser that restarts, a client whose keyframes do not reach the map. One line each,
    with its duration; a line goes when the problem is over.
    """

    ready: bool
    problems: tuple[str, ...]
    epoch: str
    uptime_s: float
    rss_bytes: int  # of the gateway
    refused: dict[str, int]  # messages never journaled: reason → count
    duplicates: int
    maps: dict[str, MapHealth]
    clients: tuple[ClientHealth, ...]


class Status(MapCounts, frozen=True, kw_only=True):
    """Detailed status of one map. Counts are of the whole journal; the delay is since this server's start."""

    epoch: str
    map: str
    state: str  # path of the map's folder
    fuser: Literal["starting", "idle", "busy"]
    uptime_s: float
    keyframes_rejected: dict[str, int]  # journaled, but not in the map: reason → count
    messages_refused: dict[str, int]  # never journaled: reason → count
    duplicates: int
    voxels: int
    map_hash: str
    color_hash: str
    peak_rss_bytes: dict[str, int]  # server (gateway), fuser
    config: dict[str, Any]  # server and volume settings
    versions: dict[str, str]


_RECENT = 10.0  # a server counts as working for so many seconds after a keyframe
_STILL = 5.0  # a map without progress for so many seconds is in trouble


def headline(
    health: Health, *, only: str = "", rate: float = 0.0, still: dict[str, float] | None = None
) -> Headline:
    """Return a summary of a server: what it does, its trouble in words, and counts.

    Args:
        only: name of a map: this map and its clients alone; empty takes all.
        rate: keyframes fused a second; 0 if not known.
        still: map → seconds in which keyframes waited and none was fused, measured by the caller.
    """
    maps = {name: one for name, one in health.maps.items() if only in ("", name)}
    clients = [one for one in health.clients if only in ("", one.map)]
    recent = [one.last_keyframe_s for one in maps.values() if one.last_keyframe_s is not None]
    waiting = sum(one.waiting for one in maps.values())
    waiting += sum(one.waiting for one in clients if one.state != "gone")
    doing = "working" if waiting or min(recent, default=_RECENT) < _RECENT else "ready, no input"
    starts = not health.ready and any(one.state == "opening" for one in maps.values())
    return Headline(
        doing="starting" if starts else doing,
        trouble="" if starts and not health.problems else _trouble(health, maps, still or {}),
        waiting=waiting,
        rate=rate,
        lost=sum(map(lost_of_map, maps.values())) + sum(map(lost_of_client, clients)),
    )


def lost_of_map(one: MapHealth) -> int:
    """Return the number of journaled keyframes that will never be in the map."""
    return sum(one.rejected.values()) + one.journal_damaged


def lost_of_client(one: ClientHealth) -> int:
    """Return the number of keyframes that the client never sent, or that the server refused."""
    return one.refused + sum(one.skipped.values())


def _trouble(health: Health, maps: dict[str, MapHealth], still: dict[str, float]) -> str:
    """Return in a few words why a server or one of its maps does not work; empty if all is well."""
    longest = max((max(still.get(name, 0.0), one.fusing_s) for name, one in maps.items()), default=0.0)
    if longest >= _STILL:
        return f"nothing fused for {span(longest)}"
    blocked = sum(bool(one.problem) for one in maps.values())
    if blocked and health.ready:
        return (
            "does not work"
            if blocked == len(maps)
            else f"{count_of(blocked, 'map does', 'maps do')} not work"
        )
    return "" if health.ready else "not ready"
