# SPDX-License-Identifier: MIT
"""Time, memory and accuracy of occupancy and distance fields: one JSON line a case.

A hall of 20 × 20 m with pillars at 5 cm (time), and the synthetic room at 2 cm (what is known of free space,
beside the map without space carving). CPU time, best and median of several runs.

    python lab/bench/distance_fields.py
"""

import argparse
import json
import time
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from tsfusion import Intrinsics, Keyframe, Volume
from tsfusion.datasets.worlds.synthetic import Synthetic
from tsfusion.geometry.map_grids import FREE

K, SHAPE = Intrinsics(160.0, 160.0, 159.5, 119.5), (240, 320)
PILLARS = [(x, y) for x in np.arange(-7.5, 8, 5) for y in np.arange(-7.5, 8, 5)]
RADIUS, HEIGHT, EYE, RANGE = 0.4, 3.0, 1.5, 8.0  # metres
BOX = (-10, -10, 10, 10)
HEIGHTS = (0.1, 1.8)


def hall(eye: NDArray[np.float64], yaw: float) -> Keyframe:
    """A view of the hall without noise."""
    forward = np.array([np.cos(yaw), np.sin(yaw), -0.25]) / np.hypot(1, 0.25)
    right = np.cross(forward, (0, 0, 1))
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    T[:3, 3] = eye
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    d = np.dstack([(u - K.cx) / K.fx, (v - K.cy) / K.fy, np.ones(SHAPE)]) @ T[:3, :3].T
    depth = np.full(SHAPE, np.inf)
    with np.errstate(all="ignore"):
        for axis, at in ((0, 10), (0, -10), (1, 10), (1, -10), (2, 0), (2, HEIGHT)):
            along = (at - eye[axis]) / d[..., axis]
            depth = np.where((along > 0) & (along < depth), along, depth)
        for x, y in PILLARS:
            a, b = (d[..., :2] ** 2).sum(-1), d[..., :2] @ (eye[:2] - (x, y))
            inside = b * b - a * (((eye[:2] - (x, y)) ** 2).sum() - RADIUS**2)
            along = (-b - np.sqrt(inside)) / a
            depth = np.where((inside > 0) & (along > 0) & (along < depth), along, depth)
    depth = np.where(depth < RANGE, depth, 0).astype(np.float32)
    return Keyframe(depth=depth, intrinsics=K, T_world_camera=T)


def views() -> Iterator[Keyframe]:
    """Six directions every 3 m, where no pillar stands."""
    for x in np.arange(-9, 10, 3.0):
        for y in np.arange(-9, 10, 3.0):
            if min(np.hypot(x - a, y - b) for a, b in PILLARS) > 0.7:
                yield from (hall(np.array([x, y, EYE]), yaw) for yaw in np.arange(0, 6.2, 1.05))


def cpu_ms(work: Callable[[], object], runs: int = 7) -> dict[str, float]:
    """Best and median CPU time of some work."""
    taken = []
    for _ in range(runs):
        begin = time.process_time()
        work()
        taken.append(1e3 * (time.process_time() - begin))
    return {"best_ms": round(min(taken), 1), "median_ms": round(float(np.median(taken)), 1)}


def report(case: str, **figures: Any) -> None:
    print(json.dumps({"case": case, **figures}), flush=True)


def times() -> None:
    """A slice, its update, and boxes of the field."""
    keyframes = list(views())
    volume = Volume(0.05, threads=1, sensor="tof", color=False)
    for keyframe in keyframes[:-12]:
        volume.integrate(keyframe)
    volume.take_dirty()
    for reach in (2.0, 5.0):
        ask = partial(volume.distance_slice, *HEIGHTS, box=BOX, up="z", max_distance=reach)
        report("distance_slice", metres="20x20", cell=0.05, max_distance=reach, **cpu_ms(ask))
    report("occupancy_slice", **cpu_ms(lambda: volume.occupancy_slice(*HEIGHTS, box=BOX, up="z")))
    kept, taken, dirty = volume.current_slice(*HEIGHTS, box=BOX, up="z"), [], []
    for change in (volume.integrate, volume.retract):
        for keyframe in keyframes[-12:]:
            change(keyframe)
            taken += [cpu_ms(kept.update, 1)["best_ms"]]
            dirty.append(len(volume.take_dirty()))
    report("update", median_ms=float(np.median(taken)), most_ms=max(taken), blocks=float(np.median(dirty)))
    plane, cube = (-10, -10, 1, 10, 10, 1.05), (-3, -3, 0, 3, 3, 3)
    for case, box in (("field, a plane of 20x20 m", plane), ("field, 6x6x3 m", cube)):
        report(case, **cpu_ms(partial(volume.distance_field, box), 5))
    field = volume.distance_field(cube, max_distance=1.0, subvoxel=False)
    begin = time.process_time()
    expected = np.minimum(distance_transform_edt(field.distance != 0) * 0.05, 1.0)
    taken_ms = round(1e3 * (time.process_time() - begin), 1)
    inner = (slice(21, -21),) * 3  # SciPy knows no site outside the box
    worst = float(np.abs(np.abs(field.distance) - expected)[inner].max())
    report("scipy on the same voxels", worst_difference_m=worst, scipy_ms=taken_ms)


def free_space() -> None:
    """Known part of a room's free space, with space carving and without."""
    recording = Synthetic("room", count=40)
    for carves in (False, True):
        volume = Volume(0.02, threads=1, space_carving=carves)
        volume.warm_up()
        keyframes = [recording[i] for i in range(len(recording))]
        taken = [cpu_ms(partial(volume.integrate, one), 1)["best_ms"] for one in keyframes]
        vertices = volume.extract_mesh().vertices
        points = np.random.default_rng(0).uniform(vertices.min(0), vertices.max(0), (400_000, 3))
        field = volume.distance_field(max_distance=0.02)
        cells = np.floor((points - field.origin) / field.voxel_size).astype(int)
        cells = np.clip(cells, 0, np.array(field.occupancy.shape) - 1)  # what is outside was not seen
        truth, known = recording.distance(points), field.occupancy[tuple(cells.T)] == FREE
        report(
            "free space", space_carving=carves, keyframe_ms=float(np.median(taken)),
            map_mb=round(volume.stats().bytes / 1e6, 1), known=round(float(known[truth > 0.02].mean()), 3),
            wrong=round(float(known[truth < -0.04].mean()), 4),
        )  # fmt: skip


if __name__ == "__main__":
    argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
    times()
    free_space()
