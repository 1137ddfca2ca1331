# SPDX-License-Identifier: MIT
"""Define the messages between gateway and fuser (msgpack of tagged structs, over a PAIR socket).

The gateway sends journal positions, a few ahead; the fuser answers each with `Done`. Neither process stores
keyframes for the other: the journal is the queue.
"""

import mmap
import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from tsfusion.core.config import CacheConfig, VolumeConfig
from tsfusion.core.errors import CheckpointError, InvalidConfig, MapError, TsfusionError
from tsfusion.journal import Position
from tsfusion.wire.messages.forget_messages import Selection
from tsfusion.wire.messages.health import MeshLayout
from tsfusion.wire.messages.messages import Command
from tsfusion.wire.messages.questions import Answer

NOT_WORKING = -1  # index while no keyframe is being fused
MOVING = -2  # index while a corrected keyframe is being moved
EXPIRED = -1  # number of a `Found` that no `Find` asked for


class Begin(Struct, frozen=True, tag="begin"):
    """Order to open the map in `folder`, compile kernels (unless `ReadAhead` or `Warm` did), and start work.

    Attributes:
        mesh_interval: least seconds between two meshes.
        checkpoint_every: keyframes; 0 = only on request and at the end.
        working: a file of 8 bytes: the index of the keyframe being fused, little-endian, or `NOT_WORKING` or
            `MOVING`. The gateway reads it after the process dies, to blame the right keyframe.
        keep_previous: also keep the checkpoint before the last, because the journal may be cut.
        memory_bytes: limit for the map's blocks.
        quota_cost, quota_map: as in the server's settings.
        moves: fuse keyframes at corrected poses; False = earlier processes died of moves.
        keep_seconds, keep_keyframes, keep_radius: as in the server's settings.
        cache: where blocks beyond `memory_bytes` are stored; None = without a cache the map is then full.
        is_private: one verb uses the map: kernels are compiled at their first use, and it can be rewound.
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
    is_private: bool = False

    @property
    def keeps_window(self) -> bool:
        """True if the map forgets keyframes that are old, far away, or too many."""
        return (self.keep_seconds, self.keep_keyframes, self.keep_radius) != (None,) * 3


class Warm(Struct, frozen=True, tag="warm"):
    """Order to compile the kernels of maps with these settings; answered with `Prepared`."""

    volume: VolumeConfig


class ReadAhead(Struct, frozen=True, tag="open"):
    """Order to read the map of a later `Begin`, which may come under another folder's name (`Prepared`)."""

    begin: Begin


class SessionProgress(Struct, frozen=True, array_like=True):
    """Progress of a map with a client's session: every keyframe up to `seq` is fused or rejected.

    `world`: the session's coordinate frame, empty = that of poses given from elsewhere.
    """

    seq: int
    client: str
    world: str = ""


class Fuse(Struct, frozen=True, tag="fuse"):
    """Order to fuse the keyframe, or record the correction, at a journal position, unless the map has it.

    `skip`: reject the record untried, for this reason. `more`: another record waits at the gateway.
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


class FuserQuestion(Struct, frozen=True, tag="question"):
    """Order to answer a question before all other work, or to make the mesh or status between two keyframes.

    Points follow as frames.

    Attributes:
        command: an `ask`, `mesh` or `status`.
        asked_ns, deadline_ns: arrival and deadline of an `ask` by the machine's monotonic clock.
    """

    number: int
    command: Command
    asked_ns: int
    deadline_ns: int


class Expire(Struct, frozen=True, tag="expire"):
    """Order to remove keyframes of segments below this number, because the journal is at its limit."""

    before_segment: int


class Save(Struct, frozen=True, tag="save"):
    """Order to write a checkpoint, so that the journal can be cut; answered with `Saved`.

    `alone`: delete older checkpoints, which still hold keyframes that are to be erased.
    """

    alone: bool = False


class Finish(Struct, frozen=True, tag="finish"):
    """Order to write a checkpoint and end the process."""


class Started(Struct, frozen=True, tag="started"):
    """Report that the process runs and waits for `Begin`."""


class Prepared(Struct, frozen=True, tag="prepared"):
    """Report that what `Warm` or `ReadAhead` ordered is done."""


class Ready(Struct, frozen=True, tag="ready"):
    """Report that the map is open. `done`: progress by session. `rejected`: number of keyframes by reason."""

    done: dict[bytes, SessionProgress]
    keyframes: int = 0
    rejected: dict[str, int] = {}
    blocks: int = 0
    map_bytes: int = 0
    moves: "CorrectionProgress | None" = None


class CorrectionProgress(Struct, frozen=True, tag="corrected"):
    """Progress of the map with corrected poses.

    Attributes:
        keyframes: number in the map now.
        removed: keyframes that corrections took out of the map.
        waiting: keyframes whose newest pose is not fused yet.
        unavailable: keyframes that stay at their fused poses, because the journal no longer has them.
        moved: keyframes that this process fused at another pose or took out.
        seconds: time spent on these moves.
        forgotten: removed keyframes that the server was told to forget.
        first_segment: the oldest segment of the journal with a keyframe of the map; 0 = none.
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
    """Report that the checkpoint holds every record that was answered with `Done` before.

    `written`: this checkpoint is new; otherwise the last one was still complete, or `problem` says why none
    can be written. `alone`: no older checkpoint remains, as `Save` asked.
    """

    written: bool
    problem: str = ""
    alone: bool = False


