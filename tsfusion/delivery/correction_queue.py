# SPDX-License-Identifier: MIT
"""Corrected poses on their way to the server: kept in the spool's folder until they are on its disk.

One message is under way at a time; what is said meanwhile goes with the next. Keyframes that the server does
not have yet wait for it.
"""

import contextlib
import logging
import math
from collections import Counter
from dataclasses import replace

from tsfusion.core.errors import DecodeError, InvalidKeyframe, JournalError
from tsfusion.delivery.spool import Spool
from tsfusion.wire import corrections
from tsfusion.wire.corrections import SUFFIX, SessionCorrections

log = logging.getLogger(__name__)

NAME = f"corrections{SUFFIX}"
_INTERVAL = 0.5  # seconds between an answer and the next message
_AGAIN = (5.0, 60.0)  # seconds without an answer: first and longest, doubling; links may be slow
_HOLD = (0.05, 60.0)  # seconds, shortest and longest that a server may have us wait


class Correcting:
    """Those of one spool. Hold `outbox.changed` around every call but `save`.

    Attributes:
        wanted: whether the server takes any; None = it has not said.
        taken, acknowledged: how many calls of `add` there were, and how many of the first ones are on the
            server's disk with all they named, or what was said of it since.
        refused: messages that the server will never take, by reason.
        refusal: the first that nobody was told of, in words; empty = none.
        held: why the server does not take any for now; empty = it said nothing of that.
    """

    def __init__(self, spool: Spool) -> None:
        self.wanted: bool | None = None
        self.taken = self.acknowledged = 0
        self.refused: Counter[str] = Counter()
        self.refusal = self.held = ""
        self._spool = spool
        self._path = spool.folder / NAME
        self._pending = self._left()
        self._revision = self._pending.revision
        self._under_way: SessionCorrections | None = None
        self._covers = 0  # `taken`, as far as what is under way goes
        self._due = 0.0
        self._again = _AGAIN[0]
        self._warned = False
        spool.pinned = bool(self._pending)

    def _left(self) -> SessionCorrections:
        """What a dead scanner left."""
        none = corrections.nothing(self._spool.session, self._spool.map_name)
        if not self._path.exists():
            return none
        try:
            left = corrections.load(self._path)
        except (JournalError, DecodeError) as error:
            log.error("the corrections that an earlier scanner left are lost: %s", error)
            return none
        if (left.session, left.map) != (none.session, none.map):
            log.warning("%s is of another spool: it is left out", self._path)
            return none
        return left

    @property
    def pending(self) -> int:
        """How many keyframes are named in what the server does not have yet; 0 = it has all."""
        return max(len(self._pending), 1) if self._pending else 0

    @property
    def settled(self) -> bool:
        """Whether there is nothing to wait for."""
        return not self._pending or self.wanted is False

    def add(self, new: SessionCorrections) -> SessionCorrections:
        """Have these sent; what to `save`.

        Raises:
            InvalidKeyframe: when that makes too many.
        """
        both = replace(self._pending.merged(new), revision=self._revision + 1)
        if len(both) > corrections.MAX_KEYFRAMES:
            raise InvalidKeyframe(f"corrections of {len(both)} keyframes wait: that is too many")
        self.taken += 1
        self._pending = both
        self._spool.pinned = bool(self._pending)
        if not self._pending:
            self.acknowledged = self.taken
        self._warn()
        return self._pending

    def _warn(self) -> None:
        if self.wanted is False and self._pending and not self._warned:
            self._warned = True
            log.warning("this server is of an older version and takes no corrections: they wait for a newer")

    def save(self, content: SessionCorrections) -> None:
        """For the next scanner, should this one die. A disk that refuses is logged: they are sent anyway."""
        if self._spool.temporary or not content:
            return
        try:
            corrections.write(self._path, content)
        except JournalError as error:
            log.warning("corrections are in memory only until the server has them: %s", error)

    # --- sending ---

    def due(self, durable: int) -> float:
        """When `message` has something, `time.monotonic()`; inf = not before something happens.

        Args:
            durable: the highest number that is on the server's disk.
        """
        return self._due if self._ready(durable) else math.inf

    def _ready(self, durable: int) -> bool:
        if not self.wanted or not durable or not self._pending:
            return False
        none_waits = not self._spool.waiting
        return (
            none_waits or self._pending.T_map_odometry is not None or bool(self._pending.seqs[0] <= durable)
        )

    def message(self, durable: int, now: float) -> list[bytes]:
        """The frames that are to be sent now; [] = none."""
        if now < self.due(durable):
            return []
        if self._under_way is None:
            if not self._spool.waiting:  # the others were dropped or refused: they never will be there
                self._pending = self._pending.up_to(durable)
            part = self._pending.up_to(durable)
            if not part:
                self._forget()
                return []
            self._covers = self.taken if len(part) == len(self._pending) else self.acknowledged
            self._revision += 1
            self._under_way = replace(part, revision=self._revision)
            self._again = _AGAIN[0]
        else:
            self._again = min(2 * self._again, _AGAIN[1])
        self._due = now + self._again
        return corrections.pack(self._under_way)

    # --- hearing ---

    def welcomed(self, revision: int | None, now: float) -> None:
        """A server let us in, and says what it has of this session; None = it takes no corrections."""
        self.wanted = revision is not None
        self._warn()
        if revision is not None:
            self.told(revision, now)
            self._under_way = None  # it is lost, or will come too late
            self._due = now

    def told(self, revision: int, now: float) -> None:
        """This revision is on the server's disk."""
        self._revision = max(self._revision, revision)
        self.held = ""
        if self._under_way is None:
            return
        if revision == self._under_way.revision:
            self._done()
            self.acknowledged = max(self.acknowledged, self._covers)
        elif revision > self._under_way.revision:  # this scanner's predecessor said so much, and left no word
            self._under_way = None
        self._due = now + _INTERVAL

    def turned_away(self, revision: int, reason: str, message: str, again_s: float, now: float) -> None:
        """This revision is not taken: not now, or never (0)."""
        if self._under_way is None or revision != self._under_way.revision:
            return
        if again_s > 0:
            self._due = now + min(max(again_s, _HOLD[0]), _HOLD[1])
            self.held = f"they have to wait ({reason}): {message}"
            return
        log.error("corrections of %d keyframes are lost (%s): %s", len(self._under_way), reason, message)
        self.refused[reason] += 1
        self.refusal = self.refusal or f"corrections were refused ({reason}): {message}"
        self._done()
        self._due = now + _INTERVAL

    def _done(self) -> None:
        assert self._under_way is not None
        self._pending = self._pending.without(self._under_way)
        self._under_way = None
        if not self._pending:
            self._forget()

    def _forget(self) -> None:
        self.acknowledged = self.taken
        self._spool.pinned = False
        with contextlib.suppress(OSError):  # the next scanner says it again
            self._path.unlink(missing_ok=True)

    def take_refusal(self) -> str:
        """Why the server did not take some since this was asked last; empty = it did."""
        refusal, self.refusal = self.refusal, ""
        return refusal

    def close(self) -> None:
        """Before the spool is closed."""
        if not self._pending:
            self._forget()
        elif self._spool.temporary:
            log.error("the corrections of %d keyframes are lost: the spool was temporary", self.pending)
