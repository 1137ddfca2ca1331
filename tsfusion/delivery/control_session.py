# SPDX-License-Identifier: MIT
"""What the client says and hears on the control socket: greetings, pings, progress, refusals. No sockets."""

import logging
import math
import time
from collections.abc import Callable
from typing import Literal, TypeAlias

from tsfusion.core.errors import DecodeError
from tsfusion.delivery.outbox import Outbox
from tsfusion.delivery.refused_keyframes import RefusedFolder
from tsfusion.delivery.timing import SAMPLES, ClockOffset
from tsfusion.wire import messages
from tsfusion.wire.messages import PROTOCOL_VERSION

log = logging.getLogger(__name__)

_HELLO_INTERVAL = (0.02, 0.5)  # seconds: first and longest, doubling until there is an answer
_PING_INTERVAL = 0.5
_FIRST_PINGS_INTERVAL = 0.02  # until the clock estimate stands on all its samples
_REWIND_INTERVAL = 0.2  # one gap is reported by every keyframe behind it
_LATEST = 1 << 62  # nanoseconds; no clock shows more than a century
_HOLD = (0.05, 60.0)  # seconds: no server may hold a client for less or longer at a time
_News: TypeAlias = messages.Ack | messages.Nack | messages.Hold | messages.Denied


class ControlSession:
    """One client's side. For the sending thread only; `heard` may be read by any.

    Args:
        say: sends the frames of a message, or drops them when they cannot leave at once: what they say is
            said again when due.
        address: of the control socket, for messages to people.

    Attributes:
        welcome: the server's terms; None = it has not let us in (yet).
        clock: the server's against ours.
        heard: when it last said something, `time.monotonic()`; 0 = never.
        moved: when something last left the spool, or was sent while nothing was on its way.
    """

    def __init__(
        self,
        outbox: Outbox,
        refused: RefusedFolder,
        say: Callable[..., None],
        *,
        address: str,
        map_name: str,
    ) -> None:
        self.welcome: messages.Welcome | None = None
        self.clock = ClockOffset()
        self.heard = self.moved = 0.0
        self._outbox = outbox
        self._refused = refused
        self._say = say
        self._address = address
        self._hello = messages.Hello(outbox.spool.session, PROTOCOL_VERSION, map_name)
        self._hello_due = self._ping_due = self._rewound = self._held_until = 0.0
        self._hello_interval = _HELLO_INTERVAL[0]
        self._asked_again = False

    @property
    def terms(self) -> messages.Welcome | None:
        """The server's terms while keyframes may be sent: it let us in, and its answers fit our clock."""
        return self.welcome if self.clock.count and not self._held_until else None

    @property
    def held(self) -> bool:
        """Whether the server wants nothing for now."""
        return self._held_until > 0

    @property
    def due(self) -> float:
        """When `tick` has something to do next."""
        due = self._ping_due
        if self.welcome is None:
            due = min(due, self._hello_due)
        if self._held_until:
            due = min(due, self._held_until)
        if self._asked_again:
            due = min(due, self._rewound + _REWIND_INTERVAL)
        return due

    def tick(self, now: float) -> None:
        """Say what is due."""
        if self.welcome is None and now >= self._hello_due:
            self._hello_due = now + self._hello_interval
            self._hello_interval = min(2 * self._hello_interval, _HELLO_INTERVAL[1])
            self._say(messages.encode(self._hello))
        if now >= self._ping_due:
            self._ping(now)
        if self._held_until and now >= self._held_until:
            self._held_until = self._rewound = 0.0
            self._asked_again = True
        if self._asked_again and now - self._rewound > _REWIND_INTERVAL:
            with self._outbox.changed:
                self.rewind()

    def _ping(self, now: float) -> None:
        settled = self.welcome is None or self.clock.count >= SAMPLES
        self._ping_due = now + (_PING_INTERVAL if settled else _FIRST_PINGS_INTERVAL)
        with self._outbox.changed:
            waiting, skipped = len(self._outbox.spool.waiting), dict(self._outbox.skipped)
        ping = messages.Ping(
            session=self._hello.session,
            sent_ns=time.monotonic_ns(),
            offset_ns=self.clock.offset_ns,
            bound_ns=self.clock.bound_ns,
            waiting=waiting,
            skipped=skipped,
        )
        self._say(messages.encode(ping))

    def greet_again(self, after: float = 0.0) -> None:
        """Ask to be let in (once more), first after so many seconds."""
        self.welcome = None
        self._hello_due = time.monotonic() + after
        self._hello_interval = max(_HELLO_INTERVAL[0], after)

    def rewind(self) -> None:
        """Send everything that is not acknowledged once more."""
        self._outbox.outstanding = 0
        self._asked_again = False
        self._rewound = self.moved = time.monotonic()

    def on_connection(self, problem: str, before: str, *, refused: bool) -> None:
        """A connection cannot be made, or is (empty), after there was another problem with it.

        Who talked to us before is rather slow or gone than somebody else: `heard` says more then.
        """
        with self._outbox.changed:
            if refused:
                self._turned_away(problem, "keys")
            elif (problem and not self.heard) or (not problem and self._outbox.problem == before):
                self._outbox.problem, self._outbox.turned_away = problem, ""

    # --- hearing ---

    def hear(self, frames: list[bytes]) -> None:
        """Deal with what the server said."""
        returned_ns = time.monotonic_ns()
        try:
            message = messages.decode_to_client(b"".join(frames))
        except DecodeError as error:
            self._on_nonsense(error)
            return
        self.heard = time.monotonic()
        if isinstance(message, messages.Pong):
            with self._outbox.changed:
                self._on_pong(message, returned_ns)
        elif isinstance(message, messages.Welcome):
            with self._outbox.changed:
                self._on_welcome(message)
        elif not isinstance(message, messages.Reply) and message.session == self._hello.session:
            self._on_news(message)

    def _on_nonsense(self, error: DecodeError) -> None:
        if self.welcome is None and not self._outbox.problem:
            with self._outbox.changed:
                self._outbox.problem = f"what answers at {self._address} is no tsfusion server: {error}"
        log.debug("the server sent %s", error)

    def _on_news(self, message: _News) -> None:
        if isinstance(message, messages.Denied):
            self._on_denied(message)
        elif isinstance(message, messages.Nack):
            self._on_nack(message)
        elif self.welcome is not None:  # else it is from before: the Welcome will say where the server stands
            with self._outbox.changed:
                if isinstance(message, messages.Ack):
                    self._on_ack(message)
                else:
                    self._on_hold(message)

    def _on_welcome(self, welcome: messages.Welcome) -> None:
        if welcome.version != PROTOCOL_VERSION:
            self._turned_away(
                f"the server speaks version {welcome.version} of the wire format, "
                f"this client {PROTOCOL_VERSION}"
            )
        elif not self._is_foreign(welcome.durable):
            self._outbox.problem, self._outbox.opening, self._outbox.turned_away = "", False, ""
            self.welcome = welcome
            self._ping_due = self._held_until = 0.0
            self._outbox.welcomed(welcome.durable, welcome.window_keyframes)
            self._on_progress(welcome.durable, welcome.fused)
            self._outbox.meshed(welcome.fused)  # a new server stamps only what it fuses from here on
            self.rewind()

    def _on_denied(self, denied: messages.Denied) -> None:
        with self._outbox.changed:
            self._outbox.opening = denied.reason == "opening"
            if self._outbox.opening:
                self._outbox.problem = self._outbox.turned_away = ""
                self.greet_again(_HELLO_INTERVAL[1])
            else:
                self._turned_away(f"the server at {self._address} refuses this client: {denied.message}")

    def _turned_away(self, problem: str, by: Literal["server", "keys"] = "server") -> None:
        """Keep asking: a person may put it right at the other end."""
        self.greet_again(_HELLO_INTERVAL[1])
        self._outbox.connected, self._outbox.turned_away = False, by
        if problem != self._outbox.problem:
            self._outbox.problem = problem
            self._outbox.changed.notify_all()
            log.error("%s", problem)

    def _on_pong(self, pong: messages.Pong, returned_ns: int) -> None:
        if self.welcome is None or pong.epoch != self.welcome.epoch:
            if self.welcome is not None:
                log.info("the server at %s is a new one", self._address)
                self.clock.clear()
                self.greet_again()
            return
        stamps = (pong.ping_sent_ns, pong.received_ns, pong.sent_ns)
        if not all(0 <= stamp < _LATEST for stamp in stamps):
            log.debug("the server's clock is none: %s", pong)
            return
        self._outbox.connected = True
        if not self.clock.count:
            self._ping_due = 0.0  # tells the server the offset before the first keyframe comes
        self.clock.add(pong.ping_sent_ns, pong.received_ns, pong.sent_ns, returned_ns)
        self._on_progress(pong.durable, pong.fused)

    def _on_ack(self, ack: messages.Ack) -> None:
        moved = self._on_progress(ack.durable, ack.fused)
        for stamps in ack.stamps:
            self._outbox.stamp(stamps, self.clock.offset_ns or 0, self.clock.bound_ns)
        self._asked_again = ack.resend or (self._asked_again and not moved)

    def _on_progress(self, durable: int, fused: int) -> bool:
        if self._is_foreign(durable) or not self._outbox.progress(durable, fused):
            return False
        self._outbox.problem = ""
        self.moved = self.heard
        return True

    def _is_foreign(self, durable: int) -> bool:
        """Whether somebody else sends under our session; then nothing it says of its keyframes is of ours."""
        foreign = self._outbox.foreign(durable)
        if foreign:
            self._turned_away(
                f"the server has keyframe {durable} of this session, which was never sent from here: another "
                f"scanner works with a copy of {self._outbox.spool.folder}; give each a folder of its own"
            )
        return foreign

    def _on_nack(self, nack: messages.Nack) -> None:
        self.moved = self.heard
        with self._outbox.changed:
            if nack.stage == "map":
                kind = self._outbox.kind(nack.seq)
                log.error("%s %d is not in the map (%s): %s", kind, nack.seq, nack.reason, nack.message)
                self._outbox.reject(nack.seq, nack.reason)
                return
            entry = self._outbox.find(nack.seq)
        if entry is not None:
            self._refused.give_up(entry, nack.reason, nack.message)

    def _on_hold(self, hold: messages.Hold) -> None:
        shortest, longest = _HOLD
        seconds = min(max(hold.seconds, shortest), longest) if math.isfinite(hold.seconds) else longest
        self._held_until = self.heard + seconds
        problem = f"the server at {self._address} takes nothing for now ({hold.reason}): {hold.message}"
        if problem != self._outbox.problem:
            self._outbox.problem = problem
            log.warning("%s", problem)
