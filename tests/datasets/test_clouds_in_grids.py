# SPDX-License-Identifier: MIT
"""Clouds whose points are in a grid give the rays that were measured, in metres, or one clear line."""

from pathlib import Path

import laspy
import numpy as np
import pytest
from numpy.typing import NDArray
from pypcd4 import PointCloud
from small_recordings import one_line

from tsfusion import open_dataset
from tsfusion.core.errors import DatasetError, InvalidConfig
from tsfusion.datasets.layout_registry import describe
from tsfusion.datasets.trajectory_files import write_tum
from tsfusion.geometry.origin import Origin

ORIGIN = np.array([447_812.0, 5_411_377.0, 312.0])
FOOT = 1200 / 3937
BEGIN_S = 345_600.0  # in a week of GPS
COUNT = 300

pyproj = pytest.importorskip("pyproj")


def places_at(times_s: NDArray[np.float64]) -> NDArray[np.float64]:
    """(n, 3) metres: where the scanner is, on a straight way at 12 m/s, which interpolation keeps."""
    return ORIGIN + np.multiply.outer(times_s - BEGIN_S, [12.0, -3.0, 0.5])


def measured(number: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points of a tile and their times; the scanner comes by twice."""
    random = np.random.default_rng(number)
    times = np.sort(BEGIN_S + np.append(random.uniform(0, 1, COUNT // 2), random.uniform(5, 6, COUNT // 2)))
    return places_at(times) + random.uniform(-20, 20, (COUNT, 3)), times


def save(
    path: Path, points: NDArray[np.float64], times: NDArray[np.float64], crs: str = "", unit: float = 1.0
) -> None:
    path.parent.mkdir(exist_ok=True)
    if path.suffix == ".pcd":
        columns = [*points.T / unit, times]
        PointCloud.from_points(columns, ("x", "y", "z", "gps_time"), (np.float64,) * 4).save(path)
        return
    made = laspy.LasData(laspy.LasHeader(version="1.4", point_format=6))
    made.header.scales, made.header.offsets = [1e-4] * 3, np.floor(points.min(axis=0) / unit)
    if crs:
        made.header.add_crs(pyproj.CRS(crs))
    made.x, made.y, made.z = points.T / unit
    made.gps_time = times
    made.write(path)


def trajectory(path: Path, *, unit: float = 1.0, begin_s: float = -0.1, end_s: float = 6.1) -> Path:
    times = BEGIN_S + np.arange(begin_s, end_s, 0.05)
    poses = np.repeat(np.eye(4)[None], len(times), axis=0)
    poses[:, :3, 3] = places_at(times) / unit
    write_tum(path, [round(time * 1e9) for time in times], list(poses))
    return path


def tiles(root: Path, suffix: str = "laz", crs: str = "", unit: float = 1.0) -> Path:
    for number in range(3):
        save(root / f"tile_447_{5411 + number}.{suffix}", *measured(number), crs, unit)
    return root


@pytest.mark.parametrize(
    ("suffix", "crs", "unit"),
    [
        ("laz", "EPSG:25832", 1.0),
        ("las", "EPSG:6880", FOOT),  # US survey feet
        ("las", "EPSG:2994", 0.3048),  # feet
        ("las", "", 1.0),
        ("pcd", "", 1.0),
    ],
)
def test_rays_of_tiles_begin_where_the_trajectory_was(tmp_path, suffix, crs, unit):
    root = tiles(tmp_path / "tiles", suffix, crs, unit)
    dataset = open_dataset(root, trajectory=trajectory(tmp_path / "way.txt", unit=unit))
    assert dataset.origin == Origin((448_000, 5_411_000, 0), crs)
    assert len(dataset) == 3
    for number, keyframe in enumerate(dataset):
        points, times = measured(number)
        assert keyframe.timestamp_ns == pytest.approx(times[0] * 1e9, rel=1e-12)
        there = keyframe.T_world_camera[:3, 3] + dataset.origin.position
        assert there == pytest.approx(places_at(times[:1])[0], abs=1e-3)
        assert there + keyframe.points == pytest.approx(points, abs=1e-3)
        assert there + keyframe.origins == pytest.approx(places_at(times), abs=1e-3)


def test_a_file_or_a_cloud_a_pose(tmp_path):
    root = tiles(tmp_path / "tiles")
    points, times = measured(1)
    way = trajectory(tmp_path / "way.txt")
    (alone,) = open_dataset(root / "tile_447_5412.laz", trajectory=way)
    assert alone.origins + alone.T_world_camera[:3, 3] + [448_000, 5_411_000, 0] == pytest.approx(
        places_at(times), abs=1e-3
    )
    # A pose for each, with a rotation that points of the grid do not have.
    turned = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    stations = [np.column_stack([turned, ORIGIN + number]) for number in range(3)]
    np.savetxt(root / "poses.txt", [T.ravel() for T in stations], fmt="%.6f")
    dataset = open_dataset(root)
    keyframe = dataset[1]
    assert keyframe.origins is None
    assert keyframe.points @ turned.T + ORIGIN + 1 == pytest.approx(points, abs=1e-3)
    assert "points in the frame of the poses, taken for metres" in describe(dataset)


def test_points_without_a_pose_in_time_are_left_out(tmp_path, caplog):
    root = tiles(tmp_path / "tiles")
    dataset = open_dataset(root, trajectory=trajectory(tmp_path / "way.txt", end_s=3.0))
    for keyframe in dataset:
        assert np.isnan(keyframe.points).any(axis=1).tolist() == [False] * 150 + [True] * 150
        assert np.isfinite(keyframe.origins).all()
    assert "150 points have no pose in time (--option max_gap_s" in caplog.text
    late = trajectory(tmp_path / "late.txt", begin_s=20, end_s=26)
    one_line(lambda: open_dataset(root, trajectory=late), "has no pose at the time of any frame")
    assert len(open_dataset(root, trajectory=late, time_offset_s=20.0)) == 3
    sparse = trajectory(tmp_path / "sparse.txt")
    lines = sparse.read_text().splitlines()
    sparse.write_text("\n".join(lines[:1] + lines[1::20]))
    one_line(lambda: open_dataset(root, trajectory=sparse), r"3 without a pose in time")
    assert len(open_dataset(root, trajectory=sparse, max_gap_s=2.0)[0].points) == COUNT


def test_what_is_missing_is_named(tmp_path):
    root = tiles(tmp_path / "tiles", "pcd")
    for posed in (True, False):
        one_line(
            lambda posed=posed: open_dataset(root, posed=posed),
            r"has no poses; expected where the scanner was, in the grid of the points \(--trajectory FILE\)",
        )
    (tmp_path / "short.txt").write_text("1 0 0 447812 0 1 0 5411377 0 0 1 312\n")
    one_line(
        lambda: open_dataset(root, trajectory=tmp_path / "short.txt"),
        r"has 1 poses for 3 frames.*in a grid points with gps_time",
    )
    # Feet in the files, metres in the trajectory.
    feet = tiles(tmp_path / "feet", "las", "EPSG:6880", FOOT)
    dataset = open_dataset(feet, trajectory=trajectory(tmp_path / "way.txt"))
    one_line(lambda: dataset[0], "more than 10 km from the sensor, as in a grid")


def test_float32_is_too_coarse_for_a_grid(tmp_path):
    points, times = measured(0)
    for number in range(2):
        path = tmp_path / f"{number}.pcd"
        columns = [*points.T.astype(np.float32), times.astype(np.float32)]
        PointCloud.from_points(columns, ("x", "y", "z", "i"), (np.float32,) * 4).save(path)
    np.savetxt(tmp_path / "poses.txt", [np.column_stack([np.eye(3), ORIGIN]).ravel()] * 2)
    one_line(lambda: open_dataset(tmp_path)[0], r"0\.pcd has float32, here in steps of 0\.5 m; expected")


def test_a_tile_of_another_system_is_left_out(tmp_path):
    root = tiles(tmp_path / "tiles", "las", "EPSG:25832")
    save(root / "tile_447_5414.las", *measured(3), "EPSG:25833")
    dataset = open_dataset(root, trajectory=trajectory(tmp_path / "way.txt"))
    assert len([*dataset]) == 3
    assert dataset.skipped == {"unreadable": 1}


def test_degrees_are_refused(tmp_path):
    points, times = measured(0)
    for number in range(2):
        save(tmp_path / f"{number}.las", points - ORIGIN, times, "EPSG:4326")
    with pytest.raises(InvalidConfig, match=r"0\.las: positions in WGS 84 are degrees: project points and"):
        open_dataset(tmp_path, posed=False)


def test_feet_near_zero_are_refused(tmp_path):
    """Nobody can tell whether they are a sensor's metres under a foreign name."""
    points, times = measured(0)
    for number in range(2):
        save(tmp_path / f"{number}.las", points - places_at(times), times, "EPSG:6880", FOOT)
    with pytest.raises(DatasetError, match=r"units of 0\.30480061 m.*lie near zero"):
        open_dataset(tmp_path, posed=False)[0]


def geotiff(path: Path, keys: dict[int, int]) -> None:
    """A LAS file of one point, whose system is in keys of GeoTIFF."""
    made = laspy.LasData(laspy.LasHeader(version="1.2", point_format=1))
    made.header.scales, made.header.offsets = [1e-3] * 3, np.floor(ORIGIN)
    table = np.array([[1, 1, 0, len(keys)], *([key, 0, 1, value] for key, value in keys.items())], "<u2")
    made.header.vlrs.append(laspy.VLR("LASF_Projection", 34735, "", table.tobytes()))
    made.x, made.y, made.z = ORIGIN[:, None] + 1
    made.write(path)


@pytest.mark.parametrize(
    ("keys", "crs", "metres"),
    [
        ({1024: 1, 3072: 25832}, "EPSG:25832", [1, 1, 1]),
        ({1024: 1, 3072: 2994, 3076: 9002}, "EPSG:2994", [0.3048] * 3),
        ({1024: 1, 3072: 32104, 3076: 9003}, "", [FOOT] * 3),  # in feet, of a code that counts metres
        ({1024: 1, 3072: 26910, 4099: 9003}, "EPSG:26910", [1, 1, FOOT]),
        ({1024: 1, 3072: 26910, 4096: 6360}, "EPSG:26910", [1, 1, FOOT]),
    ],
)
def test_the_system_of_geotiff(tmp_path, keys, crs, metres):
    from tsfusion.datasets.scan_files import read_scan

    geotiff(tmp_path / "0.las", keys)
    system = read_scan(tmp_path / "0.las").system
    assert system.crs == crs
    assert system.metres == pytest.approx(metres, rel=1e-12)


@pytest.mark.parametrize(
    ("keys", "why"),
    [
        ({1024: 2, 2048: 4326}, "positions in WGS 84 are degrees"),
        ({1024: 1, 2048: 4269, 3072: 32767}, "pyproj knows no coordinate reference system EPSG:32767"),
    ],
)
def test_a_system_of_geotiff_that_cannot_be(tmp_path, keys, why):
    from tsfusion.datasets.scan_files import read_scan

    geotiff(tmp_path / "0.las", keys)
    with pytest.raises(InvalidConfig, match=why):
        read_scan(tmp_path / "0.las")


@pytest.mark.parametrize(
    ("name", "crs", "metres"),
    [
        ("autzen_trim.laz", "", [0.3048] * 3),
        ("file_with_both_wkt_and_geotiff_vlrs.las", "EPSG:6880", [FOOT] * 3),
        ("simple.copc.laz", "EPSG:2991", [1, 1, FOOT]),
        ("simple.las", None, None),
    ],
)
def test_systems_of_real_files(data, name, crs, metres):
    from tsfusion.datasets.scan_files import read_scan

    scan = read_scan(data("las_georeferenced") / name)
    assert (scan.system and scan.system.crs) == crs
    if metres:
        assert scan.system.metres == pytest.approx(metres, rel=1e-9)


def test_real_degrees_are_refused(data):
    with pytest.raises(InvalidConfig, match="are degrees"):
        open_dataset(data("las_georeferenced") / "epsg_4326.las")


@pytest.mark.slow
@pytest.mark.usefixtures("quick_servers")
def test_a_map_of_tiles_in_feet_goes_back_into_feet(here, tmp_path):
    """A wall in US survey feet: the map is in metres, its LAS file again in the feet of the tiles."""
    times = np.sort(BEGIN_S + np.random.default_rng(0).uniform(0, 1, 20_000))
    wall = places_at(times) + np.random.default_rng(1).uniform(-1.5, 1.5, (len(times), 3))
    wall[:, 1] = ORIGIN[1] - 15  # metres
    for number, part in enumerate(np.array_split(np.arange(len(times)), 2)):
        save(tmp_path / "tiles" / f"{number}.laz", wall[part], times[part], "EPSG:6880", FOOT)
    way = trajectory(tmp_path / "way.txt", unit=FOOT, end_s=1.1)
    done = here(
        "replay", tmp_path / "tiles", "--trajectory", way, "--voxel-size", "0.2", "--out", tmp_path / "run"
    )
    assert done.returncode == 0, done.stderr
    assert "units of 0.30480061 m become metres; positions count from the origin" in done.stderr
    made = here("mesh", tmp_path / "run" / "map.tsf", tmp_path / "wall.las")
    assert made.returncode == 0, made.stderr
    cloud = laspy.read(tmp_path / "wall.las")
    assert cloud.header.parse_crs().to_epsg() == 6880
    assert np.abs(np.array(cloud.y) * FOOT - (ORIGIN[1] - 15)).max() < 0.03
    assert np.array(cloud.x).min() * FOOT == pytest.approx(wall[:, 0].min(), abs=0.4)
