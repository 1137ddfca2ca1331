# SPDX-License-Identifier: MIT
"""Find the pose of a map in the coordinate frame of another map, and merge them, or refuse."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from tsfusion.core.config import VolumeConfig
from tsfusion.core.errors import AlignmentRefused, JournalError, MapError
from tsfusion.core.readable_numbers import count_of
from tsfusion.evaluation import surface_fit
from tsfusion.evaluation.surface_fit import SampledSurface, SeenDepth, SurfaceFit, SurfaceRegistration, fit
from tsfusion.geometry import se3
from tsfusion.geometry.keyframe import MAX_POINTS, Keyframe
from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.se3 import Transform
from tsfusion.journal import state_folder
from tsfusion.journal.journaled_keyframes import JournaledKeyframes
from tsfusion.pipelines.maps import journal_fusion
from tsfusion.pipelines.maps.journal_fusion import FusionProgress
from tsfusion.tsdf.files import map_history
from tsfusion.tsdf.store.block_store import pack_keys, unpack_keys
from tsfusion.tsdf.volume import Volume

MIN_OVERLAP = 0.15  # of the smaller surface
MAX_CONTRADICTED = 0.07  # more than of the maps' own surfaces
MIN_CONSTRAINT = 0.01
_MIN_MATCHES = 200  # cells
_CELL = 2.5  # voxels, at least
_CELLS = 100  # along the diagonal of the smaller map, at most
_SCALES = (1.0, 1.6)  # of the cell, at which features are looked for
_LAST_REACHES = (2.0, 1.0, 0.5)  # voxels, of the last refinement
_MOST_COMPARED, _MIN_COMPARED = 4096, 100  # blocks; points along a direction
_MOST_THROUGH = 0.16  # share of a surface in the other's free space; true pairs have up to 0.13 (a kitchen)
_PART_REACH = 6.0  # voxels within which a part looks for the other surface
_TOLERANCE = 1.5  # voxels within which two surfaces are one
_TILT = {"given": 10.0, "imu": 10.0, "floor": 20.0, "cameras": 30.0}  # degrees of error of the up direction
_VIEWS = 24  # keyframes of each journal whose depth is compared
_APART_DEG, _APART_CELLS = 10.0, 4.0  # two transforms that differ by more are two answers
_RIVAL = 0.85  # an answer with this share of the best answer's overlap is as good
_RIVAL_CONTRADICTED = 0.05  # but at most so much more contradicted


class Alignment(msgspec.Struct, kw_only=True):
    """Pose of a map B in a map A, and the evidence for it.

    Attributes:
        T_a_b: (4, 4) rows; p_a = T_a_b @ p_b.
        error_mm: estimated error of T_a_b: how far parts of the common surface disagree about the position of
            B, divided by `overlap`. A map that has drifted fits nowhere exactly.
        overlap, rmse_mm, constraint: see `SurfaceFit`; here the RMSE is in millimetres.
        contradicted: share of the surface points in view of the other map's sensors that these sensors looked
            through. Without keyframes: share of the points in free space before the other map's surface.
        looks: number of points in view.
        contradicted_alone: the same share for each map's own surface. Noise, thin things and drift cause it.
        tilt_deg: angle between the up directions of the maps; None if the up direction of a map is unknown.
    """

    T_a_b: list[list[float]]
    error_mm: float
    overlap: float
    rmse_mm: float
    constraint: float
    contradicted: float
    looks: int
    contradicted_alone: float
    tilt_deg: float | None


@dataclass(frozen=True, eq=False, kw_only=True)
class AlignedMap:
    """A map to be aligned.

    Attributes:
        mesh: its surface.
        views: some of its keyframes with their poses. Space that their cameras looked through is free.
        volume: its voxels, to look up the free space before its surface; None if another process has them.
        keyframes: keyframes of its journal; None without a journal.
        missing: number of its keyframes that the journal does not have.
        lost: number of keyframes (or more) that damage of the journal has cost.
    """

    name: str
    mesh: Mesh
    voxel_size: float
    views: Sequence[Keyframe] = ()
    volume: Volume | None = None
    keyframes: JournaledKeyframes | None = None
    missing: int = 0
    lost: int = 0


def map_of_volume(name: str, volume: Volume, views: Sequence[Keyframe] = ()) -> AlignedMap:
    """Return a map in memory, ready to be aligned."""
    mesh = volume.extract_mesh().without_islands()
    return AlignedMap(name=name, mesh=mesh, voxel_size=volume.config.voxel_size, views=views, volume=volume)


def open_map(source: Path, *, watch: FusionProgress = lambda *_: None) -> AlignedMap:
    """Open a map (.tsf), or the settled map of a state folder or a journal.

    Raises:
        CheckpointError, JournalError: when there is no map, or it cannot be read.
    """
    if not source.exists():
        raise JournalError(f"{source} does not exist; expected a map (.tsf), a state folder or a journal")
    if source.suffix == ".tsf":
        return map_of_volume(str(source), Volume.load(source))
    source = state_folder.resolve_map(source)
    made = journal_fusion.map_of(source, VolumeConfig(), watch=watch)
    keyframes = journal_fusion.choose(source)
    there = made.volume.keyframes + sum(made.left_out.values())
    views = [keyframes[index].keyframe for index in spread(len(keyframes))]
    found = map_of_volume(str(source), made.volume, views)
    missing = max(0, there - len(keyframes))
    return replace(found, keyframes=keyframes, missing=missing, lost=made.lost)


def align(a: AlignedMap, b: AlignedMap) -> Alignment:
    """Find the pose of map `b` in map `a`.

    Raises:
        AlignmentRefused: when the maps share too little surface, or several poses fit equally well.
        MissingDependency: without scipy.
    """
    for one in (a, b):
        if not len(one.mesh.faces):
            raise AlignmentRefused(f"{one.name} has no surface (yet), so nothing can be aligned with it")
    pair = _MapPair(a, b)
    answers = sorted((pair.judged(T) for T in pair.candidates()), key=lambda one: -one.score)
    if not answers:
        raise AlignmentRefused(f"no part of {b.name} looks like a part of {a.name}")
    pair.check(answers[0])
    answers += [pair.judged(T) for T in pair.turned(answers[0].T)]
    best = max(answers, key=lambda one: one.score)
    if rival := next((one for one in answers if pair.is_rival(one, best)), None):
        turn = se3.inverse(best.T) @ rival.T
        raise AlignmentRefused(
            f"{b.name} fits {a.name} in more than one way, {np.degrees(se3.angle(turn)):.0f}° and "
            f"{se3.distance(turn):.2f} m apart ({best.fit.overlap:.0%} and {rival.fit.overlap:.0%} of the "
            "smaller surface lie on the other); scan something that tells its sides apart"
        )
    best = pair.judged(pair.finished(best.T), fine=True)
    pair.check(best)
    return best.described(pair.contradicted_alone, pair.spread(best.T) / best.fit.overlap)


def check_one_frame(a: Volume, b: Volume, names: Sequence[object]) -> None:
    """Raise MapError unless the surfaces of two maps show that both are in one coordinate frame.

    In blocks that both maps have, the surface of a map must not lie in free space before the other's. The
    three directions of normals are judged separately, because the floors of two buildings always agree. Maps
    of different voxel sizes are not checked: they are not added in any case.

    Args:
        names: names of both maps, for the message.
    """
    if a.config.voxel_size != b.config.voxel_size:
        return
    cure = "merge them only if they are known to be in one frame (--same-frame), or after `map align`"
    ours, theirs = (pack_keys(one.blocks().coordinates) for one in (a, b))
    shared = unpack_keys(np.intersect1d(ours, theirs))
    chosen = shared[:: -(-len(shared) // _MOST_COMPARED) or 1]
    near, through, on, count = 1.5 * a.config.voxel_size, np.zeros(3), np.zeros(3), 1
    for one, other in ((a, b), (b, a)):
        mesh = one.extract_mesh(surface="raw", blocks=chosen)
        distance, direction = other.signed_distance(mesh.vertices), np.abs(mesh.normals).argmax(axis=1)
        through += np.bincount(direction[distance > near], minlength=3)
        on += np.bincount(direction[np.abs(distance) <= near], minlength=3)
        count += len(mesh.vertices)
    enough = through + on >= _MIN_COMPARED
    if (worst := float((through / np.maximum(through + on, 1))[enough].max(initial=0.0))) > _MOST_THROUGH:
        raise MapError(
            f"{names[0]} and {names[1]} contradict each other: {worst:.0%} of the surface of one lies in "
            f"free space before that of the other, as of two places or frames; {cure}"
        )
    if on.sum() / count * len(shared) < MIN_OVERLAP * min(len(ours), len(theirs)):
        raise MapError(
            f"{names[0]} and {names[1]} share too little to show that they are in one frame: less than "
            f"{MIN_OVERLAP:.0%} of the smaller one lies on the other; {cure}"
        )


class _Looks(NamedTuple):
    """Counts of surface points that a sensor looked through (`through`) or saw in place (`seen`)."""

    through: int
    seen: int

    @property
    def number(self) -> int:
        return self.through + self.seen

    @property
    def contradicted(self) -> float:
        return self.through / max(1, self.number)


@dataclass(frozen=True, eq=False)
class _JudgedTransform:
    """A transform, and the evidence for and against it."""

    T: Transform
    fit: SurfaceFit
    looks: _Looks
    tilt_deg: float | None

    @property
    def score(self) -> float:
        return self.fit.overlap * (1 - self.looks.contradicted) ** 2

    def described(self, contradicted_alone: float, error: float) -> Alignment:
        return Alignment(
            T_a_b=self.T.tolist(),
            error_mm=round(1e3 * error, 1),
            overlap=round(self.fit.overlap, 4),
            rmse_mm=round(1e3 * self.fit.rmse_m, 3),
            constraint=round(self.fit.constraint, 4),
            contradicted=round(self.looks.contradicted, 4),
            looks=self.looks.number,
            contradicted_alone=round(contradicted_alone, 4),
            tilt_deg=None if self.tilt_deg is None else round(self.tilt_deg, 2),
        )


class _MapPair:
    """Two maps that are to be aligned."""

    def __init__(self, a: AlignedMap, b: AlignedMap) -> None:
        self._a, self._b = a, b
        self._voxel = max(a.voxel_size, b.voxel_size)
        diagonal = min(float(np.linalg.norm(np.ptp(one.mesh.vertices, axis=0))) for one in (a, b))
        self._cell = max(_CELL * self._voxel, diagonal / _CELLS)
        self._coarse = self._sampled(self._cell)
        self._registration = SurfaceRegistration(*self._coarse)
        self._views = tuple(
            [SeenDepth(view, self._voxel) for view in one.views if view.kind != "points"] for one in (a, b)
        )
        own = self._looks_at(self._coarse[0].points, self._coarse[1].points)
        self.contradicted_alone = own.contradicted

    def candidates(self) -> list[Transform]:
        """Return distinct refined transforms, without those that tilt the up direction too far."""
        found: list[Transform] = []
        for scale in _SCALES:
            for T in SurfaceRegistration(*self._sampled(scale * self._cell)).candidates():
                refined = self._registration.refined(T)
                if self._is_upright(refined) and not any(self._is_same(refined, other) for other in found):
                    found.append(refined)
        return found

    def turned(self, T: Transform) -> list[Transform]:
        """Return rivals of `T` in a symmetric scene: refined quarter turns about the middle of map `b`."""
        points, _ = self._coarse[1].moved(T)
        middles = (np.median(points, axis=0), (points.min(axis=0) + points.max(axis=0)) / 2)
        up = self._a.mesh.up
        axes = np.eye(3) if up is None else np.array([up.direction])
        turns = [
            se3.transform(
                R := se3.exp(np.append(np.zeros(3), quarters * np.pi / 2 * axis))[:3, :3], m - R @ m
            )
            for m, axis, quarters in product(middles, axes, (1, 2, 3))
        ]
        return [self._registration.refined(turn @ T) for turn in turns]

    def finished(self, T: Transform) -> Transform:
        """Refine a transform once more, at the resolution of voxels."""
        return SurfaceRegistration(*self._sampled(self._voxel)).refined(T, _LAST_REACHES)

    def judged(self, T: Transform, *, fine: bool = False) -> _JudgedTransform:
        """Return the evidence for and against a transform; with `fine`, at the resolution of voxels."""
        surfaces = self._sampled(self._voxel) if fine else self._coarse
        moved = self._coarse[0].moved(se3.inverse(T))[0], self._coarse[1].moved(T)[0]
        looks = self._looks_at(moved[1], moved[0])
        return _JudgedTransform(T, fit(*surfaces, T, _TOLERANCE * self._voxel), looks, self._tilt(T))

    def spread(self, T: Transform) -> float:
        """Return by how many metres parts of the common surface disagree about the position of map `b`."""
        return surface_fit.parts_spread(*self._sampled(self._voxel), T, _PART_REACH * self._voxel)

    def _looks_at(self, for_a: NDArray[np.float64], for_b: NDArray[np.float64]) -> _Looks:
        """Return how many of the points the sensors looked through or saw in place, summed over both maps.

        Args:
            for_a, for_b: (n, 3) points that map `a` and map `b` judge, in that map's frame.
        """
        through = seen = 0
        for one, views, points in zip((self._a, self._b), self._views, (for_a, for_b), strict=True):
            looks = [view.looks(points) for view in views] or [self._in_free_space(one.volume, points)]
            through, seen = through + sum(one[0] for one in looks), seen + sum(one[1] for one in looks)
        return _Looks(through, seen)

    def check(self, best: _JudgedTransform) -> None:
        """Raise AlignmentRefused if the evidence for an answer is too weak. Rivals are not compared."""
        found, a, b = best.fit, self._a.name, self._b.name
        if found.matches < _MIN_MATCHES and found.overlap >= MIN_OVERLAP:
            raise AlignmentRefused(
                f"{b} and {a} are too small to tell: {found.matches} cells of their surfaces lie on each "
                f"other at best, {_MIN_MATCHES} are needed; scan more of what both show"
            )
        if found.overlap < MIN_OVERLAP:
            raise AlignmentRefused(
                f"{b} and {a} share too little: at best {found.overlap:.0%} of the smaller surface lies on "
                f"the other, {MIN_OVERLAP:.0%} are needed; scan more of what both show"
            )
        contradicted, most = best.looks.contradicted, self.contradicted_alone + MAX_CONTRADICTED
        if contradicted > most:
            raise AlignmentRefused(
                f"{b} does not fit {a}: at best {found.overlap:.0%} of the smaller surface would lie on the "
                f"other, but sensors of one looked through {contradicted:.0%} of what the other has there "
                f"({most:.0%} are allowed)"
            )
        if found.constraint < MIN_CONSTRAINT:
            raise AlignmentRefused(
                f"{b} can slide along {a}: what they share is too flat or too even to hold it (constraint "
                f"{found.constraint:.4f}, {MIN_CONSTRAINT} is needed); scan corners that both show"
            )

    def is_rival(self, one: _JudgedTransform, best: _JudgedTransform) -> bool:
        """True if an answer differs from the best and is about as good."""
        return (
            one.fit.overlap >= _RIVAL * best.fit.overlap
            and one.looks.contradicted <= best.looks.contradicted + _RIVAL_CONTRADICTED
            and self._is_upright(one.T)
            and not self._is_same(one.T, best.T)
        )

    def _sampled(self, cell: float) -> tuple[SampledSurface, SampledSurface]:
        return SampledSurface(self._a.mesh, cell), SampledSurface(self._b.mesh, cell)

    def _in_free_space(self, volume: Volume | None, points: NDArray[np.float64]) -> tuple[int, int]:
        """Count the points before a map's surface, and those on it, by their signed distances."""
        if volume is None:
            return 0, 0
        distance = volume.signed_distance(points)
        near = _TOLERANCE * self._voxel
        return int((distance > near).sum()), int((np.abs(distance) <= near).sum())

    def _tilt(self, T: Transform) -> float | None:
        up_a, up_b = self._a.mesh.up, self._b.mesh.up
        if up_a is None or up_b is None:
            return None
        cosine = np.array(up_a.direction) @ T[:3, :3] @ np.array(up_b.direction)
        return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))

    def _is_upright(self, T: Transform) -> bool:
        tilt, ups = self._tilt(T), (self._a.mesh.up, self._b.mesh.up)
        return tilt is None or tilt <= max(_TILT[up.found_by] for up in ups if up is not None)

    def _is_same(self, one: Transform, other: Transform) -> bool:
        middle = self._coarse[1].points.mean(axis=0)
        moved = np.linalg.norm(se3.apply(one, middle[None]) - se3.apply(other, middle[None]))
        turned = np.degrees(se3.angle(se3.inverse(one) @ other))
        return bool(moved < _APART_CELLS * self._cell and turned < _APART_DEG)


