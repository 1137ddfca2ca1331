# SPDX-License-Identifier: MIT
"""The clients that may connect to a running server, as its key folder says now, and the maps of each."""

import logging
import os
import time
from pathlib import Path

from msgspec import Struct

from tsfusion.core import durable_files
from tsfusion.core.errors import InvalidConfig
from tsfusion.wire.keys.key_folder import ALLOWED, Folder, read_allow_list
from tsfusion.wire.sockets.sockets import topics_of

log = logging.getLogger(__name__)

_RETRY = 1.0  # seconds


class AllowedMaps(Struct, frozen=True):
    """The maps that a key may send into, ask about and watch.

    Attributes:
        patterns: a map's name, or with `*` at its end the beginning of names; None = every map.
    """

    patterns: tuple[str, ...] | None = None

    def __contains__(self, name: str) -> bool:
        return self.patterns is None or any(
            name.startswith(one[:-1]) if one.endswith("*") else name == one for one in self.patterns
        )

    def __str__(self) -> str:
        return "every map" if self.patterns is None else ", ".join(self.patterns) or "no map"

    def denial(self, name: str) -> str:
        """Reason why a map is not to be had. It does not say whether there is such a map."""
        return f"this key may not use map {name}, but: {self}"

    def topics(self, topic: bytes) -> list[bytes]:
        """The part of a subscription that is allowed: topics that begin with this one."""
        if self.patterns is None:
            return [topic]
        found = []
        for own in (own for one in self.patterns for own in _topics_of(one)):
            if own.startswith(topic):
                found.append(own)
            elif topic.startswith(own):
                found.append(topic)
        return found


def _topics_of(pattern: str) -> list[bytes]:
    if pattern.endswith("*"):
        return [topic[:-1] for topic in topics_of(pattern[:-1])]
    return topics_of(pattern)


ALL_MAPS = AllowedMaps()


class AllowList:
    """Names and keys of the clients that may connect, as in the file now; nobody while it cannot be read."""

    def __init__(self, folder: Folder) -> None:
        self.problem = ""  # reason why the file cannot be read; empty = it can
        self._folder = Path(folder).expanduser()
        self._path = self._folder / ALLOWED
        self._seen: tuple[int, ...] | None = ()  # the file's stamp when it was read; None = there was none
        self._again = 0.0  # when a list that cannot be read is tried once more, though nothing has changed
        self._names: dict[str, str] = {}  # public key → name
        self._revoked: dict[str, str] = {}
        self._maps: dict[str, AllowedMaps] = {}  # name → what it may use
        self._forget: frozenset[str] = frozenset()  # names that may forget keyframes of others, too
        self.refresh()

    def refresh(self) -> bool:
        """Read the file again if it changed; whether a key lost its name or has other maps. Never raises."""
        seen = self._stamp()
        if seen == self._seen and not (self.problem and time.monotonic() > self._again):
            return False
        before, maps_before, limited, self._seen = self._names, self._maps, self.limits_maps, seen
        try:
            durable_files.check_private_folder(self._folder)
            listed = read_allow_list(self._folder)
        except InvalidConfig as error:
            self._fail(str(error))
        else:
            self.problem = ""
            self._names = {key: name for name, key in listed.allowed.items()}
            self._revoked = dict(listed.revoked)
            self._maps = {name: AllowedMaps(listed.maps.get(name)) for name in listed.allowed}
            self._forget = frozenset(listed.forget)
            level = logging.INFO if self._names else logging.WARNING
            counts = len(self._names), len(self._revoked)
            log.log(level, "clients that may connect: %d, keys revoked: %d", *counts)
        return limited != self.limits_maps or any(
            self._names.get(key) != name or self.maps_of(name) != maps_before[name]
            for key, name in before.items()
        )

    def name_of(self, key: str | None) -> str | None:
        """The name under which a public key is allowed; None = it is not allowed."""
        return self._names.get(key) if key is not None else None

    @property
    def limits_maps(self) -> bool:
        """True if some name may not use every map."""
        return any(maps.patterns is not None for maps in self._maps.values())

    def maps_of(self, name: str) -> AllowedMaps:
        """The maps that the client of a name may use."""
        return self._maps.get(name, AllowedMaps(()))

    def may_forget_all(self, name: str) -> bool:
        """True if the client of a name may forget keyframes of others, too, in the maps that it may use."""
        return name in self._forget

    def rejection_reason(self, key: str) -> str:
        """One word for the reason why a key is not allowed."""
        if self.problem:
            return "allow-list"
        return "revoked" if key in self._revoked else "unknown"

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all clients that are allowed."""
        return tuple(sorted(self._names.values()))

    def _stamp(self) -> tuple[int, ...] | None:
        try:
            stat = os.stat(self._path)
        except OSError:
            return None
        return stat.st_mtime_ns, stat.st_ctime_ns, stat.st_ino, stat.st_size

    def _fail(self, problem: str) -> None:
        if problem != self.problem:
            log.error("nobody is allowed to connect: %s", problem)
        self.problem = problem
        self._again = time.monotonic() + _RETRY
        self._names, self._revoked, self._maps, self._forget = {}, {}, {}, frozenset()
