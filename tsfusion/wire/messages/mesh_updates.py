# SPDX-License-Identifier: MIT
"""Messages to viewers of a map: changed triangles, and keyframes as they come.

Each message begins with its topic, `mesh/MAP/` or `scan/MAP/`. One of these structs follows, as msgpack.
After `Meshed` come the cells, (n, 3) int32 block coordinates, and the frames of `MeshLayout`. These triangles
replace all earlier ones of these cells. After `Scanned` comes a JPEG, or nothing.

Each kind is numbered: a viewer that misses a number asks for the changes since (`questions.Cells`).
"""

import msgspec
from msgspec import Struct

from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.wire.messages.health import MeshLayout
from tsfusion.wire.records.record_header import SessionId, TransformRows


class MeshUpdate(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Description of a mesh update.

    Attributes:
        epoch: process of the server that fuses the map; a new process starts all numbers again.
        number: number of this update, from 1; updates without triangles count, but are not sent.
        version: version of the newest keyframe in the map (`Volume.version`).
        sent_until: version up to which all changes are sent, by this update and those before.
        drops: `Volume.drops` at that version.
        refined: True if the surface is the one that the map's settings ask for.
        settled: True if all changed cells have been sent with that surface.
        first_face: (n + 1,) int32, little-endian: index of each cell's first face.
        client: (n,) int32: row in `sessions` of the session that saw the cell last, or −1 if not known.
        sessions: sessions of scanners.
    """

    epoch: str
    number: int
    version: int
    sent_until: int
    drops: int
    refined: bool = False
    settled: bool = False
    first_face: bytes = b""
    client: bytes = b""
    sessions: tuple[bytes, ...] = ()


class Meshed(Struct, frozen=True, tag="meshed"):
    """The first `count` keyframes that this process answered are in the mesh. The changed cells follow.

    Changed cells come with the raw surface first. They come again, with `blocks` = 0, once they are smoothed.
    """

    count: int
    meshed_ns: int
    blocks: int = 0
    map_blocks: int = 0
    map_bytes: int = 0
    layout: MeshLayout | None = None
    update: MeshUpdate | None = None


class Scanned(Struct, frozen=True, tag="scanned", omit_defaults=True):
    """A scanner sent a keyframe, and the server has it. Its picture follows now, later, or never.

    Attributes:
        session, seq: session and number of the keyframe.
        pose: upper three rows of `T_world_camera`, row by row, as the scanner sent it.
        epoch, number: epoch of the server, and number of this message among those of its map.
        intrinsics, shape: of the keyframe's images, in pixels; None without images.
        client: name under which the scanner's key is allowed; empty without keys.
        late: True if the message was sent before, without its picture.
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
