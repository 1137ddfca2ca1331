# SPDX-License-Identifier: MIT
"""What becomes of a message with corrected poses: on the disk, known already, to be sent again, or refused.

Cheapest first, as with keyframes; the poses are looked at last.
"""

import logging
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from msgspec import structs

from tsfusion.core import logs
from tsfusion.core.config import ServerConfig
from tsfusion.core.errors import JournalError
from tsfusion.gateway.admission import Admission
from tsfusion.gateway.hosted_map import HostedMap
from tsfusion.gateway.map_registry import MapRegistry
from tsfusion.gateway.quotas import Quotas
from tsfusion.wire import corrections
from tsfusion.wire.corrections import Corrections, SessionCorrections
from tsfusion.wire.keyframe_header import Refused
from tsfusion.wire.messages import Corrected, Uncorrected

log = logging.getLogger(__name__)

_DISK_AGAIN = 1.0  # seconds
_LONGEST = 10.0
_SHARE = 16  # of what a client may send in keyframes: each message writes its session's file anew
_RATE = 20.0  # messages a second of a client


class Corrector:
    """The way from the control socket into the maps' corrections."""

    def __init__(self, server: ServerConfig, maps: MapRegistry, admission: Admission) -> None:
        self._server = server
        self._maps = maps
        self._admission = admission
        share = max(server.quota_bytes // _SHARE, 1)
        self._quotas = Quotas(structs.replace(server, quota_bytes=share, quota_keyframes=_RATE))

    def take(self, head: Corrections, frames: Sequence[Any], client: str) -> Corrected | Uncorrected | None:
        """One message; the answer. None = none: its client will say hello, and send it again."""
        hosted = self._maps.get(head.map)
        if hosted is None or not hosted.warm:
            self._admission.refused["map"] += 1
            return None
        session = hosted.sessions.get(head.session)
        if session is None or not self._admission.owns(hosted.sessions, head.session, client):
            return self._refuse(head, Refused("session", "no keyframe of this session came from you"), client)
        kept = hosted.revisions.of(head.session)
        if head.revision <= kept.revision:
            return Corrected(head.session, kept.revision)
        if again := self._has_to_wait(hosted, head, kept.nbytes, client):
            return again
        try:
            new = corrections.unpack(head, self._within(frames))
            self._check(new, session.durable)
            hosted.revisions.take(new)
        except Refused as error:
            return self._refuse(head, error, client)
        except JournalError as error:
            log.error("corrections are not taken: %s", error, extra=logs.about(map=head.map, client=client))
            return self._later(head, _DISK_AGAIN, "disk", str(error))
        subject = logs.about(map=head.map, session=head.session, client=client)
        log.info("revision %d corrects %d keyframes", new.revision, len(new), extra=subject)
        return Corrected(head.session, head.revision)

    def _has_to_wait(
        self, hosted: HostedMap, head: Corrections, kept_bytes: int, client: str
    ) -> Uncorrected | None:
        """A message costs what is written for it: the whole file."""
        now = time.monotonic()
        if seconds := hosted.disk.seconds_left(now):
            return self._later(head, seconds, "disk", hosted.disk.problem)
        nbytes = kept_bytes + corrections.file_bytes(head.count)
        if seconds := self._quotas.wait(client, nbytes, now):
            return self._later(head, seconds, "quota", "a client's corrections have a quota, too")
        return None

    def _within(self, frames: Sequence[Any]) -> Sequence[Any]:
        nbytes, most = sum(memoryview(frame).nbytes for frame in frames), self._server.max_frame_bytes
        if nbytes > most:
            raise Refused("size", f"corrections may have {most} bytes, got {nbytes}")
        return frames

    def _check(self, new: SessionCorrections, durable: int) -> None:
        if len(new) and new.seqs[-1] > durable:
            raise Refused(
                "values", f"keyframe {new.seqs[-1]} is corrected, the last one that came is {durable}"
            )
        most = self._server.quota_extent
        away = float(np.linalg.norm(new.poses[:, :3, 3], axis=1).max(initial=0.0))
        if away > most:
            raise Refused("quota", f"a sensor may be {most:g} m from the origin, got {away:.0f} m")

    def _later(self, head: Corrections, seconds: float, reason: str, message: str) -> Uncorrected:
        self._admission.refused["held"] += 1
        return Uncorrected(head.session, head.revision, reason, message, min(max(seconds, 0.1), _LONGEST))

    def _refuse(self, head: Corrections, error: Refused, client: str) -> Uncorrected:
        self._admission.refused[error.reason] += 1
        subject = logs.about(map=head.map, session=head.session, client=client, reason=error.reason)
        log.warning("corrections are refused: %s", error, extra=subject)
        return Uncorrected(head.session, head.revision, error.reason, str(error))
