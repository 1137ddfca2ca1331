# SPDX-License-Identifier: MIT
"""Does the colour lie on the depth? Edges of the depth images are compared with edges of the colour images.

Where a surface ends in the depth, the colour usually changes too. The mean colour gradient under the depth's
edges, over the mean gradient of the image, is about 2 where colour is registered and 1.2 where it is not.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.geometry.frame import Frame

MAX_WIDTH = 320  # pixels of the images compared
MAX_SHIFT = 12  # of these pixels, in x and y
SCALES = (0.84, 0.88, 0.92, 0.96, 1.04, 1.08, 1.12, 1.16)  # of the colour image, tried beside 1
MAX_FRAMES = 8
DEPTH_JUMP = 0.1  # of the depth: an edge of a surface
MIN_EDGES = 0.005  # share of a depth image's pixels on such edges
FLAT_GRADIENT = 8  # grey levels a pixel; weaker gradients count less
GOOD_AGREEMENT = 1.7  # at least: colour lies on the depth
MIN_LEAD = 0.3  # by which edges must agree better elsewhere than where they are
MIN_TIME_LEAD = 0.15  # the same, with the colour of the frame before or after
MIN_VOTES = 0.8  # share of the frames of which that holds
MIN_ERRORS = 3.0  # standard errors by which edges must agree better, too
SAME_SHIFT = 3  # of these pixels: what half of the frames' own shifts may differ from the common one, at most


@dataclass(frozen=True, eq=False)
class Outlines:
    """Edges of one frame's depth and of its image, both (h, w) float32.

    Attributes:
        depth: 0 to 1.
        image: strength of the image's gradient where the surroundings have mean 1.
        pixel: pixels of the frame a pixel here.
    """

    depth: NDArray[np.float32]
    image: NDArray[np.float32]
    pixel: int


def outlines(frame: Frame) -> Outlines | None:
    """Edges of a frame; None without colour or depth image, or where the depth has hardly an edge."""
    depth, gray = frame.depth_m, frame.gray
    if depth is None or gray is None:
        return None
    pixel = -(-depth.shape[1] // MAX_WIDTH)
    size = max(1, depth.shape[1] // pixel), max(1, depth.shape[0] // pixel)
    if min(size) < 4 * MAX_SHIFT:
        return None
    edges = _depth_edges(
        _resized(cv2.dilate(depth, np.ones((pixel + 1, pixel + 1))), size, cv2.INTER_NEAREST)
    )
    if edges.mean() < MIN_EDGES:
        return None
    return Outlines(_blurred(edges, 1.0), _gradient(_resized(gray, size, cv2.INTER_AREA)), pixel)


def _depth_edges(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    least = cv2.erode(np.where(depth > 0, depth, np.float32(1e9)), np.ones((3, 3)))
    most = cv2.dilate(depth, np.ones((3, 3)))
    edges: NDArray[np.float32] = ((depth > 0) & (most - least > DEPTH_JUMP * most)).astype(np.float32)
    return edges


def _gradient(gray: NDArray[Any]) -> NDArray[np.float32]:
    smooth = _blurred(gray.astype(np.float32), 0.8)
    strength = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1))
    strength /= _blurred(strength, 8.0) + FLAT_GRADIENT
    return np.asarray(strength / max(float(strength.mean()), 1e-6), np.float32)


def _resized(image: NDArray[Any], size: tuple[int, int], how: int) -> NDArray[Any]:
    return np.asarray(cv2.resize(image, size, interpolation=how))


def _blurred(image: NDArray[np.float32], sigma: float) -> NDArray[np.float32]:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma), np.float32)


def misplaced_color(frames: Mapping[int, Outlines | None]) -> str | None:
    """One sentence on colour of another time, or elsewhere than the depth; None where nothing is sure.

    Args:
        frames: edges by index of the frame.
    """
    seen = {index: each for index, each in frames.items() if each is not None}
    if len({each.depth.shape for each in seen.values()}) != 1:
        return None
    every = max(1, -(-len(seen) // MAX_FRAMES))
    return _other_time(seen) or _other_place([seen[index] for index in sorted(seen)[::every]])


def _other_time(seen: Mapping[int, Outlines]) -> str | None:
    """Sentence on colour that lies better on the depth of the frame after, or before; None = it does not."""
    neighbours = [(seen[index], seen[index + 1]) for index in seen if index + 1 in seen]
    if len(neighbours) < 2:
        return None
    own = np.array([(_agreement(a, a) + _agreement(b, b)) / 2 for a, b in neighbours])
    after = np.array([_agreement(a, b) for a, b in neighbours])
    before = np.array([_agreement(b, a) for a, b in neighbours])
    for other, way in ((after, "late"), (before, "early")):
        if _is_sure(other - own, MIN_TIME_LEAD):
            neighbour = "after" if way == "late" else "before"
            return (
                f"the colour is about one frame {way}: the depth's edges lie on those of the colour image "
                f"{neighbour} it; match colour and depth by their time stamps"
            )
    return None


def _agreement(depth: Outlines, color: Outlines) -> float:
    """Mean gradient of one frame's colour under the depth's edges of another."""
    return float((depth.depth * color.image).sum() / max(float(depth.depth.sum()), 1e-6))


def _other_place(seen: list[Outlines]) -> str | None:
    """Sentence on colour that lies clearly better on the depth when moved or scaled; None = it does not."""
    if len(seen) < 2:
        return None
    unscaled = _agreement_by_shift(seen, 1.0)
    near = unscaled[:, MAX_SHIFT - 1 : MAX_SHIFT + 2, MAX_SHIFT - 1 : MAX_SHIFT + 2]
    here = near.max(axis=(1, 2))
    if here.mean() > GOOD_AGREEMENT:
        return None
    agreement = {1.0: unscaled, **{scale: _agreement_by_shift(seen, scale) for scale in SCALES}}
    scale = max(agreement, key=lambda factor: agreement[factor].mean(axis=0).max())
    mean = agreement[scale].mean(axis=0)
    row, column = np.unravel_index(int(mean.argmax()), mean.shape)
    there = agreement[scale][:, row, column]
    own = np.array([np.unravel_index(int(each.argmax()), each.shape) for each in agreement[scale]])
    stray = np.abs(own - [row, column]).max(axis=1)
    at_border = {int(row), int(column)} & {0, 2 * MAX_SHIFT}  # and better beyond, perhaps
    if at_border or not _is_sure(there - here, MIN_LEAD) or np.median(stray) > SAME_SHIFT:
        return None
    shift = (int(column) - MAX_SHIFT) * seen[0].pixel, (int(row) - MAX_SHIFT) * seen[0].pixel
    return (
        f"the colour is not registered to the depth: its edges lie {_place_text(shift, scale)}; the shape is "
        "not touched, but its colours will be misplaced: register colour and depth before (cameras' own "
        "software does it: align, registered, transformed)"
    )


def _is_sure(leads: NDArray[np.floating], least: float) -> bool:
    """True if edges agree better elsewhere in nearly all frames, and by more than chance."""
    error = float(leads.std(ddof=1)) / np.sqrt(len(leads))
    mean = float(leads.mean())
    return bool(mean > max(least, MIN_ERRORS * error) and (leads > 0).mean() >= MIN_VOTES)


def _agreement_by_shift(seen: list[Outlines], scale: float) -> NDArray[np.float32]:
    """Agreement of each frame with its image scaled about its centre, then moved: (n, y, x) float32."""
    height, width = seen[0].depth.shape
    affine = np.array([[scale, 0, (1 - scale) * width / 2], [0, scale, (1 - scale) * height / 2]])
    inner = (slice(MAX_SHIFT, -MAX_SHIFT),) * 2
    return np.array(
        [
            cv2.matchTemplate(
                each.image if scale == 1 else cv2.warpAffine(each.image, affine, (width, height)),
                each.depth[inner],
                cv2.TM_CCORR,
            )
            / max(float(each.depth[inner].sum()), 1e-6)
            for each in seen
        ]
    )


def _place_text(shift: tuple[int, int], scale: float) -> str:
    sides = ("right of", "left of"), ("below", "above")
    moved = [
        f"{abs(pixels)} px {side[0] if pixels > 0 else side[1]}"
        for pixels, side in zip(shift, sides, strict=True)
        if pixels
    ]
    place = f"about {' and '.join(moved)} the depth's" if moved else "elsewhere than the depth's"
    if scale == 1:
        return place
    return f"{place}, in an image about {abs(1 / scale - 1):.0%} {'larger' if scale < 1 else 'smaller'}"
