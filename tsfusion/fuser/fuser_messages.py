# SPDX-License-Identifier: MIT
"""The messages between gateway and fuser (msgpack of tagged structs, over a PAIR socket).

The gateway hands out journal positions, a few ahead; the fuser answers each with `Done`. Neither holds
keyframes for the other: the queue is the journal.
"""

import mmap
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import msgspec
from msgspec import Struct

from tsfusion.core.config import CacheConfig, VolumeConfig
from tsfusion.core.errors import CheckpointError, InvalidConfig, MapError, TsfusionError
from tsfusion.journal import Position
from tsfusion.wire.messages.forget_messages import Selection
from tsfusion.wire.messages.health import MeshLayout
from tsfusion.wire.messages.mesh_updates import Meshed
from tsfusion.wire.messages.messages import Command
from tsfusion.wire.messages.questions import Answer, Question

NOT_WORKING = -1  # instead of a keyframe's index
MOVING = -2  # likewise: at a keyframe that a correction moves
EXPIRED = -1  # instead of the number of a `Find`


class Begin(Struct, frozen=True, tag="begin"):
    """Open the map in `folder` and compile the kernels, unless `ReadAhead` or `Warm` did, and work at it.

    Attributes:
        mesh_interval: seconds between two meshes, at least.
        checkpoint_every: keyframes; 0 = only on request and at the end.
        working: a file of 8 bytes: the index of the keyframe that is being fused, little-endian, or
            `NOT_WORKING` or `MOVING`. Read when the process has died, so that the right keyframe is blamed.
        keep_previous: whether to keep the checkpoint before the last, too: the journal may be cut.
        memory_bytes: that the map's blocks may take.
        quota_cost, quota_map: as in the server's settings.
        moves: whether to fuse keyframes where corrections say; False = others died of that.
        keep_seconds, keep_keyframes, keep_radius: as in the server's settings.
        cache: where blocks beyond `memory_bytes` wait; None = nowhere, the map is full then.
    """

    folder: str
    volume: VolumeConfig
    mesh_interval: float
    checkpoint_every: int
    working: str
    keep_previous: bool
    memory_bytes: int
    quota_cost: int
    quota_map: float
    moves: bool = True
    keep_seconds: float | None = None
    keep_keyframes: int | None = None
    keep_radius: float | None = None
    cache: CacheConfig | None = None


class Warm(Struct, frozen=True, tag="warm"):
    """Compile the kernels of maps with these settings; answered with `Prepared`."""

    volume: VolumeConfig


class ReadAhead(Struct, frozen=True, tag="open"):
    """Read the map of a `Begin` that comes later, when its folder may have another name; answered with
    `Prepared`."""

    begin: Begin


class SessionProgress(Struct, frozen=True, array_like=True):
    """Progress of a map with a client's session: every keyframe up to `seq` is fused or rejected.

    `world`: the session's coordinate frame, empty = that of poses given from elsewhere.
    """

    seq: int
    client: str
    world: str = ""


class Fuse(Struct, frozen=True, tag="fuse"):
    """Fuse the keyframe, or note the correction, at a journal position, unless the map has it already.

    `skip`: reject it without a try, for this reason. `more`: another one waits at the gateway.
    """

    index: int
    position: Position
    session: bytes
    seq: int
    client: str = ""
    world: str = ""
    skip: str | None = None
    is_correction: bool = False
    more: bool = False


class FuserQuery(Struct, frozen=True, tag="ask"):
    """Answer a command between two keyframes."""

    number: int
    command: Command


class FuserQuestion(Struct, frozen=True, tag="question"):
    """Answer a question to the map, before everything else; its points follow as frames.

    `asked_ns`, `deadline_ns`: monotonic, of the machine: when it came, and until when it is worth an answer.
    """

    number: int
    question: Question
    asked_ns: int
    deadline_ns: int
    compress: bool = False


class Find(Struct, frozen=True, tag="find"):
    """Find the keyframes of a selection in the journal; answered with `Found` of the same number."""

    number: int
    selection: Selection


class Expire(Struct, frozen=True, tag="expire"):
    """Let keyframes of segments below this number go, for the journal is at its limit."""

    before_segment: int


class Publish(Struct, frozen=True, tag="publish"):
    """Send the triangles with `Meshed` from now on, or do not: whether the map has viewers."""

    wanted: bool


class Save(Struct, frozen=True, tag="save"):
    """Write a checkpoint, so that the journal can be cut.

    `alone`: no older checkpoint may stay beside it: keyframes are to be erased that it still holds.
    """

    alone: bool = False


class Finish(Struct, frozen=True, tag="finish"):
    """Write a checkpoint and end."""


class Started(Struct, frozen=True, tag="started"):
    """The process runs and waits for `Begin`."""


class Prepared(Struct, frozen=True, tag="prepared"):
    """End of the preparations that `Warm` or `ReadAhead` asked for."""


class Ready(Struct, frozen=True, tag="ready"):
    """Kernels are warm. `done`: how far the map is, by session. `rejected`: keyframes, by reason."""

    done: dict[bytes, SessionProgress]
    keyframes: int = 0
    rejected: dict[str, int] = {}
    blocks: int = 0
    map_bytes: int = 0
    moves: "CorrectionProgress | None" = None


