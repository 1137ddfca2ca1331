# SPDX-License-Identifier: MIT
"""The maps that a client may use, by name or by how their names begin."""

from msgspec import Struct

from tsfusion.wire.sockets import topics_of


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
