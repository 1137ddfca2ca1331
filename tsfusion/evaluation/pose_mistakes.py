# SPDX-License-Identifier: MIT
"""List the usual mistakes in poses, each with its correction; `pose_check` tries them."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry.se3 import Transform
from tsfusion.geometry.trajectory import quaternion, rigid

_MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])
_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_CAMERA_BODY = np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])  # x forward, z up


@dataclass(frozen=True)
class Content:
    """Properties of a dataset that the advice depends on.

    Attributes:
        measures: what the sensor measures.
        integer_depth: True if depth is stored as integers of some unit.
        quaternions: True if the rotations were read as quaternions, False for matrices.
        kitti: True for a dataset of KITTI.
    """

    measures: Literal["depth", "disparity", "points"] = "depth"
    integer_depth: bool = True
    quaternions: bool = False
    kitti: bool = False

    def holds(self, mistake: str) -> bool:
        """Return True if the mistake is possible in the dataset."""
        return self.quaternions or not mistake.startswith("quaternion")


@dataclass(frozen=True)
class Mistake:
    """One way to misread poses.

    Attributes:
        name: short, for programs.
        text: the mistake and its remedy, for measurements that are images.
        intended: function from a given pose to the intended pose, up to the choice of the world's axes. The
            result may be a reflection: only `inv(intended_j) @ intended_i`, a rigid motion, is used.
        scan_text: the same as `text` for a LiDAR; None = `text`.
        matrix_text: the same as `text` for rotations given as matrices; None = `text`.
        kitti_text: addition to the text for KITTI.
    """

    name: str
    text: str
    intended: Callable[[Transform], NDArray[np.float64]]
    scan_text: str | None = None
    matrix_text: str | None = None
    kitti_text: str = ""

    def text_for(self, content: Content) -> str:
        """Return the mistake and its remedy, in words that suit the dataset."""
        text = self.text
        if self.scan_text is not None and content.measures == "points":
            text = self.scan_text
        elif self.matrix_text is not None and not content.quaternions:
            text = self.matrix_text
        return text + (self.kitti_text if content.kitti else "")


def _reordered_quaternion(order: list[int]) -> Callable[[Transform], Transform]:
    def intended(T: Transform) -> Transform:
        return rigid(quaternion(T[:3, :3])[order], T[:3, 3])

    return intended


def _conjugated(T: Transform) -> Transform:
    intended: Transform = np.array(T)
    intended[:3, :3] = T[:3, :3].T
    return intended


def _inverse(T: Transform) -> NDArray[np.float64]:
    return np.asarray(np.linalg.inv(T), np.float64)


MISTAKES: tuple[Mistake, ...] = (
    Mistake(
        "inverse",
        "the poses are world-to-camera; camera-to-world is expected: invert each",
        _inverse,
        scan_text="the poses are world-to-sensor; sensor-to-world is expected: invert each",
    ),
    Mistake(
        "opengl",
        "the poses are of a camera with OpenGL axes (y up, z back), not OpenCV's (y down, z forward): "
        "multiply each from the right by diag(1, -1, -1, 1)",
        lambda T: np.asarray(T @ _OPENGL),
        scan_text="the poses are of a body whose y and z axes point the other way than the sensor's (z down, "
        "not up): multiply each from the right by diag(1, -1, -1, 1)",
    ),
    Mistake(
        "inverse opengl",
        "the poses are world-to-camera and of a camera with OpenGL axes (a view matrix): invert each, then "
        "multiply from the right by diag(1, -1, -1, 1)",
        lambda T: np.asarray(_inverse(T) @ _OPENGL),
        scan_text="the poses are world-to-sensor and of a body whose y and z axes point the other way than "
        "the sensor's: invert each, then multiply from the right by diag(1, -1, -1, 1)",
    ),
    Mistake(
        "mirror",
        "one of depth and poses is mirrored up-down: fy should have the other sign, or the poses are "
        "left-handed (Unity)",
        lambda T: np.asarray(T @ _MIRROR),
        scan_text="one of points and poses is mirrored: y should have the other sign, or the poses are "
        "left-handed (Unity)",
    ),
    Mistake(
        "inverse mirror",
        "the poses are world-to-camera and mirrored up-down: invert each; fy should have the other sign, or "
        "they are left-handed (Unity)",
        lambda T: np.asarray(_inverse(T) @ _MIRROR),
        scan_text="the poses are world-to-sensor and mirrored: invert each; y should have the other sign, or "
        "they are left-handed (Unity)",
    ),
    Mistake(
        "body axes",
        "the poses are of a body with x forward and z up, the measurement of a camera with z forward: "
        "multiply each pose from the right by the camera's pose in the body",
        lambda T: np.asarray(T @ _CAMERA_BODY.T),
    ),
    Mistake(
        "camera axes",
        "a change from camera to body axes was made the wrong way round, or twice: multiply each pose from "
        "the right by the body's axes in the camera",
        lambda T: np.asarray(T @ _CAMERA_BODY),
        scan_text="the poses are of a camera with z forward, the measurement of a sensor with x forward and "
        "z up: multiply each pose from the right by the sensor's pose in the camera",
        kitti_text=" (Tr)",
    ),
    Mistake(
        "quaternion wxyz",
        "the quaternions are in the order w x y z and were read as x y z w: reorder them",
        _reordered_quaternion([1, 2, 3, 0]),
        matrix_text="the rotation matrices were made from quaternions in the order w x y z as if it were "
        "x y z w: make them again",
    ),
    Mistake(
        "quaternion xyzw",
        "the quaternions are in the order x y z w and were read as w x y z: reorder them",
        _reordered_quaternion([3, 0, 1, 2]),
        matrix_text="the rotation matrices were made from quaternions in the order x y z w as if it were "
        "w x y z: make them again",
    ),
    Mistake(
        "conjugate",
        "the rotations are transposed (conjugate quaternions), the translations are right: transpose them",
        _conjugated,
        matrix_text="the rotations are transposed, the translations are right: transpose each 3×3 part",
    ),
)
IN_WORLD = Mistake(
    "points in the world",
    "the points seem to be in the world already, and the poses move them a second time: move "
    "them into the sensor's frame by the inverse of each pose, or find poses by `tsfusion scan`",
    lambda T: np.eye(4),
)  # of scans alone

# Factors that correct the translations. Dividing the depth by the factor is the same.
SCALES: tuple[tuple[float, str], ...] = (
    (0.001, "the translations are in millimetres, metres are expected: divide them by 1000"),
    (0.01, "the translations are in centimetres, metres are expected: divide them by 100"),
    (0.1, "depth is ten times too small, or the translations too large: check the depth scale"),
    (0.2, "depth is 5 times too small: its unit is 1 mm (1/1000) where 1/5000 was taken"),
    (1000 / 6553.5, "depth is 6.55 times too small: its unit is 1 mm (1/1000) where 1/6553.5 was taken"),
    (5.0, "depth is 5 times too large: its unit is 1/5000 m (TUM) where 1 mm (1/1000) was taken"),
    (6.5535, "depth is 6.55 times too large: its unit is 1/6553.5 m where 1 mm (1/1000) was taken"),
    (10.0, "depth is ten times too large: its unit is 0.1 mm where 1 mm was taken"),
    (100.0, "the translations are 100 times too small, or depth is in centimetres where metres were taken"),
    (1000.0, "depth is 1000 times too large (millimetres taken for metres), or the translations too small"),
)


_DEPTH_UNITS = (0.1, 0.2, 1000 / 6553.5, 5.0, 6.5535, 10.0)  # factors that mean integers in another unit


def scale_text(factor: float, content: Content) -> str:
    """Return the mistake and its remedy if translations must be multiplied by a factor, to become metres."""
    known = dict(SCALES)
    units = content.measures == "depth" and content.integer_depth
    if factor in known and (units or factor not in _DEPTH_UNITS):
        text = known[factor]
        return text if content.measures == "depth" else text.replace("depth", _MEASUREMENT[content.measures])
    size = f"{1 / factor:.3g} times too large" if factor < 1 else f"{factor:.3g} times too small"
    where = {
        "depth": "the depth scale" if content.integer_depth else "the unit of the depth",
        "disparity": "the baseline, the intrinsics",
        "points": "the unit of the points",
    }[content.measures]
    return (
        f"the translations are {size} for the {_MEASUREMENT[content.measures]} (no usual unit): check "
        f"{where} and where the poses come from"
    )


_MEASUREMENT = {"depth": "depth", "disparity": "stereo depth", "points": "range"}


def alternatives_text(alternatives: tuple[str, ...]) -> str:
    """Return the end of a sentence that names a mistake: others that fit as well; empty without any."""
    return f" (these would fit as well: {', '.join(alternatives)})" if alternatives else ""


def not_ruled_out_text(alternatives: tuple[str, ...]) -> str:
    """Return the end of a sentence that poses agree: mistakes that are still possible; empty without any."""
    if not alternatives:
        return ""
    return (
        f", but so would poses that are wrong in one of these ways: {', '.join(alternatives)}; the sensor "
        "moves too little or too straight here to tell them apart"
    )
