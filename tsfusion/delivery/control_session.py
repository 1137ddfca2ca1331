# SPDX-License-Identifier: MIT
"""Handle the client's control messages, without the socket: greetings, pings, progress, refusals."""

import logging
import math
import time
from collections.abc import Callable

from msgspec.structs import replace

from tsfusion.core.errors import DecodeError, JournalError
from tsfusion.core.readable_numbers import count_of
from tsfusion.delivery.outbox import LinkState, Outbox
from tsfusion.delivery.outcomes import SAMPLES, ClockOffset
from tsfusion.delivery.spool import Waiting
from tsfusion.geometry.sample_ranges import NO_SAMPLES
from tsfusion.journal.quarantine import Quarantine
from tsfusion.wire.messages import messages
from tsfusion.wire.messages.messages import PROTOCOL_VERSION, Stamps

REFUSED_FOLDER = "refused"  # inside the spool; opens like any journal
REFUSED_BYTES = 64 << 20


class RefusedRecords:
    """Log and count of records that were refused or rejected, with copies in a folder of the spool.

    A temporary spool keeps no copies.
    """

    def __init__(self, outbox: Outbox) -> None:
        self._outbox = outbox
        self._warning_due = 0.0  # time.monotonic() of the next warning about rejected records
        self._unsaid = 0  # records rejected since the last warning
        self._kept = Quarantine(outbox.spool.folder / REFUSED_FOLDER, REFUSED_BYTES)

    def give_up(self, entry: Waiting, reason: str, message: str, *, readable: bool = True) -> None:
        """Remove a record from the spool for good, and keep a copy if it can be read."""
        log.error("%s %d is lost (%s): %s", entry.kind, entry.seq, reason, message)
        if readable and not self._outbox.spool.temporary:
            self._keep(entry, reason)
        self._outbox.refuse(entry, reason, message)

    def note_rejected(self, nack: messages.Nack, now: float) -> None:
        """Log that the map could not take a record: the first one of each reason at once, as an error."""
        counted = self._outbox.reject(nack.seq, nack.reason, nack.message)
        if counted is None:  # it was told twice
            return
        kind, is_first = counted
        self._unsaid += not is_first and nack.reason != NO_SAMPLES
        what = (kind, nack.seq, nack.reason, nack.message)
        if is_first:
            log.error("%s %d is not in the map (%s): %s", *what)
        elif now >= self._warning_due and nack.reason != NO_SAMPLES:
            more = f", the last of {self._unsaid} more that are not" if self._unsaid > 1 else ""
            log.warning("%s %d is not in the map (%s): %s%s", *what, more)
            self._unsaid = 0
            self._warning_due = now + _WARNING_INTERVAL

    def _keep(self, entry: Waiting, reason: str) -> None:
        try:
            frames = self._outbox.spool.read(entry)
        except (JournalError, OSError) as error:
            log.warning("%s %d could not be kept aside: %s", entry.kind, entry.seq, error)
            return
        path = self._kept.keep(frames, session=self._outbox.spool.session, seq=entry.seq, reason=reason)
        if path is not None:
            log.info("%s %d is in %s", entry.kind, entry.seq, path)


log = logging.getLogger(__name__)

_HELLO_INTERVAL = (0.02, 0.5)  # seconds: first and longest, doubling until there is an answer
_PING_INTERVAL = 0.5
_FIRST_PINGS_INTERVAL = 0.02  # until the clock estimate has all its samples
_REWIND_INTERVAL = 0.2  # every keyframe after a gap reports the gap
_LATEST = 1 << 62  # nanoseconds; no clock shows more than a century
_OTHER_WORLD_INTERVAL = 5.0  # seconds; a map's frame changes when the server begins anew
_WARNING_INTERVAL = 10.0  # seconds between two warnings of rejected records
_HOLD = (0.05, 60.0)  # seconds: no server may hold a client for less or longer at a time


