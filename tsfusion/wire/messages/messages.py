# SPDX-License-Identifier: MIT
"""Control messages between scanner and server (msgpack of tagged structs).

All `*_ns` stamps of the server are on its own monotonic clock; the client shifts them to its own clock.
"""

from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta, Struct

from tsfusion.core.config import MapName
from tsfusion.core.errors import DecodeError
from tsfusion.core.readable_numbers import counted
from tsfusion.wire.messages.forget_messages import Forgotten, Selection
from tsfusion.wire.messages.health import Health, MeshLayout, Status
from tsfusion.wire.messages.migration_messages import Address, HandOver, Moved, Parcel
from tsfusion.wire.messages.questions import Answer, Question
from tsfusion.wire.records.record_header import SessionId, WorldName, is_damaged, seal

PROTOCOL_VERSION = 3  # covers these messages, and the kinds of records that a server takes
# Reasons why a client never sends a keyframe: the keys of `Ping.skipped`, in words
SKIP_REASONS = {
    "thinned": "the map was too far behind",
    "room": "the spool's room ran short",
    "dropped": "newer ones came first",
    "spool": "the spool was full",
    "disk": "the spool's disk was full or failed",
}
Counts = dict[Annotated[str, Meta(max_length=32)], Annotated[int, Meta(ge=0)]]  # by reason


def other_version(*, server: int, client: int) -> str:
    """Return why a server and a client of these protocol versions cannot talk; empty if they can."""
    if server == client:
        return ""
    return (
        f"the server speaks version {server} of the wire format, this client {client}: update the older one"
    )


def explained(counts: dict[str, int]) -> str:
    """Return counts by reason in words: {"thinned": 2} → 2 × thinned (the map was too far behind)."""
    named = {reason: f"{reason} ({SKIP_REASONS[reason]})" for reason in counts if reason in SKIP_REASONS}
    return counted({named.get(reason, reason): count for reason, count in counts.items()})


Seq = Annotated[int, Meta(ge=0, le=(1 << 63) - 1)]


class Stamps(Struct, frozen=True, array_like=True):
    """Times of a keyframe's stages in the server (received … meshed), monotonic nanoseconds; 0 = not yet."""

    seq: Seq
    received_ns: int = 0
    durable_ns: int = 0
    fuse_start_ns: int = 0
    fused_ns: int = 0
    meshed_ns: int = 0


