# SPDX-License-Identifier: MIT
"""A scanner's picture, small enough to hang in a scene."""

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.wire import image_headers
from tsfusion.wire.record_header import Refused

_WIDTH = 320  # pixels
_MOST_PIXELS = 1 << 26


def small_picture(jpeg: bytes) -> NDArray[np.uint8] | None:
    """(h, w, 3) RGB of a JPEG, at most 320 pixels wide; None = it cannot be read."""
    try:
        height, width = image_headers.size(jpeg)
    except Refused:
        return None
    if height * width > _MOST_PIXELS:
        return None
    flag = cv2.IMREAD_REDUCED_COLOR_4 if width >= 8 * _WIDTH else cv2.IMREAD_COLOR
    flag = cv2.IMREAD_REDUCED_COLOR_2 if 4 * _WIDTH <= width < 8 * _WIDTH else flag
    image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), flag | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        return None
    if image.shape[1] > _WIDTH:
        size = (_WIDTH, max(1, round(image.shape[0] * _WIDTH / image.shape[1])))
        image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    return np.ascontiguousarray(image[..., ::-1])
