# SPDX-License-Identifier: MIT
"""Find where and when a recording's colour lies beside its depth, by edges that both show.

An edge of depth is mostly an edge of colour. So depth edges are projected into colour images by cameras that
colour may have, and into those of neighbouring frames; the strongest gradients there tell place and time.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cache, cached_property, lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from tsfusion.core.errors import TsfusionError
from tsfusion.core.readable_numbers import count_of
from tsfusion.geometry.depth_registration import Registration
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.geometry.se3 import Transform

MAX_WIDTH = 320  # pixels, largest width of the images of edges
MAX_SHIFT = 12  # of these pixels, in x and y
SCALES = (0.84, 0.88, 0.92, 0.96, 1.04, 1.08, 1.12, 1.16)  # of the colour image, tried besides 1
MAX_FRAMES = 8
DEPTH_JUMP = 0.1  # of the depth; a larger jump is an edge
MIN_EDGES = 0.005  # share of a depth image's pixels that are on edges
FLAT_GRADIENT = 8  # grey levels a pixel; weaker gradients count less
GOOD_AGREEMENT = 1.7  # with more, colour is registered to depth
MIN_LEAD = 0.3  # by which edges must agree better after a shift
MIN_TIME_LEAD = 0.15  # by which edges must agree better with the colour of a neighbouring frame
MIN_VOTES = 0.8  # share of the frames that must agree better
MIN_ERRORS = 3.0  # standard errors by which edges must also agree better
SAME_SHIFT = 3  # of these pixels: median difference of the frames' own shifts from the common shift, at most
SPREAD = 24  # frames of a recording, evenly spread, that a place is found from
FEWEST = 6  # views with edges that show the place of a known camera
FEWEST_FITTED = 16  # views that a camera is fitted to and tried on, half of them each
SAME_VIEW = 0.5  # overlap of the depth edges of two frames that are one view
MIN_AGREEMENT = 1.4  # agreement with a found camera
PLACE_LEAD = 0.5  # by which edges must agree better with it: a late image in a quick turn leads by 0.35
NO_DEPTH_M = 1e9  # metres, in the place of no depth
MAX_POINTS = 3000  # depth edges of a frame that are projected
# A Kinect's colour camera, for 585 pixels of focal length in depth at 640 columns. It is not published, but
# was measured on 7-Scenes' RedKitchen by moving depth edges onto colour edges.
KINECT_COLOR, KINECT_BASELINE_M = Intrinsics(527.0, 527.0, 320.0, 237.5), -0.025
FIT_LEAD = 0.1  # by which edges must agree better with a fitted camera than with a Kinect's
STEPS = (0.01, 4.0, 4.0, 0.008)  # first steps of a fit: share of the focal length, pixels, pixels, metres
HALVINGS = 5  # of the steps
MAX_BASELINE_M = 0.1
FRAMES_LATE = (0, 1, -1, 2, -2, 3, -3)  # by which colour may be paired anew


@dataclass(frozen=True, eq=False)
class Outlines:
    """Edges in one frame's depth and in its image, both (h, w) float32.

    Attributes:
        depth: 0 to 1.
        image: strength of the image's gradient; its mean in the surroundings is 1.
        near_m: (h, w) float32 metres, depth of the nearest surface around a pixel.
        pixel: width of a pixel of `depth` and `image`, in pixels of the frame.
    """

    depth: NDArray[np.float32]
    image: NDArray[np.float32]
    near_m: NDArray[np.float32]
    pixel: int

    @cached_property
    def points(self) -> NDArray[np.float32]:
        """Pixels of the frame on depth edges, their depths in metres and their weights, (4, n)."""
        v, u = np.nonzero((self.depth > 0.1) & (self.near_m < NO_DEPTH_M))
        some = slice(None, None, max(1, len(u) // MAX_POINTS))
        u, v = u[some], v[some]
        place = (np.stack([u, v]) + 0.5) * self.pixel - 0.5
        return np.array([*place, self.near_m[v, u], self.depth[v, u]], np.float32)


def outlines(frame: Frame) -> Outlines | None:
    """Return the edges of a frame, or None without colour, without depth, or with few edges in depth."""
    depth, gray = frame.depth_m, frame.gray
    if depth is None or gray is None:
        return None
    pixel = -(-depth.shape[1] // MAX_WIDTH)
    size = max(1, depth.shape[1] // pixel), max(1, depth.shape[0] // pixel)
    if min(size) < 4 * MAX_SHIFT:
        return None
    small = _resized(cv2.dilate(depth, np.ones((pixel + 1, pixel + 1))), size, cv2.INTER_NEAREST)
    edges = _depth_edges(small)
    if edges.mean() < MIN_EDGES:
        return None
    near = _nearest(small, 5)
    return Outlines(_blurred(edges, 1.0), _gradient(_resized(gray, size, cv2.INTER_AREA)), near, pixel)


def _nearest(depth: NDArray[np.float32], width: int) -> NDArray[np.float32]:
    known = np.where(depth > 0, depth, np.float32(NO_DEPTH_M))
    return np.asarray(cv2.erode(known, np.ones((width, width))), np.float32)


def _depth_edges(depth: NDArray[np.float32]) -> NDArray[np.float32]:
    least = _nearest(depth, 3)
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
    """Return a sentence if colour is surely of another time, or shifted against the depth; else None.

    Args:
        frames: frame's index → its edges.
    """
    seen = {index: each for index, each in frames.items() if each is not None}
    if len({each.depth.shape for each in seen.values()}) != 1:
        return None
    every = max(1, -(-len(seen) // MAX_FRAMES))
    return _other_time(seen) or _other_place([seen[index] for index in sorted(seen)[::every]])


def _other_time(seen: Mapping[int, Outlines]) -> str | None:
    """Return a sentence if the depth fits the colour of the next or previous frame better, else None."""
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
    """Return the mean gradient of one frame's colour at the depth edges of another frame."""
    return float((depth.depth * color.image).sum() / max(float(depth.depth.sum()), 1e-6))


