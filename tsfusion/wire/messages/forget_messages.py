# SPDX-License-Identifier: MIT
"""Keyframes of a map that are to be forgotten, and those that were."""

from typing import Annotated

import msgspec
from msgspec import Meta, Struct

from tsfusion.core.number_ranges import NumberRanges
from tsfusion.wire.records.record_header import RecordNumber

_MAX_RANGES = 10_000
_WallClock = Annotated[int, Meta(ge=-(1 << 63), le=(1 << 63) - 1)]
_SessionHex = Annotated[str, Meta(pattern=r"\A[0-9a-f]{0,32}\Z")]
_Range = tuple[RecordNumber, RecordNumber]
_Bounds = tuple[float, float, float, float, float, float]


class Selection(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The keyframes for which all of this is true.

    Attributes:
        session: how the session's id begins, hexadecimal; empty = any.
        client: name that the sender's key is allowed under; None = any.
        since_ns, until_ns: when the server journaled them, by its wall clock, both inclusive; below zero, so
            long before the last record of a scanner. None = any.
        numbers: first and last of each range of numbers in their session; None = any.
        box: x, y, z of two opposite corners, metres, in the map's frame: the sensor was in it, and so is
            nearly all that it measured; None = anywhere.
    """

    session: _SessionHex = ""
    client: Annotated[str, Meta(max_length=32)] | None = None
    since_ns: _WallClock | None = None
    until_ns: _WallClock | None = None
    numbers: Annotated[tuple[_Range, ...], Meta(max_length=_MAX_RANGES)] | None = None
    box: _Bounds | None = None

    @property
    def is_empty(self) -> bool:
        """True if nothing is named, which would be every keyframe."""
        return self == Selection()

    @property
    def counts_from_end(self) -> bool:
        """True if a time is named as before the last record."""
        return any(one is not None and one < 0 for one in (self.since_ns, self.until_ns))

    def at_end(self, last_ns: int) -> "Selection":
        """The selection in a journal whose last record has this time."""
        times = {name: getattr(self, name) for name in ("since_ns", "until_ns")}
        past = {name: last_ns + one for name, one in times.items() if one is not None and one < 0}
        return msgspec.structs.replace(self, **past)

    def has(self, *, session: bytes, client: str, seq: int, logged_ns: int) -> bool:
        """True if a keyframe is selected, as far as that is known without its pose."""
        return (
            session.hex().startswith(self.session)
            and self.client in (None, client)
            and (self.since_ns is None or logged_ns >= self.since_ns)
            and (self.until_ns is None or logged_ns <= self.until_ns)
            and (self.numbers is None or any(first <= seq <= last for first, last in self.numbers))
        )


class ForgottenSession(Struct, frozen=True, kw_only=True):
    """The keyframes of one session that were selected.

    Attributes:
        session: its id, hexadecimal.
        client: name that its key is allowed under; empty = it came without keys.
        keyframes: that were not forgotten before.
        selected: all of them, first and last number of each range.
    """

    session: str
    client: str
    keyframes: int
    selected: tuple[tuple[int, int], ...]

    @property
    def numbers(self) -> NumberRanges:
        """All of the selected keyframes."""
        return NumberRanges(self.selected)


class Forgotten(Struct, frozen=True, kw_only=True):
    """Result of a request to forget.

    Attributes:
        sessions: that have keyframes of the selection.
        erased: records whose bytes were deleted from the journal, those of earlier requests included.
        quarantined: files that were deleted from the quarantine.
        remains: files of the server that may still hold something of these keyframes.
        unavailable: sessions with keyframes in the map that its journal has no more: these stay in the map.
    """

    sessions: tuple[ForgottenSession, ...]
    erased: int = 0
    quarantined: int = 0
    remains: tuple[str, ...] = ()
    unavailable: tuple[str, ...] = ()

    @property
    def keyframes(self) -> int:
        """Number of keyframes that were forgotten now."""
        return sum(one.keyframes for one in self.sessions)

    @property
    def selected(self) -> int:
        """Number of keyframes that were selected, those that were forgotten before included."""
        return sum(len(one.numbers) for one in self.sessions)