class FoundKeyframes(Struct, frozen=True):
    """Keyframes of one session that a `Find` selected, in journal order.

    `rows`: (n, 4) int64 as bytes: number of each, segment and offset of its record, and 1 if the map was
    already told to forget it. A number occurs twice if the journal has its record twice.
    """

    session: bytes
    client: str
    rows: bytes

    @property
    def columns(self) -> NDArray[np.int64]:
        """(4, n) int64 array of `rows`, one row for each column."""
        return np.array(np.frombuffer(self.rows, np.int64).reshape(-1, 4).T)

    @property
    def positions(self) -> Iterator[Position]:
        """Positions of the keyframes' records in the journal."""
        return map(Position, *self.columns[1:3].tolist())

    @property
    def new(self) -> NDArray[np.int64]:
        """Numbers of the keyframes that the map was not yet told to forget, ascending."""
        return np.unique(self.columns[0, self.columns[3] == 0])


class Find(Struct, frozen=True, tag="find"):
    """Order to find the keyframes of a selection; answered with `Found` of the same number.

    Attributes:
        sessions: all keyframes in the journal that match the selection but for its box.
        reaches_back: True if the selection also means keyframes from before the journal's first record.
    """

    number: int
    selection: Selection
    sessions: tuple[FoundKeyframes, ...] = ()
    reaches_back: bool = True


class Found(Struct, frozen=True, tag="found"):
    """Answer to `Find`; `unavailable`: sessions with keyframes that the journal no longer has.

    With number `EXPIRED`, no `Find` asked: by the map's settings, the keyframes are too old or too far away.
    """

    number: int
    sessions: tuple[FoundKeyframes, ...] = ()
    unavailable: tuple[str, ...] = ()
    error: str = ""


class Stuck(Struct, frozen=True, tag="stuck"):
    """Report that the next record cannot be read for now; repeated at each attempt."""

    message: str


FailureKind = Literal["config", "checkpoint", "map", "other"]
_FAILURES: dict[FailureKind, type[TsfusionError]] = {  # the first that fits counts
    "config": InvalidConfig,
    "checkpoint": CheckpointError,
    "map": MapError,
    "other": TsfusionError,
}


class Failed(Struct, frozen=True, tag="failed"):
    """Report that the map cannot be opened, with the error."""

    kind: FailureKind
    message: str

    @classmethod
    def of(cls, error: TsfusionError) -> "Failed":
        """Return the message that reports this error."""
        return cls(next(kind for kind, one in _FAILURES.items() if isinstance(error, one)), str(error))

    def error(self) -> TsfusionError:
        """Return the error for the gateway to raise."""
        return _FAILURES[self.kind](self.message)


class Done(Struct, frozen=True, tag="done"):
    """Report that a record is fused, recorded or left out as forgotten; or rejected, for `reason`."""

    index: int
    fuse_start_ns: int
    fused_ns: int
    reason: str | None = None
    message: str = ""


class Meshed(Struct, frozen=True, tag="meshed"):
    """The first `count` keyframes that this process answered are noted for viewers, who may get them."""

    count: int
    meshed_ns: int
    map_blocks: int = 0
    map_bytes: int = 0


class FuserAnswer(Struct, frozen=True, tag="answered"):
    """Answer to a FuserQuestion, with its arrays or its mesh as frames; or an error.

    Attributes:
        figures: the fuser's part of a `health.Status`, by field; of `config` the volume's settings.
        late: True if the answer took too long.
    """

    number: int
    answer: Answer | None = None
    mesh: MeshLayout | None = None
    figures: dict[str, Any] | None = None
    error: str = ""
    late: bool = False


ToFuser = Warm | ReadAhead | Begin | Fuse | FuserQuestion | Find | Expire | Save | Finish
ToGateway = (
    Started | Prepared | Ready | Failed | Done | CorrectionProgress | Saved | Found | Stuck | Meshed
    | FuserAnswer
)  # fmt: skip
to_fuser: "msgspec.msgpack.Decoder[ToFuser]" = msgspec.msgpack.Decoder(ToFuser)
to_gateway: "msgspec.msgpack.Decoder[ToGateway]" = msgspec.msgpack.Decoder(ToGateway)
encode = msgspec.msgpack.encode


class CurrentKeyframe:
    """File with the index of the keyframe being fused; the gateway can read it after the process dies."""

    def __init__(self, path: str) -> None:
        try:
            with Path(path).open("r+b") as file:
                self._word = mmap.mmap(file.fileno(), 8)
        except (OSError, ValueError) as error:  # ValueError: the file is too short
            raise MapError(f"cannot share a file with the gateway: {error}") from error

    @property
    def is_set(self) -> bool:
        return bool(struct.unpack_from("<q", self._word, 0) != (NOT_WORKING,))

    @contextmanager
    def aside(self) -> Iterator[None]:
        """Write `NOT_WORKING` during the `with` block: no keyframe is blamed for a crash in it."""
        (index,) = struct.unpack_from("<q", self._word, 0)
        self.set(NOT_WORKING)
        yield
        self.set(index)

    def set(self, index: int) -> None:
        """Write the index of the keyframe to the file; `NOT_WORKING` = none."""
        struct.pack_into("<q", self._word, 0, index)
