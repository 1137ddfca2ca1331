# SPDX-License-Identifier: MIT
"""Answer viewers of a map which keyframes scanners sent: the pose of each, and its picture as it came.

Nothing is decoded here, and the fuser is not involved. Pictures have a limit of bytes a second. Of the
pictures over it, the newest of each scanner comes once there is room.
"""

import math
import time
from collections import defaultdict, deque
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import msgspec

from tsfusion.core.limits import Bucket
from tsfusion.wire.messages.questions import SCANS_BYTES, Scanned, Scans, ScansFound
from tsfusion.wire.records.record_header import KeyframeHeader

PICTURE_BYTES = 2 << 20  # bytes a second, for all maps together
_MOST_WAITING = 16  # pictures
_KEPT = 256  # keyframes of a map
_KEPT_PICTURES = 16  # of all maps: viewers ask for them within moments
_WATCHED_S = 10.0  # seconds after a viewer's question in which its next one is expected
_TOGETHER_S = 0.1  # seconds between two answers to viewers that wait


class _WaitingAsker(NamedTuple):
    number: int
    map: str
    asked: Scans
    ends_s: float  # time.monotonic()


class _Recent:
    """Newest keyframes of a map, by consecutive numbers."""

    def __init__(self) -> None:
        self.newest = 1
        self.scans: deque[Scanned] = deque(maxlen=_KEPT)
        self.watched_until = 0.0  # time.monotonic()


class ScanUpdates:
    """The newest keyframes of each map, and the questions for them. Call `step` again and again."""

    def __init__(self) -> None:
        self._epoch = f"{time.monotonic_ns():x}"
        self._recent: dict[str, _Recent] = defaultdict(_Recent)
        self._room = Bucket(PICTURE_BYTES, time.monotonic(), burst=0.5)
        self._unsent: dict[tuple[str, bytes], Scanned] = {}  # map, session → newest keyframe over the limit
        self._pictured: deque[tuple[str, int]] = deque()  # map, number of keyframes that hold a picture
        self._waiting: list[_WaitingAsker] = []
        self._next = 0.0  # time.monotonic() of the next answers

    def note(self, map_name: str, header: KeyframeHeader, buffers: Sequence[Any], client: str) -> None:
        """Keep a keyframe that was journaled for viewers."""
        images = [one.shape for one in header.buffers if one.name in ("depth", "disparity")]
        scanned = Scanned(
            session=header.session,
            seq=header.seq,
            pose=header.pose,
            intrinsics=header.intrinsics if images else None,
            shape=(images[0][0], images[0][1]) if images else None,
            client=client,
        )
        self._unsent.pop((map_name, header.session), None)
        picture = self._picture_of(map_name, header, buffers)
        if picture and not self._take(picture):
            late = msgspec.structs.replace(scanned, picture=picture, late=True)
            self._unsent[map_name, header.session] = late
            if len(self._unsent) > _MOST_WAITING:
                del self._unsent[next(iter(self._unsent))]
            picture = b""
        self._add(map_name, msgspec.structs.replace(scanned, picture=picture))

    def _picture_of(self, map_name: str, header: KeyframeHeader, buffers: Sequence[Any]) -> bytes:
        """Return a keyframe's JPEG; empty without one, without a viewer, or for a very large one."""
        if time.monotonic() > self._recent[map_name].watched_until:
            return b""
        for at, one in enumerate(header.buffers, start=1):
            if one.name == "color" and one.codec == "jpeg" and one.bytes <= SCANS_BYTES:
                return bytes(buffers[at])
        return b""

    def _take(self, picture: bytes) -> bool:
        """Reserve bandwidth for a picture. Return False if the limit of bytes a second is reached."""
        if self._room.wait(len(picture), time.monotonic()):
            return False
        self._room.spend(len(picture))
        return True

    def _add(self, map_name: str, scanned: Scanned) -> None:
        recent = self._recent[map_name]
        recent.newest += 1
        recent.scans.append(scanned)
        if scanned.picture:
            self._pictured.append((map_name, recent.newest))
        while len(self._pictured) > _KEPT_PICTURES:
            self._drop_picture(*self._pictured.popleft())

    def _drop_picture(self, map_name: str, number: int) -> None:
        recent = self._recent[map_name]
        at = len(recent.scans) - 1 - (recent.newest - number)
        if at >= 0:
            recent.scans[at] = msgspec.structs.replace(recent.scans[at], picture=b"")

    def ask(self, number: int, map_name: str, asked: Scans, deadline_s: float = math.inf) -> None:
        """Take a question: `step` answers it under this number, by `deadline_s` (`time.monotonic()`)."""
        now = time.monotonic()
        self._recent[map_name].watched_until = now + _WATCHED_S
        self._waiting.append(_WaitingAsker(number, map_name, asked, min(now + asked.wait_s, deadline_s)))

    def forget(self, map_name: str) -> None:
        """Drop the keyframes of a map, some of which must be forgotten. Viewers may have missed them."""
        self._recent[map_name].scans.clear()
        self._unsent = {key: one for key, one in self._unsent.items() if key[0] != map_name}

    def step(self) -> Iterator[tuple[int, ScansFound]]:
        """Yield the answers that are due, with the numbers of their questions."""
        while self._unsent:
            key = next(iter(self._unsent))
            if not self._take(self._unsent[key].picture):
                break
            self._add(key[0], self._unsent.pop(key))
        now = time.monotonic()
        due = [one for one in self._waiting if self._is_due(one, now)]
        if due:
            self._waiting = [one for one in self._waiting if not self._is_due(one, now)]
            self._next = now + _TOGETHER_S
        for one in due:
            yield one.number, self._found(one.map, one.asked)

    def _is_due(self, one: _WaitingAsker, now: float) -> bool:
        is_new = one.asked.epoch != self._epoch or self._recent[one.map].newest != one.asked.since
        return now >= one.ends_s or (is_new and now >= self._next)

    def _found(self, map_name: str, asked: Scans) -> ScansFound:
        recent = self._recent[map_name]
        count = recent.newest - asked.since
        if asked.epoch != self._epoch or not 0 <= count <= len(recent.scans):
            return ScansFound(self._epoch, recent.newest, missed=bool(asked.epoch))
        scans, nbytes = list[Scanned](), 0
        for scanned in list(recent.scans)[len(recent.scans) - count :]:
            picture = scanned.picture if len(scanned.picture) <= asked.most_bytes else b""
            nbytes += len(picture)
            if scans and nbytes > min(asked.most_bytes, SCANS_BYTES):
                break
            scans.append(msgspec.structs.replace(scanned, picture=picture))
        return ScansFound(self._epoch, asked.since + len(scans), tuple(scans))
