# SPDX-License-Identifier: MIT
"""The rows of the ablation: scenes, noise and methods; and how one of them is measured."""

import os
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lab.bench.peers import DATA, Open3D, VDBFusion, surroundings, timed_keyframes
from lab.evaluation import stanford_bunny, surface_error
from lab.evaluation.known_surfaces import (
    COMPLETE_WITHIN,
    KnownSurface,
    ReferenceSurface,
    WorldSurface,
    measure,
    rounded,
)
from lab.evaluation.view_prediction import compare_views
from lab.worlds import benchmark_worlds
from tsfusion.core.config import SENSORS
from tsfusion.datasets import Synthetic, open_dataset
from tsfusion.geometry.keyframe import Intrinsics, Keyframe, points_world
from tsfusion.kernels.base import runtime

# metres, for every system; else the sensor preset's. 2.8: the things in the middle, not the walls behind
MAX_RANGE = {"street": 30.0, "corners": 2.8, "thin": 2.8, "kitchen": 4.0, "hololens": 4.0}
MOST_SHOWN = 100  # clean views that say what was seen
SEEN_BY = 4  # clean samples in a cell: fewer are the outlines of round things and the rims of images
HOLD_OUT = 5  # every fifth recorded keyframe is not fused but predicted

OFF = {"regularizer": "off", "surface": "raw"}
METHODS: dict[str, dict[str, Any]] = {  # what is not said is the sensor preset's
    "default": {},
    "off": OFF,
    "exact": {**OFF, "bundle": False},
    "paper": {"regularizer": "paper", "surface": "raw"},
    "ray": {"regularizer": "ray", "surface": "raw"},
    "normal": {**OFF, "surface": "normal"},
    "field": {**OFF, "surface": "field"},
    "ray+normal": {"regularizer": "ray", "surface": "normal"},
    "ray+field": {"regularizer": "ray", "surface": "field"},
    "carving": {"regularizer": "off", "space_carving": True},
    "open3d": {},
    "open3d-1": {},
    "vdbfusion": {},
}
# of Open3D, voxels of weight ≥ 2, and ≥ 1
PEERS: dict[str, Callable[..., Any]] = {
    "open3d": Open3D,
    "open3d-1": partial(Open3D, mesh_weight=1.0),
    "vdbfusion": VDBFusion,
}
SOME = ("default", "off", "paper", "ray", "normal", "carving", "open3d", "open3d-1")
FEW = ("default", "off", "ray", "ray+field", "open3d", "open3d-1")
DRIFT = ("default", "off", "paper", "ray")


@dataclass(frozen=True)
class Setup:
    """Scene, noise and path of the keyframes that are fused."""

    question: str
    scene: str
    noise: str  # none, kinect, stereo, lidar; recorded
    keyframes: int
    voxel_size: float = 0.02
    path: str | None = None
    seed: int = 0

    @property
    def name(self) -> str:
        path = f"-{self.path}" if self.path else ""
        size = "" if self.voxel_size == 0.02 else f"-{self.voxel_size * 100:g}cm"
        return f"{self.scene}{path}-{self.noise}-{self.keyframes}{size}"


@dataclass(frozen=True)
class Row:
    """One setup fused by one method."""

    setup: Setup
    method: str
    quick: bool = False

    @property
    def name(self) -> str:
        return f"{self.setup.name}-{self.method}"


def rows() -> list[Row]:
    """Every row, in the order of the tables."""
    return [
        Row(setup, method, setup.question == "keyframes" and setup.keyframes == 20)
        for setup, methods in _setups()
        for method in methods
        if setup.noise not in ("lidar", "recorded-scan") or not method.startswith("open3d")
        if setup.noise != "recorded-scan" or method != "vdbfusion"
    ]


