# SPDX-License-Identifier: MIT
"""A client of Foxglove's protocol: what it was sent, read by the schemas that came with the topics."""

import base64
import json
import struct
import time
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from numpy.typing import NDArray
from websockets.sync.client import connect
from websockets.typing import Subprotocol

DEADLINE = 60.0
MESSAGE = struct.Struct("<BIQ")
DELETE_ALL = 1


class FoxgloveClient:
    """A WebSocket client that subscribes to topics as they are offered, and reads only when it is stepped.

    Args:
        topics: topics to subscribe to; None = all.

    Attributes:
        offered: topics by name, as they were advertised.
        scenes: by topic: entities by id, after all updates and deletions.
        last: the newest message of each other topic.
        seen: number of messages, by topic.
    """

    def __init__(
        self, url: str, topics: Iterable[str] | None = None, *, protocol: str = "foxglove.sdk.v1", **how: Any
    ) -> None:
        self.link = connect(url, subprotocols=[Subprotocol(protocol)], max_size=None, compression=None, **how)
        self._wanted = None if topics is None else set(topics)
        self.info: dict[str, Any] = {}
        self.offered: dict[str, dict[str, Any]] = {}
        self._by_number: dict[int, tuple[str, Any]] = {}
        self.scenes: dict[str, dict[str, Any]] = {}
        self.last: dict[str, Any] = {}
        self.all: dict[str, list[Any]] = {}
        self.seen: dict[str, int] = {}

    def close(self) -> None:
        self.link.close()

    def __enter__(self) -> "FoxgloveClient":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def until(self, reached: Callable[[], Any]) -> None:
        end = time.monotonic() + DEADLINE
        while not reached():
            assert time.monotonic() < end, (self.seen, {name: len(one) for name, one in self.scenes.items()})
            self.step()

    def step(self, timeout: float = 0.1) -> None:
        try:
            message = self.link.recv(timeout=timeout)
        except TimeoutError:
            return
        if isinstance(message, str):
            self._take_text(json.loads(message))
            return
        kind, number, _ = MESSAGE.unpack_from(message)
        assert kind == 1
        topic, decode = self._by_number[number]
        self._take(topic, decode(message[MESSAGE.size :]))

    def _take_text(self, message: dict[str, Any]) -> None:
        match message["op"]:
            case "serverInfo":
                self.info = message
            case "advertise":
                for one in message["channels"]:
                    self.offered[one["topic"]] = one
                    self._by_number[one["id"]] = (one["topic"], decoder(one))
                wanted = [one["id"] for one in message["channels"] if self._wants(one["topic"])]
                each = [{"id": number, "channelId": number} for number in wanted]
                self.send(op="subscribe", subscriptions=each)
            case "unadvertise":
                gone = set(message["channelIds"])
                self.offered = {name: one for name, one in self.offered.items() if one["id"] not in gone}

    def _wants(self, topic: str) -> bool:
        return self._wanted is None or topic in self._wanted

    def send(self, **message: Any) -> None:
        self.link.send(json.dumps(message))

    def _take(self, topic: str, message: Any) -> None:
        self.seen[topic] = self.seen.get(topic, 0) + 1
        self.all.setdefault(topic, []).append(message)
        if self.offered[topic]["schemaName"] != "foxglove.SceneUpdate":
            self.last[topic] = message
            return
        scene = self.scenes.setdefault(topic, {})
        for one in message.deletions:
            if one.type == DELETE_ALL:
                scene.clear()
            else:
                scene.pop(one.id, None)
        for one in message.entities:
            scene[one.id] = one

    def corners(self, topic: str = "/map") -> NDArray[np.float32]:
        """(n, 9) corners of a scene's triangles, in an order that depends on them alone."""
        found = [np.zeros((0, 9), np.float32)]
        for entity in self.scenes.get(topic, {}).values():
            for part in entity.triangles:
                points = np.array([(p.x, p.y, p.z) for p in part.points], np.float32)
                found.append(points[np.array(part.indices, np.int64)].reshape(-1, 9))
        corners = np.concatenate(found)
        return corners[np.lexsort(corners.T)]

    def frames(self) -> dict[str, Any]:
        """Newest transform of each frame, by its name."""
        return {one.child_frame_id: one for each in self.all.get("/tf", ()) for one in each.transforms}


def decoder(channel: dict[str, Any]) -> Callable[[bytes], Any]:
    """Return the function that decodes the messages of an advertised channel."""
    if channel["encoding"] == "json":
        return json.loads
    assert (channel["encoding"], channel["schemaEncoding"]) == ("protobuf", "protobuf")
    pool = descriptor_pool.DescriptorPool()
    for file in descriptor_pb2.FileDescriptorSet.FromString(base64.b64decode(channel["schema"])).file:
        pool.Add(file)
    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(channel["schemaName"]))
    decode: Callable[[bytes], Any] = kind.FromString
    return decode
