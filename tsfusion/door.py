# SPDX-License-Identifier: MIT
"""Who may come in: keys and the allow-list, checked when a connection is made and again at every message."""

import logging
from collections import Counter
from pathlib import Path
from typing import Any

import zmq

from tsfusion.errors import InvalidConfig
from tsfusion.keys import AllowList
from tsfusion.transport.curve import ServerKeys, server_keys
from tsfusion.transport.zap import Zap, sender_of

log = logging.getLogger(__name__)


class Door:
    """The allow-list of one server; without a folder of keys everybody who can reach it may come in.

    Args:
        folder: made by `tsfusion keys`; None = no keys.

    Attributes:
        keys: the server's own pair, for its sockets.
        poll: the sockets that `step` wants to be called for.

    Raises:
        InvalidConfig: when the folder has no usable keys or allow-list.
    """

    def __init__(self, context: "zmq.Context[Any]", folder: str | None) -> None:
        self.keys: ServerKeys | None = None
        self._allowed: AllowList | None = None
        self._zap: Zap | None = None
        self._revoked = False
        if folder is not None:
            self.keys = server_keys(folder)
            self._allowed = AllowList(Path(folder))
            if self._allowed.problem:  # who starts a server is there to mend it; later, nobody is let in
                raise InvalidConfig(self._allowed.problem)
            self._zap = Zap(context, self._allowed.name_of, self._allowed.why_not)
        self.poll = [] if self._zap is None else [self._zap.socket]

    @property
    def problem(self) -> str:
        """Why nobody at all is let in; empty = the allow-list can be read."""
        return "" if self._allowed is None else self._allowed.problem

    @property
    def refused(self) -> Counter[str]:
        """Connections that were turned away, by reason."""
        return Counter() if self._zap is None else self._zap.refused

    def step(self) -> bool:
        """Answer who knocks. True when somebody no longer may: all connections have to be made anew."""
        if self._allowed is None or self._zap is None:
            return False
        self._revoked |= self._allowed.refresh()
        self._zap.answer_all()
        revoked, self._revoked = self._revoked, False
        return revoked

    def client_of(self, frame: zmq.Frame) -> str | None:
        """The name its sender's key is allowed under: empty without keys, None when it is (no longer)."""
        if self._allowed is None:
            return ""
        self._revoked |= self._allowed.refresh()  # it may have been since the last step
        key = sender_of(frame)
        return None if key is None else self._allowed.name_of(key)

    def close(self) -> None:
        """Nobody is answered any more."""
        if self._zap is not None:
            self._zap.close()
