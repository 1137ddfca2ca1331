# SPDX-License-Identifier: MIT
"""Each recording among the real data opens by its path alone, or is refused with what to do instead."""

import importlib.util
from collections.abc import Callable
from pathlib import Path

import pytest
from small_recordings import one_line

from tsfusion.core.errors import TsfusionError
from tsfusion.datasets import describe, find

POSED, UNPOSED, SCAN = "all with poses", "no poses", "`tsfusion scan PATH` finds poses"
FOUND = {  # path → layout, words of its description
    "3dmatch": ("7-Scenes", POSED),
    "7scenes/redkitchen": ("7-Scenes", POSED),
    "azure_kinect": ("Azure Kinect", UNPOSED),
    "azure_kinect/recording.mkv": ("Azure Kinect", "1 RGB-D frames 640×576, no poses"),
    "euroc_V1_01": ("EuRoC", POSED),
    "hololens": ("HoloLens", POSED),
    "icl_nuim_tum": ("TUM RGB-D", POSED),
    "kitti07_lidar_keyframes": ("LiDAR keyframes", "5 scans, all with poses"),
    "kitti_odometry/sequences/06": ("KITTI odometry", POSED),
    "lidar_ply_pair": ("LiDAR pair", "2 scans, all with poses"),
    "lidar_ply_pair/source.ply": ("LiDAR scans", "1 scans, no poses"),
    "livox_pcd": ("LiDAR scans", "3 scans at 2 Hz, all with poses"),
    "livox_pcd/full24.pcd": ("LiDAR scans", "1 scans, no poses"),
    "open3d_rgbd": ("Redwood", POSED),
    "pcl_organised": ("LiDAR scans", "1 scans, no poses"),
    "realsense_bag": ("ROS bag", "2 depth images 640×480 at 6 Hz, no poses"),
    "record3d_export": ("Record3D", "53 RGB-D frames 192×256 at 14.9 Hz, all with poses"),
    "redwood_livingroom1": ("Redwood", POSED),
    "rgbd_dataset_freiburg1_xyz": ("TUM RGB-D", POSED),
    "ros2_lidar_packets/vlp16/1673400472138016708.pcd": ("LiDAR scans", UNPOSED),
    "ros2_lidar_packets/xt16/1732848128093928016.pcd": ("LiDAR scans", UNPOSED),
    "semantic_kitti": ("LiDAR scans", "1 scans, no poses"),
    "semantic_kitti/sequences/08/velodyne/000000.bin": ("LiDAR scans", "1 scans, no poses"),
    "stanford_bunny": ("LiDAR scans", "6 scans, no poses"),
    "velodyne_pcap": ("LiDAR packets", "4 scans at 10.5 Hz, no poses"),
}
REFUSED = {  # path → the cure
    "7scenes": "holds 2 datasets; open one of them: ",
    "kitti_odometry": "name one with --sequence, or give its own path",
    "las_georeferenced": "holds 5 clouds of points .*; open one, or name those of one LiDAR by numbers",
    "las_georeferenced/autzen_trim.laz": "expected where the scanner was, in the grid of the points .--traj",
    "las_georeferenced/epsg_4326.las": "are degrees: project points and poses first",
    "las_georeferenced/simple.las": "expected where the scanner was, in the grid of the points .--trajectory",
    "middlebury_motorcycle": "in no layout known here: .*; `tsfusion datasets` says what each expects",
    "ros2_lidar_packets": "holds 2 datasets; open one of them: ",
    "ros2_lidar_packets/vlp16": "packets of a LiDAR: its driver makes PointCloud2 of them, record that topic",
    "ros2_lidar_packets/xt16": "packets of a LiDAR: its driver makes PointCloud2 of them, record that topic",
    "ouster_packets": "holds 3 files of packets .*pcap, .*osf, 512x10_raw.bag.; open one",
    "synthetic_room": "in no layout known here: .*; `tsfusion datasets` says what each expects",
    "tum_rgbd": "holds 2 datasets; open one of them: ",
}
NEEDS = {  # start of a path → module
    "azure": "av",
    "las": "laspy",
    "livox": "pypcd4",
    "ouster": "rosbags",
    "pcl": "pypcd4",
    "realsense": "rosbags",
    "record3d": "OpenEXR",
    "ros2": "rosbags",
    "velodyne": "velodyne_decoder",
}


def needed(path: str, data: Callable[[str], Path]) -> Path:
    for start, module in NEEDS.items():
        if path.startswith(start):
            pytest.importorskip(module)
    return data(path)


@pytest.mark.parametrize("path", FOUND)
def test_a_recording_opens_by_its_path(data: Callable[[str], Path], path: str) -> None:
    layout, words = FOUND[path]
    found = find(needed(path, data))
    assert found.layout.name == layout
    dataset = found.open(posed=words.endswith(POSED))
    assert words in describe(dataset)
    if not words.endswith(POSED):
        with pytest.raises(TsfusionError, match=SCAN):
            found.open()


@pytest.mark.parametrize("path", REFUSED)
def test_what_is_no_recording_is_refused_with_the_cure(data: Callable[[str], Path], path: str) -> None:
    whole = needed(path, data)
    if "degrees" in REFUSED[path]:
        with pytest.raises(TsfusionError, match=REFUSED[path]):
            find(whole).open(posed=False)
    else:
        one_line(lambda: find(whole).open(posed=False), REFUSED[path])


@pytest.mark.parametrize("name", ["OS-0-128-U1_v2.3.0_1024x10.pcap", "512x10_raw.bag"])
def test_an_ousters_packets_open_where_its_library_is(data: Callable[[str], Path], name: str) -> None:
    if importlib.util.find_spec("ouster") is None:
        with pytest.raises(TsfusionError, match="pip install --no-deps ouster-sdk"):
            find(data(f"ouster_packets/{name}")).open(posed=False)
    else:
        assert find(data(f"ouster_packets/{name}")).layout.name == "LiDAR packets"
