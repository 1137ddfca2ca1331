# SPDX-License-Identifier: MIT
"""Poses in UTM make the map of poses near zero; the origin goes into every result, and comes back in LAS."""

import json
from pathlib import Path

import laspy
import numpy as np
import pytest
from command_processes import Here
from numpy.typing import NDArray

from tsfusion import Volume, open_dataset
from tsfusion.datasets import Synthetic
from tsfusion.datasets.trajectory_files import write_tum
from tsfusion.geometry.frame import Frame
from tsfusion.journal.journaled_keyframes import JournalRecording

ORIGIN = np.array([447_000, 5_411_000, 0])
COUNT = 4
VOXEL = 0.2


def recorded(root: Path, shift: NDArray[np.integer], *, poses: bool = True) -> Path:
    """Scans of the synthetic room, whose poses are shifted."""
    root.mkdir(parents=True)
    rows = []
    for number, view in enumerate(Synthetic("room", sensor="lidar", count=COUNT)):
        points = np.asarray(view.measurement, "<f4")
        np.column_stack([points, np.ones(len(points), "<f4")]).tofile(root / f"{number:03d}.bin")
        T = view.T_world_camera.copy()
        T[:3, 3] += shift
        rows.append(" ".join(f"{value:.9f}" for value in T[:3].ravel()))
    (root / ("poses.txt" if poses else "other.kitti")).write_text("\n".join(rows) + "\n")
    return root


@pytest.mark.slow
@pytest.mark.usefixtures("quick_servers")
def test_a_map_in_utm(here: Here, tmp_path: Path) -> None:
    utm = recorded(tmp_path / "utm", ORIGIN)
    out, state = tmp_path / "run", tmp_path / "state"
    done = here(
        "replay", utm, "--option", "crs=EPSG:25832", "--state", state, "--voxel-size", VOXEL, "--no-check",
        "--out", out,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert "positions count from the origin 447000 5411000 0 EPSG:25832" in done.stderr
    record = json.loads((out / "run.json").read_text())
    assert record["origin_m"] == ORIGIN.tolist()
    plain = Volume(VOXEL, sensor="lidar")
    for keyframe in open_dataset(recorded(tmp_path / "plain", 0 * ORIGIN)):
        plain.integrate(keyframe)
    assert record["map_hash"] == plain.map_hash()
    assert b"comment origin_m 447000 5411000 0 EPSG:25832\n" in (out / "mesh.ply").read_bytes()[:800]
    info = here("map", "info", out / "map.tsf")
    assert "poses given, from the origin 447000 5411000 0 EPSG:25832" in info.stdout

    made = here("mesh", out / "map.tsf", tmp_path / "room.las")
    assert made.returncode == 0, made.stderr
    cloud, mesh = laspy.read(tmp_path / "room.las"), plain.extract_mesh()
    low = np.array(cloud.xyz).min(axis=0) - ORIGIN
    assert low == pytest.approx(mesh.vertices.min(axis=0), abs=1e-4)
    assert cloud.header.parse_crs().to_epsg() == 25832

    # The journal knows it, and so do maps that are made of it.
    origin = JournalRecording(state).origin
    assert origin is not None
    assert origin.position == tuple(ORIGIN)
    other = tmp_path / "other"
    fused = here(
        "fuse", utm, "--origin", "446000,5411000,0", "--voxel-size", VOXEL, "--workers", "1", "--out", other
    )
    assert fused.returncode == 0, fused.stderr
    assert b"comment origin_m 446000 5411000 0\n" in (other / "mesh.ply").read_bytes()[:800]

    # A map from another origin is another frame.
    refused = here("map", "merge", out / "map.tsf", other / "map.tsf", "--out", tmp_path / "sum.tsf")
    assert refused.returncode == 1
    cure = "(447000 5411000 0 EPSG:25832 and 446000 5411000 0): give one to all (--origin 447000,5411000,0)"
    assert f"the other map counts from another origin {cure}" in refused.stderr
    refused = here("fuse", utm, tmp_path / "state", "--out", tmp_path / "none")
    assert (refused.returncode, "counts from another origin" in refused.stderr) == (1, True)


def test_every_way_of_giving_poses_has_one_origin(tmp_path: Path) -> None:
    views = list(Synthetic("room", sensor="lidar", count=COUNT))
    inside = recorded(tmp_path / "inside", ORIGIN)
    beside = recorded(tmp_path / "beside", ORIGIN, poses=False)
    for dataset in (open_dataset(inside), open_dataset(beside, trajectory=beside / "other.kitti")):
        assert dataset.origin.position == tuple(ORIGIN)
        for view, read in zip(views, dataset, strict=True):
            assert read.T_world_camera == pytest.approx(view.T_world_camera, abs=1e-8)
    assert open_dataset(inside, origin="447000,5411000,-300")[0].T_world_camera[2, 3] == pytest.approx(
        views[0].T_world_camera[2, 3] + 300
    )


def test_a_scan_by_a_trajectory_in_utm(tmp_path: Path) -> None:
    from tsfusion.core.config import ScanConfig
    from tsfusion.scanner.localization import localizers

    poses = [view.T_world_camera.copy() for view in Synthetic("room", sensor="lidar", count=COUNT)]
    for T in poses:
        T[:3, 3] += ORIGIN
    stamps = [10**9 * (1 + number) for number in range(COUNT)]
    write_tum(tmp_path / "poses.txt", stamps, poses)
    for given, height in ((None, 0.0), ("447000,5411000,-300", 300.0)):
        config = ScanConfig(localizer="trajectory", trajectory=str(tmp_path / "poses.txt"), origin=given)
        first = Frame.of(Synthetic("room", sensor="lidar", count=1)[0], "lidar")
        localizer = localizers.create_localizer(config, first)
        assert localizer.origin.position == (447_000, 5_411_000, -300 if given else 0)
        assert localizer._trajectory.translations[0][2] == pytest.approx(poses[0][2, 3] + height)
