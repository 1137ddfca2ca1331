# SPDX-License-Identifier: MIT
"""Choose and construct the localizer that fits a scan's settings and its first frame."""

import logging

from tsfusion.core.config import LocalizerName, ScanConfig
from tsfusion.core.errors import InvalidConfig, MissingDependency
from tsfusion.geometry.frame import Frame
from tsfusion.scanner.localization.localizer import Localizer

_DEFAULT_FOR_KIND: dict[str, LocalizerName] = {
    "depth": "rgbd",
    "disparity": "rgbd",
    "pair": "stereo",
    "points": "lidar",
}

_ACCEPTED_KINDS: dict[str, tuple[str, ...]] = {
    "rgbd": ("depth", "disparity"),
    "stereo": ("pair", "depth", "disparity"),
    "lidar": ("points",),
}
_INPUT_NAMES = {"rgbd": "depth images", "stereo": "stereo pairs, or depth with an image", "lidar": "points"}
_KIND_NAMES = {
    "depth": "depth images",
    "disparity": "disparity images",
    "pair": "stereo pairs",
    "points": "points",
}

log = logging.getLogger(__name__)


def localizer_name(config: ScanConfig, first: Frame) -> LocalizerName:
    """Return the localizer's name: from the setting, or with `auto` by the kind of the first frame."""
    if config.localizer != "auto":
        return config.localizer
    if config.trajectory is not None:
        return "trajectory"
    if config.feed is not None:
        return "feed"
    return _DEFAULT_FOR_KIND[first.kind]


def create_localizer(config: ScanConfig, first: Frame) -> Localizer:
    """Construct the localizer given by `localizer_name`. If it tracks images, add loop closure.

    Raises:
        InvalidConfig: the localizer's file or address is missing, or it cannot track frames of this kind.
        MissingDependency: the localizer's optional package is not installed.
    """
    name = localizer_name(config, first)
    if first.kind not in _ACCEPTED_KINDS.get(name, (first.kind,)):
        raise InvalidConfig(
            f"the localizer {name} follows {_INPUT_NAMES[name]}, "
            f"and this source gives {_KIND_NAMES[first.kind]}"
        )
    where = {"max_gap_s": config.max_gap, "time_offset_s": config.time_offset}
    if name == "given":
        from tsfusion.scanner.localization.given_poses import GivenPoses

        return GivenPoses()
    if name == "trajectory":
        from tsfusion.scanner.localization.given_poses import TrajectoryFilePoses

        file = _required(config.trajectory, "--trajectory FILE")
        return TrajectoryFilePoses(file, origin=config.origin, **where)
    if name == "feed":
        from tsfusion.scanner.localization.pose_feed.feed import PoseFeed

        return PoseFeed(_required(config.feed, "--feed ADDRESS"), **where)
    if name == "lidar":
        from tsfusion.scanner.localization.lidar import LidarLocalizer

        return LidarLocalizer()
    return _with_loops(_tracker(name)) if config.loop_closure else _tracker(name)


def _required(value: str | None, flag: str) -> str:
    if value is None:
        raise InvalidConfig(f"this localizer needs {flag}")
    return value


def _tracker(name: LocalizerName) -> Localizer:
    if name == "stereo":
        from tsfusion.scanner.localization.stereo.stereo_tracker import StereoLocalizer

        return StereoLocalizer()
    from tsfusion.scanner.localization.rgbd.rgbd_tracker import RGBDLocalizer

    return RGBDLocalizer()


def _with_loops(tracker: Localizer) -> Localizer:
    from tsfusion.scanner.localization.loop_closure.loop_closing import LoopClosing

    try:
        return LoopClosing(tracker, beside=True)
    except MissingDependency as error:
        log.warning("no loop closure: %s", error)
        return tracker