class ControlSession:
    """Client's side of the control messages. For the sending thread; any thread may read `last_heard`.

    Args:
        send: sends a message, or drops it if it cannot leave at once; a dropped message is sent again when
            due.
    """

    def __init__(
        self,
        outbox: Outbox,
        refused: RefusedRecords,
        send: Callable[[bytes], None],
        *,
        address: str,
        map_name: str,
    ) -> None:
        self.welcome: messages.Welcome | None = None  # the server's terms; None before a Welcome
        self.clock = ClockOffset()
        self.last_heard = 0.0  # time of the server's last message, `time.monotonic()`; 0 = never
        self.last_progress = 0.0  # time at which a record last left the spool or was turned away
        self.last_active = 0.0  # the same, or the time of a send while nothing was on its way
        self._outbox = outbox
        self._refused = refused
        self._send = send
        self._address = address
        self._hello = messages.Hello(
            outbox.spool.session, PROTOCOL_VERSION, map_name, outbox.spool.world, outbox.spool.same_frame
        )
        self._hello_due = self._ping_due = self._rewound = self._held_until = 0.0
        self._hello_interval = _HELLO_INTERVAL[0]
        self._asked_again = False
        self._tries = False  # after a hold: one record at a time, until its outcome is known
        self._is_lost = False  # the log says that the server is gone or silent
        self._moved_to: tuple[str, str] | None = None

    @property
    def terms(self) -> messages.Welcome | None:
        """Latest Welcome, with its limits; None while no record may be sent (no Welcome, or a hold)."""
        if self.welcome is None or not self.clock.count or self._held_until:
            return None
        return replace(self.welcome, window_keyframes=1) if self._tries else self.welcome

    @property
    def held(self) -> bool:
        """True during a hold: the server takes no record for some seconds."""
        return self._held_until > 0

    @property
    def due(self) -> float:
        """Time, `time.monotonic()`, of the next message or rewind that `tick` has to do."""
        due = self._ping_due
        if self.welcome is None:
            due = min(due, self._hello_due)
        if self._held_until:
            due = min(due, self._held_until)
        if self._asked_again:
            due = min(due, self._rewound + _REWIND_INTERVAL)
        return due

    def tick(self, now: float) -> None:
        """Send the messages whose time has come (Hello, Ping), and end a hold that is over."""
        if self.welcome is None and now >= self._hello_due:
            self._hello_due = now + self._hello_interval
            self._hello_interval = min(2 * self._hello_interval, _HELLO_INTERVAL[1])
            self._send(messages.encode_sealed(self._hello))
        if now >= self._ping_due:
            self._ping(now)
        if self._held_until and now >= self._held_until:
            self._held_until = self._rewound = 0.0
            self._asked_again = self._tries = True
        if self._asked_again and now - self._rewound > _REWIND_INTERVAL:
            self.rewind()

    def _ping(self, now: float) -> None:
        is_clock_known = self.welcome is None or self.clock.count >= SAMPLES
        self._ping_due = now + (_PING_INTERVAL if is_clock_known else _FIRST_PINGS_INTERVAL)
        self._say_how_it_is()

    def take_leave(self) -> None:
        """Send a last Ping with the counts, which tells the server that this client ends."""
        self._say_how_it_is(leaving=True)

    def _say_how_it_is(self, *, leaving: bool = False) -> None:
        ping = messages.Ping(
            session=self._hello.session,
            sent_ns=time.monotonic_ns(),
            offset_ns=self.clock.offset_ns,
            bound_ns=self.clock.bound_ns,
            waiting=self._outbox.keyframes_waiting,
            skipped=self._outbox.stats().skipped,
            leaving=leaving,
        )
        self._send(messages.encode_sealed(ping))

    def greet_again(self, after: float = 0.0) -> None:
        """Send a new Hello after so many seconds; no record is sent before its Welcome."""
        self.welcome = None
        self._hello_due = time.monotonic() + after
        self._hello_interval = max(_HELLO_INTERVAL[0], after)

    def rewind(self) -> None:
        """Start to send all unacknowledged records once more, from the oldest."""
        self._outbox.rewind()
        self._asked_again = False
        self._rewound = self.last_active = time.monotonic()

    def on_connection(self, problem: str, before: str, *, refused: bool) -> None:
        """Handle a connection's new problem (empty = none), after its earlier problem `before`."""
        if refused:
            self._turned_away(LinkState("locked_out", problem))
        elif not problem:
            self._outbox.change_link_state(self._outbox.link_state.reachable(before))
        elif not self.last_heard:
            self._outbox.change_link_state(LinkState("connecting", problem))

    def on_silence(self, why: str = "") -> None:
        """Handle too long a silence of the server; `why` is the problem of the connection, if any."""
        if self._outbox.change_link_state(self._outbox.link_state.silent(why)):
            self._note_loss("is silent")

    def on_cut(self) -> None:
        """Handle a lost control connection: greet the server again on the next connection."""
        if self.welcome is not None:
            self._note_loss("is gone")
        self.greet_again()

    def _note_loss(self, how: str) -> None:
        if not self._is_lost:
            self._is_lost = True
            folder = self._outbox.spool.folder
            log.warning(
                "the server at %s %s; keyframes wait in %s until it answers", self._address, how, folder
            )

    def _note_answer(self) -> None:
        if self._is_lost and self._outbox.link_state.is_connected:
            self._is_lost = False
            waiting = count_of(self._outbox.keyframes_waiting, "keyframe waits", "keyframes wait")
            log.info("the server at %s answers again; %s for it", self._address, waiting)

    # --- messages of the server ---

    def receive(self, frames: list[bytes]) -> None:
        """Handle one message of the server, by its type."""
        returned_ns = time.monotonic_ns()
        try:
            message = messages.decode_to_client(b"".join(frames))
        except DecodeError as error:
            self._on_nonsense(error)
            return
        self.last_heard = time.monotonic()
        if isinstance(message, messages.Pong):
            self._on_pong(message, returned_ns)
        elif isinstance(message, messages.Welcome):
            self._on_welcome(message)
        elif isinstance(message, messages.Reply) or message.session != self._hello.session:
            return
        elif isinstance(message, messages.Denied):
            self._on_denied(message)
        elif isinstance(message, messages.Nack):
            self._on_nack(message)
        elif self.welcome is None:
            return  # an old message: the Welcome will tell the server's progress
        elif isinstance(message, messages.Ack):
            self._on_ack(message)
        else:
            self._on_hold(message)

    def _on_nonsense(self, error: DecodeError) -> None:
        if self.welcome is None:
            why = f"what answers at {self._address} is no tsfusion server: {error}"
            self._outbox.change_link_state(self._outbox.link_state.misunderstood(why))
        log.debug("the server sent %s", error)

    def _on_welcome(self, welcome: messages.Welcome) -> None:
        if other := messages.other_version(server=welcome.version, client=PROTOCOL_VERSION):
            self._refuse(other)
        elif not self._is_foreign(welcome.durable):
            self._outbox.change_link_state(self._outbox.link_state.welcomed())
            self.welcome = welcome
            self._ping_due = self._held_until = 0.0
            self._tries = False
            if lost := self._outbox.welcome(welcome.durable, welcome.window_keyframes):
                log.error("%s", lost)
            self._on_progress(welcome.durable, welcome.fused)
            self._outbox.note_meshed(welcome.fused)  # a new server stamps only what it fuses itself
            self.rewind()

    def _on_denied(self, denied: messages.Denied) -> None:
        if denied.reason == "opening":
            why = f"the server is opening the map {self._hello.map}"
            self._outbox.change_link_state(LinkState("opening", why))
            self.greet_again(_HELLO_INTERVAL[1])
        elif denied.reason == "moved":
            self.greet_again()
            self._moved_to = (denied.address, denied.control)
        elif denied.reason == "world":
            self._on_other_world(denied)
        else:
            self._refuse(f"the server at {self._address} refuses this client: {denied.message}")

    def take_move(self) -> tuple[str, str] | None:
        """Return the data and control address of the server that now has the map, once; else None."""
        found, self._moved_to = self._moved_to, None
        return found

    def follow(self, address: str, *, after: float) -> None:
        """Start a new session with the server at control address `address`, after so many seconds."""
        why = f"map {self._hello.map} is on another server: going on at {address}"
        self._outbox.change_link_state(LinkState("moved", why))
        log.info("%s", why)
        self._address = address
        self.clock.clear()
        self.last_heard = time.monotonic()
        self._held_until = 0.0
        self.greet_again(after)
        self.rewind()

    def refuse_move(self, why: str) -> None:
        """Stay with this server, and report why this client does not go to the other server."""
        self._refuse(f"the server at {self._address} sends this client elsewhere: {why}")

    def _on_other_world(self, denied: messages.Denied) -> None:
        """Stop sending: the map's coordinate frame differs. Records stay, and `Client.send` raises."""
        own = f"--map {denied.free_map} or --map auto" if denied.free_map else "another map"
        why = (
            f"the server at {self._address} refuses this client: {denied.message}: use {own}, or "
            "--same-frame where both share one frame (of a Client: map=, same_frame=True)"
        )
        self._outbox.change_link_state(LinkState("other_world", why))
        self.greet_again(_OTHER_WORLD_INTERVAL)

    def _refuse(self, why: str) -> None:
        self._turned_away(LinkState("refused", why))

    def _turned_away(self, state: LinkState) -> None:
        """Report why the server refuses this client. Asking goes on: a person may repair the cause."""
        self.greet_again(_HELLO_INTERVAL[1])
        if self._outbox.change_link_state(state):
            log.error("%s", state.why)

    def _on_pong(self, pong: messages.Pong, returned_ns: int) -> None:
        if self.welcome is None or pong.epoch != self.welcome.epoch:
            if self.welcome is not None:
                log.info("the server at %s is a new one", self._address)
                self.clock.clear()
                self.greet_again()
            return
        stamps = (pong.ping_sent_ns, pong.received_ns, pong.sent_ns)
        if not all(0 <= stamp < _LATEST for stamp in stamps):
            log.debug("the server's clock cannot be used: %s", pong)
            return
        if not self.clock.count:
            self._ping_due = 0.0  # tells the server the offset before the first keyframe comes
        self.clock.add(pong.ping_sent_ns, pong.received_ns, pong.sent_ns, returned_ns)
        self._outbox.change_link_state(self._outbox.link_state.answered())
        self._note_answer()
        self._on_progress(pong.durable, pong.fused)
        if pong.corrections_waiting is not None:
            self._outbox.note_moves(pong.fused, pong.corrections_waiting)

    def _on_ack(self, ack: messages.Ack) -> None:
        moved = self._on_progress(ack.durable, ack.fused, ack.stamps)
        self._asked_again = ack.resend or (self._asked_again and not moved)

    def _on_progress(self, durable: int, fused: int, stamps: tuple[Stamps, ...] = ()) -> bool:
        """Record which numbers are durable and fused. Returns True if a record left the spool."""
        if self._is_foreign(durable):
            return False
        offset_ns, bound_ns = self.clock.offset_ns or 0, self.clock.bound_ns
        moved = self._outbox.acknowledge(durable, fused, stamps, offset_ns=offset_ns, bound_ns=bound_ns)
        if moved:
            self._outbox.change_link_state(self._outbox.link_state.moved())
            self._tries = False
            self.last_active = self.last_progress = self.last_heard
        return moved

    def _is_foreign(self, durable: int) -> bool:
        """Return True if the server has a record that this client never sent: another scanner has a copy of
        the session. This client is then refused."""
        foreign = self._outbox.is_foreign(durable)
        if foreign:
            self._refuse(
                f"the server has keyframe {durable} of this session, which was never sent from here: another "
                f"scanner works with a copy of {self._outbox.spool.folder}; give each a folder of its own"
            )
        return foreign

    def _on_nack(self, nack: messages.Nack) -> None:
        self.last_active = self.last_progress = self.last_heard
        self._tries = False
        if nack.stage == "map":
            self._refused.note_rejected(nack, self.last_heard)
        elif (entry := self._outbox.find_sent(nack.seq)) is not None:
            self._refused.give_up(entry, nack.reason, nack.message)

    def _on_hold(self, hold: messages.Hold) -> None:
        shortest, longest = _HOLD
        seconds = min(max(hold.seconds, shortest), longest) if math.isfinite(hold.seconds) else longest
        self._held_until = self.last_heard + seconds
        why = f"the server at {self._address} takes nothing for now ({hold.reason}): {hold.message}"
        if self._outbox.change_link_state(self._outbox.link_state.held(why)):
            log.warning("%s", why)