def _other_place(seen: list[Outlines]) -> str | None:
    """Return a sentence if colour fits the depth clearly better after a shift or scaling, else None."""
    found = _shifted(seen)
    if found is None:
        return None
    return (
        f"the colour is not registered to the depth: its edges lie {_place_text(*found)}; the shape is "
        "not touched, but its colours will be misplaced: register colour and depth before (cameras' own "
        "software does it: align, registered, transformed)"
    )


def _shifted(seen: list[Outlines]) -> tuple[tuple[int, int], float] | None:
    """Return the shift in pixels, and the scale, with which colour surely fits the depth better, or None."""
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
    at_border = {int(row), int(column)} & {0, 2 * MAX_SHIFT}  # the best shift may be larger
    if at_border or not _is_sure(there - here, MIN_LEAD) or np.median(stray) > SAME_SHIFT:
        return None
    return ((int(column) - MAX_SHIFT) * seen[0].pixel, (int(row) - MAX_SHIFT) * seen[0].pixel), scale


def _is_sure(leads: NDArray[np.floating], least: float) -> bool:
    """Return True if edges agree better in nearly all frames, and by more than chance."""
    error = float(leads.std(ddof=1)) / np.sqrt(len(leads))
    mean = float(leads.mean())
    return bool(mean > max(least, MIN_ERRORS * error) and (leads > 0).mean() >= MIN_VOTES)


def _agreement_by_shift(seen: list[Outlines], scale: float) -> NDArray[np.float32]:
    """Return each frame's agreement with its image, scaled about the centre and shifted: (n, y, x)."""
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


