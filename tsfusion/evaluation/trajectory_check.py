# SPDX-License-Identifier: MIT
"""Check a whole trajectory for jumps between frames, and for drift between distant visits of one scene.

`pose_check` compares neighbouring frames at a few times. It can miss the two frames of a jump, and sees no
drift. A step unlike the steps around it is a jump in two cases: the frames fit the usual motion clearly
better, or they fit it equally well and no sensor accelerates like that. Two frames of one scene, seen again
later, show drift if they fit only after a shift, and the frames beside them fit after the same shift.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from tsfusion.datasets.dataset import NOMINAL_NS, Dataset, pose_of, readable
from tsfusion.evaluation.frame_pairs import MIN_FIT, FramePair, best_near
from tsfusion.geometry import se3
from tsfusion.geometry.se3 import Transform

AROUND = 3  # steps before and after a step, which show the usual motion
MOST_STEPS = 3  # steps whose frames are compared
UNUSUAL = 4.0  # times the distance from the usual motion that nine tenths of all steps have
SURE_FIT = 0.6  # fit that a correction must reach
SURE_GAIN = 0.15  # increase of the fit that a correction must give
AS_GOOD = 0.02  # two fits with a smaller difference count as equal
STRONGEST = 30.0  # m/s²; no sensor that is carried or driven accelerates more from frame to frame
VIOLENT = 100.0  # m/s²; a jump even if the frames show nothing
COARSE = (16.0, 8.0, 4.0, 2.0)  # factors on the sensor's tolerance, to find a large shift
MOST_POSES = 300  # poses among which later visits are searched
MOST_REVISITS = 8
MIN_WAY = 1.0  # between two visits: metres divided by the depth, plus radians
SAME_VIEW = 0.5  # the same measure between two views of one scene, at most
SAME_SHIFT = 0.4  # of a shift: largest difference from the shift of the frames beside
MIN_DRIFTED = 2  # pairs of visits that must show drift


@dataclass(frozen=True)
class PoseFault:
    """Two frames between which poses are surely wrong.

    Attributes:
        mistake: `jump` = a step that was not made; `drift` = one scene at two positions.
        frames: indices of the two frames.
        metres: size of the error.
    """

    mistake: Literal["jump", "drift"]
    frames: tuple[int, int]
    metres: float
    text: str


@dataclass(frozen=True, eq=False)
class _Track:
    """Frames with a pose: indices, (n, 4, 4) poses, (n,) seconds, which are nominal unless `timed`."""

    indices: NDArray[np.intp]
    poses: Transform
    seconds: NDArray[np.float64]
    timed: bool


def find_fault(
    dataset: Dataset, compare: Callable[[int, int], FramePair | None], range_m: float
) -> PoseFault | None:
    """Return the first fault of a dataset's poses, or None if none is sure.

    Args:
        compare: function from two frame indices to the pair; it returns None if a frame has no surface.
        range_m: typical depth, metres.

    Raises:
        DatasetError: a frame cannot be read.
    """
    track = _track(dataset)
    if len(track.poses) < 2 * AROUND:
        return None
    return _jump(track, compare, range_m) or _drift(track, compare, range_m)


def apart(range_m: float) -> float:
    """Return the distance, metres, above which two positions of one surface are not noise of good poses."""
    return 0.02 + 0.03 * range_m


def _track(dataset: Dataset) -> _Track:
    poses = dict(readable(partial(pose_of, dataset), range(len(dataset))))
    found = {index: T for index, T in poses.items() if T is not None}
    indices, stamps = np.array(list(found), np.intp), dataset.timestamps_ns
    ns = NOMINAL_NS * indices if stamps is None else np.asarray(stamps)[indices]
    T_world_camera = np.array(list(found.values())).reshape(-1, 4, 4)
    return _Track(indices, T_world_camera, (ns - ns[:1]) / 1e9, stamps is not None)


def _jump(track: _Track, compare: Callable[[int, int], FramePair | None], range_m: float) -> PoseFault | None:
    steps = se3.log(se3.inverse(track.poses[:-1]) @ track.poses[1:])  # (n - 1, 6)
    seconds = np.diff(track.seconds)
    seconds = np.where(seconds > 0, seconds, max(float(np.median(seconds)), 1e-3))
    rates = steps / seconds[:, None]
    around = np.arange(len(steps))[:, None] + [*range(-AROUND, 0), *range(1, AROUND + 1)]
    inside = (around >= 0) & (around < len(steps))
    near = np.where(inside[..., None], rates[around.clip(0, len(steps) - 1)], np.nan)
    usual = np.nanmedian(near, axis=1) * seconds[:, None]
    moved, turned = (np.linalg.norm((steps - usual)[:, part], axis=1) for part in np.s_[:3, 3:])
    off, force = moved + range_m * turned, moved / seconds**2
    unusual = (off > apart(range_m)) | (moved > 0.05) & (force > STRONGEST)
    unusual &= off > UNUSUAL * min(np.percentile(off, 90), np.sort(off)[-3])  # one wrong pose has two steps
    for step in sorted(np.flatnonzero(unusual).tolist(), key=lambda step: -off[step])[:MOST_STEPS]:
        first, second = track.indices[step : step + 2].tolist()
        pair = compare(first, second)
        expected, is_timed = se3.inverse(se3.exp(usual[step])), track.timed
        if far := _jumped(pair, expected, range_m, moved=moved[step], force=force[step], is_timed=is_timed):
            text = f"the poses jump by {far:.2f} m from {_frames(track, step, step + 1)}"
            return PoseFault("jump", (first, second), round(float(far), 3), text)
    return None


def _jumped(
    pair: FramePair | None, usual: Transform, range_m: float, *, moved: float, force: float, is_timed: bool
) -> float:
    """Return the metres by which a step surely jumps, or 0 if it does not or is not sure.

    Args:
        usual: motion expected from the steps around; the step is `moved` m off, which takes `force` m/s².
    """
    by_force = moved if is_timed and force > VIOLENT else 0.0
    if pair is None:
        return by_force
    given, expected = pair.fit(pair.motion()), pair.fit(usual)
    best, motion = best_near(pair, usual)
    far = pair.shift(pair.motion(), motion)
    if best >= SURE_FIT and best - given > SURE_GAIN and far > apart(range_m):
        return far
    if max(given, expected) < MIN_FIT:
        return by_force
    return moved if expected >= given - AS_GOOD and force > STRONGEST else 0.0


def _drift(
    track: _Track, compare: Callable[[int, int], FramePair | None], range_m: float
) -> PoseFault | None:
    drifted, strange = [], 0
    for first, second in _revisits(track, range_m):
        pair = compare(int(track.indices[first]), int(track.indices[second]))
        if pair is None:
            continue
        best, fitting = best_near(pair, pair.motion(), coarse=COARSE)
        given = pair.fit(pair.motion())
        strange += best < MIN_FIT  # of one scene by the poses, but without a fit
        place = np.median(se3.apply(pair.poses[0], pair.first_view.points.T), axis=0)
        far = float(np.linalg.norm(_shift(pair, fitting, place)))
        if best < SURE_FIT or best - given < SURE_GAIN or far <= apart(range_m):
            continue
        step = 1 if second + 1 < len(track.indices) else -1
        beside = compare(*(int(track.indices[max(0, index + step)]) for index in (first, second)))
        if beside is None:
            continue
        _, moved = best_near(beside, beside.motion(), coarse=COARSE)
        difference = _shift(beside, moved, place) - _shift(pair, fitting, place)
        if np.linalg.norm(difference) < SAME_SHIFT * far:
            drifted.append((far, first, second))
    if not drifted or len(drifted) + strange < MIN_DRIFTED:
        return None
    far, first, second = max(drifted)
    text = f"the poses drift: what {_frames(track, first, second)} see of one place lies {far:.2f} m apart"
    return PoseFault("drift", (int(track.indices[first]), int(track.indices[second])), round(far, 3), text)


def _shift(pair: FramePair, fitting: Transform, place: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the shift (3,) in the world, metres, of the point `place` (3,), with which the pair fits."""
    T = pair.poses[1] @ fitting @ se3.inverse(pair.poses[0])
    return np.asarray(se3.apply(T, place[None])[0] - place)


