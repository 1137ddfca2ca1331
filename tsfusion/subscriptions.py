# SPDX-License-Identifier: MIT
"""What viewers subscribed to, so that a fuser is told when nobody watches."""

from collections.abc import Iterable

from tsfusion.transport import sockets

_MAX_TOPICS = 256  # of maps that are not open


class Subscriptions:
    """Topics that somebody subscribed to, as far as they can be a map's."""

    def __init__(self) -> None:
        self._topics: set[bytes] = set()

    def __len__(self) -> int:
        return len(self._topics)

    def add(self, topic: bytes, maps: Iterable[str]) -> bool:
        """Somebody subscribed; False when that leads to nothing. The topics of open maps always have room.

        Args:
            maps: those that are open.
        """
        wanted = any(sockets.mesh_topic(name).startswith(topic) for name in maps)
        if not wanted and (len(self._topics) >= _MAX_TOPICS or not sockets.is_mesh_topic(topic)):
            return False
        self._topics.add(topic)
        return True

    def discard(self, topic: bytes) -> None:
        """Nobody does any more."""
        self._topics.discard(topic)

    def clear(self) -> None:
        """All connections are gone."""
        self._topics.clear()

    def watched(self, map_name: str) -> bool:
        """Whether anybody gets a map's updates."""
        topic = sockets.mesh_topic(map_name)
        return any(topic.startswith(wanted) for wanted in self._topics)
