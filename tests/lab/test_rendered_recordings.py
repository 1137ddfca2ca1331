# SPDX-License-Identifier: MIT
"""Worlds rendered into files: whole or not there, and as other readers expect them."""

import cv2
import numpy as np
import pytest
from small_recordings import round_a_block

from lab.worlds.desk_world import Desk
from lab.worlds.rendered_recordings import record
from lab.worlds.street_drive import StreetDrive
from tsfusion.core.errors import DatasetError
from tsfusion.datasets import KITTI, open_dataset

pytestmark = pytest.mark.nightly


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    return round_a_block(tmp_path_factory.mktemp("poses") / "06.txt")


def test_a_recording_appears_whole_and_goes_on_where_it_stopped(path, tmp_path):
    drive, folder = StreetDrive("kitti06", kitti=path, count=5, width=96), tmp_path / "drive"
    done = []

    def stop_after_three(count, total):
        done.append(count)
        if count == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        record(drive, folder, color=True, progress=stop_after_three)
    assert not folder.exists()
    rendered, own = [], drive._frame
    drive._frame = lambda index: rendered.append(index) or own(index)
    record(drive, folder, color=True)
    assert rendered == [3, 4]
    assert [child.name for child in tmp_path.iterdir()] == ["drive"]
    record(drive, folder, color=True)
    assert rendered == [3, 4]
    dataset = open_dataset(folder)
    assert isinstance(dataset, KITTI)
    assert len(dataset) == 5
    for index in (0, 4):
        frame, expected = dataset.frame(index), own(index)
        for name in ("left", "right", "color"):
            np.testing.assert_array_equal(getattr(frame, name), getattr(expected, name))
        np.testing.assert_allclose(dataset.pose(index), drive.pose(index), atol=1e-12)
    assert dataset.frame(0).baseline_fx == pytest.approx(drive.baseline_fx)
    assert len(StreetDrive("kitti06", kitti=folder)) == 5  # its poses are a path too
    with pytest.raises(
        DatasetError, match="holds something else than synthetic kitti06; choose another folder"
    ):
        record(StreetDrive("kitti06", kitti=path, count=4, width=96), folder, color=True)


def test_pykitti_reads_a_recording(path, tmp_path):
    pykitti = pytest.importorskip("pykitti")
    drive = StreetDrive("kitti06", kitti=path, count=2, width=96)
    record(drive, tmp_path / "drive")
    theirs = pykitti.odometry(str(tmp_path / "drive"), "06")
    file = tmp_path / "drive" / "sequences" / "06" / "image_1" / "000001.png"
    ours = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
    np.testing.assert_array_equal(np.asarray(theirs.get_cam1(1)), ours)
    assert theirs.calib.b_gray == pytest.approx(drive.baseline_fx / drive.intrinsics.fx)
    np.testing.assert_allclose(theirs.poses[1], drive.pose(1))
    assert theirs.timestamps[1].total_seconds() == pytest.approx(0.1)


def test_a_desk_is_recorded_as_corbs_is(tmp_path):
    desk = Desk(count=4, width=64)
    record(desk, tmp_path / "desk")
    dataset = open_dataset(tmp_path / "desk")
    assert (len(dataset), dataset.sensor, dataset.camera.intrinsics) == (4, "tof", desk.camera.intrinsics)
    theirs, ours = dataset.frame(3), desk.frame(3)
    np.testing.assert_array_equal(theirs.color, ours.color)
    np.testing.assert_allclose(theirs.depth / 5000, ours.depth * 1e-4, atol=1.01e-4)
    np.testing.assert_allclose(dataset.pose(3), desk.pose(3), atol=1e-8)
    with pytest.raises(DatasetError, match="can be recorded as tof or as a drive, not as lidar"):
        record(Desk("desk", "lidar", count=1), tmp_path / "scans")
