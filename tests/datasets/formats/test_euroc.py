# SPDX-License-Identifier: MIT
"""EuRoC: a rig driven through the synthetic room comes back with its poses and depth."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
import rig_recordings
import written_recordings
from geometry_checks import warp_residual
from rig_recordings import circle
from small_recordings import LeftOut, one_line_of, put, replace
from written_recordings import at, fits_together

from tsfusion.core.errors import DatasetError
from tsfusion.datasets import EuRoC, describe, open_dataset
from tsfusion.geometry import se3
from tsfusion.geometry.calibration import Camera
from tsfusion.geometry.se3 import angle, inverse

CAM0, CAM1, TRUTH = "mav0/cam0", "mav0/cam1", "mav0/state_groundtruth_estimate0/data.csv"


@pytest.fixture(scope="module", params=["radial-tangential", "equidistant"])
def euroc_root(request, tmp_path_factory):
    return rig_recordings.euroc(tmp_path_factory.mktemp("euroc") / request.param, request.param)


@pytest.fixture
def euroc(euroc_root, tmp_path):
    """One to break."""
    return Path(shutil.copytree(euroc_root, tmp_path / "V1"))


def test_euroc_poses_and_depth_are_the_rectified_left_cameras(euroc_root):
    dataset = open_dataset(euroc_root)
    assert isinstance(dataset, EuRoC)
    assert (len(dataset), dataset.sensor, dataset.skipped) == (3, "stereo", {})
    turn = inverse(circle(1)[0]) @ dataset.pose(0)
    assert 0.3 < np.degrees(angle(turn)) < 5  # rectification turns the camera, and moves it nowhere
    for index, T in enumerate(circle(3)):
        np.testing.assert_allclose(dataset.pose(index), T @ turn, atol=1e-6)
    a, b = dataset[0], dataset[1]
    assert (a.disparity > 0).mean() > 0.85
    fits_together(a, b, bound=0.026)
    truth = at([a.T_world_camera], width=640)[0]
    assert warp_residual(a, truth) < 0.04  # 0.2 px of disparity at 2.6 m
    flat = Camera(dataset.intrinsics, (240, 376))
    expected = written_recordings.through_lens(truth.color, truth.intrinsics, flat)
    assert written_recordings.shift(a.color, expected) < 0.1  # pixels


def test_euroc_frames_are_pairs_with_stamps(euroc_root):
    dataset = EuRoC(euroc_root / "mav0")
    assert dataset.name == f"EuRoC {euroc_root.name}"
    frame = dataset.frame(1)
    assert (frame.kind, frame.shape) == ("pair", (240, 376))
    assert frame.timestamp_ns == rig_recordings.FIRST_NS + 50_000_000
    assert frame.baseline_fx == pytest.approx(dataset.intrinsics.fx * np.linalg.norm((0.06, 0.002, -0.003)))
    said, camera = describe(dataset).split("; camera ")
    assert said.endswith("3 stereo pairs 376×240 at 20 Hz, all with poses")
    assert camera.endswith(", 376×240, from sensor.yaml, rectified")


def test_euroc_images_without_their_other_half_are_counted(euroc):
    left, right = (sorted((euroc / cam / "data").glob("*.png")) for cam in (CAM0, CAM1))
    left[0].unlink()
    lines = (euroc / CAM1 / "data.csv").read_text().splitlines()
    (euroc / CAM1 / "data.csv").write_text("\n".join([*lines[:2], *lines[3:]]) + "\n")
    dataset = EuRoC(euroc)
    assert dataset.skipped == {"without their other half": 2}
    assert list(dataset.timestamps_ns) == [int(left[2].stem)]
    with pytest.raises(DatasetError, match=r"no usable frames.*\(3 without their other half\)"):
        EuRoC(euroc, max_difference_s=1e-9)
    right[2].write_bytes(b"")
    with pytest.raises(DatasetError, match=r"cannot be decoded; expected an image"):
        dataset[0]


def test_euroc_stamps_can_be_shifted_and_poses_missing(euroc):
    shifted = EuRoC(euroc, time_offset_s=0.05)
    assert shifted.skipped == {"without a pose in time": 1}
    np.testing.assert_allclose(shifted.pose(0), EuRoC(euroc).pose(1), atol=1e-9)
    unposed = EuRoC(euroc, time_offset_s=0.05, posed=False)
    assert [unposed.pose(index) is None for index in range(3)] == [False, False, True]
    (euroc / TRUTH).unlink()
    assert EuRoC(euroc, posed=False).frame(0).T_world_camera is None
    with pytest.raises(DatasetError, match=r"data\.csv is missing; expected `ns,px.*`tsfusion scan"):
        EuRoC(euroc)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda root: (root / CAM1 / "sensor.yaml").unlink(), r"cam1/sensor\.yaml is missing"),
        (replace(f"{CAM0}/sensor.yaml", "T_BS", "T_XX"), r"sensor\.yaml"),
        (replace(f"{CAM0}/sensor.yaml", "resolution: [376, 240]", "resolution: [752, 480]"),
         r"the camera was calibrated for images of 752×480, got 376×240"),
        (replace(f"{CAM0}/sensor.yaml", "distortion_model", "other"), r"sensor\.yaml has no distortion_m"),
        (replace(f"{CAM1}/sensor.yaml", "distortion_coefficients", "other"),
         r"distortion_model is .*, and its coefficients are missing"),
        (replace(f"{CAM0}/data.csv", ",", ";"), r"cam0/data\.csv:2: .*; expected `ns,file` a line"),
        (replace(TRUTH, f"{rig_recordings.FIRST_NS},", "soon,"),
         LeftOut(r"must be nanoseconds, got 'soon'", {"without a pose in time": 1})),
        (replace(TRUTH, ",0,0,0,0,0,0,0,0,0", ""), None),
        (put(TRUTH, "1,2,3\n"), r"data\.csv:1: 2 numbers, expected 7"),
        (put(TRUTH, "1,2,3,4,5,6,7,8\n"), r"quaternion must have length 1"),
        (put(TRUTH, "1,0,0,0,1,0,0,0\n"), r"\(3 without a pose in time\)"),
    ],
)  # fmt: skip
def test_a_broken_euroc_sequence_is_one_clear_line(euroc, change, match):
    change(euroc)
    if match is None:  # the columns of velocity and bias are not needed
        assert len(list(EuRoC(euroc))) == 3
        return
    one_line_of(lambda: EuRoC(euroc), match)


def test_euroc_accelerometer_is_turned_into_the_cameras_axes(euroc, caplog):
    """A body that moves evenly measures the opposite of gravity, along the room's z."""
    turn = se3.exp(np.array((0.1, 0, 0, 0.3, -0.5, 0.7)))  # of the accelerometer on the body
    rows = ["#timestamp [ns],w_RS_S_x [rad s^-1],...,a_RS_S_z [m s^-2]"]
    for index, T in enumerate(circle(3)):
        force = (T @ inverse(rig_recordings.T_BODY_LEFT) @ turn)[:3, :3].T @ (0, 0, 9.81)
        stamp = rig_recordings.FIRST_NS + 50_000_000 * index
        rows += [f"{stamp + late},0,0,0,{force[0]},{force[1]},{force[2]}" for late in (-9, 9)]
    imu = euroc / "mav0" / "imu0"
    imu.mkdir()
    (imu / "sensor.yaml").write_text(f"T_BS:\n  cols: 4\n  rows: 4\n  data: {turn.reshape(-1).tolist()}\n")
    (imu / "data.csv").write_text("\n".join(rows) + "\n")
    dataset = open_dataset(euroc)
    for index in range(3):
        up = dataset.pose(index)[:3, :3] @ dataset.frame(index).specific_force
        assert up == pytest.approx((0, 0, 9.81), abs=0.3)  # the neighbours' are within 50 ms, too
        np.testing.assert_allclose(dataset.frame(index).specific_force, dataset.frame(index).specific_force)
    assert dataset.frame(1).turn_since(dataset.frame(0).attitude) == pytest.approx(np.eye(3), abs=1e-9)
    (imu / "data.csv").write_text("\n".join([*rows, "1,2,3"]))
    np.testing.assert_array_equal(EuRoC(euroc).frame(0).specific_force, dataset.frame(0).specific_force)
    assert "imu0/data.csv: 1 of 7 lines are broken, the first: " in caplog.text
    put("mav0/imu0/data.csv", "1,2,3\n")(euroc)
    assert EuRoC(euroc).frame(0).specific_force is None
    assert "imu0/data.csv:1: '1,2,3'; expected `ns,wx,wy,wz,ax,ay,az` a line" in caplog.text
    (imu / "data.csv").unlink()
    assert EuRoC(euroc).frame(0).specific_force is None


