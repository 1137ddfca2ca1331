# SPDX-License-Identifier: MIT
"""Scenes of the localizer's examination: recordings with truth, and rooms that nothing else uses."""

import json
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from lab.bench.peers import DATA
from tsfusion import open_dataset
from tsfusion.datasets import Dataset, Synthetic
from tsfusion.datasets.worlds import worlds
from tsfusion.geometry import se3
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.inertial_sensors import Gyroscope
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.scanner.sources.source import RecordedSource

ROOM_FRAMES = 100
FAST_FRAMES, FAST_HZ = 60, 30
PHONE = worlds.SyntheticCamera((256, 192), Intrinsics(193.8, 193.8, 95.5, 127.5), 0.12)


def _recorded(path: str) -> Callable[[], list[Frame]]:
    return lambda: _frames(open_dataset(DATA / path))


def _frames(dataset: Dataset) -> list[Frame]:
    return list(RecordedSource(dataset))


def _record3d() -> list[Frame]:
    """Open the phone's export with its camera, and with the phone's poses as the truth."""
    folder = DATA / "record3d_export"
    facts = json.loads((folder / "metadata.json").read_text(encoding="utf-8"))
    K, share = facts["K"], facts["dw"] / facts["w"]
    dataset = open_dataset(folder, posed=False, intrinsics=[share * K[i] for i in (0, 4, 6, 7)])
    frames = zip(_frames(dataset), facts["poses"], strict=True)
    return [replace(frame, T_world_camera=_opengl(*pose)) for frame, pose in frames]


def _opengl(x: float, y: float, z: float, w: float, *position: float) -> se3.Transform:
    """Return T_world_camera with OpenCV axes, of a quaternion and position with OpenGL axes."""
    q = np.array([x, y, z]) / np.sqrt(x * x + y * y + z * z + w * w)
    scalar = w / np.sqrt(x * x + y * y + z * z + w * w)
    R = np.eye(3) + 2 * scalar * se3.hat(q) + 2 * se3.hat(q) @ se3.hat(q)
    return se3.transform(R @ np.diag([1.0, -1.0, -1.0]), np.array(position))


def furnished_room(seed: int) -> worlds.World:
    """Return a 4×4×2.8 m room with pictures on its walls and furniture before them, all by chance."""
    rng = np.random.default_rng([59, seed])
    plain = seed % 2 == 1
    rows = [worlds.solid(worlds.ROOM, (0, 0, 1.4), (2, 2, 1.4), worlds.PLAIN if plain else worlds.INTERIOR)]
    for side in range(4):
        for _ in range(int(rng.integers(2, 5))):
            rows.append(_picture(rng, side))
        for _ in range(int(rng.integers(1, 3))):
            rows.append(_furniture(rng, side))
    for _ in range(3):
        size = rng.uniform(0.1, 0.28)
        center = (*rng.uniform(-0.45, 0.45, 2), size)
        rows.append(worlds.solid(worlds.SPHERE, center, (size,) * 3, worlds.MARBLE))
    path = worlds.room().paths["handheld"]
    begin = int(rng.integers(0, 500))
    return worlds.World(
        f"furnished room {seed}", np.array(rows), {"hand": lambda i, count: path(begin + i, count)}
    )


def _at_wall(side: int, along: float, away: float) -> tuple[float, float]:
    x, y = ((away, along), (along, away), (-away, along), (along, -away))[side]
    return x, y


def _picture(rng: np.random.Generator, side: int) -> list[float]:
    x, y = _at_wall(side, rng.uniform(-1.6, 1.6), 1.98)
    wide, high = rng.uniform(0.12, 0.4), rng.uniform(0.1, 0.35)
    half = (0.02, wide, high) if side % 2 == 0 else (wide, 0.02, high)
    material = int(rng.choice([worlds.PAINT, worlds.MARBLE, worlds.STRIPES, worlds.FACADE]))
    center = (x, y, rng.uniform(0.6, 2.2))
    return worlds.solid(worlds.BOX, center, half, material, variant=int(rng.integers(1, 900)))