def _setups() -> Iterator[tuple[Setup, tuple[str, ...]]]:
    everything = tuple(METHODS)
    for noise in ("none", "kinect", "stereo"):
        yield Setup("noise", "shared-room", noise, 40), everything
    for noise in ("kinect", "stereo"):
        for count in (20, 80, 240):
            yield Setup("keyframes", "room", noise, count, path="circle"), SOME
    for seed, path in enumerate(("circle-again", "tour", "wander"), 1):
        for noise in ("none", "kinect", "stereo"):
            yield Setup("trajectories", "room", noise, 80, path=path, seed=seed), FEW
    for noise in ("lidar", "stereo"):
        yield Setup("street", "street", noise, 40, voxel_size=0.1), everything
    for scene in ("corners", "thin"):
        for noise in ("none", "kinect", "stereo"):
            yield Setup("details", scene, noise, 60, seed=4), SOME
    yield Setup("bunny", "bunny", "recorded-scan", 6, voxel_size=0.001), everything
    for scene, count in (("kitchen", 125), ("hololens", 40)):
        for size in (0.02, 0.01):
            yield Setup("predicted", scene, "recorded", count, voxel_size=size), everything
    for noise in ("kinect", "stereo"):
        for count in (240, 1000):
            yield Setup("drift", "room", noise, count, path="still", seed=5), DRIFT


@dataclass
class Material:
    """Input of a row."""

    fused: list[Keyframe]
    sensor: str
    truth: KnownSurface | None = None
    held_out: list[Keyframe] = field(default_factory=list)
    max_range: float | None = None  # metres; None = the sensor preset's


def missing_data(setup: Setup) -> str | None:
    """Why a recorded scene cannot be had, if it cannot."""
    folder = FOLDERS.get(setup.scene)
    if folder and not (DATA / folder).exists():
        return f"no {folder} in {DATA} (set TSFUSION_DATA)"
    return None


FOLDERS = {
    "shared-room": "synthetic_room",
    "bunny": "stanford_bunny",
    "kitchen": "7scenes/redkitchen",
    "hololens": "hololens",
}


def run(row: Row, threads: int) -> dict[str, Any]:
    """Measure one row in this process; JSON-like."""
    os.environ["OMP_NUM_THREADS"] = str(threads)
    runtime.start(threads)  # before the renderer does
    setup = row.setup
    material = load(setup)
    system = _system(row, material, threads)
    cpu = timed_keyframes(material.fused, system.integrate)[0, 0]
    mesh_cpu = time.process_time()
    mesh = system.extract_mesh()
    mesh_cpu = time.process_time() - mesh_cpu
    found: dict[str, Any] = {}
    if material.truth is not None:
        found = measure(mesh, material.truth, setup.voxel_size)
    if material.held_out:
        reach = material.max_range or SENSORS[material.sensor].max_range
        found["predicted"] = rounded(
            compare_views(mesh, material.held_out, max_range=reach, voxel_size=setup.voxel_size)
        )
    return {
        "row": row.name, "question": setup.question, "setup": setup.name, "scene": setup.scene,
        "noise": setup.noise, "path": setup.path, "seed": setup.seed, "voxel_size": setup.voxel_size,
        "keyframes": len(material.fused), "method": row.method, **found,
        "keyframe_cpu_ms": round(float(np.median(cpu)) * 1e3, 2), "mesh_cpu_ms": round(mesh_cpu * 1e3, 1),
        **surroundings(threads),
    }  # fmt: skip


def load(setup: Setup) -> Material:
    """Keyframes and truth of a setup."""
    loaders = {
        "shared-room": _shared_room, "bunny": _bunny, "kitchen": _recorded, "hololens": _recorded,
    }  # fmt: skip
    return loaders.get(setup.scene, _synthetic)(setup)


def _system(row: Row, material: Material, threads: int) -> Any:
    setup, model = row.setup, SENSORS[material.sensor]
    reach = material.max_range or model.max_range
    if peer := PEERS.get(row.method):
        # 4 voxels as is usual; 10 for stereo, whose noise is as wide
        truncation = 10.0 if material.sensor == "stereo" else 4.0
        return peer(setup.voxel_size, max_range=reach, truncation=truncation)
    from tsfusion import Volume

    volume = Volume(
        voxel_size=setup.voxel_size, sensor=material.sensor, max_range=reach, color=False,
        threads=threads, **METHODS[row.method],
    )  # fmt: skip
    volume.warm_up()
    return volume