class Merge(NamedTuple):
    """Result of the addition of a map to another.

    Attributes:
        not_exact: why the result differs from a fusion of all keyframes of both maps; empty if it does not.
        left_out: reason → number of keyframes that the first map could not take.
    """

    not_exact: str
    left_out: dict[str, int]


def merge(
    volume: Volume, b: AlignedMap, T_a_b: Transform, *, watch: FusionProgress = lambda *_: None
) -> Merge:
    """Add map `b` to the volume of map `a`, at the pose `T_a_b`.

    With the journal of `b` the result is exact. Without it, the surface of `b` is added as points seen once.
    The volume no longer refers to its journal. A server cannot continue sessions of `b`, because their poses
    are in another frame.

    Raises:
        MapError: when both hold the same keyframes, as far as a server recorded them.
    """
    theirs = {} if b.volume is None else b.volume.meta
    map_history.check_addable(volume.meta, theirs, same_frame=True)
    aligned, sessions = volume.meta.get("aligned", ()), set(theirs.get("done", ()))
    if twice := sessions & {name for one in aligned for name in one["sessions"]}:
        raise MapError(
            f"{b.name} was merged into that map before (session {min(twice)[:8]}): it would count twice"
        )
    not_exact, left_out = "", dict[str, int]()
    if b.keyframes is None:
        not_exact = f"{b.name} has no journal: its surface was resampled"
        for keyframe in _surface_keyframes(b.mesh):
            volume.integrate(replace(keyframe, T_world_camera=T_a_b))
    else:
        sensor = b.volume.config.sensor if b.volume is not None else None
        left_out = journal_fusion.fuse(
            b.keyframes, volume, T_map_journal=T_a_b, sensor=sensor, watch=watch
        ).left_out
        if b.missing:
            not_exact = f"{count_of(b.missing, 'keyframe')} of {b.name} are not in its journal, and left out"
    entry = {"name": b.name, "T_map_other": np.array(T_a_b).tolist(), "sessions": sorted(sessions)}
    volume.meta = {**map_history.without_journal(volume.meta), "aligned": [*aligned, entry]}
    return Merge(not_exact, left_out)


def _surface_keyframes(mesh: Mesh) -> list[Keyframe]:
    """Return keyframes of points: the mesh's vertices, each seen from 1 m away along its normal."""
    found = []
    for first in range(0, len(mesh.vertices), MAX_POINTS):
        part = slice(first, first + MAX_POINTS)
        points, normals = mesh.vertices[part], mesh.normals[part]
        color = None if mesh.colors is None else mesh.colors[part, ::-1]
        found.append(Keyframe(points=points, origins=points + normals, color=color, T_world_camera=np.eye(4)))
    return found


def spread(count: int) -> list[int]:
    """Return at most 24 indices, spread evenly over `count` keyframes."""
    chosen = np.linspace(0, count - 1, min(count, _VIEWS)).round().astype(int)
    return [int(index) for index in chosen]
