# SPDX-License-Identifier: MIT
"""Up is found on real recordings and by formula, and left open where nothing tells."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from small_recordings import first_views

from tsfusion import InvalidConfig, Mesh, Volume, open_dataset
from tsfusion.datasets import select
from tsfusion.geometry import up_direction
from tsfusion.geometry.se3 import exp
from tsfusion.geometry.up_direction import SensorPosture, Up


def degrees(a: object, b: object) -> float:
    return math.degrees(math.acos(np.clip(np.dot(a, b) / np.linalg.norm(a) / np.linalg.norm(b), -1, 1)))


def held(poses: list, sensor: str = "kinect", forces: list | None = None) -> SensorPosture:
    sums = SensorPosture()
    for T, force in zip(poses, forces or [None] * len(poses), strict=True):
        sums.add(T, sensor, force)
    return SensorPosture(sums.numbers)  # as it comes back from a checkpoint


def scanned(path: Path, *, limit: int | None, voxel_size: float, **options: str) -> tuple[Mesh, list, str]:
    """Mesh, poses and sensor of a recording's first frames."""
    dataset = select(open_dataset(path, **options), limit=limit)
    volume = Volume(voxel_size=voxel_size, sensor=dataset.sensor)
    keyframes = list(dataset)
    for keyframe in keyframes:
        volume.integrate(keyframe)
    return volume.extract_mesh(), [one.T_world_camera for one in keyframes], dataset.sensor


@pytest.mark.parametrize(
    ("folder", "options", "limit", "voxel_size", "truth", "within", "below"),
    [
        ("hololens", {}, 40, 0.04, (0, 1, 0), 1.0, 1.60),  # its tracker finds gravity
        ("icl_nuim_tum", {}, 3, 0.04, (0, -1, 0), 1.0, 1.29),
        ("open3d_rgbd", {}, 5, 0.04, (0, 1, 0), 1.0, None),
        # A car's first camera, which is not level to the road by more than a few degrees, 1.65 m above it
        ("kitti_odometry", {"sequence": "06", "modality": "stereo"}, 3, 0.2, (0, -1, 0), 5.0, 1.65),
        ("kitti_odometry", {"sequence": "00", "modality": "lidar"}, 3, 0.2, (0, 0, 1), 3.0, 1.73),
        ("kitti07_lidar_keyframes", {}, 5, 0.2, (0, 0, 1), 3.0, 1.73),
    ],
)
def test_the_floor_of_real_scans(
    data: Callable[[str], Path],
    folder: str,
    options: dict,
    limit: int,
    voxel_size: float,
    truth: tuple,
    within: float,
    below: float | None,
) -> None:
    """`below`: metres from the sensors to the floor, by the car's drawing or by hand."""
    mesh, poses, sensor = scanned(data(folder), limit=limit, voxel_size=voxel_size, **options)
    sensors = held(poses, sensor)
    up = up_direction.find(mesh, sensors)
    if below is not None:
        height = sensors.position @ up.direction - up_direction.floor_height(mesh, up, sensors)
        assert height == pytest.approx(below, abs=0.12)
    assert up.found_by == "floor"
    assert degrees(up.direction, truth) < within


def test_a_kitchen_whose_cameras_look_down(data: Callable[[str], Path]) -> None:
    """The mean camera is 26° off; a floor is square to the wall, which faces the first camera."""
    mesh, poses, sensor = scanned(data("7scenes/redkitchen"), limit=60, voxel_size=0.04)
    up = up_direction.find(mesh, held(poses, sensor))
    assert up.found_by == "floor"
    sensors = held(poses, sensor)
    height = up_direction.floor_height(mesh, up, sensors)
    assert sensors.position @ up.direction - height == pytest.approx(1.40, abs=0.1), "not the worktop's"
    wall = up_direction._FacingSurface(mesh)._plane(np.array((0.0, 0.46, -0.89)), np.True_)[0]
    assert degrees(up.direction, wall) == pytest.approx(90, abs=1.5)


def turned(mesh: Mesh, T: np.ndarray) -> Mesh:
    R = T[:3, :3].astype(np.float32)
    return Mesh(mesh.vertices @ R.T, mesh.faces, mesh.normals @ R.T)