def _synthetic(setup: Setup) -> Material:
    world: Any = {
        "room": benchmark_worlds.room,
        "corners": benchmark_worlds.corners,
        "thin": benchmark_worlds.thin,
    }.get(setup.scene)
    sensor = "kinect" if setup.noise == "none" else setup.noise
    options: dict[str, Any] = {
        "world": world() if world else setup.scene, "count": setup.keyframes, "seed": setup.seed,
        "color": False, "path": setup.path and setup.path.removesuffix("-again"),
        "width": 160 if setup.path == "still" else None,
    }  # fmt: skip
    views = Synthetic(sensor=sensor, noise=setup.noise != "none", **options)
    clean = Synthetic(sensor=sensor, noise=False, **options)
    reach = MAX_RANGE.get(setup.scene)
    step = setup.keyframes if setup.path == "still" else 1 + setup.keyframes // MOST_SHOWN
    shown = (clean[i] for i in range(0, setup.keyframes, step))
    truth = WorldSurface(views.world, _seen(shown, setup, reach), edges=setup.scene != "street")
    return Material(list(views), sensor, truth, max_range=reach)


def _shared_room(setup: Setup) -> Material:
    import cv2

    folder = DATA / FOLDERS[setup.scene]
    poses = np.loadtxt(folder / "poses.txt").reshape(-1, 3, 4)
    sensor = "kinect" if setup.noise == "none" else setup.noise

    def read(kind: str) -> list[Keyframe]:
        images = [cv2.imread(str(path), cv2.IMREAD_UNCHANGED) for path in sorted((folder / kind).iterdir())]
        return [
            Keyframe(
                depth=image, depth_scale=1e-4, T_world_camera=np.vstack([pose, (0, 0, 0, 1)]), sensor=sensor,
                intrinsics=Intrinsics(292.5, 292.5, 159.5, 119.5),
                baseline_fx=35.1 if sensor == "stereo" else None,
            )
            for image, pose in zip(images, poses, strict=True)
        ]  # fmt: skip

    clean = read("clean")
    fused = clean if setup.noise == "none" else read(setup.noise)
    return Material(fused, sensor, WorldSurface(benchmark_worlds.room(), _seen(clean, setup)))


def _bunny(setup: Setup) -> Material:
    folder = DATA / FOLDERS[setup.scene]
    scans = list(stanford_bunny.scans(folder))
    measured = _seen(scans, setup)
    truth = ReferenceSurface(
        *stanford_bunny.reference(folder), measured, reach=COMPLETE_WITHIN * setup.voxel_size
    )
    return Material(scans, "scanner", truth)


def _recorded(setup: Setup) -> Material:
    options = {"color": False} if setup.scene == "kitchen" else {}
    recorded = open_dataset(DATA / FOLDERS[setup.scene], **options)
    keyframes = [recorded[i] for i in range(min(len(recorded), setup.keyframes))]
    return Material(
        [k for i, k in enumerate(keyframes) if i % HOLD_OUT], recorded.sensor,
        held_out=keyframes[::HOLD_OUT], max_range=MAX_RANGE[setup.scene],
    )  # fmt: skip


def _seen(views: Iterable[Keyframe], setup: Setup, max_range: float | None = None) -> NDArray[np.float64]:
    """Points of the surface that clean views show, one a cell."""
    shown = []
    for view in views:
        points = points_world(view)
        if max_range is not None:
            points = points[np.linalg.norm(points - view.T_world_camera[:3, 3], axis=1) < max_range]
        shown.append(points)
    return surface_error.one_per_cell(
        np.concatenate(shown), COMPLETE_WITHIN * setup.voxel_size, at_least=SEEN_BY
    )
