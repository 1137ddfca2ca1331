# SPDX-License-Identifier: MIT
"""Choice of the frames that become keyframes of the map."""

import numpy as np
import pytest

from lab.worlds.street_drive import DRIVES
from tsfusion import Intrinsics, open_dataset
from tsfusion.core.config import ScanConfig
from tsfusion.datasets.dataset import frame_of
from tsfusion.datasets.trajectory_files import read_kitti
from tsfusion.geometry import se3
from tsfusion.geometry.frame import Frame
from tsfusion.scanner.keyframe_selection import KeyframeSelector

K = Intrinsics(100.0, 100.0, 79.5, 59.5)


def wall(z: float = 2.0, stamp: int = 1) -> Frame:
    """A wall straight ahead."""
    depth = np.full((120, 160), z, np.float32)
    return Frame(sensor="kinect", depth=depth, intrinsics=K, timestamp_ns=stamp)


def at(*translation: float, degrees: float = 0.0) -> np.ndarray:
    """A pose that is moved, and turned about the vertical."""
    T = se3.exp(np.array([0, 0, 0, 0, np.radians(degrees), 0]))
    T[:3, 3] = translation
    return T


def selector(outdoors: bool = False, **rules) -> KeyframeSelector:
    """One that has taken a wall at the origin."""
    made = KeyframeSelector(ScanConfig(**rules), outdoors=outdoors)
    assert made.reason(wall(), at(0, 0, 0)) == "first"
    made.accept(wall(), at(0, 0, 0))
    return made


@pytest.mark.parametrize(
    ("rules", "T", "reason"),
    [
        ({}, at(0, 0, 0.05), None),
        ({}, at(0, 0, 0.11), "distance"),
        ({"distance": 0.2}, at(0, 0, 0.11), None),
        ({}, at(0, 0, 0, degrees=8), None),
        ({}, at(0, 0, 0, degrees=11), "angle"),
        ({"angle": 5.0}, at(0, 0, 0, degrees=8), "angle"),
        # A step of d moves the wall's view by 50 d of 160 pixels: 0.64 m leave 80 % of it.
        ({"distance": 9.0}, at(0.4, 0, 0), None),
        ({"distance": 9.0}, at(0.9, 0, 0), "overlap"),
        ({"distance": 9.0, "min_overlap": 0.5}, at(0.9, 0, 0), None),
        ({"distance": 9.0}, at(0, 0, 1.0), "overlap"),
    ],
)
def test_rules(rules, T, reason):
    assert selector(**rules).reason(wall(), T) == reason


def test_outdoors_goes_further():
    assert selector(outdoors=True, min_overlap=0.0).reason(wall(), at(0, 0, 1.9)) is None
    assert selector(outdoors=True, min_overlap=0.0).reason(wall(), at(0, 0, 2.1)) == "distance"


def test_at_most_so_many_a_second():
    made = selector(max_rate=2.0)
    assert made.reason(wall(stamp=499_999_999), at(1, 0, 0)) is None
    assert made.reason(wall(stamp=500_000_002), at(1, 0, 0)) == "distance"


def test_pairs_points_and_blind_frames_have_no_overlap():
    image = np.zeros((120, 160), np.uint8)
    frames = [
        Frame(sensor="stereo", left=image, right=image, intrinsics=K, baseline_fx=50.0),
        Frame(sensor="lidar", points=np.ones((10, 3), np.float32)),
        wall(z=0.0),
    ]
    for frame in frames:
        made = KeyframeSelector(ScanConfig(distance=9.0), outdoors=False)
        made.accept(frame, at(0, 0, 0))
        assert made.reason(frame, at(3, 0, 0)) is None
        assert made.reason(frame, at(9, 0, 0)) == "distance"


def test_reset_begins_anew():
    made = selector()
    made.reset()
    assert made.reason(wall(), at(0, 0, 0)) == "first"


def test_rates_on_real_scenes(data):
    """The rates that docs/localization.md gives: every keyframe's reason, over the true poses."""
    counts = {}
    scenes = {"7scenes/redkitchen": {}, "kitti_odometry": {"sequence": "06"}}
    for name, options in scenes.items():
        dataset = open_dataset(data(name), **options)
        made = KeyframeSelector(ScanConfig(), outdoors=dataset.sensor == "stereo")
        taken = []
        for index in range(len(dataset)):
            frame = frame_of(dataset, index)
            reason = made.reason(frame, frame.T_world_camera)
            if reason:
                made.accept(frame, frame.T_world_camera)
                taken.append(reason)
        counts[name] = len(taken), len(dataset)
    kitchen, street = counts.values()
    assert 30 <= kitchen[0] <= 36, counts  # of 125 in 16.5 s: two a second
    assert 14 <= street[0] <= 18, counts  # of 30 at 10 Hz: five a second


@pytest.mark.parametrize(("name", "wanted"), [("kitti06", 428), ("kitti07", 242)])
def test_drives_have_as_many_keyframes_as_the_paper_fused(data, name, wanted):
    poses = read_kitti(data("kitti_odometry") / "poses" / f"{DRIVES[name].sequence}.txt")
    made = KeyframeSelector(ScanConfig(distance=DRIVES[name].keyframe_distance), outdoors=True)
    grey = np.zeros((4, 4), dtype=np.uint8)
    frame = Frame(sensor="stereo", left=grey, right=grey, intrinsics=Intrinsics(4, 4, 2, 2), baseline_fx=1.0)
    taken = 0
    for T in poses:
        if made.reason(frame, T):
            made.accept(frame, T)
            taken += 1
    assert taken == wanted
