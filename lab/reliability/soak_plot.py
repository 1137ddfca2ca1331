# SPDX-License-Identifier: MIT
"""The plot of a soak run: memory and files over time, kills and the full disk marked."""

from pathlib import Path
from typing import Any

from lab.reliability.soak_run import Outcome

_MOST_POINTS = 400  # a curve
_COLORS = {"server killed": "#d62728", "fuser killed": "#ff7f0e", "scanner killed": "#9467bd"}


def plot(outcome: Outcome, path: Path) -> None:
    """Draw it (PNG or SVG, by the name's ending)."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 5.4), dpi=100, layout="constrained")
    memory, progress = figure.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    samples = outcome.samples[:: max(len(outcome.samples) // _MOST_POINTS, 1)]
    at = [one.seconds for one in samples]
    for name in samples[0].processes:
        memory.plot(at, [one.processes[name].rss_mb for one in samples], label=f"{name}: RSS", linewidth=1.2)
    memory.plot(at, [one.disk_mb for one in samples], label="server's files", linewidth=1.2, color="#8c8c8c")
    memory.set_ylabel("MB")
    progress.plot(at, [one.durable / 1000 for one in samples], label="1000 keyframes", color="#111111")
    for kind, marks in {"files": "#1f77b4", "threads": "#2ca02c"}.items():
        opened = [getattr(one.processes["gateway"], kind) for one in samples]
        progress.plot(at, opened, label=f"gateway: {kind}", linewidth=1.0, color=marks)
    progress.set_xlabel("seconds")
    for axis in (memory, progress):
        _mark(axis, outcome)
        axis.set_ylim(0, 1.35 * axis.get_ylim()[1])  # the legend stands above the curves
        axis.spines[["top", "right"]].set_visible(False)
        axis.tick_params(labelsize=8)
        axis.legend(fontsize=7, framealpha=1, edgecolor="none", loc="upper left", ncols=3)
    figure.suptitle(
        f"{outcome.keyframes:,} keyframes of three scanners, {outcome.kills} kills, a full disk", fontsize=10
    )
    figure.savefig(path)


def _mark(axis: Any, outcome: Outcome) -> None:
    labelled = set()
    for event in outcome.events:
        if event.what in _COLORS:
            label = None if event.what in labelled else event.what
            axis.axvline(event.seconds, color=_COLORS[event.what], linewidth=0.7, alpha=0.7, label=label)
            labelled.add(event.what)
    ends = {event.what: event.seconds for event in outcome.events}
    if "room again" in ends:
        axis.axvspan(ends["disk full"], ends["room again"], color="#e8c86a", alpha=0.6, label="disk full")
