# SPDX-License-Identifier: MIT
"""The target of an attack: its addresses, and the keys that the attacker has."""

import time
from contextlib import AbstractContextManager
from typing import Literal, get_args

import msgspec
from keyframes_and_servers import connected

from tsfusion.wire.sockets import sockets
from tsfusion.wire.sockets.curve import ClientKeys

Access = Literal["open", "stranger", "allowed"]  # no keys; attackers without one; attackers with their own
ACCESS: tuple[Access, ...] = get_args(Access)


class Target(msgspec.Struct, frozen=True):
    """The server under attack, and when to stop."""

    data: str = ""
    control: str = ""
    server_key: str = ""  # its public one; empty = it asks for none
    public: str = ""  # the attacker's own key, which the server allows; empty = it has none
    secret: str = ""
    end: float = 0.0

    @property
    def keys(self) -> ClientKeys | None:
        """The attacker's own keys; None = it has none."""
        return ClientKeys(self.public, self.secret, self.server_key) if self.public else None

    @property
    def over(self) -> bool:
        return time.monotonic() >= self.end

    def data_link(self) -> AbstractContextManager[sockets.AnySocket]:
        """A socket for keyframes, connected."""
        return connected(sockets.push, self.data, self.keys)

    def control_link(self) -> AbstractContextManager[sockets.AnySocket]:
        """A socket for greetings and commands, connected."""
        return connected(sockets.dealer, self.control, self.keys)
