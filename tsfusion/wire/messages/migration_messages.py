# SPDX-License-Identifier: MIT
"""Messages between two servers when a map moves: the one that gets it asks, the other answers.

    list    the map's files; from then on none of them is deleted, and a checkpoint is written
    read    a piece of a file
    freeze  no record is taken any more; the files as they stay, and how far each session is
    commit  the map is the other server's: written down before it is answered, and answered so ever after
    cancel  the map stays, and takes records again

Who may write is decided in one place: by the giver's disk, at `commit`. Before, the map is the giver's, and
the taker's copy is worth nothing; afterwards it is the taker's, and the giver sends every client there.
"""

from typing import Annotated, Any, Literal

from msgspec import Meta, Struct

from tsfusion.wire.records.record_header import Natural, SessionId

READ_BYTES = 1 << 20  # of a piece
MOST_FILES = 100_000
FILE_NAME = r"(journal/[0-9]{6,9}\.mcap|map\.tsf|quarantine/[A-Za-z0-9][A-Za-z0-9._-]{0,120}\.mcap)"
MoveId = Annotated[bytes, Meta(min_length=16, max_length=16)]
Address = Annotated[str, Meta(max_length=256)]


class HandOver(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """A question of the server that is to have the map.

    Attributes:
        move: drawn for this move.
        file, offset: of `read`.
        address, control: of `commit`, where clients find the map from then on.
    """

    move: MoveId
    step: Literal["list", "read", "freeze", "commit", "cancel"]
    file: Annotated[str, Meta(pattern=rf"\A({FILE_NAME})?\Z")] = ""
    offset: Natural = 0
    address: Address = ""
    control: Address = ""


class MapFile(Struct, frozen=True):
    """A file of a map. One of another version is another file in its place."""

    name: Annotated[str, Meta(pattern=rf"\A{FILE_NAME}\Z")]
    nbytes: Natural
    version: str


class MovedSession(Struct, frozen=True):
    """Progress of a session: what was acknowledged must be known before the map is read."""

    key: SessionId
    client: str
    world: str | None
    durable: Natural


class Parcel(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The answer: of `read`, the piece follows as a frame.

    Attributes:
        volume: the map's settings.
        is_saved: of `list`, whether the checkpoint that the first one asked for is there.
        sessions: of `freeze`.
        crc32: of the piece.
    """

    files: Annotated[tuple[MapFile, ...], Meta(max_length=MOST_FILES)] = ()
    volume: dict[str, Any] = {}
    is_saved: bool = False
    sessions: tuple[MovedSession, ...] = ()
    crc32: int = 0


class Moved(Struct, frozen=True):
    """Outcome of a move.

    Attributes:
        frozen_s: seconds in which the map took no records.
    """

    address: str
    nbytes: int
    seconds: float
    frozen_s: float