def _furniture(rng: np.random.Generator, side: int) -> list[float]:
    x, y = _at_wall(side, rng.uniform(-1.5, 1.5), 1.7)
    high, yaw, variant = rng.uniform(0.2, 0.8), rng.uniform(0, 0.6), int(rng.integers(1, 900))
    half = (rng.uniform(0.12, 0.28), rng.uniform(0.12, 0.28), high)
    kind = int(rng.choice([worlds.BOX, worlds.CYLINDER, worlds.PRISM]))
    material = int(rng.choice([worlds.WOOD, worlds.METAL, worlds.PAINT]))
    return worlds.solid(kind, (x, y, high), half, material, yaw=yaw, variant=variant, top=0.7)


def _room(seed: int, sensor: str, camera: worlds.SyntheticCamera | None = None) -> Callable[[], list[Frame]]:
    def frames() -> list[Frame]:
        world = furnished_room(seed)
        world = world if camera is None else replace(world, camera=camera)
        return _frames(Synthetic(world, sensor, count=ROOM_FRAMES, seed=seed))

    return frames


SCENES: dict[str, Callable[[], list[Frame]]] = {
    "kitchen": _recorded("7scenes/redkitchen"),
    "freiburg1_xyz": _recorded("rgbd_dataset_freiburg1_xyz"),
    "HoloLens": _recorded("hololens"),
    "Redwood": _recorded("redwood_livingroom1"),
    "Record3D": _record3d,
    "room 2, Kinect": _room(2, "kinect"),
    "room 3, plain, Kinect": _room(3, "kinect"),
    "room 4, time of flight": _room(4, "tof"),
    "room 5, plain, phone": _room(5, "tof", PHONE),
}

# Rooms that no constant was chosen by
FRESH_ROOMS = {
    f"room {seed}, {sensor}": _room(seed, sensor)
    for seed, sensor in ((6, "kinect"), (7, "kinect"), (8, "tof"), (9, "tof"))
}


def fast_turns(seed: int) -> list[Frame]:
    """Return two seconds of a sensor that swings by up to 200°/s, blurred by 1/60 s, with a gyroscope."""
    world, rng, hz = furnished_room(seed), np.random.default_rng(seed), 10 * FAST_HZ
    begin = world.paths["hand"](0, 1)

    def pose(seconds: float) -> se3.Transform:
        turn = np.radians(60) * np.sin(np.radians(200) / np.radians(60) * seconds)
        moved = np.array([0.2 * np.sin(2 * seconds), 0.1 * np.sin(3 * seconds), 0.1 * seconds])
        return begin @ se3.exp(np.array([*moved, 0.1 * turn, turn, 0]))

    times = np.arange(FAST_FRAMES / FAST_HZ * 200) / 200
    rates = [200 * se3.log(se3.inverse(pose(t)) @ pose(t + 1 / 200))[3:] for t in times]
    noisy = np.array(rates) + rng.normal(0, 0.01, (len(rates), 3)) + (0.02, -0.015, 0.01)
    gyroscope = Gyroscope()
    for seconds, rate in zip(times, noisy, strict=True):
        gyroscope.add(round(seconds * 1e9), rate)
    path = {"fast": lambda index, _: pose(index / hz)}
    source = Synthetic(replace(world, paths=path), "kinect", count=10 * FAST_FRAMES, seed=seed)
    return [_exposed(source, 10 * index, hz, gyroscope) for index in range(FAST_FRAMES)]


def _exposed(source: Synthetic, index: int, hz: int, gyroscope: Gyroscope) -> Frame:
    """Return a frame with the mean colour of five moments around it."""
    colors = [source.frame(max(0, index + late)).color for late in range(-2, 3)]
    stamp_ns = round(index / hz * 1e9)
    return replace(
        source.frame(index), timestamp_ns=stamp_ns, attitude=gyroscope.attitude(stamp_ns),
        color=np.rint(np.mean([*map(np.float32, colors)], axis=0)).astype(np.uint8),
    )  # fmt: skip
