# SPDX-License-Identifier: MIT
"""Make a frame's measurement of the messages of a chosen sensor, whether recorded or live."""

import logging
from collections.abc import Callable
from typing import Any

import numpy as np

from tsfusion.datasets.cameras import DepthUnit
from tsfusion.datasets.readers import check_metres
from tsfusion.datasets.rosbag import bag_messages
from tsfusion.datasets.rosbag.topics import ChosenTopics, SensorOptions
from tsfusion.datasets.scan_files import Scan
from tsfusion.geometry.depth_registration import Registration
from tsfusion.geometry.se3 import Transform

log = logging.getLogger(__name__)


class MessageFrames:
    """Measurements of one sensor.

    Args:
        chosen: its topics and cameras.
        given: of its options, `depth_scale` and `color`.
        recorded_scale: metres per unit, as recorded; None = by REP 118.
    """

    _registration: Registration | None = (
        None  # of a separate colour camera; None = not needed, or not yet known
    )
    _is_told = False  # that nothing leads to it

    def __init__(
        self, chosen: ChosenTopics, given: SensorOptions, recorded_scale: float | None = None
    ) -> None:
        self._chosen, self._with_color = chosen, given.color
        self._float_scale = given.depth_scale or 1.0
        usual = DepthUnit(
            recorded_scale or 0.001, "as ROS has it" if recorded_scale is None else "as recorded"
        )
        self.depth_unit = (
            usual if chosen.camera is None else chosen.camera.depth_unit(given.depth_scale, usual)
        )

    def register(self, between: Callable[[str, str], Transform | None]) -> bool:
        """Register images of a separate colour camera from now on. Return False if nothing leads to it.

        Args:
            between: returns T_target_source of two frames, or None.
        """
        chosen, other = self._chosen, self._chosen.color_camera
        if other is None or chosen.camera is None or self._registration is not None:
            return True
        T_color_depth = between(other.frame, chosen.frame)
        if T_color_depth is None:
            if not self._is_told:
                words = (
                    "no transforms lead from %r to %r, so that colour cannot be registered and is left out"
                )
                log.warning(words, other.frame, chosen.frame)
                self._is_told = True
            return False
        own = other.camera
        self._registration = Registration(
            chosen.camera.intrinsics, own.intrinsics, T_color_depth, chosen.size, color_size=own.size
        )
        return True

    def scan(self, content: Any) -> Scan:
        """Return the points of a PointCloud2. Raises DatasetError."""
        found = bag_messages.cloud(content)
        return found if self._with_color else found._replace(color=None)

    def images(self, content: Any, beside: Any) -> dict[str, Any]:
        """Return fields of a `Frame` of a depth image with its colour, or of a left and a right image.

        Raises:
            DatasetError: a message contradicts itself, or the first message of its topic.
        """
        if self._chosen.modality == "stereo":
            return self._pair(content, beside)
        return self._depth(content, beside if self._with_color else None)

    def _depth(self, content: Any, beside: Any) -> dict[str, Any]:
        camera = self._chosen.camera
        assert camera is not None
        depth = bag_messages.depth(content)
        self._chosen.check_size(self._chosen.main, depth.shape)
        if depth.dtype == np.float32:
            depth = depth * np.float32(self._float_scale)
            check_metres(depth, "has floats")
        color = None if beside is None else bag_messages.color(beside)
        own = camera if self._chosen.color_camera is None else self._chosen.color_camera.camera
        depth, color = camera.depth(depth), None if color is None else own.color(color)
        scale = self.depth_unit.metres
        if color is not None and self._registration is not None:
            metres = np.nan_to_num(depth * (1.0 if depth.dtype == np.float32 else scale))
            color = self._registration.color_of_depth(color, metres.astype(np.float32))
        return {"depth": depth, "depth_scale": scale, "color": color, "intrinsics": camera.intrinsics}

    def _pair(self, left: Any, right: Any) -> dict[str, Any]:
        pairs = self._chosen.pairs
        assert pairs is not None
        flat = pairs.pair(bag_messages.gray(left), bag_messages.gray(right))
        color = pairs.pair(*[bag_messages.color(left)] * 2)[0] if self._with_color else None
        return {
            "left": flat[0], "right": flat[1], "color": color,
            "intrinsics": pairs.intrinsics, "baseline_fx": pairs.baseline_fx,
        }  # fmt: skip
