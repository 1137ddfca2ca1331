# SPDX-License-Identifier: MIT
"""Updates about scanners for viewers of a map: the pose of each keyframe, and its picture as it came.

Nothing is decoded here, and the fuser is not involved. Pictures have a limit of bytes a second. Of the
pictures over it, the newest of each scanner is sent once there is room.
"""

import time
from collections import Counter
from collections.abc import Sequence
from typing import Any

import msgspec

from tsfusion.core.limits import Bucket
from tsfusion.gateway.ports.ports import Ports, Subscriptions
from tsfusion.wire.messages import mesh_updates
from tsfusion.wire.messages.mesh_updates import Scanned
from tsfusion.wire.records.record_header import KeyframeHeader
from tsfusion.wire.sockets.sockets import scan_topic

PICTURE_BYTES = 2 << 20  # bytes a second, for all maps together
_LARGEST = 1 << 20  # bytes; a larger picture is not sent
_MOST_WAITING = 16  # pictures


class ScanUpdates:
    """Updates about accepted keyframes. Call `step` again and again."""

    def __init__(self, ports: Ports, subscriptions: Subscriptions) -> None:
        self._ports, self._subscriptions = ports, subscriptions
        self._epoch = f"{time.monotonic_ns():x}"
        self._numbers: Counter[str] = Counter()
        self._room = Bucket(PICTURE_BYTES, time.monotonic(), burst=0.5)
        self._waiting: dict[tuple[bytes, bytes], tuple[Scanned, Any]] = {}  # topic, session → update, picture

    def note(self, map_name: str, header: KeyframeHeader, buffers: Sequence[Any], client: str) -> None:
        """Tell viewers that a keyframe was journaled."""
        self._numbers[map_name] += 1
        topic = scan_topic(map_name)
        self._waiting.pop((topic, header.session), None)
        if not self._subscriptions.watched(topic):
            return
        images = [one.shape for one in header.buffers if one.name in ("depth", "disparity")]
        scanned = Scanned(
            session=header.session,
            seq=header.seq,
            pose=header.pose,
            epoch=self._epoch,
            number=self._numbers[map_name],
            intrinsics=header.intrinsics if images else None,
            shape=(images[0][0], images[0][1]) if images else None,
            client=client,
        )
        picture = _picture_of(header, buffers)
        if picture is not None and not self._take(picture):
            self._waiting[topic, header.session] = scanned, picture
            if len(self._waiting) > _MOST_WAITING:
                del self._waiting[next(iter(self._waiting))]
            picture = None
        self._publish(topic, scanned, picture)

    def step(self) -> None:
        """Send the waiting pictures as far as there is room."""
        while self._waiting:
            (topic, session), (scanned, picture) = next(iter(self._waiting.items()))
            if not self._take(picture):
                return
            del self._waiting[topic, session]
            self._publish(topic, msgspec.structs.replace(scanned, late=True), picture)

    def _take(self, picture: Any) -> bool:
        """Reserve bandwidth for a picture. Return False if the limit of bytes a second is reached."""
        if self._room.wait(len(picture), time.monotonic()):
            return False
        self._room.spend(len(picture))
        return True

    def _publish(self, topic: bytes, scanned: Scanned, picture: Any) -> None:
        frames = [] if picture is None else [picture]
        self._ports.publish(topic, mesh_updates.encode(scanned), frames)


def _picture_of(header: KeyframeHeader, buffers: Sequence[Any]) -> Any:
    """Return the bytes of a keyframe's JPEG, or None without one, or for a very large one."""
    for at, one in enumerate(header.buffers, start=1):
        if one.name == "color" and one.codec == "jpeg" and one.bytes <= _LARGEST:
            return buffers[at]
    return None
