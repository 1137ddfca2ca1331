# SPDX-License-Identifier: MIT
"""Say in one line how a run fell short of its goal, and what to do about it.

One rule holds for all runs. Each keyframe sent must be on the server's disk and in one map. Half of them are
enough if the rest has no sample in range. Nearly all frames must have a pose. A run that falls short keeps
its results, but the command prints the line and ends with status 1.
"""

import os
from collections.abc import Iterable, Mapping

from tsfusion.client import Client, ClientStats
from tsfusion.core.readable_numbers import count_of
from tsfusion.datasets.dataset import CLOCK, UNREADABLE, WITHOUT_POSE
from tsfusion.geometry.sample_ranges import NO_SAMPLES
from tsfusion.geometry.sweeps import skewed

FEW = 0.05  # share of frames that may lack a pose: more would leave out a part of the scene
_LOST = ("spool", "disk")  # reasons for skipping a keyframe that no policy asks for


def of_delivery(stats: ClientStats, *, spool: str | os.PathLike[str], link: str, rejection: str) -> str:
    """Return a line on keyframes that the server or its map lacks, or an empty text if it has enough.

    Args:
        stats: sums over all clients of the run.
        spool: folder where keyframes wait for the server.
        link: why the server takes nothing; empty if it does.
        rejection: why the map rejected the first keyframe that it rejected.
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
    if stats.rejected.keys() - {NO_SAMPLES} or 2 * rejected > stats.sent:
        return f"the map took {stats.sent - rejected} of {stats.sent} keyframes only: {rejection}"
    if corrections := stats.corrections_refused:
        reasons = ", ".join(f"{count} × {reason}" for reason, count in corrections.items())
        count = count_of(sum(corrections.values()), "correction was", "corrections were")
        return f"{count} not taken ({reasons}): keyframes are where they were before; see the log above"
    return ""


def of_sweeps(clients: Iterable[Client]) -> list[str]:
    """Return one line, in a list, on LiDAR keyframes not corrected for motion; empty without any."""
    count = sum(client.skewed for client in clients)
    text = skewed(f"{count_of(count, 'keyframe has', 'keyframes have')} point times without a motion")
    return [text] if count else []


def of_disk(stats: ClientStats) -> str:
    """Return a line on keyframes that this machine's disk could not store, or an empty text without any."""
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
    """Return a line on keyframes that are lost because journals are damaged, or an empty text for 0."""
    if not lost:
        return ""
    return (
        f"the map lacks {count_of(lost, 'keyframe')} or more, which the journal cannot give back: "
        "`tsfusion journal verify` says where it is damaged"
    )


def of_absence(absent: int) -> str:
    """Return a line on keyframes of saved maps that their journals no longer have, or an empty text for 0."""
    if not absent:
        return ""
    return (
        f"the journal no longer has {count_of(absent, 'keyframe')} of the map that is saved beside it "
        "(deleted, or they came with `tsfusion map resume`), so they are not in this one; `tsfusion mesh`, "
        "`ask` and `map` read the saved one"
    )


def cure_of_tracking(localizer: str) -> str:
    """Return advice on how to lose fewer frames, by the name of the localizer."""
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
    """Return a line on frames whose clock stepped back, or an empty text. `left_out`: see `of_poses`."""
    late = ((reason, count) for reason, count in left_out.items() if reason.startswith(CLOCK))
    return together(f"{count_of(n, 'frame is', 'frames are')} not in the map: {reason}" for reason, n in late)


def of_poses(frames: int, left_out: Mapping[str, int]) -> str:
    """Return a line if many frames of a recording have no pose, else an empty text.

    Args:
        frames: number of frames with a pose.
        left_out: reason → number of frames left out, see `Dataset.skipped`.
    """
    without = sum(count for reason, count in left_out.items() if reason.startswith(WITHOUT_POSE))
    if without <= FEW * (frames + without):
        return ""
    return (
        f"only {frames} of {frames + without} frames have a pose, and the rest is not in the map: give a "
        "trajectory of all (--trajectory FILE, --option max_gap_s=SECONDS bridges gaps), or let "
        "`tsfusion scan` find them"
    )


def of_unreadable(frames: int, left_out: Mapping[str, int]) -> str:
    """Return a line if many frames of a recording cannot be read, else an empty text."""
    bad = left_out.get(UNREADABLE, 0)
    if bad <= FEW * frames:
        return ""
    return f"{bad} of {frames} frames cannot be read, and are not in the map: see the first of them above"


def of_tracking(frames: int, tracked: int, why: str, *, localizer: str = "rgbd", maps: int = 1) -> str:
    """Return a line if frames were lost; an empty text if nearly all have a pose in one map.

    Args:
        why: why the sensor was lost the last time.
        maps: number of maps of the scan.
    """
    if frames - tracked <= FEW * frames and maps < 2:
        return ""
    pieces = f", in {maps} maps" if maps > 1 else ""
    found = f"only {tracked} of {frames} frames were localised{pieces}"
    return f"the sensor was lost ({why}): {found}; {cure_of_tracking(localizer)}"


def together(shortfalls: Iterable[str]) -> str:
    """Join all shortfalls in one line; empty if there are none."""
    return "; ".join(filter(None, shortfalls))


def _never(counts: dict[str, int]) -> str:
    reasons = ", ".join(f"{count} × {reason}" for reason, count in counts.items())
    return f"{count_of(sum(counts.values()), 'keyframe')} will never be at the server ({reasons})"
