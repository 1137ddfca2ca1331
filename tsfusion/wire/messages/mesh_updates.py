# SPDX-License-Identifier: MIT
"""Messages to viewers of a map: the triangles that have changed, and the keyframes as they come.

A message of either kind begins with its topic, `mesh/MAP/` or `scan/MAP/`, then one of these structs as
msgpack. After `Meshed` come the cells, (n, 3) int32, and the frames of `MeshLayout`: these triangles replace
all earlier ones in these cells, which are blocks of 8³ voxels. After `Scanned` comes a JPEG, or nothing.

Each kind is numbered: who misses a number asks for what has changed since (`questions.Cells`).
"""

import msgspec
from msgspec import Struct

from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.wire.messages.health import MeshLayout
from tsfusion.wire.records.record_header import SessionId, TransformRows


class MeshUpdate(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Facts about a mesh update.

    Attributes:
        epoch: process of the server that fuses the map; a new one begins all numbers again.
        number: of this update, from 1 on; some are of no triangles, and not sent.
        stamp: of the newest keyframe in the map (`Volume.stamp`).
        sent_until: stamp up to which all changes were sent, with this update and those before; `drops`:
            `Volume.drops` then.
        refined: whether it is the surface that the map's settings ask for.
        settled: whether all cells were sent with that surface since they changed.
        first_face: (n + 1,) int32, little-endian: where the faces of each cell begin.
        client: (n,) int32: the row in `sessions` of who saw the cell last; −1 = not known.
        sessions: of scanners.
    """

    epoch: str
    number: int
    stamp: int
    sent_until: int
    drops: int
    refined: bool = False
    settled: bool = False
    first_face: bytes = b""
    client: bytes = b""
    sessions: tuple[bytes, ...] = ()


class Meshed(Struct, frozen=True, tag="meshed"):
    """Meshes have the first `count` keyframes that this process answered; viewers get the changed part.

    The changed part comes with the raw surface first, and again, with `blocks` = 0, once it is regularised.
    """

    count: int
    meshed_ns: int
    blocks: int = 0
    map_blocks: int = 0
    map_bytes: int = 0
    layout: MeshLayout | None = None
    update: MeshUpdate | None = None


class Scanned(Struct, frozen=True, tag="scanned", omit_defaults=True):
    """A scanner sent a keyframe, and the server has it. Its picture may follow, and may also come later.

    Attributes:
        session, seq: of the keyframe.
        pose: the upper three rows of `T_world_camera`, row by row, as the scanner sent it.
        epoch, number: of the server, and of this message among those of its map.
        intrinsics, shape: of its images, pixels; None = there are none.
        client: name that its key is allowed under; empty without keys.
        late: whether it was sent before, without its picture.
    """

    session: SessionId
    seq: int
    pose: TransformRows
    epoch: str
    number: int
    intrinsics: Intrinsics | None = None
    shape: tuple[int, int] | None = None
    client: str = ""
    late: bool = False


encode = msgspec.msgpack.encode
meshed_of = msgspec.msgpack.Decoder(Meshed).decode
scanned_of = msgspec.msgpack.Decoder(Scanned).decode