@dataclass(frozen=True, eq=False)
class ColorPlace:
    """Camera and time of a recording's colour beside its depth; `str` shows them.

    Attributes:
        camera: intrinsics of colour, its axes parallel to the depth camera's; None = the depth camera.
        baseline_m: x of the depth camera's origin in the colour camera's axes, metres.
        frames_late: so many frames later comes the image that belongs to a frame's depth.
    """

    camera: Intrinsics | None = None
    baseline_m: float = 0.0
    frames_late: int = 0

    def __str__(self) -> str:
        K, frames, texts = self.camera, count_of(abs(self.frames_late), "frame"), list[str]()
        if K is not None:
            texts.append(
                f"colour of another camera (f {K.fx:.0f} cx {K.cx:.0f} cy {K.cy:.0f}, "
                f"{1000 * abs(self.baseline_m):.0f} mm beside it, found by edges), registered"
            )
        if self.frames_late:
            texts.append(f"colour {frames} {'late' if self.frames_late > 0 else 'early'}, paired anew")
        return "; ".join(texts)

    def registered(self, frame: Frame, T_then_now: Transform | None = None) -> Frame:
        """Return the frame with the colour of its depth pixels.

        `T_then_now`: motion of the camera from depth to colour, (4, 4); None = none, or not known.
        """
        there = self.camera is None and T_then_now is None
        if there or frame.color is None or frame.depth_m is None or frame.intrinsics is None:
            return frame
        moved = (np.eye(4) if T_then_now is None else T_then_now).tobytes()
        registration = _registration(self, frame.intrinsics, frame.depth_m.shape, moved)
        return replace(frame, color=registration.color_of_depth(frame.color, frame.depth_m))

    def agreements(self, seen: Sequence[Outlines], depth: Intrinsics) -> NDArray[np.float64]:
        """Return the mean gradient of each frame's colour where this camera sees the depth edges, (n,)."""
        return np.array([self._agreement(each, depth) for each in seen])

    def _agreement(self, seen: Outlines, depth: Intrinsics) -> float:
        (u, v, z, weight), K = seen.points, self.camera or depth
        x = K.fx * ((u - depth.cx) / depth.fx + self.baseline_m / z) + K.cx
        y = K.fy * (v - depth.cy) / depth.fy + K.cy
        right, down = (((side + 0.5) / seen.pixel - 0.5).astype(np.float32)[:, None] for side in (x, y))
        found = cv2.remap(seen.image, right, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT)[:, 0]
        return float((found * weight).sum() / max(float(weight.sum()), 1e-6))

    def fitted(self, seen: Sequence[Outlines], depth: Intrinsics) -> "ColorPlace":
        """Return the place near this one with the best mean agreement."""
        best, most = self, float(self.agreements(seen, depth).mean())
        middle_m = float(np.median(np.concatenate([each.points[2] for each in seen])))
        for halving in range(HALVINGS):
            for axis in (1, 2, 0, 3, 1, 2, 0, 3):
                for side in (1, -1):
                    other = best._moved(axis, side * STEPS[axis] / 2**halving, middle_m)
                    mean = float(other.agreements(seen, depth).mean())
                    if mean > most and abs(other.baseline_m) <= MAX_BASELINE_M:
                        best, most = other, mean
        return best

    def _moved(self, axis: int, step: float, middle_m: float) -> "ColorPlace":
        """Return the place with another focal length, cx, cy or baseline. The latter keeps a middle depth."""
        assert self.camera is not None
        K, by = self.camera, [0.0] * 4
        by[axis] = step
        fx, fy = K.fx * (1 + by[0]), K.fy * (1 + by[0])
        moved = Intrinsics(fx, fy, K.cx + by[1] - fx * by[3] / middle_m, K.cy + by[2])
        return ColorPlace(moved, self.baseline_m + by[3])


@lru_cache(maxsize=4)
def _registration(place: ColorPlace, depth: Intrinsics, size: tuple[int, int], moved: bytes) -> Registration:
    T_color_depth = np.frombuffer(moved).reshape(4, 4).copy()
    T_color_depth[0, 3] += place.baseline_m
    return Registration(depth, place.camera or depth, T_color_depth, size)


def some_frames(count: int) -> list[int]:
    """Return the indices, spread over `count` frames, that a place is found from."""
    return [*map(int, np.linspace(0, count - 1, min(count, SPREAD)).round())]


def _views(edges: Iterable[Outlines]) -> list[Outlines]:
    """Return the edges of the frames that see something else than the frames before."""
    views: list[Outlines] = []
    for each in edges:
        if all(_overlap(each.depth, other.depth) < SAME_VIEW for other in views):
            views.append(each)
    return views


def _overlap(a: NDArray[np.float32], b: NDArray[np.float32]) -> float:
    return float((a * b).sum() / np.sqrt((a * a).sum() * (b * b).sum()))


