# SPDX-License-Identifier: MIT
"""Time stamps of a keyframe, the stages between them, and statistics over many keyframes."""

from typing import Annotated

import numpy as np
from msgspec import Meta, Struct
from numpy.typing import NDArray

Seq = Annotated[int, Meta(ge=0, le=(1 << 63) - 1)]


class Stamps(Struct, frozen=True, array_like=True):
    """Server times of one keyframe, monotonic nanoseconds; 0 = not yet."""

    seq: Seq
    received_ns: int = 0
    durable_ns: int = 0
    fuse_start_ns: int = 0
    fused_ns: int = 0
    meshed_ns: int = 0


class Spread(Struct, frozen=True, kw_only=True):
    """Statistics of a duration over `count` keyframes, milliseconds; all 0 where there is none."""

    count: int = 0
    mean: float = 0.0
    p50: float = 0.0
    p95: float = 0.0
    p99: float = 0.0
    max: float = 0.0


class KeyframeTimes(Struct, kw_only=True):
    """The latency ledger's row: one keyframe, every stamp on the client's monotonic clock; 0 = unknown.

    `clock_bound_ns`: the server's stamps are right to within ± this (half the best round trip).
    """

    seq: int
    timestamp_ns: int = 0  # the sensor's own clock
    captured_ns: int = 0
    sent_ns: int = 0
    received_ns: int = 0
    durable_ns: int = 0
    fuse_start_ns: int = 0
    fused_ns: int = 0
    meshed_ns: int = 0
    clock_bound_ns: int = 0


# A stage lasts from one stamp to the next; together they are a keyframe's way from capture to mesh.
STAGES: dict[str, tuple[str, str]] = {
    "encode": ("captured_ns", "sent_ns"),
    "wire": ("sent_ns", "received_ns"),
    "journal": ("received_ns", "durable_ns"),
    "queue": ("durable_ns", "fuse_start_ns"),
    "fuse": ("fuse_start_ns", "fused_ns"),
    "mesh": ("fused_ns", "meshed_ns"),
}
DELAY = ("captured_ns", "fused_ns")


def spread(values_ms: NDArray[np.float64]) -> Spread:
    """Count, mean, p50, p95, p99 and maximum of the values that are not NaN."""
    known = values_ms[~np.isnan(values_ms)]
    if not len(known):
        return Spread()
    mean, p50, p95, p99, most = (
        round(float(x), 3) for x in (known.mean(), *np.percentile(known, (50, 95, 99)), known.max())
    )
    return Spread(count=len(known), mean=mean, p50=p50, p95=p95, p99=p99, max=most)
