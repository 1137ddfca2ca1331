# SPDX-License-Identifier: MIT
"""Messages that select keyframes to forget, and report the keyframes that were forgotten."""

from typing import Annotated

import msgspec
import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

from tsfusion.core.number_ranges import NumberRanges
from tsfusion.wire.records.record_header import RecordNumber

_MAX_RANGES = 10_000
_EARLIEST, _LATEST = -(1 << 63), (1 << 63) - 1
_WallClock = Annotated[int, Meta(ge=_EARLIEST, le=_LATEST)]
_SessionHex = Annotated[str, Meta(pattern=r"\A[0-9a-f]{0,32}\Z")]
_Range = tuple[RecordNumber, RecordNumber]
_Metres = Annotated[float, Meta(ge=-1e300, le=1e300)]  # no NaN, which is in no box
_Bounds = tuple[_Metres, _Metres, _Metres, _Metres, _Metres, _Metres]


class Selection(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Choice of keyframes to forget: those that match every attribute.

    Attributes:
        session: first hexadecimal digits of the session's id; empty matches any.
        client: name under which the sender's key is allowed; None matches any.
        since_ns, until_ns: first and last time of journaling, on the server's wall clock, both inclusive. A
            negative time counts back from the last record of a scanner. None matches any.
        numbers: first and last of each range of numbers in the session; None matches any.
        box: x, y, z of two opposite corners, metres, in the map's frame. The sensor and nearly all measured
            points were in this box. None matches any.
    """

    session: _SessionHex = ""
    client: Annotated[str, Meta(max_length=32)] | None = None
    since_ns: _WallClock | None = None
    until_ns: _WallClock | None = None
    numbers: Annotated[tuple[_Range, ...], Meta(max_length=_MAX_RANGES)] | None = None
    box: _Bounds | None = None

    @property
    def is_empty(self) -> bool:
        """True if the selection has no condition, so it would match every keyframe."""
        return self == Selection()

    @property
    def counts_from_end(self) -> bool:
        """True if a time counts back from the last record."""
        return any(one is not None and one < 0 for one in (self.since_ns, self.until_ns))

    def at_end(self, last_ns: int) -> "Selection":
        """Return the selection with absolute times, for a journal whose last record has time `last_ns`."""
        times = {name: getattr(self, name) for name in ("since_ns", "until_ns")}
        past = {name: last_ns + one for name, one in times.items() if one is not None and one < 0}
        return msgspec.structs.replace(self, **past)

    def mask(self, seqs: NDArray[np.int64], logged_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Return an (n,) mask of keyframes, by number and time of journaling, that match these conditions."""
        found = logged_ns >= (_EARLIEST if self.since_ns is None else self.since_ns)
        found &= logged_ns <= (_LATEST if self.until_ns is None else self.until_ns)
        return found if self.numbers is None else found & NumberRanges(self.numbers).mask(seqs)


class ForgottenSession(Struct, frozen=True, kw_only=True):
    """Selected keyframes of one session, in the answer to a request to forget.

    Attributes:
        session: id of the session, hexadecimal.
        client: name under which the session's key is allowed; empty without keys.
        keyframes: number of keyframes that were not forgotten before.
        selected: all selected keyframes, first and last number of each range.
    """

    session: str
    client: str
    keyframes: int
    selected: tuple[tuple[int, int], ...]

    @property
    def numbers(self) -> NumberRanges:
        return NumberRanges(self.selected)


class Forgotten(Struct, frozen=True, kw_only=True):
    """Result of a request to forget.

    Attributes:
        sessions: sessions with selected keyframes.
        erased: number of records whose bytes were deleted from the journal, also by earlier requests.
        quarantined: number of files deleted from the quarantine.
        remains: files of the server that may still hold bytes of these keyframes.
        unavailable: sessions with keyframes in the map that the journal has lost; these stay in the map.
    """

    sessions: tuple[ForgottenSession, ...]
    erased: int = 0
    quarantined: int = 0
    remains: tuple[str, ...] = ()
    unavailable: tuple[str, ...] = ()

    @property
    def keyframes(self) -> int:
        """Number of keyframes that this request newly forgot."""
        return sum(one.keyframes for one in self.sessions)

    @property
    def selected(self) -> int:
        """Number of selected keyframes, also those forgotten before."""
        return sum(one.numbers.count for one in self.sessions)