def color_placement(read: Callable[[int], Frame], count: int) -> ColorPlace | None:
    """Return place and time of a recording's colour; None if it lies on the depth, or nobody can tell.

    `read`: frame by its index below `count`; a frame that raises an error is left out.
    """
    cameras = set[tuple[Intrinsics | None, tuple[int, ...]]]()

    @cache
    def edges(index: int) -> Outlines | None:
        with suppress(TsfusionError, cv2.error, OSError):
            frame = read(index) if 0 <= index < count else None
            cameras.update([(frame.intrinsics, frame.shape)] if frame else [])
            return None if frame is None else outlines(frame)
        return None

    some = [index for index in some_frames(count) if edges(index)]
    depth, size = min(cameras, key=str, default=(None, (0,)))
    if len(some) < FEWEST or len(cameras) > 1 or depth is None:
        return None
    late = _frames_late(edges, some[:: -(-len(some) // MAX_FRAMES)])
    paired = ((edges(index), edges(index + late)) for index in some)
    seen = [replace(deep, image=color.image) for deep, color in paired if deep and color]
    place = replace(_camera_place(seen, depth, size) or ColorPlace(), frames_late=late)
    return place if str(place) else None


def _frames_late(edges: Callable[[int], Outlines | None], some: list[int]) -> int:
    """Return by how many frames colour surely comes late; 0 also where a shift explains it as well."""

    def agreements(late: Sequence[int]) -> NDArray[np.float64]:
        rows = ([edges(index + each) for each in late] for index in some)
        return np.array(
            [[_agreement(row[0], one) for one in row if one] for row in rows if row[0] and all(row)]
        )

    found = agreements(FRAMES_LATE[:3])
    if len(found) and (found[:, 0].mean() < GOOD_AGREEMENT or found.mean(axis=0).argmax()):
        found = agreements(FRAMES_LATE)
    best = int(found.mean(axis=0).argmax()) if len(found) >= FEWEST else 0
    if best == 0 or not _is_sure(found[:, best] - found[:, 0], MIN_LEAD):
        return 0
    seen = [each for each in map(edges, some) if each]
    shifted = max(_agreement_by_shift(seen, scale).mean(axis=0).max() for scale in (1.0, *SCALES))
    return FRAMES_LATE[best] if found[:, best].mean() > shifted else 0


def _camera_place(edges: Sequence[Outlines], depth: Intrinsics, size: tuple[int, ...]) -> ColorPlace | None:
    """Return the place of the colour of some frames; None if it lies on the depth, or cannot be told.

    A camera is fitted to every other view, and has to agree with those between, too.
    """
    seen = _views(edges)
    if len(seen) < FEWEST:
        return None
    here = ColorPlace(depth, 0.0).agreements(seen, depth)
    if here.mean() > GOOD_AGREEMENT:
        return None
    known = _kinect(size[1])
    fit = _fit(seen, known, depth, size) if len(seen) >= FEWEST_FITTED else None
    found, tried = (known, slice(None)) if fit is None else (fit, slice(1, None, 2))
    there = found.agreements(seen[tried], depth)
    return found if there.mean() > MIN_AGREEMENT and _is_sure(there - here[tried], PLACE_LEAD) else None


def _fit(
    seen: Sequence[Outlines], known: ColorPlace, depth: Intrinsics, size: tuple[int, ...]
) -> ColorPlace | None:
    """Return a camera that surely agrees better than the known one, also in views it is not fitted to."""
    fitted, tried = seen[::2], seen[1::2]
    shifted = _shifted(list(fitted))
    if shifted is None:
        return None
    start = ColorPlace(_shifted_camera(depth, size, *shifted), 0.0)
    fits = [each.fitted(fitted, depth) for each in (known, start)]
    fit = max(fits, key=lambda each: each.agreements(fitted, depth).mean())
    lead = fit.agreements(tried, depth) - known.agreements(tried, depth)
    return fit if _is_sure(lead, FIT_LEAD) else None


def _shifted_camera(
    depth: Intrinsics, size: tuple[int, ...], shift: tuple[int, int], scale: float
) -> Intrinsics:
    """Return the camera whose image, scaled about its centre and shifted, lies on the depth."""
    height, width = size
    cx = (depth.cx + shift[0] - (1 - scale) * width / 2) / scale
    cy = (depth.cy + shift[1] - (1 - scale) * height / 2) / scale
    return Intrinsics(depth.fx / scale, depth.fy / scale, cx, cy)


def _kinect(columns: int) -> ColorPlace:
    camera = KINECT_COLOR if columns == 640 else KINECT_COLOR.scaled(columns / 640)
    return ColorPlace(camera, KINECT_BASELINE_M)
