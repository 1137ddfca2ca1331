# SPDX-License-Identifier: MIT
"""Publish and subscribe over DDS, as bytes, with Cyclone DDS."""

import logging
import os
import struct
import threading
import time
import types
from collections import defaultdict
from contextlib import suppress
from functools import cache
from typing import Any

from cyclonedds import core, domain, pub, sub, topic
from cyclonedds.builtin import BuiltinDataReader, BuiltinTopicDcpsPublication
from cyclonedds.idl import IdlStruct
from cyclonedds.idl import types as idl
from cyclonedds.qos import Policy, Qos
from cyclonedds.util import duration

from tsfusion.core.errors import SourceError
from tsfusion.datasets.ros2.middleware import (
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

# An image with its colour comes as a burst of 1.5 MB: what finds no room is asked for again, 0.1 s later.
_SETTINGS = (
    "<CycloneDDS><Domain>{}<Internal><SocketReceiveBufferSize max='8MB'/></Internal></Domain></CycloneDDS>"
)
_LOOPBACK = (
    "<General><AllowMulticast>false</AllowMulticast><Interfaces><NetworkInterface name='lo'/></Interfaces>"
    "<MaxMessageSize>65500B</MaxMessageSize><FragmentSize>65000B</FragmentSize></General><Discovery>"
    "<ParticipantIndex>auto</ParticipantIndex><Peers><Peer Address='localhost'/></Peers></Discovery>"
)
_KEPT = 64  # messages of a topic that wait for this thread; the oldest go first
_SENT = 8  # messages of a topic that are kept until they are acknowledged
_BLOCKING = duration(milliseconds=100)
_WAIT = duration(milliseconds=50)
_ALL = 1 << 20
# ROS's definition of a type in rosbags → Cyclone's. An enum of rosbags: BASE, NAME, ARRAY, SEQUENCE
_BASES: dict[str, Any] = {
    "bool": bool, "byte": idl.uint8, "char": idl.uint8, "octet": idl.uint8, "string": str,
    "float32": idl.float32, "float64": idl.float64,
    **{f"{u}int{n}": getattr(idl, f"{u}int{n}") for u in ("", "u") for n in (8, 16, 32, 64)},
}  # fmt: skip
_NO_MEMBER = "structure_needs_at_least_one_member"
_HEADER = struct.Struct("<4xQq")  # Cyclone's header of a request and of its reply: client, number


class Dds:
    """`Middleware` over DDS.

    CYCLONEDDS_URI configures it as it does rmw_cyclonedds.

    Raises:
        SourceError: Cyclone DDS cannot begin.
    """

    name: Transport = "dds"

    def __init__(self, deliver: Deliver, domain_id: int) -> None:
        self._deliver = deliver
        try:
            self._domain = _configured(domain_id)
            self._participant = domain.DomainParticipant(domain_id)
            self._found = BuiltinDataReader(self._participant, BuiltinTopicDcpsPublication)
            self._waitset = core.WaitSet(self._participant)
        except core.DDSException as error:
            raise SourceError(f"DDS cannot begin in domain {domain_id}: {error} (CYCLONEDDS_URI?)") from error
        self._endpoints: dict[Any, Any] = {}
        self._readers: dict[str, tuple[LiveTopic, Any]] = {}  # by topic
        self._writers: dict[str, Any] = {}
        self._services: list[tuple[Any, str, Respond]] = []
        self._lock = threading.Lock()
        self._closed = False
        self._thread = threading.Thread(target=self._receive, name="dds", daemon=True)
        self._thread.start()

    def topics(self) -> list[LiveTopic]:
        for one in self._found.take(_ALL):
            if one.sample_info.instance_state == core.InstanceState.Alive and one.sample_info.valid_data:
                self._endpoints[one.key] = one
            else:
                self._endpoints.pop(one.key, None)
        found = defaultdict(list)
        for one in self._endpoints.values():
            kind = ros_type(one.type_name)
            if one.topic_name.startswith("rt/") and kind is not None:
                found[one.topic_name[2:], kind].append(one.qos)
        return [
            LiveTopic(*key, self.name, len(each), all(map(_is_reliable, each)), all(map(_is_latched, each)))
            for key, each in sorted(found.items())
        ]

    def subscribe(self, topic: LiveTopic) -> None:
        before = self._readers.get(topic.name)
        if before is not None and before[0][3:] == (topic.publishers, *topic[4:]):
            return
        if before is not None and before[0][4:] == topic[4:]:
            self._readers[topic.name] = (topic, before[1])
            return
        self.unsubscribe(topic.name)
        reader = self._reader(f"rt{topic.name}", topic.kind, _qos(topic.reliable, latched=topic.latched))
        with self._lock:
            self._readers[topic.name] = (topic, reader)
            self._waitset.attach(reader)

    def _reader(self, name: str, kind: str, qos: Qos) -> Any:
        reader = sub.DataReader(self._participant, self._topic(name, kind), qos=qos)
        reader.set_status_mask(core.DDSStatus.DataAvailable)
        return reader

    def unsubscribe(self, topic: str) -> None:
        with self._lock:
            found = self._readers.pop(topic, None)
            if found is not None:
                self._waitset.detach(found[1])

    def _topic(self, name: str, kind: str) -> Any:
        return topic.Topic(self._participant, name, _idl_type(kind))

    def _receive(self) -> None:
        while not self._closed:
            self._waitset.wait(_WAIT)
            with self._lock:
                readers = list(self._readers.values())
                services = list(self._services)
            for described, reader in readers:
                self._take(described, reader)
            for service in services:
                self._answer(*service)

    def _take(self, described: LiveTopic, reader: Any) -> None:
        for one in reader.take(_KEPT):
            if not isinstance(one, sub.InvalidSample):
                publisher = one.sample_info.publication_handle.to_bytes(8, "little")
                now = time.time_ns(), time.monotonic_ns()
                self._deliver(CdrMessage(described.stream, publisher, *now, one.content))

    def announce(self, topic: str, kind: str, *, latched: bool = False) -> None:
        self._writers[topic] = self._writer(f"rt{topic}", kind, latched=latched)

    def listeners(self, topic: str) -> int:
        return len(self._writers[topic].get_matched_subscriptions())

    def publish(self, topic: str, content: bytes) -> None:
        writer = self._writers[topic]
        writer.write(writer.data_type(content))

    def _writer(self, name: str, kind: str, *, latched: bool) -> Any:
        qos = _qos(True, latched=latched, depth=1 if latched else _SENT)
        return pub.DataWriter(self._participant, self._topic(name, kind), qos)

    def serve(self, service: str, kind: str, answer: Respond) -> None:
        """Respond as rmw_cyclonedds does: before the content a header names the client and the request."""
        writer = self._writer(f"rr{service}Reply", f"{kind}_Response", latched=False)

        def replied(request: bytes) -> bytes:
            client, number = _HEADER.unpack_from(request)
            content = answer(request[:4] + request[_HEADER.size :])
            return content[:4] + _HEADER.pack(client, number)[4:] + content[4:]

        reader = self._reader(f"rq{service}Request", f"{kind}_Request", _qos(True))
        with self._lock:
            self._services.append((reader, f"{kind}_Response", replied))
            self._writers[f"rr{service}"] = writer
            self._waitset.attach(reader)

    def _answer(self, reader: Any, kind: str, answer: Respond) -> None:
        for one in reader.take(_KEPT):
            if not isinstance(one, sub.InvalidSample) and len(one.content) >= _HEADER.size:
                name = reader.topic.name[2 : -len("Request")]
                self._writers[f"rr{name}"].write(_idl_type(kind)(answer(one.content)))

    def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        self._thread.join()
        self._readers.clear()
        self._writers.clear()
        self._services.clear()
        del self._found, self._waitset, self._participant, self._domain


def _configured(domain_id: int) -> Any:
    """Return a domain with our settings; None if the user has some, or this process is in it already."""
    if "CYCLONEDDS_URI" not in os.environ:
        with suppress(core.DDSException):
            return domain.Domain(domain_id, _SETTINGS.format(_LOOPBACK if is_local() else ""))
    return None


def _qos(reliable: bool, *, latched: bool = False, depth: int = _KEPT) -> Qos:
    return Qos(
        Policy.Reliability.Reliable(_BLOCKING) if reliable else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile,
        Policy.History.KeepLast(depth),
        Policy.DataRepresentation(use_cdrv0_representation=True, use_xcdrv2_representation=False),
    )


def _is_reliable(qos: Qos) -> bool:
    return bool(isinstance(qos[Policy.Reliability], Policy.Reliability.Reliable))


def _is_latched(qos: Qos) -> bool:
    return bool(qos[Policy.Durability] != Policy.Durability.Volatile)


@cache
def _idl_type(kind: str) -> Any:
    """Return Cyclone's class of a ROS type: it describes the type to others, and leaves bytes as they are."""
    from rosbags.interfaces import Nodetype

    def annotated(description: Any) -> Any:
        node, value = description
        if node == Nodetype.BASE:
            return idl.bounded_str[value[1]] if value[0] == "string" and value[1] else _BASES[value[0]]
        if node == Nodetype.NAME:
            return _idl_type(value)
        item, length = annotated(value[0]), value[1]
        if node == Nodetype.ARRAY:
            return idl.array[item, length]
        return idl.sequence[item, length] if length else idl.sequence[item]

    fields = message_types().fielddefs[kind][1]
    own = {"client": idl.uint64, "number": idl.int64} if "/srv/" in kind else {}
    own |= {name: annotated(each) for name, each in fields} or {_NO_MEMBER: idl.uint8}

    def keep(self: Any, content: bytes) -> None:
        self.content = content

    def fill(namespace: dict[str, Any]) -> None:
        namespace["__annotations__"] = own
        namespace["__init__"] = keep
        namespace["serialize"] = lambda self, **_: self.content
        namespace["deserialize"] = namespace["deserialize_key"] = classmethod(lambda cls, raw: cls(raw))

    name = dds_type(kind).replace("::", ".")
    return types.new_class(name.rpartition(".")[2], (IdlStruct,), {"typename": name}, fill)