class CorrectionProgress(Struct, frozen=True, tag="corrected"):
    """Progress of the map with corrected poses.

    Attributes:
        keyframes: in the map, now.
        removed: keyframes that corrections took out of it.
        waiting: keyframes whose newest pose is not fused yet.
        unavailable: keyframes that stay where they were fused, because the journal has them no more.
        moved: keyframes that were fused at another pose, or taken out, by this process.
        seconds: of work for that.
        forgotten: of the removed, those that the server was told to forget.
        first_segment: the oldest segment of the journal with a keyframe of the map; 0 = there is none.
    """

    keyframes: int
    removed: int
    waiting: int
    unavailable: int
    moved: int
    seconds: float
    forgotten: int = 0
    first_segment: int = 0


class Saved(Struct, frozen=True, tag="saved"):
    """The checkpoint holds every keyframe that was answered with `Done` before this message.

    `written`: whether it is a new one; otherwise the one before held them all already, unless there is a
    `problem`: why no checkpoint can be written. `alone`: no older checkpoint is beside it, as `Save` wanted.
    """

    written: bool
    problem: str = ""
    alone: bool = False


class FoundKeyframes(Struct, frozen=True):
    """The keyframes of one session that a `Find` selected, in journal order.

    Attributes:
        seqs: int64 numbers; one comes twice when its record stands in the journal twice.
        segments, offsets: int64 positions of their records.
        forgotten: bool, each: whether the map was told to forget it before.
    """

    session: bytes
    client: str
    seqs: bytes
    segments: bytes
    offsets: bytes
    forgotten: bytes


class Found(Struct, frozen=True, tag="found"):
    """The answer to `Find`; `unavailable`: sessions with keyframes that the journal has no more.

    Number `EXPIRED`: nobody asked, keyframes are too old or too far away by the settings of the map.
    """

    number: int
    sessions: tuple[FoundKeyframes, ...] = ()
    unavailable: tuple[str, ...] = ()
    error: str = ""


class Held(Struct, frozen=True, tag="held"):
    """The next record cannot be read for now; it is tried again, and said again at each try."""

    message: str


FailureKind = Literal["config", "checkpoint", "map", "other"]
_FAILURES: dict[FailureKind, type[TsfusionError]] = {  # the first that fits counts
    "config": InvalidConfig,
    "checkpoint": CheckpointError,
    "map": MapError,
    "other": TsfusionError,
}


class Failed(Struct, frozen=True, tag="failed"):
    """The map cannot be opened."""

    kind: FailureKind
    message: str

    @classmethod
    def of(cls, error: TsfusionError) -> "Failed":
        """The message about an error."""
        return cls(next(kind for kind, one in _FAILURES.items() if isinstance(error, one)), str(error))

    def error(self) -> TsfusionError:
        """The error, to be raised in the gateway."""
        return _FAILURES[self.kind](self.message)


class Done(Struct, frozen=True, tag="done"):
    """A keyframe is in the map, or a correction is noted; or `reason` says why it never will be."""

    index: int
    fuse_start_ns: int
    fused_ns: int
    reason: str | None = None
    message: str = ""


class FuserStatus(Struct, frozen=True):
    """The fuser's part of a Status."""

    keyframes_fused: int
    keyframes_rejected: dict[str, int]
    blocks: int
    voxels: int
    map_bytes: int
    map_hash: str
    color_hash: str
    peak_rss_bytes: int
    versions: dict[str, str]
    config: dict[str, Any]


class FuserReply(Struct, frozen=True, tag="answer"):
    """The answer to a FuserQuery; arrays of a mesh follow as frames."""

    number: int
    error: str | None = None
    status: FuserStatus | None = None
    layout: MeshLayout | None = None


class FuserAnswer(Struct, frozen=True, tag="answered"):
    """The answer to a FuserQuestion, with its arrays as frames; or why there is none.

    `late`: its time was over.
    """

    number: int
    answer: Answer | None = None
    error: str = ""
    late: bool = False


ToFuser = (
    Warm | ReadAhead | Begin | Fuse | FuserQuery | FuserQuestion | Find | Expire | Publish | Save | Finish
)
ToGateway = (
    Started | Prepared | Ready | Failed | Done | CorrectionProgress | Saved | Found | Held | Meshed
    | FuserReply | FuserAnswer
)  # fmt: skip
to_fuser: "msgspec.msgpack.Decoder[ToFuser]" = msgspec.msgpack.Decoder(ToFuser)
to_gateway: "msgspec.msgpack.Decoder[ToGateway]" = msgspec.msgpack.Decoder(ToGateway)
encode = msgspec.msgpack.encode


class CurrentKeyframe:
    """The file that says which keyframe the process is at, also after its death."""

    def __init__(self, path: str) -> None:
        try:
            with Path(path).open("r+b") as file:
                self._word = mmap.mmap(file.fileno(), 8)
        except (OSError, ValueError) as error:  # ValueError: the file is too short
            raise MapError(f"cannot share memory with the gateway: {error}") from error

    @property
    def is_set(self) -> bool:
        return bool(struct.unpack_from("<q", self._word, 0) != (NOT_WORKING,))

    @contextmanager
    def aside(self) -> Iterator[None]:
        """Be at no keyframe for the block: what happens in it is not the keyframe's fault."""
        (index,) = struct.unpack_from("<q", self._word, 0)
        self.set(NOT_WORKING)
        yield
        self.set(index)

    def set(self, index: int) -> None:
        """Write the index of the keyframe; `messages.NOT_WORKING` = none."""
        struct.pack_into("<q", self._word, 0, index)
