# SPDX-License-Identifier: MIT
"""Do the poses hold together? Every step of the trajectory, and frames of one place at distant times.

`pose_check` compares neighbours in a few places: a jump lies between two that it may not look at, and drift
between no two. A step that is unlike those around it is a jump where the frames fit the usual motion, too,
either clearly better than the given one, or as well while no sensor accelerates like that. Frames of one
place seen again show drift where they fit only after a shift, and frames beside them after the same.
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

AROUND = 3  # steps before and after one that show the usual motion
MOST_STEPS = 3  # whose frames are compared
UNUSUAL = 4.0  # times as far from the usual motion as nine tenths of all steps
SURE_FIT = 0.6  # that a correction must reach
SURE_GAIN = 0.15  # by which it must fit better
AS_GOOD = 0.02  # difference of two fits that counts as none
STRONGEST = 30.0  # m/s²; no sensor that is carried or driven accelerates more from frame to frame
VIOLENT = 100.0  # m/s², where the frames show nothing
COARSE = (16.0, 8.0, 4.0, 2.0)  # tolerances over the sensor's own, to search for a shift from far off
MOST_POSES = 300  # among which places seen again are searched for
MOST_REVISITS = 8
MIN_WAY = 1.0  # between two visits: metres over the depth, plus radians
SAME_VIEW = 0.5  # the same between two views of one place, at most
SAME_SHIFT = 0.4  # of a shift: its difference from that of the frames beside, at most
MIN_DRIFTED = 2  # pairs of visits


@dataclass(frozen=True)
class PoseFault:
    """A place where poses are surely wrong.

    Attributes:
        mistake: a step that was not made, or one place that has moved in the meantime.
        frames: indices of the two frames.
        metres: by how much.
    """

    mistake: Literal["jump", "drift"]
    frames: tuple[int, int]
    metres: float
    text: str


@dataclass(frozen=True, eq=False)
class _Track:
    """The frames with a pose: indices, (n, 4, 4) poses, (n,) seconds; not `timed` = at thirty a second."""

    indices: NDArray[np.intp]
    poses: Transform
    seconds: NDArray[np.float64]
    timed: bool


def find_fault(
    dataset: Dataset, compare: Callable[[int, int], FramePair | None], range_m: float
) -> PoseFault | None:
    """The first fault of a dataset's poses; None where none is sure.

    Args:
        compare: two frames by their indices; None where one has no surface.
        range_m: typical depth, metres.

    Raises:
        DatasetError: a frame cannot be read.
    """
    track = _track(dataset)
    if len(track.poses) < 2 * AROUND:
        return None
    return _jump(track, compare, range_m) or _drift(track, compare, range_m)


def apart(range_m: float) -> float:
    """Metres between two places of one surface that are more than noise of good poses, at a typical depth."""
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
    unusual &= off > UNUSUAL * np.percentile(off, 90)
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
    """Distance by which a step surely jumps, metres; 0 = none, or nobody can tell.

    Args:
        usual: motion that the steps around let expect; it is `moved` metres off, and needs a `force` in m/s².
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
        strange += best < MIN_FIT  # of one place by the poses, and yet they show nothing alike
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
    """Shift (3,) of a place (3,) that makes the pair fit: both in the world's axes, metres."""
    T = pair.poses[1] @ fitting @ se3.inverse(pair.poses[0])
    return np.asarray(se3.apply(T, place[None])[0] - place)


def _revisits(track: _Track, range_m: float) -> Iterator[tuple[int, int]]:
    """Places in the track of frames that see one place, with a long way between: the longest first."""
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
    """Two frames of a track in words, with their times where they are known."""
    numbers = f"frame {track.indices[first]} to {track.indices[second]}"
    if not track.timed:
        return numbers
    return f"{numbers} ({track.seconds[first]:.2f} s to {track.seconds[second]:.2f} s)"
