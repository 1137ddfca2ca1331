# SPDX-License-Identifier: MIT
"""Opening a dataset: layouts are recognised, and everything else is one clear line."""

import numpy as np
import pytest
from command_processes import python
from small_recordings import one_line, seven_scenes

from tsfusion import datasets
from tsfusion.core.errors import DatasetError
from tsfusion.datasets import Dataset, open_dataset, select
from tsfusion.geometry.keyframe import Keyframe
from tsfusion.geometry.origin import Origin


@pytest.mark.parametrize(
    ("name", "options", "layout", "sensor", "count"),
    [
        ("7scenes/redkitchen", {}, datasets.SevenScenes, "kinect", 125),
        ("7scenes/redkitchen_png", {}, datasets.SevenScenes, "kinect", None),
        ("3dmatch", {}, datasets.SevenScenes, "kinect", 5),
        ("hololens", {}, datasets.HoloLens, "tof", 40),
        ("hololens/000", {}, datasets.HoloLens, "tof", 40),
        ("redwood_livingroom1", {}, datasets.Redwood, "kinect", 60),
        ("open3d_rgbd", {}, datasets.Redwood, "kinect", 5),
        ("icl_nuim_tum", {}, datasets.TUM, "kinect", 3),
        ("kitti_odometry", {"sequence": "06"}, datasets.KITTI, "stereo", 30),
        ("kitti_odometry/sequences/06", {}, datasets.KITTI, "stereo", 30),
        ("kitti_odometry/sequences/00", {}, datasets.KITTI, "lidar", 6),
    ],
)
def test_real_layouts_are_recognised(data, name, options, layout, sensor, count):
    dataset = open_dataset(data(name), **options)
    assert isinstance(dataset, layout)
    assert isinstance(dataset, Dataset)
    assert dataset.sensor == sensor
    assert dataset.skipped == {}
    if count is not None:
        assert len(dataset) == count
    first = dataset[0]
    assert isinstance(first, Keyframe)
    assert first.sensor == sensor
    np.testing.assert_array_equal(dataset[-len(dataset)].measurement, first.measurement)


def test_synthetic_worlds_have_names():
    assert open_dataset("synthetic:room").sensor == "kinect"
    street = open_dataset("synthetic:street:lidar", count=3)
    assert (street.name, street.sensor, len(street)) == ("synthetic street", "lidar", 3)


def test_iteration_indexing_and_selection(tmp_path):
    dataset = open_dataset(seven_scenes(tmp_path, count=5))
    assert [int(keyframe.measurement[0, 0]) for keyframe in dataset] == [100, 101, 102, 103, 104]
    with pytest.raises(IndexError, match="5 keyframes, got index 5"):
        dataset[5]
    chosen = select(dataset, start=1, stride=2)
    assert [int(keyframe.measurement[0, 0]) for keyframe in chosen] == [101, 103]
    assert len(select(dataset, limit=2)) == 2
    assert chosen.name == dataset.name
    assert not hasattr(chosen, "distance")
    world = open_dataset("synthetic:room", count=6)
    assert list(select(world, stride=3).timestamps_ns) == [0, 300_000_000]
    assert select(world, stride=3).distance(np.array([[0, 0, 0.1]])) == pytest.approx(0.1)
    with pytest.raises(DatasetError, match="has 5 keyframes, none after the first 5"):
        select(dataset, start=5)
    with pytest.raises(DatasetError, match="stride must be >= 1"):
        select(dataset, stride=0)
    with pytest.raises(DatasetError, match="none from 2 up to 2"):
        select(dataset, start=2, stop=2)
    with pytest.raises(DatasetError, match="limit must be >= 1, got 0"):
        select(dataset, limit=0)


def test_images_are_not_read_before_they_are_asked_for(tmp_path):
    dataset = open_dataset(seven_scenes(tmp_path))
    (tmp_path / "frame-000001.depth.png").write_bytes(b"not a png")
    assert dataset[0].shape == (6, 8)
    with pytest.raises(DatasetError, match=r"frame-000001\.depth\.png cannot be decoded"):
        dataset[1]


def test_layouts_are_listed_with_what_they_expect():
    found = datasets.layouts()
    assert {"7-Scenes", "TUM RGB-D", "EuRoC", "ScanNet"} <= {layout.name for layout in found}
    assert all(layout.description and "\n" not in layout.description for layout in found)
    assert len({layout.name for layout in found}) == len(found)


@pytest.mark.parametrize(
    ("make", "match"),
    [
        (lambda root: root / "nowhere", r"nowhere does not exist"),
        (lambda root: (root / "file").write_text("x") and root / "file", r"file is not a folder"),
        (lambda root: root, r"is in no layout known here: .*7-Scenes.*; `tsfusion datasets` says"),
        (lambda _: "synthetic:moon", r"world must be one of room, street, .*, got 'moon'"),
        (lambda _: "synthetic:room:radar", r"must be kinect, tof, stereo or lidar, got 'radar'"),
        (lambda _: "synthetic:room:kinect:x", r"expected synthetic:WORLD"),
    ],
)
def test_what_cannot_be_opened_is_one_clear_line(tmp_path, make, match):
    one_line(lambda: open_dataset(make(tmp_path)), match)


def test_several_datasets_in_a_folder_are_named(tmp_path):
    seven_scenes(tmp_path / "chess", 1)
    assert len(open_dataset(tmp_path)) == 1
    seven_scenes(tmp_path / "fire", 1)
    with pytest.raises(DatasetError, match=r"holds 2 datasets; open one of them: .*chess, .*fire"):
        open_dataset(tmp_path)


def test_an_option_of_another_layout_is_refused(tmp_path):
    with pytest.raises(DatasetError, match=r"^a 7-Scenes dataset takes no `sequence`; it takes .*posed"):
        open_dataset(seven_scenes(tmp_path), sequence="06")


def test_recorded_datasets_do_not_import_taichi_or_pykitti(tmp_path):
    code = (
        "import sys; from tsfusion.datasets import open_dataset; open_dataset(sys.argv[1])[0]; "
        "sys.exit(' '.join({'taichi', 'pykitti', 'pandas'} & set(sys.modules)) or None)"
    )
    done = python(code, seven_scenes(tmp_path))
    assert (done.returncode, done.stderr) == (0, "")


def test_some_of_a_recording_count_from_its_origin(tmp_path):
    dataset = open_dataset(seven_scenes(tmp_path, count=3), origin="300,200,100")
    chosen = dataset[1:]
    assert chosen.origin == dataset.origin == Origin((300, 200, 100))
    np.testing.assert_array_equal(chosen[0].T_world_camera, dataset[1].T_world_camera)
