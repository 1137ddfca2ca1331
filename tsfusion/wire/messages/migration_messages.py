# SPDX-License-Identifier: MIT
"""Messages between two servers when a map moves: the taker asks, the giver answers.

    list    the map's files; from now on the giver deletes none, and writes a checkpoint
    read    a piece of a file
    freeze  the giver takes no more records; the final files, and the progress of each session
    commit  the map belongs to the taker: written to the giver's disk first; always answered the same way
    cancel  the map stays, and takes records again

One disk decides who owns the map: the giver's, at `commit`. Before, the giver owns it and the taker's copy is
worth nothing. Afterwards the taker owns it, and the giver sends every client to the taker.
"""

from typing import Annotated, Any, Literal

from msgspec import Meta, Struct

from tsfusion.wire.records.record_header import Natural, SessionId

READ_BYTES = 1 << 20  # of a piece
MOST_FILES = 100_000
FILE_NAME = r"(journal/[0-9]{6,9}\.mcap|map\.tsf|quarantine/[A-Za-z0-9][A-Za-z0-9._-]{0,120}\.mcap)"
MoveId = Annotated[bytes, Meta(min_length=16, max_length=16)]
MoveStep = Literal["list", "read", "freeze", "commit", "cancel"]
Address = Annotated[str, Meta(max_length=256)]


class HandOver(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Request of the server that takes over a map, to the server that gives it.

    Attributes:
        move: 16 random bytes, the id of this move.
        file, offset: with `read`, the file and the first byte of the piece.
        address, control: with `commit`, the taker's addresses for clients.
    """

    move: MoveId
    step: MoveStep
    file: Annotated[str, Meta(pattern=rf"\A({FILE_NAME})?\Z")] = ""
    offset: Natural = 0
    address: Address = ""
    control: Address = ""


class MapFile(Struct, frozen=True):
    """File of a map that moves. A new `version` is a new file under the same name."""

    name: Annotated[str, Meta(pattern=rf"\A{FILE_NAME}\Z")]
    nbytes: Natural
    version: str


class MovedSession(Struct, frozen=True):
    """Progress of a session of a map that moves, which the taker must know before it reads the map."""

    key: SessionId
    client: str
    world: str | None
    durable: Natural


class Parcel(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Answer of the giving server. After a `read` the piece of the file follows as a frame.

    Attributes:
        volume: settings of the map.
        is_saved: with `list`, True once the checkpoint that the first `list` ordered is written.
        sessions: with `freeze`.
        crc32: CRC-32 of the piece.
    """

    files: Annotated[tuple[MapFile, ...], Meta(max_length=MOST_FILES)] = ()
    volume: dict[str, Any] = {}
    is_saved: bool = False
    sessions: tuple[MovedSession, ...] = ()
    crc32: int = 0


class Moved(Struct, frozen=True):
    """Result of a map's move to another server.

    Attributes:
        frozen_s: seconds in which the map took no records.
    """

    address: str
    nbytes: int
    seconds: float
    frozen_s: float
