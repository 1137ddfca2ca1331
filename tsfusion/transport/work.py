# SPDX-License-Identifier: MIT
"""What gateway and fuser say to each other (msgpack of tagged structs, over a PAIR socket).

The gateway hands out journal positions, a few ahead; the fuser answers each with `Done`. Neither holds
keyframes for the other: the queue is the journal.
"""

from typing import Any

import msgspec
from msgspec import Struct

from tsfusion.config import VolumeConfig
from tsfusion.journal import Position
from tsfusion.transport.messages import Command, MeshLayout


class Begin(Struct, frozen=True, tag="begin"):
    """Open the map in `state` and compile the kernels."""

    state: str
    volume: VolumeConfig
    mesh_interval: float  # seconds
    checkpoint_every: int  # keyframes


class Fuse(Struct, frozen=True, tag="fuse"):
    """Fuse the keyframe at a journal position. `skip`: count it as rejected for this reason instead."""

    index: int
    position: Position
    skip: str | None = None


class Ask(Struct, frozen=True, tag="ask"):
    """Answer a person's command between two keyframes."""

    number: int
    command: Command


class Publish(Struct, frozen=True, tag="publish"):
    """Whether anyone watches: send the triangles with `Meshed`, or keep them."""

    wanted: bool


class Finish(Struct, frozen=True, tag="finish"):
    """Write a checkpoint and end."""


class Started(Struct, frozen=True, tag="started"):
    """The process is there and waits for `Begin`."""


class Ready(Struct, frozen=True, tag="ready"):
    """Kernels are warm; the map holds the journal up to and with `position`; (0, 0) = nothing."""

    position: Position


class Failed(Struct, frozen=True, tag="failed"):
    """The map cannot be opened. `error` is the name of a class in `tsfusion.errors`."""

    error: str
    message: str


class Done(Struct, frozen=True, tag="done"):
    """A keyframe is in the map, or `reason` says why it never will be."""

    index: int
    fuse_start_ns: int
    fused_ns: int
    reason: str | None = None
    message: str = ""


class Meshed(Struct, frozen=True, tag="meshed"):
    """The mesh has every keyframe up to and with `index`; the changed part may follow as frames.

    What keyframes changed comes as fused first, and again, with `blocks` = 0, once it is regularised.
    """

    index: int
    meshed_ns: int
    blocks: int = 0
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


class Answer(Struct, frozen=True, tag="answer"):
    """To an Ask; arrays of a mesh follow as frames."""

    number: int
    error: str | None = None
    status: FuserStatus | None = None
    layout: MeshLayout | None = None


ToFuser = Begin | Fuse | Ask | Publish | Finish
ToGateway = Started | Ready | Failed | Done | Meshed | Answer
to_fuser: "msgspec.msgpack.Decoder[ToFuser]" = msgspec.msgpack.Decoder(ToFuser)
to_gateway: "msgspec.msgpack.Decoder[ToGateway]" = msgspec.msgpack.Decoder(ToGateway)
encode = msgspec.msgpack.encode