@pytest.fixture(scope="module")
def room() -> tuple[Mesh, list[np.ndarray]]:
    keyframes = first_views(6)
    volume = Volume(voxel_size=0.06)
    for keyframe in keyframes:
        volume.integrate(keyframe)
    return volume.extract_mesh(), [one.T_world_camera for one in keyframes]


def test_a_volume_knows_up_and_keeps_it(tmp_path: Path) -> None:
    first, *others = first_views(6)
    volume = Volume(voxel_size=0.06)
    assert volume.extract_mesh().up is None
    volume.integrate(first)
    before = volume.held.numbers
    for keyframe in others:
        volume.integrate(keyframe)
    up = volume.extract_mesh().up
    assert (up.axis, up.found_by) == ("+z", "floor")
    loaded = Volume.load(volume.save(tmp_path / "map.tsf"))
    assert (loaded.extract_mesh().up, loaded.meta) == (up, {})
    box = trimesh.load(loaded.extract_mesh().save(tmp_path / "room.glb"), force="mesh").extents
    assert box[1] == pytest.approx(np.ptp(loaded.extract_mesh().vertices[:, 2]), abs=0.06)
    for keyframe in reversed(others):
        volume.retract(keyframe)
    assert volume.held.numbers == before


def test_of_points_without_a_sensor_nobody_knows_the_axes() -> None:
    volume = Volume(voxel_size=0.1)
    points = np.random.default_rng(1).uniform(-1, 1, (100, 3)).astype(np.float32) + np.float32((0, 0, 3))
    volume.integrate(points=points, T_world_camera=np.eye(4))
    assert volume.keyframes == 1
    assert not any(volume.held.numbers)


@pytest.mark.parametrize("seed", range(3))
def test_a_turned_room(room: tuple[Mesh, list[np.ndarray]], seed: int) -> None:
    mesh, poses = room
    T = exp(np.append(np.zeros(3), np.random.default_rng(seed).normal(size=3)))
    sensors = held([T @ pose for pose in poses])
    up = up_direction.find(turned(mesh, T), sensors)
    assert up_direction.floor_height(turned(mesh, T), up, sensors) == pytest.approx(0, abs=0.02)
    assert up.found_by == "floor"
    assert degrees(up.direction, T[:3, 2]) < 0.3
    assert degrees(up.to_y() @ up.direction, (0, 1, 0)) < 1e-4


def test_without_a_floor_the_cameras_decide() -> None:
    wall = trimesh.creation.box((4, 0.1, 2)).subdivide().subdivide().subdivide().subdivide()
    wall.update_faces(wall.face_normals[:, 1] > 0.9)
    mesh = Mesh(wall.vertices.astype(np.float32), wall.faces.astype(np.int32),
                np.tile(np.float32((0, 1, 0)), (len(wall.vertices), 1)))  # fmt: skip
    pose = np.eye(4)
    pose[:3, :3] = np.stack(((-1.0, 0, 0), (0, 0, -1.0), (0, -1.0, 0)), axis=1)  # looks at it from y = 2
    pose[1, 3] = 2
    assert up_direction.find(mesh, held([pose])) == Up((0.0, 0.0, 1.0), "cameras")
    # Alone it may be a wall of a map whose z is up, or the floor of one whose y is up.
    turned_about = [pose @ exp(np.array((0, 0, 0, 0, 0, angle))) for angle in (0, 2.1, 4.2)]
    assert up_direction.find(mesh, held(turned_about)) == up_direction.find(mesh, SensorPosture())


def level(height: float, side: float, *, tilt: float = 0.0) -> trimesh.Trimesh:
    """A square that faces up, of small triangles."""
    plate = trimesh.creation.box((side, side, 0.02))
    plate.update_faces(plate.face_normals[:, 2] > 0.9)
    plate = plate.subdivide_to_size(0.1)
    plate.apply_transform(exp(np.array((0.0, 0, 0, 0, tilt, 0))))
    plate.apply_translation((0, 0, height - 0.01))
    return plate


