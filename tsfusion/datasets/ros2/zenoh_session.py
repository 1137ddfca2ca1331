# SPDX-License-Identifier: MIT
"""Publish and subscribe over Zenoh as rmw_zenoh does: keys, liveliness tokens and attachments of its design.

Source: github.com/ros2/rmw_zenoh, docs/design.md and liveliness_utils.cpp, as of ROS 2 Jazzy.
"""

import json
import logging
import os
import struct
import threading
import time
from collections import defaultdict
from typing import Any

import zenoh
from zenoh import ext

from tsfusion.core.errors import SourceError
from tsfusion.datasets.ros2.middleware import (
    SERVICE_HASHES,
    CdrMessage,
    Deliver,
    LiveTopic,
    Respond,
    Transport,
    dds_type,
    is_local,
    message_types,
    ros_type,
)

log = logging.getLogger(__name__)

_ROUTER = "tcp/localhost:7447"
_TOKENS = "@ros2_lv"
# A token: domain, session, node, number, kind, enclave, namespace, node's name, topic, type, hash, QoS
_PARTS, _KIND, _TOPIC, _TYPE, _QOS = 13, 5, 9, 10, 12
_BEST_EFFORT, _TRANSIENT_LOCAL = "2", "1"  # rmw's enums; reliable and volatile are the defaults, left empty
_USUAL_QOS, _LATCHED_QOS = "::,10:,:,:,,", ":1:,10:,:,:,,"
_NODE = "tsfusion"
_ATTACHED = struct.Struct("<qqB16s")  # number, source's time, length of its id, id
_KEPT = 1  # messages of a latched topic