class KeyframeTimes(Struct, kw_only=True):
    """Times of all stages of a keyframe, nanoseconds on the client's monotonic clock; 0 if not known.

    `clock_bound_ns`: largest error of the server's stamps (half the best round trip).
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


# A stage lasts from one stamp to the next; together they are a keyframe's way from capture to mesh.
STAGES: dict[str, tuple[str, str]] = {
    "encode": ("captured_ns", "sent_ns"),
    "wire": ("sent_ns", "received_ns"),
    "journal": ("received_ns", "durable_ns"),
    "queue": ("durable_ns", "fuse_start_ns"),
    "fuse": ("fuse_start_ns", "fused_ns"),
    "mesh": ("fused_ns", "meshed_ns"),
}
DELAY = ("captured_ns", "fused_ns")


class Hello(Struct, frozen=True, tag="hello", omit_defaults=True):
    """Message by which a client opens its session, or opens it again.

    Attributes:
        version: `PROTOCOL_VERSION` of the client.
        world, same_frame: as in the headers of its records.
    """

    session: SessionId
    version: int
    map: MapName = "default"
    world: WorldName = ""
    same_frame: bool = False


class Welcome(Struct, frozen=True, tag="welcome"):
    """Answer to a Hello: the session is open. After a new `epoch`, records above `durable` are sent again."""

    epoch: str
    version: int
    durable: Seq  # highest seq of this session on the server's disk; 0 without one
    fused: Seq  # highest seq that the map has taken or rejected; 0 without one
    window_keyframes: int  # limit for keyframes that are sent and not yet durable
    window_bytes: int
    max_frame_bytes: int


class Ack(Struct, frozen=True, tag="ack"):
    """Message on progress: records up to `durable` are on the server's disk, and may leave the spool.

    `resend`: a record is missing; send all again from durable + 1, at once.
    """

    session: SessionId
    durable: Seq
    fused: Seq
    stamps: tuple[Stamps, ...] = ()
    resend: bool = False


class Nack(Struct, frozen=True, tag="nack"):
    """Message that refuses a record (keyframe or correction) for good: it will never count.

    Attributes:
        stage: `door`: the record was not journaled; do not send it again. `map`: it is journaled, but the map
            could not take it.
    """

    session: SessionId
    seq: Seq
    stage: Literal["door", "map"]
    reason: str
    message: str


class Hold(Struct, frozen=True, tag="hold"):
    """Message that no keyframe of this session is accepted for `seconds`; then go on from durable + 1.

    `reason`: `disk` (full or failing) or `quota`; `message` explains it to a person.
    """

    session: SessionId
    seconds: float
    reason: str
    message: str


class Denied(Struct, frozen=True, tag="denied", omit_defaults=True):
    """Answer to a Hello that opens no session (yet). The client tells the user why, and asks again.

    It also answers a record whose session is not open, or whose world is not the map's.

    Attributes:
        reason: `opening` (the map is being opened), `map` (the map cannot be opened, or there is no room for
            it), `session` (it belongs to another client), `world` (the map has keyframes of another world),
            `moved` (another server has the map) or `version`.
        free_map: with `world`, the name of a map that does not exist yet.
        address, control: with `moved`, data and control address of the other server.
    """

    session: SessionId
    reason: str
    message: str
    free_map: str = ""
    address: Address = ""
    control: Address = ""


class Ping(Struct, frozen=True, tag="ping", omit_defaults=True):
    """Message of a client that shows that it lives, with its counts.

    Attributes:
        offset_ns: the client's estimate of the server's clock minus its own; None if not known yet.
        bound_ns: error bound of this estimate.
        waiting: number of keyframes in its spool.
        skipped: number of keyframes that were not spooled or left the spool unsent, by reason, since the
            client began.
        leaving: True in the client's last message.
    """

    session: Annotated[bytes, Meta(max_length=16)]
    sent_ns: int
    offset_ns: int | None = None
    bound_ns: int = 0
    waiting: Annotated[int, Meta(ge=0)] = 0
    skipped: Annotated[Counts, Meta(max_length=16)] = {}
    leaving: bool = False


class Pong(Struct, frozen=True, tag="pong"):
    """Answer to a Ping, with the server's clock and the progress of the session.

    `corrections_waiting`: as in `MapHealth`, when the map had everything up to `fused`; None if not known.
    """

    epoch: str
    ping_sent_ns: int
    received_ns: int
    sent_ns: int
    durable: Seq = 0
    fused: Seq = 0
    corrections_waiting: int | None = None


class Command(Struct, frozen=True, tag="command", kw_only=True):
    """Request to the control port, answered by one Reply. The points of an `ask` follow as frames."""

    name: Literal["ping", "health", "status", "mesh", "new_map", "forget", "ask", "move", "hand_over"]
    map: MapName = "default"  # `new_map`: the wished name, taken if it is free
    min_weight: float | None = None
    selection: Selection | None = None  # this and the next two: `forget`
    erase: bool = False  # also delete the records' bytes
    dry_run: bool = False  # only say what would be forgotten
    source: Address = ""  # `move`: the data address of the server that has the map
    source_control: Address = ""  # its control address; empty takes the next port
    hand_over: HandOver | None = None
    question: Question | None = None  # this and all below: `ask`
    number: Annotated[int, Meta(ge=0)] = 0  # comes back with the answer
    timeout_s: float = 1.0  # after it, the client no longer waits for the answer
    compress: bool = False  # compress large arrays of the answer


class Elsewhere(Struct, frozen=True):
    """Data and control address of another server, which has the map now; empty `control` = the next port."""

    address: str
    control: str = ""

    def why(self, map_name: str) -> str:
        """Return a text for people: why this server does not answer about a map that has moved."""
        return f"map {map_name} is at {self.address} now"

    def denial(self, session: bytes, map_name: str) -> Denied:
        """Return the Denied message that sends a client of this session to the other server."""
        return Denied(session, "moved", self.why(map_name), address=self.address, control=self.control)


class Reply(Struct, frozen=True, tag="reply", kw_only=True, omit_defaults=True):
    """Answer to a Command. Arrays of a mesh or of an answer follow as raw frames."""

    name: str
    error: str | None = None  # why there is no answer, for a person
    retry: bool = False  # True if the same command may succeed soon
    map: MapName | None = None  # a free name, kept for the client that asked
    health: "Health | None" = None
    status: "Status | None" = None
    mesh: "MeshLayout | None" = None
    forgotten: Forgotten | None = None
    moved: Moved | None = None
    elsewhere: Elsewhere | None = None  # the server that has the command's map, if it is another one
    parcel: Parcel | None = None  # answer to `hand_over`
    version: int = 2  # answer to a ping: `PROTOCOL_VERSION`, which servers of version 2 leave out
    number: int = 0  # number of the question
    late: bool = False  # True if the question's time was over
    answer: Answer | None = None  # arrays follow as frames


ToServer = Hello | Ping | Command
ToClient = Welcome | Denied | Hold | Ack | Nack | Pong | Reply
_TO_SERVER = msgspec.msgpack.Decoder(ToServer)
_TO_CLIENT = msgspec.msgpack.Decoder(ToClient)
encode = msgspec.msgpack.encode


def encode_sealed(message: ToServer | ToClient) -> bytes:
    """Encode a message, with a seal (CRC-32) by which the receiver detects damage."""
    return seal(encode(message))


def decode_to_server(frame: Any) -> ToServer:
    """Decode a control message to the server. Raise DecodeError for anything else."""
    return _decode(_TO_SERVER, frame)  # type: ignore[no-any-return]


def decode_to_client(frame: Any) -> ToClient:
    """Decode a control message to the client. Raise DecodeError for anything else."""
    return _decode(_TO_CLIENT, frame)  # type: ignore[no-any-return]


def _decode(decoder: Any, frame: Any) -> Any:
    if is_damaged(frame):
        raise DecodeError("a control message was damaged on its way (CRC-32 differs)")
    try:
        return decoder.decode(frame)
    except Exception as error:  # msgspec also raises UnicodeDecodeError and RecursionError
        raise DecodeError(f"not a control message: {error}") from error
