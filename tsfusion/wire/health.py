# SPDX-License-Identifier: MIT
"""Health and status: how a server and a map are doing."""

from typing import Any, Literal

from msgspec import Struct

from tsfusion.wire.keyframe_times import Spread


class MeshLayout(Struct, frozen=True, kw_only=True):
    """Shapes of the frames that follow: vertices float32, faces int32, normals float32, colors uint8."""

    vertices: int
    faces: int
    colors: bool


MapState = Literal["opening", "idle", "busy", "restarting", "failed"]


class MapHealth(Struct, frozen=True, kw_only=True):
    """How one map is doing, as far as the gateway knows without asking its fuser.

    Attributes:
        problem: what keeps it from taking or fusing keyframes; empty = nothing.
        waiting: durable, not yet fused or rejected.
        rejected: journaled, but not fusable: reason → count.
        quarantined: keyframes kept aside for inspection.
        last_keyframe_s: seconds since the last one was journaled; None = none since the server began.
        delay_bound_ms: the delays are right to within so much (half the best round trip, the worst client's).
    """

    state: MapState
    problem: str
    keyframes_durable: int
    keyframes_fused: int
    waiting: int
    rejected: dict[str, int]
    quarantined: int
    sessions: int
    journal_bytes: int
    journal_damaged: int  # records the recovery scan could not read
    fuser_restarts: int
    blocks: int
    map_bytes: int
    last_keyframe_s: float | None
    delay_ms: Spread
    delay_bound_ms: float
    corrections: int = 0  # records of corrected poses: in the journal at the start, and journaled since


class ClientHealth(Struct, frozen=True, kw_only=True):
    """One session that was heard since the server began.

    Attributes:
        client: the name its key is allowed under; empty without keys.
        session: the first 8 hexadecimal digits.
        heard_s: seconds since its last message.
        waiting, skipped: as its last Ping said.
        held: why nothing is taken from it now; empty = it is.
        corrections: its records of corrected poses, as of a map.
    """

    client: str
    session: str
    map: str
    heard_s: float
    durable: int
    fused: int
    received_bytes: int
    waiting: int
    skipped: dict[str, int]
    held: str
    corrections: int = 0


class Health(Struct, frozen=True, kw_only=True):
    """How a server is doing, answered at once whatever its fusers do. Counts are since it began.

    `ready`: keyframes are accepted, journaled and fused. `problems`: why not, or what needs a person.
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


class Status(Struct, frozen=True, kw_only=True):
    """How a map is doing. Counts are of the whole journal and map; the delay of this process."""

    epoch: str
    map: str
    state: str  # the map's folder
    fuser: Literal["starting", "idle", "busy"]
    uptime_s: float
    keyframes_durable: int
    keyframes_fused: int
    keyframes_rejected: dict[str, int]  # journaled, but not fusable: reason → count
    messages_refused: dict[str, int]  # never journaled: reason → count
    duplicates: int
    sessions: int
    blocks: int
    voxels: int
    map_bytes: int
    map_hash: str
    color_hash: str
    journal_bytes: int
    journal_damaged: int  # records the recovery scan could not read
    fuser_restarts: int
    peak_rss_bytes: dict[str, int]  # server (gateway), fuser
    delay_ms: Spread  # capture to fused, of the last 1024 keyframes
    delay_bound_ms: float  # that is right to within so much
    config: dict[str, Any]  # server and volume settings
    versions: dict[str, str]