class Zenoh:
    """`Middleware` over Zenoh.

    ZENOH_SESSION_CONFIG_URI configures it as it does rmw_zenoh.

    Raises:
        SourceError: the configuration is malformed.
    """

    name: Transport = "zenoh"

    def __init__(self, deliver: Deliver, domain_id: int, router: str | None = None) -> None:
        self._deliver, self._domain = deliver, domain_id
        try:
            self._session = zenoh.open(_config(router))
        except zenoh.ZError as error:
            raise SourceError(f"Zenoh cannot begin: {error} (ZENOH_SESSION_CONFIG_URI, router=?)") from error
        self._tokens: dict[str, tuple[str, ...]] = {}
        self._lock = threading.Lock()
        self._subscribers: dict[str, tuple[bool, Any]] = {}  # by topic: whether latched
        self._publishers: dict[str, Any] = {}
        self._announced: list[Any] = []
        self._sent = 0
        self._watch = self._session.liveliness().declare_subscriber(
            f"{_TOKENS}/{domain_id}/**", self._on_token, history=True
        )

    def _on_token(self, sample: Any) -> None:
        key = str(sample.key_expr)
        parts = tuple(key.split("/"))
        if len(parts) != _PARTS or parts[_KIND] not in ("MP", "MS"):
            return
        with self._lock:
            if sample.kind == zenoh.SampleKind.PUT:
                self._tokens[key] = parts
            else:
                self._tokens.pop(key, None)

    def topics(self) -> list[LiveTopic]:
        found: defaultdict[tuple[str, str], list[list[str]]] = defaultdict(list)
        with self._lock:
            tokens = list(self._tokens.values())
        for parts in tokens:
            kind = ros_type(parts[_TYPE])
            if kind is not None and parts[_KIND] == "MP":
                found[parts[_TOPIC].replace("%", "/"), kind].append(parts[_QOS].split(":"))
        return [
            LiveTopic(
                *key, self.name, len(each),
                all(one[0] != _BEST_EFFORT for one in each),
                all(one[1:2] == [_TRANSIENT_LOCAL] for one in each),
            )
            for key, each in sorted(found.items())
        ]  # fmt: skip

    def subscribe(self, topic: LiveTopic) -> None:
        before = self._subscribers.get(topic.name)
        if before is not None and before[0] == topic.latched:
            return
        self.unsubscribe(topic.name)
        stream = topic.stream

        def arrived(sample: Any) -> None:
            now = time.time_ns(), time.monotonic_ns()
            attached = b"" if sample.attachment is None else sample.attachment.to_bytes()
            self._deliver(CdrMessage(stream, attached[-16:], *now, sample.payload.to_bytes()))

        key = self._key(topic.name, topic.kind, "*")
        if topic.latched:
            history = ext.HistoryConfig(detect_late_publishers=True)
            made: Any = ext.declare_advanced_subscriber(self._session, key, arrived, history=history)
        else:
            made = self._session.declare_subscriber(key, arrived)
        self._subscribers[topic.name] = topic.latched, made

    def unsubscribe(self, topic: str) -> None:
        found = self._subscribers.pop(topic, None)
        if found is not None:
            found[1].undeclare()

    def announce(self, topic: str, kind: str, *, latched: bool = False) -> None:
        key = self._key(topic, kind, message_types().hash_rihs01(kind))
        if latched:
            cache = ext.CacheConfig(_KEPT)
            made: Any = ext.declare_advanced_publisher(
                self._session, key, cache=cache, publisher_detection=True
            )
        else:
            made = self._session.declare_publisher(key, congestion_control=zenoh.CongestionControl.BLOCK)
        self._publishers[topic] = made
        self._announce("MP", topic, key, _LATCHED_QOS if latched else _USUAL_QOS)

    def listeners(self, topic: str) -> int:
        with self._lock:
            told = [(parts[_KIND], parts[_TOPIC]) for parts in self._tokens.values()]
        status = getattr(self._publishers[topic], "matching_status", None)  # of a latched one it is unknown
        is_heard = status is None or bool(getattr(status, "matching", status))
        return max(int(is_heard), told.count(("MS", topic.replace("/", "%"))))

    def publish(self, topic: str, content: bytes) -> None:
        self._publishers[topic].put(content, attachment=self._attached())

    def serve(self, service: str, kind: str, answer: Respond) -> None:
        """Respond queries; the attachment of a request comes back with its reply."""

        def asked(query: Any) -> None:
            request = b"" if query.payload is None else query.payload.to_bytes()
            query.reply(query.key_expr, answer(request), attachment=query.attachment)

        key = self._key(service, kind, SERVICE_HASHES[kind])
        self._announced.append(self._session.declare_queryable(key, asked))
        self._announce("SS", service, key, _USUAL_QOS)

    def _key(self, name: str, kind: str, type_hash: str) -> str:
        return f"{self._domain}/{name.strip('/')}/{dds_type(kind)}/{type_hash}"

    def _announce(self, entity: str, name: str, key: str, qos: str) -> None:
        _, kind, type_hash = key.rsplit("/", 2)
        owner = f"{self._domain}/{self._session.zid()}/0/{len(self._announced) + 1}"
        described = f"{name.replace('/', '%')}/{kind}/{type_hash}/{qos}"
        token = f"{_TOKENS}/{owner}/{entity}/%/%/{_NODE}/{described}"
        self._announced.append(self._session.liveliness().declare_token(token))

    def _attached(self) -> bytes:
        self._sent += 1
        source = bytes.fromhex(str(self._session.zid()).zfill(32))
        return _ATTACHED.pack(self._sent, time.time_ns(), len(source), source)

    def close(self) -> None:
        if not self._session.is_closed():
            self._session.close()  # type: ignore[no-untyped-call]


def _config(router: str | None) -> Any:
    """Return the configuration of a session of rmw_zenoh: a peer that its router tells of the others."""
    path = os.environ.get("ZENOH_SESSION_CONFIG_URI")
    if path and router is None:
        return zenoh.Config.from_file(path)
    config = zenoh.Config()
    settings = {
        "mode": "peer",
        "connect/endpoints": [router or _ROUTER],
        "listen/endpoints": ["tcp/127.0.0.1:0" if is_local() or not router else "tcp/[::]:0"],
        "scouting/multicast/enabled": False,
        "timestamping/enabled": True,  # of latched messages
    }
    for key, value in settings.items():
        config.insert_json5(key, json.dumps(value))
    return config