def test_euroc_gyroscope_tells_the_turn_between_frames(euroc):
    """A body turns about an axis of its own; the gyroscope sits askew on it."""
    turn = se3.exp(np.array((0.1, 0, 0, 0.3, -0.5, 0.7)))
    rate = np.array((0.4, -1.0, 3.0))  # rad/s, on the body
    measured = turn[:3, :3].T @ rate
    rows = [
        f"{rig_recordings.FIRST_NS + late},{measured[0]},{measured[1]},{measured[2]},0,0,9.81"
        for late in range(-5_000_000, 115_000_000, 5_000_000)
    ]
    imu = euroc / "mav0" / "imu0"
    imu.mkdir()
    (imu / "sensor.yaml").write_text(f"T_BS:\n  cols: 4\n  rows: 4\n  data: {turn.reshape(-1).tolist()}\n")
    (imu / "data.csv").write_text("\n".join(rows) + "\n")
    first, second, third = map(open_dataset(euroc).frame, range(3))
    R_body_camera = rig_recordings.T_BODY_LEFT[:3, :3]
    expected = R_body_camera.T @ se3.exp(np.array((0, 0, 0, *rate * 0.05)))[:3, :3] @ R_body_camera
    assert second.turn_since(first.attitude) == pytest.approx(expected, abs=0.02)
    assert third.turn_since(first.attitude) == pytest.approx(expected @ expected, abs=0.04)


def test_euroc_as_recorded(data):
    dataset = open_dataset(data("euroc_V1_01"))
    assert (len(dataset), dataset.skipped) == (4, {})
    frame = dataset.frame(0)
    assert frame.baseline_fx / frame.intrinsics.fx == pytest.approx(0.11008, abs=5e-5)
    corners = cv2.goodFeaturesToTrack(frame.left, 300, 0.01, 8)
    moved, found, _ = cv2.calcOpticalFlowPyrLK(
        frame.left, frame.right, corners, None, winSize=(21, 21), maxLevel=4
    )
    apart = np.abs((moved - corners)[found[:, 0] == 1, 0, 1])
    assert np.median(apart) < 0.4
    assert (dataset[0].disparity > 0).mean() > 0.5
    # The drone stands: its body is where the ground truth's first row has it, the camera 7 cm from there.
    assert np.linalg.norm(dataset.pose(0)[:3, 3] - (0.878895, 2.1834, 0.948427)) == pytest.approx(
        0.0689, abs=1e-3
    )
    assert warp_residual(dataset[0], dataset[3], max_depth=4) < 0.02
