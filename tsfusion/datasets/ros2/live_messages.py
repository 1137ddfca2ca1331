# SPDX-License-Identifier: MIT
"""Receive the messages of a running ROS 2 system, with a recording's face for the choice of topics."""

import logging
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator, Sequence
from typing import Any, NamedTuple

from tsfusion.core.errors import InvalidConfig, MissingDependency, SourceError
from tsfusion.datasets.ros2.middleware import (
    INSTALL,
    TRANSPORTS,
    CdrMessage,
    Deliver,
    LiveTopic,
    Middleware,
    Transport,
    domain_id,
    message_types,
)
from tsfusion.datasets.rosbag.reader import Message, MessageLocation, Stream, stamp_ns

log = logging.getLogger(__name__)

_MOST_BYTES = 32 << 20  # of messages that wait to be taken; the oldest go first
_SMALL = 1 << 16  # bytes of a message that is no image and no cloud; the only one of /tf_static among them
_OWN = "/tsfusion/"  # topics of `tsfusion ros2 publish`, which no sensor made
_SHOWN = 30  # topics in a message to people


def open_middlewares(
    deliver: Deliver, *, transport: str | None = None, domain: int | None = None, router: str | None = None
) -> list[Middleware]:
    """Open a transport, or those whose library is installed.

    Args:
        router: endpoint of Zenoh's router; default as rmw_zenoh, tcp/localhost:7447.

    Raises:
        MissingDependency: the library of the named transport is not installed, or of none.
        InvalidConfig: there is no such transport or domain.
        SourceError: the library cannot begin, as with a malformed CYCLONEDDS_URI.
    """
    if transport not in (None, *TRANSPORTS):
        raise InvalidConfig(f"transport of ROS 2 must be {' or '.join(TRANSPORTS)}, got {transport!r}")
    message_types()
    number, opened, missing = domain_id(domain), [], []
    wanted: Sequence[str] = TRANSPORTS if transport is None else (transport,)
    try:
        for name in wanted:
            try:
                opened.append(_opener(name)(deliver, number, router))
            except ImportError as error:
                missing.append(f"{name} ({error})")
    except SourceError:
        for one in opened:
            one.close()
        raise
    if not opened:
        raise MissingDependency(f"ROS 2 needs a library for {' and for '.join(missing)}: {INSTALL}")
    for each in missing:
        log.info("ROS 2 without %s: %s", each, INSTALL)
    return opened


def _opener(name: str) -> Callable[[Deliver, int, str | None], Any]:
    if name == "dds":
        from tsfusion.datasets.ros2.dds import Dds

        return lambda deliver, domain, _router: Dds(deliver, domain)
    from tsfusion.datasets.ros2.zenoh_session import Zenoh

    return Zenoh


class LiveMessage(NamedTuple):
    """Message that came, decoded."""

    message: Message
    publisher: bytes
    captured_ns: int  # `time.monotonic_ns()` of its arrival


