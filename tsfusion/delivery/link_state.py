# SPDX-License-Identifier: MIT
"""State of the link between client and server: every state, and every way from one to another.

    connecting   nobody has answered yet, or a server has let us in and its first answer is awaited
    connected    the server answers, and takes what is sent
    held         the server answers, but wants nothing for now: its disk is full, or the quota is used up
    opening      the server answers, but the map is not open yet
    refused      the server does not want this client: another version, another's session, no such map
    moved        another server has the map, and the client goes there
    other_world  the map has keyframes of another session, in another coordinate frame
    locked_out   the server does not know the client's key, or asks for one
    silent       the server answered once, and has not been heard for too long

A client begins as `connecting`. A Welcome leads back there from anywhere but `connected` and `held`: the
server has let us in, and the next Pong means `connected`. From there a Hold leads to `held`, and progress
back again. A Denied leads to `opening`, `moved`, `refused` or `other_world`, a refused handshake to
`locked_out`, and they stay until a Welcome, another Denied or, with `locked_out`, until the handshake
succeeds. Silence leads to `silent` from `connected`, `held`, `opening` and `moved`; the others say already
why nothing moves.

Nobody gives up in any state: the client asks again for ever, because a person may put it right at the other
end. States are values without behaviour: `ControlSession` sees the events and replaces the present state by
the next.
"""

from typing import Literal

from msgspec import Struct

LinkKind = Literal[
    "connecting", "connected", "held", "opening", "moved", "refused", "other_world", "locked_out", "silent"
]


class LinkState(Struct, frozen=True):
    """One state of the link; each method gives the next one after an event."""

    kind: LinkKind = "connecting"
    why: str = ""  # for a person, why nothing is taken; empty = nothing is known against it

    @property
    def is_connected(self) -> bool:
        """True if the server answers and has let this client in."""
        return self.kind in ("connected", "held")

    @property
    def is_refused(self) -> bool:
        return self.kind in ("refused", "other_world", "locked_out")

    # --- the transport ---

    def unreachable(self, why: str) -> "LinkState":
        """The state when no connection can be made: no server ever answered, or no socket opens."""
        return LinkState("connecting", why)

    def reachable(self, problem: str) -> "LinkState":
        """The state when a connection stands again that had this problem."""
        return LinkState() if self.why == problem else self

    def locked_out(self, why: str) -> "LinkState":
        """The state after a refused handshake."""
        return LinkState("locked_out", why)

    def silent(self, why: str = "") -> "LinkState":
        """The state when no message of the server came for too long; empty = the connection stands."""
        is_so = self.is_connected or self.kind in ("opening", "moved", "silent")
        return LinkState("silent", why) if is_so else self

    # --- the server's messages ---

    def misunderstood(self, why: str) -> "LinkState":
        """The state when something answers that is no server of ours."""
        return self if self.why else LinkState(self.kind, why)

    def opening(self, why: str) -> "LinkState":
        """The state after a Denied, because the map is not open yet."""
        return LinkState("opening", why)

    def away(self, why: str) -> "LinkState":
        """The state after a Denied, because another server has the map."""
        return LinkState("moved", why)

    def refused(self, why: str) -> "LinkState":
        """The state when server and client cannot work together, by a Denied or by what a Welcome says."""
        return LinkState("refused", why)

    def other_world(self, why: str) -> "LinkState":
        """The state when the map's coordinate frame is not that of this client's poses."""
        return LinkState("other_world", why)

    def welcomed(self) -> "LinkState":
        """The state after a Welcome."""
        return LinkState("connected" if self.is_connected else "connecting")

    def answered(self) -> "LinkState":
        """The state after a Pong of the server that let this client in."""
        return LinkState("connected") if self.kind in ("connecting", "silent") else self

    def held(self, why: str) -> "LinkState":
        """The state after a Hold."""
        return self if self.is_refused else LinkState("held", why)

    def moved(self) -> "LinkState":
        """The state after the server has taken a record."""
        return LinkState("connected") if self.kind == "held" else self