def _revisits(track: _Track, range_m: float) -> Iterator[tuple[int, int]]:
    """Yield index pairs of frames that see one scene with a long path between them, longest first."""
    chosen = np.unique(np.linspace(0, len(track.poses) - 1, MOST_POSES).astype(np.intp))
    poses, steps = track.poses[chosen], np.diff(track.poses, axis=0)[:, :3, 3]
    R, t = poses[:, :3, :3], poses[:, :3, 3] / range_m
    turns = se3.rotation_vector(track.poses[:-1, :3, :3].swapaxes(1, 2) @ track.poses[1:, :3, :3])
    way = np.linalg.norm(steps, axis=1) / range_m + np.linalg.norm(turns, axis=1)
    gone = np.concatenate([[0.0], np.cumsum(way)])[chosen]
    turned = np.arccos(np.clip((np.einsum("aij,bij->ab", R, R) - 1) / 2, -1, 1))
    near = np.linalg.norm(t[:, None] - t, axis=2) + turned
    between = gone - gone[:, None]
    worth = np.where((between > MIN_WAY) & (near < SAME_VIEW) & (between > 3 * near), between - 4 * near, 0.0)
    apart_by = max(1, len(chosen) // 12)
    for _ in range(MOST_REVISITS):
        first, second = (int(index) for index in np.unravel_index(int(worth.argmax()), worth.shape))
        if not worth[first, second]:
            return
        yield int(chosen[first]), int(chosen[second])
        rows, columns = (slice(max(0, at - apart_by), at + apart_by + 1) for at in (first, second))
        worth[rows, columns] = 0.0


def _frames(track: _Track, first: int, second: int) -> str:
    """Return text that names two frames of a track, with their times if known."""
    numbers = f"frame {track.indices[first]} to {track.indices[second]}"
    if not track.timed:
        return numbers
    return f"{numbers} ({track.seconds[first]:.2f} s to {track.seconds[second]:.2f} s)"
