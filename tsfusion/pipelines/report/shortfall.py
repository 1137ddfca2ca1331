# SPDX-License-Identifier: MIT
"""Shortfalls of a run: what it was for and did not reach, in one line that says what to do.

One rule for all runs. A run reached its purpose when each keyframe that it sent is on the server's disk and
in one map (half of them, where the others have no sample in range), and nearly all frames have a pose. What
falls short of that still leaves its results; the command ends with the line, and with status 1.
"""

import os
from collections.abc import Iterable, Mapping

from tsfusion.client import Client, ClientStats
from tsfusion.core.readable_numbers import count_of
from tsfusion.datasets.dataset import CLOCK, UNREADABLE, WITHOUT_POSE
from tsfusion.geometry.sample_ranges import NO_SAMPLES
from tsfusion.geometry.sweeps import skewed

FEW = 0.05  # share of the frames that may be without a pose: more are a part of the scene
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
    if stats.rejected.keys() - {NO_SAMPLES} or 2 * rejected > stats.sent:
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
    """Say that many frames of a recording have no pose; empty = nearly all have.

    Args:
        frames: that are left.
        left_out: number of others by reason, as `Dataset.skipped` has them.
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
    """Say that many of a recording's frames cannot be read; empty = nearly all can."""
    bad = left_out.get(UNREADABLE, 0)
    if bad <= FEW * frames:
        return ""
    return f"{bad} of {frames} frames cannot be read, and are not in the map: see the first of them above"


def of_tracking(frames: int, tracked: int, why: str, *, localizer: str = "rgbd", maps: int = 1) -> str:
    """Say that frames were lost; empty = nearly all have a pose, in one map.

    Args:
        why: the sensor was lost the last time.
        maps: number of maps that the scan is in.
    """
    if frames - tracked <= FEW * frames and maps < 2:
        return ""
    pieces = f", in {maps} maps" if maps > 1 else ""
    found = f"only {tracked} of {frames} frames were localised{pieces}"
    return f"the sensor was lost ({why}): {found}; {cure_of_tracking(localizer)}"


def together(shortfalls: Iterable[str]) -> str:
    """All shortfalls in one line; empty = there are none."""
    return "; ".join(filter(None, shortfalls))


def _never(counts: dict[str, int]) -> str:
    reasons = ", ".join(f"{count} × {reason}" for reason, count in counts.items())
    return f"{count_of(sum(counts.values()), 'keyframe')} will never be at the server ({reasons})"
