# SPDX-License-Identifier: MIT
"""Shortfalls of a run: what it was for and did not reach, in one line that says what to do.

One rule for all runs. A run reached its purpose when each keyframe that it sent is on the server's disk, when
the map took at least half of them, and when at least half of the frames were localised. What falls short of
that still leaves its results; the command ends with the line, and with status 1.
"""

import os
from collections.abc import Iterable, Mapping

from tsfusion.client import Client, ClientStats
from tsfusion.core.counts import count_of
from tsfusion.datasets.dataset import CLOCK, WITHOUT_POSE
from tsfusion.geometry.sweeps import skewed

_LOST = ("spool", "disk")  # reasons of skipping that no policy asks for


def of_delivery(stats: ClientStats, *, spool: str | os.PathLike[str], link: str, rejection: str) -> str:
    """Say which keyframes are not at the server, or not in its map; empty = enough are.

    Args:
        stats: sums over all clients of the run.
        spool: where keyframes wait for the server.
        link: why the server takes nothing; empty = it does.
        rejection: why the map did not take the first keyframe that it rejected.
    """
    rejected = sum(stats.rejected.values())
    if stats.waiting:
        unnamed = "it is behind" if stats.durable else "no server answers so far"
        return (
            f"{count_of(stats.waiting, 'keyframe is', 'keyframes are')} not at the server "
            f"({link or unnamed}), but in {spool}; check the address with `tsfusion status --connect`, then "
            f"`tsfusion spool send --spool {spool}`"
        )
    if lost := of_disk(stats):
        return lost
    if stats.refused:
        return f"{_never(stats.refused)}: see the log above"
    if rejected and 2 * rejected > stats.sent:
        return f"the map took {stats.sent - rejected} of {stats.sent} keyframes only: {rejection}"
    if corrections := stats.corrections_refused:
        reasons = ", ".join(f"{count} × {reason}" for reason, count in corrections.items())
        count = count_of(sum(corrections.values()), "correction was", "corrections were")
        return f"{count} not taken ({reasons}): keyframes are where they were before; see the log above"
    return ""


def of_sweeps(clients: Iterable[Client]) -> list[str]:
    """Say in how many keyframes the motion within the sweep stays; empty = in none."""
    count = sum(client.skewed for client in clients)
    text = skewed(f"{count_of(count, 'keyframe has', 'keyframes have')} point times without a motion")
    return [text] if count else []


def of_disk(stats: ClientStats) -> str:
    """Say which keyframes this machine's disk could not keep; empty = it kept all."""
    lost = {reason: count for reason, count in stats.skipped.items() if reason in _LOST}
    if damaged := stats.skipped.get("damaged", 0):
        spool = "an earlier scan's spool"
        return f"{count_of(damaged, 'record')} of {spool} could not be read: what had not been sent is lost"
    if not lost:
        return ""
    return (
        f"{_never(lost)}: the disk of their spool is full or failed, or spool_bytes is reached; make room, "
        "or choose another folder (--spool with --connect, else --out)"
    )


def of_damage(lost: int) -> str:
    """Say that damage in journals has cost so many keyframes, or more; empty = none."""
    if not lost:
        return ""
    return (
        f"the map lacks {count_of(lost, 'keyframe')} or more, which the journal cannot give back: "
        "`tsfusion journal verify` says where it is damaged"
    )


def of_absence(absent: int) -> str:
    """Say that journals no longer have so many keyframes of the maps saved beside them; empty = none."""
    if not absent:
        return ""
    return (
        f"the journal no longer has {count_of(absent, 'keyframe')} of the map that is saved beside it "
        "(deleted, or they came with `tsfusion map resume`), so they are not in this one; `tsfusion mesh`, "
        "`ask` and `map` read the saved one"
    )


def cure_of_tracking(localizer: str) -> str:
    """Advice when frames are lost, by the name of the localizer."""
    if localizer == "trajectory":
        return (
            "give the trajectory of this recording, in its clock (--time-offset SECONDS is added to the "
            "times of frames, --max-gap SECONDS bridges gaps)"
        )
    if localizer == "feed":
        return "send poses sooner and in the frames' clock, or record them for --trajectory FILE"
    if localizer == "given":
        return "give poses of all frames (--trajectory FILE), or let them be found (--localizer rgbd)"
    return "move more slowly, give every frame, or take poses from elsewhere (--trajectory FILE)"


def of_clock(left_out: Mapping[str, int]) -> str:
    """Say which frames came when their clock had stepped back; empty = none. `left_out` as of `of_poses`."""
    late = ((reason, count) for reason, count in left_out.items() if reason.startswith(CLOCK))
    return together(f"{count_of(n, 'frame is', 'frames are')} not in the map: {reason}" for reason, n in late)


def of_poses(frames: int, left_out: Mapping[str, int]) -> str:
    """Say that most frames of a recording have no pose; empty = at least half have.

    Args:
        frames: that are left.
        left_out: number of others by reason, as `Dataset.skipped` has them.
    """
    without = sum(count for reason, count in left_out.items() if reason.startswith(WITHOUT_POSE))
    if without <= frames:
        return ""
    return (
        f"only {frames} of {frames + without} frames have a pose, and the rest is not in the map: give a "
        "trajectory of all (--trajectory FILE, --option max_gap_s=SECONDS bridges gaps), or let "
        "`tsfusion scan` find them"
    )


def of_tracking(frames: int, tracked: int, why: str, *, localizer: str = "rgbd") -> str:
    """Say that most frames were lost; empty = at least half have a pose.

    Args:
        why: the sensor was lost the last time.
    """
    if 2 * tracked >= frames:
        return ""
    return f"only {tracked} of {frames} frames were localised ({why}): {cure_of_tracking(localizer)}"


def together(shortfalls: Iterable[str]) -> str:
    """All shortfalls in one line; empty = there are none."""
    return "; ".join(filter(None, shortfalls))


def _never(counts: dict[str, int]) -> str:
    reasons = ", ".join(f"{count} × {reason}" for reason, count in counts.items())
    return f"{count_of(sum(counts.values()), 'keyframe')} will never be at the server ({reasons})"
