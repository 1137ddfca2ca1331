# SPDX-License-Identifier: MIT
"""Compute the latency ledger: how long each keyframe took in each stage from capture to mesh."""

import csv
import io
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from tsfusion.wire.messages.health import Spread, spread
from tsfusion.wire.messages.messages import DELAY, STAGES, KeyframeTimes

TARGET_MS = 500.0
_STAMPS = (
    "timestamp_ns", "captured_ns", "sent_ns", "received_ns", "durable_ns",
    "fuse_start_ns", "fused_ns", "meshed_ns", "clock_bound_ns",
)  # fmt: skip


class LatencySummary(msgspec.Struct, frozen=True):
    """Summary of the ledger. The delay is the time from captured to fused.

    `clock_bound_ms` bounds the error of every figure that compares the scanner's clock with the server's.
    """

    delay_ms: Spread
    slope_ms_per_keyframe: float
    stages_ms: dict[str, Spread]
    clock_bound_ms: float


def durations_ms(records: Sequence[KeyframeTimes], start: str, end: str) -> NDArray[np.float64]:
    """Return (n,) milliseconds from the stamp named `start` to that named `end`; NaN where one is unknown."""
    stamps = np.array([(getattr(r, start), getattr(r, end)) for r in records], dtype=np.int64).reshape(-1, 2)
    known = (stamps > 0).all(axis=1)
    return np.where(known, (stamps[:, 1] - stamps[:, 0]) / 1e6, np.nan)


def summarise(records: Sequence[KeyframeTimes]) -> LatencySummary:
    """Return statistics of the keyframes' delay and of each stage, and the growth of the delay."""
    delay = durations_ms(records, *DELAY)
    return LatencySummary(
        delay_ms=spread(delay),
        slope_ms_per_keyframe=slope(delay),
        stages_ms={name: spread(durations_ms(records, *ends)) for name, ends in STAGES.items()},
        clock_bound_ms=max((record.clock_bound_ns for record in records), default=0) / 1e6,
    )


def slope(values_ms: NDArray[np.float64]) -> float:
    """Return the least-squares growth of (n,) values, ms per keyframe; 0 with fewer than two known values."""
    index = np.flatnonzero(~np.isnan(values_ms))
    if len(index) < 2:
        return 0.0
    return round(float(np.polyfit(index, values_ms[index], 1)[0]), 4)


def write_csv(records: Sequence[KeyframeTimes], path: Path) -> None:
    """Write a line a keyframe: stamps (ns, scanner's clock, 0 = unknown); stages, delay (ms, or empty)."""
    columns = {f"{name}_ms": durations_ms(records, *ends) for name, ends in STAGES.items()}
    columns["delay_ms"] = durations_ms(records, *DELAY)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["seq", *_STAMPS, *columns])
    for row, record in enumerate(records):
        values = (column[row] for column in columns.values())
        spans = ["" if np.isnan(value) else f"{value:.3f}" for value in values]
        writer.writerow([record.seq, *(getattr(record, stamp) for stamp in _STAMPS), *spans])
    path.write_text(text.getvalue(), encoding="utf-8")


def plot(records: Sequence[KeyframeTimes], path: Path, *, target_ms: float = TARGET_MS) -> None:
    """Draw a PNG: the stages up to `fused` stacked per keyframe, their sum, and the target line."""
    from matplotlib.figure import Figure  # without pyplot: no global state, no window system

    index = np.arange(len(records))
    delay = durations_ms(records, *DELAY)
    summary = summarise(records)
    figure = Figure(figsize=(9.6, 4.8), dpi=120, layout="constrained")
    axes = figure.add_subplot()
    bottom = np.zeros(len(records))
    for name, ends in STAGES.items():
        if name == "mesh":
            continue  # after `fused`, so no part of the delay
        height = np.nan_to_num(durations_ms(records, *ends)).clip(min=0)
        axes.bar(index, height, width=1.0, bottom=bottom, label=name)
        bottom += height
    axes.plot(index, delay, color="black", linewidth=0.8, label="captured → fused")
    axes.axhline(target_ms, color="crimson", linestyle="--", linewidth=1, label=f"{target_ms:.0f} ms")
    axes.set_xlim(-0.5, max(len(records) - 0.5, 0.5))
    axes.set_ylim(0, max(1.1 * target_ms, 1.05 * summary.delay_ms.max))
    axes.set(xlabel="keyframe", ylabel="delay (ms)", title=_title(summary))
    figure.legend(loc="outside right center", frameon=False)
    figure.savefig(path, format="png")


def _title(summary: LatencySummary) -> str:
    delay = summary.delay_ms
    return (
        f"delay per keyframe: mean {delay.mean:.0f}, p95 {delay.p95:.0f}, max {delay.max:.0f} ms; "
        f"slope {summary.slope_ms_per_keyframe:+.2f} ms/keyframe"
    )
