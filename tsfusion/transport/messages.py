# SPDX-License-Identifier: MIT
"""What scanner and server say to each other on the control socket (msgpack of tagged structs).

All `*_ns` stamps of the server are its own monotonic clock; the client shifts them to its own.
"""

from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct

from tsfusion.config import MapName
from tsfusion.corrections import Corrections
from tsfusion.errors import DecodeError

SessionId = Annotated[bytes, Meta(min_length=16, max_length=16)]
Counts = dict[Annotated[str, Meta(max_length=32)], Annotated[int, Meta(ge=0)]]  # by reason
Seq = Annotated[int, Meta(ge=0, le=(1 << 63) - 1)]


class Hello(Struct, frozen=True, tag="hello", omit_defaults=True):
    """A client opens (or re-opens) its session."""

    session: SessionId
    version: int  # wire format it speaks
    map: MapName = "default"


class Welcome(Struct, frozen=True, tag="welcome"):
    """The server's answer. A new `epoch` is a new server process: resend everything after `durable`.

    `corrections`: the revision of this session's that is on the server's disk; None = it takes none.
    """

    epoch: str
    version: int
    durable: Seq  # the highest seq of this session that is on the server's disk; 0 = none
    fused: Seq  # the highest that the map has taken or refused; 0 = none
    window_keyframes: int  # credit: sent, not yet durable
    window_bytes: int
    max_frame_bytes: int
    corrections: Annotated[int, Meta(ge=0)] | None = None


class Stamps(Struct, frozen=True, array_like=True):
    """When the server did what with one keyframe; 0 = not yet."""

    seq: Seq
    received_ns: int = 0
    durable_ns: int = 0
    fuse_start_ns: int = 0
    fused_ns: int = 0
    meshed_ns: int = 0


class Ack(Struct, frozen=True, tag="ack"):
    """Progress. Everything up to `durable` may leave the spool.

    `resend` asks to go back to durable + 1 at once: something in between never came.
    """

    session: SessionId
    durable: Seq
    fused: Seq
    stamps: tuple[Stamps, ...] = ()
    resend: bool = False


class Nack(Struct, frozen=True, tag="nack"):
    """This keyframe will never be in the map.

    Attributes:
        stage: `door` = it was not journaled and must not be sent again; `map` = it is journaled, but the
            map could not take it.
    """

    session: SessionId
    seq: Seq
    stage: Literal["door", "map"]
    reason: str
    message: str


class Hold(Struct, frozen=True, tag="hold"):
    """Nothing is taken from this session for so long: keep everything, then go on from durable + 1.

    `reason`: `disk` (full or failing) or `quota`; `message` says it to a person.
    """

    session: SessionId
    seconds: float
    reason: str
    message: str


class Corrected(Struct, frozen=True, tag="corrected"):
    """The answer to Corrections: this revision of the session is on the server's disk, or a later one."""

    session: SessionId
    revision: Annotated[int, Meta(ge=0)]


class Uncorrected(Struct, frozen=True, tag="uncorrected"):
    """The answer to Corrections that are not taken.

    `again_s`: seconds after which they may be sent again; 0 = they never will be.
    """

    session: SessionId
    revision: Annotated[int, Meta(ge=0)]
    reason: str
    message: str
    again_s: float = 0.0


class Denied(Struct, frozen=True, tag="denied"):
    """The answer to a Hello that opens no session (yet): ask again, but tell the user why.

    `reason`: `opening` (the map is being opened), `map` (there is no such map, and no room for one, or it
    cannot be opened), `session` (it is another client's) or `version`.
    """

    session: SessionId
    reason: str
    message: str


class Ping(Struct, frozen=True, tag="ping", omit_defaults=True):
    """A client is alive, and how it is doing.

    Attributes:
        offset_ns: what the client takes the server's clock minus its own to be (None = not yet known).
        bound_ns: the most that this can be wrong.
        waiting: keyframes in its spool.
        skipped: keyframes that were never spooled or left it unsent, by reason, since the client began.
    """

    session: Annotated[bytes, Meta(max_length=16)]
    sent_ns: int
    offset_ns: int | None = None
    bound_ns: int = 0
    waiting: Annotated[int, Meta(ge=0)] = 0
    skipped: Annotated[Counts, Meta(max_length=16)] = {}


class Pong(Struct, frozen=True, tag="pong"):
    epoch: str
    ping_sent_ns: int
    received_ns: int
    sent_ns: int
    durable: Seq = 0
    fused: Seq = 0


ASK_AGAIN = "ask again"  # so ends the error of a Reply when the same question may be answered soon


class Command(Struct, frozen=True, tag="command", kw_only=True):
    """A request of a person or program; answered by one Reply."""

    name: Literal["ping", "health", "status", "mesh"]
    map: MapName = "default"
    min_weight: float | None = None


class Reply(Struct, frozen=True, tag="reply", kw_only=True):
    """The answer to a Command; arrays of a mesh follow as raw frames."""

    name: str
    error: str | None = None
    health: "Health | None" = None
    status: "Status | None" = None
    mesh: "MeshLayout | None" = None


class MeshLayout(Struct, frozen=True, kw_only=True):
    """Shapes of the frames that follow: vertices float32, faces int32, normals float32, colors uint8."""

    vertices: int
    faces: int
    colors: bool


class Spread(Struct, frozen=True, kw_only=True):
    """Milliseconds over so many keyframes; all 0 where there is none."""

    count: int = 0
    mean: float = 0.0
    p50: float = 0.0
    p95: float = 0.0
    p99: float = 0.0
    max: float = 0.0


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
    corrections: int = 0  # messages with corrected poses that were taken since the server began


class ClientHealth(Struct, frozen=True, kw_only=True):
    """One session that was heard since the server began.

    Attributes:
        client: the name its key is allowed under; empty without keys.
        session: the first 8 hexadecimal digits.
        heard_s: seconds since its last message.
        waiting, skipped: as its last Ping said.
        held: why nothing is taken from it now; empty = it is.
        revision, corrected: of its corrections the newest, and how many keyframes they name.
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
    revision: int = 0
    corrected: int = 0


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


class KeyframeTimes(Struct, kw_only=True):
    """The latency ledger's row: one keyframe, every stamp on the client's monotonic clock; 0 = unknown.

    `clock_bound_ns`: the server's stamps are right to within ± this (half the best round trip).
    """

    seq: int
    timestamp_ns: int = 0  # the sensor's own clock
    captured_ns: int = 0
    sent_ns: int = 0
    received_ns: int = 0
    durable_ns: int = 0
    fuse_start_ns: int = 0
    fused_ns: int = 0
    meshed_ns: int = 0
    clock_bound_ns: int = 0


ToServer = Hello | Ping | Command | Corrections
ToClient = Welcome | Denied | Hold | Ack | Nack | Corrected | Uncorrected | Pong | Reply
_TO_SERVER = msgspec.msgpack.Decoder(ToServer)
_TO_CLIENT = msgspec.msgpack.Decoder(ToClient)
encode = msgspec.msgpack.encode


def decode_to_server(frame: Any) -> ToServer:
    """Raises DecodeError for anything but a message to the server."""
    return _decode(_TO_SERVER, frame)  # type: ignore[no-any-return]


def decode_to_client(frame: Any) -> ToClient:
    """Raises DecodeError for anything but a message to the client."""
    return _decode(_TO_CLIENT, frame)  # type: ignore[no-any-return]


def _decode(decoder: Any, frame: Any) -> Any:
    try:
        return decoder.decode(frame)
    except Exception as error:  # msgspec also raises UnicodeDecodeError and RecursionError
        raise DecodeError(f"not a control message: {error}") from error
