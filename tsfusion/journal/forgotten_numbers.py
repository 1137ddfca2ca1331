# SPDX-License-Identifier: MIT
"""The keyframes that a journal's records forget, for whoever reads the journal without a map."""

from contextlib import suppress

from tsfusion.core.config import SERVER_SESSION
from tsfusion.core.errors import DecodeError
from tsfusion.core.number_ranges import NumberRanges
from tsfusion.journal.mcap_layout import Record
from tsfusion.wire import codec
from tsfusion.wire.corrections import Correction


class ForgottenNumbers:
    """A set of (session, number) that grows with each record that forgets keyframes."""

    def __init__(self) -> None:
        self._sessions: dict[bytes, NumberRanges] = {}

    def __contains__(self, keyframe: tuple[bytes, int]) -> bool:
        session, seq = keyframe
        return session in self._sessions and seq in self._sessions[session]

    def note(self, record: Record) -> None:
        """Take in a record; any but those that forget keyframes, and a damaged one, are passed over."""
        if record.session != SERVER_SESSION or not record.is_correction:
            return
        with suppress(DecodeError):  # `verify` tells of it
            found = codec.decode(record.frames)
            if isinstance(found, Correction) and found.target is not None:
                self._sessions.setdefault(found.target, NumberRanges()).add(found.removed)

    def of(self, session: bytes) -> NumberRanges:
        """The numbers of one session."""
        return self._sessions.get(session, NumberRanges())
