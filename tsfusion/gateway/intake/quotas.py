# SPDX-License-Identifier: MIT
"""The quotas of a client: keyframes and bytes a second, points of a keyframe, distance from the origin."""

import math
from collections import OrderedDict
from collections.abc import Sequence
from typing import Any

import numpy as np

from tsfusion.core.config import ServerConfig, VolumeConfig
from tsfusion.core.errors import InvalidConfig
from tsfusion.core.rates import Bucket
from tsfusion.wire.records import corrections
from tsfusion.wire.records.codec import measurement
from tsfusion.wire.records.record_header import CorrectionHeader, KeyframeHeader, RecordHeader, Refused

_MAX_CLIENTS = 4096
# Without keys all share one quota, and each of so many connections has at least one part in so many of it,
# whatever others send. A connection that is silent for so long loses it.
_SHARES = 16
_SHARE_KEPT_S = 10.0
_ANY_MAP = VolumeConfig()


class Allowance:
    """The keyframes and bytes that may come in a second.

    Args:
        part: the divisor of both rates.
    """

    def __init__(self, server: ServerConfig, now: float, part: int = 1) -> None:
        self._keyframes = Bucket(server.quota_keyframes / part, now)
        self._bytes = Bucket(server.quota_bytes / part, now)
        self.asked = now

    def wait(self, nbytes: int, now: float) -> float:
        """Seconds until a message may pass; 0 = it does, and is counted."""
        self.asked = now
        seconds = max(self._keyframes.wait(1.0, now), self._bytes.wait(nbytes, now))
        if not seconds:
            self._keyframes.spend(1.0)
            self._bytes.spend(nbytes)
        return seconds


class Quotas:
    """The allowance of every client."""

    def __init__(self, server: ServerConfig) -> None:
        self._server = server
        self._clients: OrderedDict[str, Allowance] = OrderedDict()
        self._shares: dict[int, Allowance] = {}  # by connection, where there are no keys

    def wait(self, owner: str, nbytes: int, now: float, connection: int | None = None) -> float:
        """Seconds that a client has to wait before it may send a message; 0 = it passes, and is counted.

        Args:
            owner: the client's name. Without keys all clients are one: new sessions cost nothing.
            now: `time.monotonic()`.
            connection: over which the message came; None = that is not known.
        """
        allowance = self._clients.get(owner)
        if allowance is None:
            allowance = self._clients[owner] = Allowance(self._server, now)
            if len(self._clients) > _MAX_CLIENTS:
                self._clients.popitem(last=False)
        self._clients.move_to_end(owner)
        share = None if owner or connection is None else self._share_of(connection, now)
        seconds = allowance.wait(nbytes, now)
        return 0.0 if seconds and share is not None and not share.wait(nbytes, now) else seconds

    def _share_of(self, connection: int, now: float) -> Allowance | None:
        """The part of the quota that nobody else may use up; None = others have all parts."""
        share = self._shares.get(connection)
        if share is None and len(self._shares) >= _SHARES:
            self._shares = {fd: one for fd, one in self._shares.items() if now - one.asked < _SHARE_KEPT_S}
        if share is None and len(self._shares) < _SHARES:
            share = self._shares[connection] = Allowance(self._server, now, _SHARES)
        if share is not None:
            share.asked = now
        return share

    def check(self, header: RecordHeader, frames: Sequence[Any]) -> None:
        """Raise Refused for a checked record that asks too much.

        Raises:
            Refused: `quota` for too many points or a place too far away, `values` for a sensor that no
                map knows, and a correction of keyframes that cannot have come before it.
        """
        if isinstance(header, CorrectionHeader):
            self._check_correction(header, frames[1])
        else:
            self._check_keyframe(header)

    def _check_keyframe(self, header: KeyframeHeader) -> None:
        server = self._server
        shape = next(buffer.shape for buffer in header.buffers if buffer.name == measurement(header))
        points = shape[0] if len(shape) == 2 and measurement(header) == "points" else int(np.prod(shape))
        if points > server.quota_points:
            raise Refused("quota", f"a keyframe may have {server.quota_points} points, got {points}")
        self._check_place(math.dist(header.pose[3::4], (0.0, 0.0, 0.0)))
        try:
            _ANY_MAP.model(header.sensor)
        except InvalidConfig as error:
            raise Refused("values", str(error)) from error

    def _check_correction(self, header: CorrectionHeader, body: Any) -> None:
        seqs, rows, removed = corrections.arrays(header, body)
        last = max(seqs.max(initial=0), removed.max(initial=0))
        if last >= header.seq:
            raise Refused("values", f"correction {header.seq} names keyframe {last}, which comes after it")
        self._check_place(float(np.linalg.norm(rows[:, :, 3], axis=1).max(initial=0.0)))

    def _check_place(self, away: float) -> None:
        server = self._server
        if away > server.quota_extent:
            raise Refused(
                "quota", f"a sensor may be {server.quota_extent:g} m from the origin, got {away:.0f} m"
            )