class LiveMessages:
    """Messages of one ROS domain, but for those of tsfusion itself.

    Messages of all topics subscribed to wait until they are taken. `streams`, `messages` and `listing`
    tell of them as a `BagRecording` does.

    Args:
        kinds: types of the topics to subscribe to.
        transport, domain, router: as for `open_middlewares`.

    Attributes:
        path: the domain, for messages to people.
        changed: `time.monotonic()` when the last topic was found.
        heard: topic → `time.monotonic()` of its last message.
        broken, dropped: topic → number of messages that cannot be decoded, or found no room.

    Raises:
        MissingDependency, InvalidConfig, SourceError: as for `open_middlewares`.
    """

    def __init__(
        self, kinds: Collection[str], *, transport: str | None, domain: int | None, router: str | None
    ) -> None:
        self._news = threading.Condition()
        self._waiting: deque[CdrMessage] = deque()
        self._nbytes = 0
        self._first: dict[Stream, CdrMessage] = {}
        self._topics: dict[str, LiveTopic] = {}
        self._subscribed: dict[str, Transport] = {}
        self._is_wanted: Callable[[LiveTopic], bool] = lambda topic: topic.kind in kinds
        self.changed = time.monotonic()
        self.heard: dict[str, float] = {}
        self.broken: Counter[str] = Counter()
        self.dropped: Counter[str] = Counter()
        self._middlewares = open_middlewares(self._arrived, transport=transport, domain=domain, router=router)
        names = " and ".join({"dds": "DDS", "zenoh": "Zenoh"}[one.name] for one in self._middlewares)
        self.path = f"ROS 2 domain {domain_id(domain)} over {names}"

    def _arrived(self, arrival: CdrMessage) -> None:
        with self._news:
            if arrival.stream.topic not in self._subscribed:  # it was on its way when its topic was left
                return
            self.heard[arrival.stream.topic] = time.monotonic()
            self._first.setdefault(arrival.stream, arrival)
            self._waiting.append(arrival)
            self._nbytes += len(arrival.content)
            while self._nbytes > _MOST_BYTES:
                large = (i for i, each in enumerate(self._waiting) if len(each.content) > _SMALL)
                oldest = self._waiting[index := next(large, 0)]
                del self._waiting[index]
                self._nbytes -= len(oldest.content)
                self.dropped[oldest.stream.topic] += 1
            self._news.notify()

    # --- topics ---

    def look(self) -> None:
        """Look for topics, and subscribe to the wanted ones, each over one transport."""
        found: dict[str, LiveTopic] = {}
        for middleware in self._middlewares:
            for topic in middleware.topics():
                if topic.name.startswith(_OWN):
                    continue
                if topic.name not in self._topics:
                    self.changed = time.monotonic()
                is_first = found.setdefault(topic.name, topic) is topic
                of_this = self._subscribed.get(topic.name, middleware.name) == middleware.name
                if is_first and of_this and self._is_wanted(topic):
                    self._subscribed[topic.name] = middleware.name
                    middleware.subscribe(topic)
        self._topics = found

    def narrow(self, is_wanted: Callable[[LiveTopic], bool]) -> None:
        """Keep only some topics from now on; messages of others that wait are dropped.

        A transport over which none of them comes is closed.
        """
        self._is_wanted = is_wanted
        wanted = {name for name, topic in self._topics.items() if is_wanted(topic)}
        for name in self._subscribed.keys() - wanted:
            transport = self._subscribed.pop(name)
            for middleware in self._middlewares:
                if middleware.name == transport:
                    middleware.unsubscribe(name)
        for middleware in [*self._middlewares]:
            if middleware.name not in self._subscribed.values():
                middleware.close()
                self._middlewares.remove(middleware)
        with self._news:
            self._waiting = deque(each for each in self._waiting if each.stream.topic in wanted)
            self._nbytes = sum(len(each.content) for each in self._waiting)
            self._first.clear()

    def publishers(self, topic: str) -> int:
        """Return the number of publishers of a topic at the last `look`."""
        found = self._topics.get(topic)
        return 0 if found is None else found.publishers

    @property
    def topics(self) -> list[LiveTopic]:
        """The topics at the last `look`."""
        return sorted(self._topics.values())

    @property
    def streams(self) -> list[Stream]:
        return [topic.stream for topic in self.topics]

    def listing(self) -> str:
        shown = [f"{one.name} ({one.kind.replace('/msg/', '/')})" for one in self.topics]
        more = f" and {len(shown) - _SHOWN} more" if len(shown) > _SHOWN else ""
        return (
            f"its topics: {', '.join(shown[:_SHOWN])}{more}" if shown else "nobody publishes anything there"
        )

    # --- messages ---

    def messages(self, streams: Collection[Stream]) -> Iterator[Message | Stream]:
        """Yield the first message of some streams, and those that wait, without taking them."""
        with self._news:
            first = [self._first[one] for one in streams if one in self._first]
            waiting = [each for each in self._waiting if each.stream in streams and each not in first]
        for arrival in (*first, *waiting):
            made = self._decoded(arrival)
            yield arrival.stream if made is None else made.message

    def take(self, timeout: float) -> list[LiveMessage]:
        """Return all messages that wait; wait up to `timeout` seconds for the first one."""
        with self._news:
            if not self._waiting:
                self._news.wait(timeout)
            taken, self._waiting, self._nbytes = self._waiting, deque(), 0
        made = []
        for arrival in taken:
            one = self._decoded(arrival)
            if one is not None:
                made.append(one)
                continue
            self.count_broken(arrival.stream.topic, f"of {len(arrival.content)} bytes cannot be decoded")
        return made

    def count_broken(self, topic: str, why: str) -> None:
        """Count a message that cannot be used, and say so of the first one of its topic."""
        self.broken[topic] += 1
        if self.broken[topic] == 1:
            log.warning("a message on %s %s: it is left out, and later ones are counted", topic, why)

    def _decoded(self, arrival: CdrMessage) -> LiveMessage | None:
        store = message_types()
        try:
            content = store.deserialize_cdr(arrival.content, arrival.stream.kind)
        except Exception as error:  # noqa: BLE001  generated code: what it meets in foreign bytes, it raises
            log.debug("%s: %s", arrival.stream.topic, error)
            return None
        where = MessageLocation(0, arrival.log_ns, stamp_ns(content))
        return LiveMessage(Message(arrival.stream, where, content), arrival.publisher, arrival.captured_ns)

    def close(self) -> None:
        for middleware in self._middlewares:
            middleware.close()
