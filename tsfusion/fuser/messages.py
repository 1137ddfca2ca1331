# SPDX-License-Identifier: MIT
"""What gateway and fuser say to each other (msgpack of tagged structs, over a PAIR socket).

The gateway hands out journal positions, a few ahead; the fuser answers each with `Done`. Neither holds
keyframes for the other: the queue is the journal.
"""

from typing import Any

import msgspec
from msgspec import Struct

from tsfusion.core.config import VolumeConfig
from tsfusion.journal import Position
from tsfusion.wire.health import MeshLayout
from tsfusion.wire.messages import Command

NOT_WORKING = -1
WORKING_FILE = "working"  # in the folder of the socket


class Begin(Struct, frozen=True, tag="begin"):
    """Open the map in `folder` and compile the kernels.

    Attributes:
        working: a file of 8 bytes: the index of the keyframe that is being fused, little-endian, or
            `NOT_WORKING`. Read when the process has died, so that the death is put down to the right one.
        keep_previous: also keep the checkpoint before the last: the journal will not go back to the start.
        memory_bytes: what the process may allocate.
    """

    folder: str
    volume: VolumeConfig
    mesh_interval: float  # seconds
    checkpoint_every: int  # keyframes
    working: str
    keep_previous: bool
    memory_bytes: int


class SessionProgress(Struct, frozen=True, array_like=True):
    """How far the map is with a session: fused or rejected up to `seq`; `client` owns the session."""

    seq: int
    client: str


class Fuse(Struct, frozen=True, tag="fuse"):
    """Fuse the keyframe, or note the correction, at a journal position, unless the map has it already.

    `skip`: count it as rejected for this reason instead.
    """

    index: int
    position: Position
    session: bytes
    seq: int
    client: str = ""
    skip: str | None = None
    is_correction: bool = False


class FuserQuery(Struct, frozen=True, tag="ask"):
    """Answer a person's command between two keyframes."""

    number: int
    command: Command


class Publish(Struct, frozen=True, tag="publish"):
    """Whether anyone watches: send the triangles with `Meshed`, or keep them."""

    wanted: bool


class Save(Struct, frozen=True, tag="save"):
    """Write a checkpoint: the journal wants room."""


class Finish(Struct, frozen=True, tag="finish"):
    """Write a checkpoint and end."""


class Started(Struct, frozen=True, tag="started"):
    """The process is there and waits for `Begin`."""


class Ready(Struct, frozen=True, tag="ready"):
    """Kernels are warm. `done`: how far the map is, by session. `rejected`: reason → count."""

    done: dict[bytes, SessionProgress]
    keyframes: int = 0
    rejected: dict[str, int] = {}
    blocks: int = 0
    map_bytes: int = 0


class Saved(Struct, frozen=True, tag="saved"):
    """The checkpoint holds everything that was answered with `Done` before this.

    `written`: it is a new one; else the one before held all of it already.
    """

    written: bool


class Failed(Struct, frozen=True, tag="failed"):
    """The map cannot be opened. `error` is the name of a class in `tsfusion.core.errors`."""

    error: str
    message: str


class Done(Struct, frozen=True, tag="done"):
    """A keyframe is in the map or a correction is noted, or `reason` says why it never will be."""

    index: int
    fuse_start_ns: int
    fused_ns: int
    reason: str | None = None
    message: str = ""


class Meshed(Struct, frozen=True, tag="meshed"):
    """The mesh has the first `count` keyframes that this process answered; the changed part may follow.

    What keyframes changed comes as fused first, and again, with `blocks` = 0, once it is regularised.
    """

    count: int
    meshed_ns: int
    blocks: int = 0
    map_blocks: int = 0
    map_bytes: int = 0
    layout: MeshLayout | None = None


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
    """To an Ask; arrays of a mesh follow as frames."""

    number: int
    error: str | None = None
    status: FuserStatus | None = None
    layout: MeshLayout | None = None


ToFuser = Begin | Fuse | FuserQuery | Publish | Save | Finish
ToGateway = Started | Ready | Failed | Done | Saved | Meshed | FuserReply
to_fuser: "msgspec.msgpack.Decoder[ToFuser]" = msgspec.msgpack.Decoder(ToFuser)
to_gateway: "msgspec.msgpack.Decoder[ToGateway]" = msgspec.msgpack.Decoder(ToGateway)
encode = msgspec.msgpack.encode