def mesh_of(*parts: trimesh.Trimesh) -> Mesh:
    whole = trimesh.util.concatenate(parts)
    vertices, normals = (np.asarray(of, np.float32) for of in (whole.vertices, whole.vertex_normals))
    return Mesh(vertices, np.asarray(whole.faces, np.int32), normals)


def test_the_floor_is_the_lowest_large_level() -> None:
    up, pose = Up((0.0, 0.0, 1.0), "given"), np.eye(4)
    pose[2, 3] = 1.5
    floor, table, roof, spot = level(-0.3, 2.0), level(0.45, 3.0), level(2.5, 4.0), level(-1.0, 0.5)
    for seen, expected in (
        ((floor, table, roof, spot), -0.3),  # a table hides the most of it; specks below are none
        ((table, roof), 0.45),
        ((level(-0.3, 2.0, tilt=math.radians(1)), table), -0.3),
        ((roof,), None),  # above the sensors
    ):
        height = up_direction.floor_height(mesh_of(*seen), up, held([pose]))
        assert height == (None if expected is None else pytest.approx(expected, abs=0.03))
    assert up_direction.floor_height(mesh_of(roof), up, SensorPosture()) == pytest.approx(2.5)
    assert up_direction.floor_height(mesh_of(roof), Up((1.0, 0.0, 0.0), "given"), SensorPosture()) is None


def test_without_cameras_walls_and_floor_look_alike(room: tuple[Mesh, list[np.ndarray]]) -> None:
    mesh, _ = room
    assert up_direction.find(mesh, SensorPosture()) is None
    no_points = np.zeros((0, 3), np.float32)
    assert up_direction.find(Mesh(no_points, no_points.astype(np.int32), no_points), SensorPosture()) is None


def test_the_accelerometer_beats_the_floor(room: tuple[Mesh, list[np.ndarray]]) -> None:
    mesh, poses = room
    slope = np.array((0.3, 0, 0.95)) / np.linalg.norm((0.3, 0, 0.95))
    shakes = (1, 0, 0), (-1, 0, 0), (0, 2, 0), (0, -2, 0), (0, 0, 0)
    shaken = [9.81 * slope + shake for shake in shakes]
    forces = [None, *(pose[:3, :3].T @ force for pose, force in zip(poses[1:], shaken, strict=True))]
    up = up_direction.find(mesh, held(poses, forces=forces))
    assert (up.found_by, up.axis) == ("imu", "+z")
    assert degrees(up.direction, slope) < 1e-3
    in_g = [None if force is None else force / 9.81 for force in forces]
    assert up_direction.find(mesh, held(poses, forces=in_g)).found_by == "imu"
    # Free of gravity, as some drivers give it, or in axes that are not known: the floor
    assert up_direction.find(mesh, held(poses, forces=[np.array((0.1, 0, 0))] * 6)).found_by == "floor"


@pytest.mark.parametrize(
    ("text", "direction"),
    [
        ("z", (0, 0, 1)),
        ("+y", (0, 1, 0)),
        ("-x", (-1, 0, 0)),
        ("0,-2,0", (0, -1, 0)),
        ("3,0,4", (0.6, 0, 0.8)),
    ],
)
def test_up_is_given(text: str, direction: tuple[float, float, float]) -> None:
    up = up_direction.parse(text)
    assert (up.direction, up.found_by) == (pytest.approx(direction), "given")


@pytest.mark.parametrize("text", ["", "w", "--z", "0,0,0", "1,2", "nan,0,1", "1e999,0,0", "z,x,y"])
def test_nonsense_is_no_direction(text: str) -> None:
    with pytest.raises(InvalidConfig, match="x, y, z, -x, -y, -z or three numbers"):
        up_direction.parse(text)


@pytest.mark.parametrize("axis", ["x", "-x", "y", "-y", "z", "-z"])
def test_an_axis_is_turned_exactly(axis: str) -> None:
    up = up_direction.parse(axis)
    turn = up.to_y()
    assert (turn @ up.direction == (0, 1, 0)).all()
    assert np.linalg.det(turn) == pytest.approx(1)
    assert np.isin(turn, (-1, 0, 1)).all()
    assert up.axis == (axis if axis[0] == "-" else f"+{axis}")
