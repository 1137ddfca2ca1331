# SPDX-License-Identifier: MIT
"""Images as textures take them: colours, the depth behind them, and how far each pixel is to be trusted."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry import se3
from tsfusion.geometry.keyframe import Keyframe, depth_metres

_SMALLEST = 8  # pixels of an image's side
_EDGE = 4.0  # pixels from an edge of the depth at which colour is trusted wholly: registration ends there
_JUMP = 0.05  # of the depth: an edge
_CLIPPED = 250  # grey levels from which a channel may have been any brightness
_CLIPPED_TRUST = 0.05


class PosedImages(Protocol):
    """Keyframes that can be read again and again, in the same order; None stands for one of no use."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> Keyframe | None: ...


class TextureImage(NamedTuple):
    """An image and what is known of its pixels; arrays of H × W.

    Attributes:
        number: of its keyframe.
        color: (H, W, 3) uint8 RGB.
        depth: float32 metres, 0 = none.
        clearness: float32 from 0 (no depth, or at its edge) to 1.
        trust: float32 from 0 to 1; low where the camera's range ended.
        T_camera_world: (4, 4) float64.
        camera: float32 fx, fy, cx, cy.
    """

    number: int
    color: NDArray[np.uint8]
    depth: NDArray[np.float32]
    clearness: NDArray[np.float32]
    trust: NDArray[np.float32]
    T_camera_world: NDArray[np.float64]
    camera: NDArray[np.float32]


def images(keyframes: PosedImages, chosen: Sequence[int] | None = None) -> Iterator[TextureImage]:
    """The keyframes with depth and colour images, one at a time.

    Args:
        chosen: their indices; None = all.
    """
    for index in range(len(keyframes)) if chosen is None else chosen:
        found = image_of(keyframes[index], index)
        if found is not None:
            yield found


def image_of(keyframe: Keyframe | None, index: int) -> TextureImage | None:
    """The image of a keyframe; None where it has none, as that of a LiDAR, or one of a few pixels."""
    if keyframe is None or keyframe.color is None or keyframe.intrinsics is None:
        return None
    if min(keyframe.shape) < _SMALLEST:
        return None
    depth = depth_metres(keyframe).astype(np.float32)
    K = keyframe.intrinsics
    color = np.ascontiguousarray(keyframe.color[..., ::-1])
    clipped = color.max(axis=2) >= _CLIPPED
    return TextureImage(
        index,
        color,
        depth,
        clearness_of(depth),
        np.where(clipped, np.float32(_CLIPPED_TRUST), np.float32(1)),
        se3.inverse(keyframe.T_world_camera),
        np.array([K.fx, K.fy, K.cx, K.cy], np.float32),
    )


def clearness_of(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """(H, W) float32: 0 at an edge of the depth or where it has none, 1 some pixels away from it."""
    square = np.ones((3, 3))
    least = cv2.erode(np.where(depth > 0, depth, np.float32(1e9)), square)
    most = cv2.dilate(depth, square)
    inner = (depth > 0) & (most - least < _JUMP * most)
    away = cv2.distanceTransform(inner.astype(np.uint8), cv2.DIST_L2, 3)
    return np.asarray(np.minimum(away / _EDGE, 1), np.float32)
