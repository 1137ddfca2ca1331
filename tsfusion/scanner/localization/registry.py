# SPDX-License-Identifier: MIT
"""Localizers by name. Without Taichi: they run on the scanner."""

import logging

from tsfusion.core.config import LocalizerName, ScanConfig
from tsfusion.core.errors import InvalidConfig, MissingDependency
from tsfusion.geometry.frame import Frame
from tsfusion.scanner.localization.localizer import Localizer, Lost, Pose, PoseCorrections

__all__ = ["Localizer", "Lost", "Pose", "PoseCorrections", "choose", "make"]

_BY_KIND: dict[str, LocalizerName] = {
    "depth": "rgbd",
    "disparity": "rgbd",
    "pair": "stereo",
    "points": "lidar",
}

_FOLLOWS: dict[str, tuple[str, ...]] = {
    "rgbd": ("depth", "disparity"),
    "stereo": ("pair", "depth", "disparity"),
    "lidar": ("points",),
}
_WORDS = {"rgbd": "depth images", "stereo": "stereo pairs, or depth with an image", "lidar": "points"}
_KINDS = {
    "depth": "depth images", "disparity": "disparity images", "pair": "stereo pairs", "points": "points"
}  # fmt: skip

log = logging.getLogger(__name__)


def choose(config: ScanConfig, first: Frame) -> LocalizerName:
    """The localizer's name: the config's, or for `auto` the one that follows such frames."""
    if config.localizer != "auto":
        return config.localizer
    if config.trajectory is not None:
        return "trajectory"
    if config.feed is not None:
        return "feed"
    return _BY_KIND[first.kind]


def make(config: ScanConfig, first: Frame) -> Localizer:
    """The localizer of `choose`, with loop closure where it follows images.

    Raises:
        InvalidConfig: when it lacks its file or address.
        MissingDependency: when it needs an optional package.
    """
    name = choose(config, first)
    if first.kind not in _FOLLOWS.get(name, (first.kind,)):
        raise InvalidConfig(
            f"the localizer {name} follows {_WORDS[name]}, and this source gives {_KINDS[first.kind]}"
        )
    if name == "given":
        from tsfusion.scanner.localization.given_poses import GivenPoses

        return GivenPoses()
    if name == "trajectory":
        from tsfusion.scanner.localization.given_poses import TrajectoryFilePoses

        return TrajectoryFilePoses(
            _needed(config.trajectory, "--trajectory FILE"),
            max_gap_s=config.max_gap,
            time_offset_s=config.time_offset,
        )
    if name == "feed":
        from tsfusion.scanner.localization.pose_feed.feed import PoseFeed

        return PoseFeed(
            _needed(config.feed, "--feed ADDRESS"), max_gap_s=config.max_gap, time_offset_s=config.time_offset
        )
    if name == "lidar":
        from tsfusion.scanner.localization.lidar import LidarLocalizer

        return LidarLocalizer()
    return _with_loops(_tracker(name), wanted=config.loop_closure)


def _needed(value: str | None, flag: str) -> str:
    if value is None:
        raise InvalidConfig(f"this localizer needs {flag}")
    return value


def _tracker(name: LocalizerName) -> Localizer:
    if name == "stereo":
        from tsfusion.scanner.localization.stereo.tracker import StereoLocalizer

        return StereoLocalizer()
    from tsfusion.scanner.localization.rgbd.tracker import RGBDLocalizer

    return RGBDLocalizer()


def _with_loops(tracker: Localizer, *, wanted: bool) -> Localizer:
    if not wanted:
        return tracker
    from tsfusion.scanner.localization.loop_closure.loop_closing import LoopClosing

    try:
        return LoopClosing(tracker)
    except MissingDependency as error:
        log.warning("no loop closure: %s", error)
        return tracker
