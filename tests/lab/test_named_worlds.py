# SPDX-License-Identifier: MIT
"""Names of the laboratory's worlds, as `pip install -e lab` gives them to every command; and the desk."""

import sys
from importlib.metadata import EntryPoint, EntryPoints, entry_points

import numpy as np
import pytest
from command_processes import tsfusion
from repository import ROOT

from lab.worlds import named_worlds
from lab.worlds.desk_world import Desk
from tsfusion.core.errors import DatasetError
from tsfusion.datasets import layout_registry, layouts, open_dataset
from tsfusion.datasets.worlds.synthetic import DEPTH_SCALE
from tsfusion.geometry.keyframe import points_world

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib


@pytest.fixture
def installed(monkeypatch):
    """The entry points that lab/pyproject.toml names, whatever is installed here."""
    project = tomllib.loads((ROOT / "lab" / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    group = project["entry-points"][layout_registry.GROUP]
    points = EntryPoints(EntryPoint(name, value, layout_registry.GROUP) for name, value in group.items())
    monkeypatch.setattr(layout_registry, "entry_points", lambda group: points)


@pytest.mark.usefixtures("installed")
def test_an_installed_laboratory_adds_its_worlds(caplog):
    desk = open_dataset("synthetic:desk", count=4, width=64)
    assert (type(desk), desk.name, desk.sensor, len(desk)) == (Desk, "synthetic desk", "tof", 4)
    assert open_dataset("synthetic:desk:kinect", count=1).sensor == "kinect"
    assert open_dataset("synthetic:room", count=1).name == "synthetic room"
    assert [layout.name for layout in layouts()[:2]] == ["KITTI's paths", "desk"]
    assert not caplog.records


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize("opened", [open_dataset, named_worlds.open_world])
def test_missing_poses_are_one_clear_line(opened, tmp_path, monkeypatch):
    monkeypatch.delenv("TSFUSION_DATA", raising=False)
    with pytest.raises(DatasetError, match=r"path of KITTI 07 is needed: say --option kitti=FOLDER"):
        opened("synthetic:kitti07")
    with pytest.raises(DatasetError, match=r"06.txt does not exist: expected the true poses of KITTI 06"):
        opened("synthetic:kitti06", kitti=tmp_path)
    with pytest.raises(DatasetError, match="sensor of kitti06 must be stereo, got 'lidar'"):
        opened("synthetic:kitti06:lidar", kitti=tmp_path)
    with pytest.raises(DatasetError, match="takes no `speed`; it takes world, sensor, kitti"):
        opened("synthetic:kitti06", speed=2)
    with pytest.raises(
        DatasetError, match=r"^world must be one of room, .*, got 'kitti08'; in a clone, `pip "
    ):
        opened("synthetic:kitti08")


def test_measurements_need_no_installed_laboratory(monkeypatch):
    monkeypatch.setattr(layout_registry, "entry_points", lambda group: EntryPoints())
    with pytest.raises(DatasetError, match="`pip install -e lab` adds kitti06, kitti07 and desk"):
        open_dataset("synthetic:desk")
    assert named_worlds.open_world("synthetic:desk:kinect", count=1).sensor == "kinect"
    assert named_worlds.open_world("synthetic:room", count=1).name == "synthetic room"


def test_commands_find_the_worlds_where_the_laboratory_is_installed():
    if not any(point.value.startswith("lab.") for point in entry_points(group=layout_registry.GROUP)):
        pytest.skip("the laboratory is not installed: pip install -e lab")
    assert "synthetic:kitti06" in tsfusion("datasets").stdout


def test_a_kinect_v2_at_the_desk_has_its_noise_and_loses_outlines():
    dataset, clean = (Desk(count=600, noise=noise, width=320) for noise in (True, False))
    assert (dataset.sensor, dataset.camera.size, dataset[0].sensor) == ("tof", (240, 320), "tof")
    poses = np.array([dataset.pose(index) for index in range(0, 600, 5)])
    assert dataset.distance(poses[:, :3, 3]).min() > 0.15
    noisy, true = (each[300].depth.astype(float) * DEPTH_SCALE for each in (dataset, clean))
    lost = (true > 0) & (noisy == 0)
    assert 0.002 < lost.mean() < 0.05
    error = (noisy - true)[(noisy > 0) & (true > 0)]
    assert 0.001 < np.median(np.abs(error)) / 0.6745 < 0.006
    assert 0.002 < (np.abs(error) > 0.03).mean() < 0.05  # between front and back
    assert np.abs(clean.distance(points_world(clean[300])[::50])).max() < 1e-4
    assert Desk().camera.size == (480, 640)
