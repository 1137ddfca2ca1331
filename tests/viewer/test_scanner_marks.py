# SPDX-License-Identifier: MIT
"""Where scanners are, what they saw, and their ways: corrected ones, and as they were before."""

from typing import Any

import cv2
import numpy as np
import pytest
from drawn_scenes import DrawnScene

from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.geometry.trajectory import quaternion
from tsfusion.viewer.map.scanner_marks import ScannerMarks
from tsfusion.wire.asking.followed_map import PathsFound, ScannerSeen

ANNA, BOB = b"a" * 16, b"b" * 16
CAMERA = Intrinsics(400.0, 400.0, 319.5, 239.5)


def pose(x: float, y: float = 0.0) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]
    T[:3, 3] = x, y, 0
    return T


def picture(value: int = 90) -> bytes:
    return bytes(cv2.imencode(".jpg", np.full((480, 640, 3), value, np.uint8))[1].tobytes())


def seen(session: bytes, seq: int, T: np.ndarray, **fields: Any) -> ScannerSeen:
    given = {"intrinsics": CAMERA, "shape": (480, 640), "picture": picture(), **fields}
    return ScannerSeen(session, seq, T, **given)


@pytest.fixture
def marks() -> ScannerMarks:
    found = ScannerMarks(DrawnScene())  # type: ignore[arg-type]
    found.voxel_size = 0.02
    return found


def drawn(marks: ScannerMarks, now: float = 100.0) -> DrawnScene:
    marks.draw(now)
    scene: Any = marks._scene
    return scene


def test_a_camera_stands_where_it_was_last_with_its_picture_small(marks: ScannerMarks) -> None:
    marks.note_seen(seen(ANNA, 1, pose(0.1)))
    marks.note_seen(seen(ANNA, 2, pose(0.2)))
    node: Any = drawn(marks).nodes[f"/scanners/{ANNA.hex()}"]
    assert node.position.tolist() == [0.2, 0, 0]
    assert np.allclose(np.roll(node.wxyz, -1), quaternion(pose(0)[:3, :3]))
    assert node.image.shape == (240, 320, 3)
    assert abs(int(node.image.mean()) - 90) <= 2
    assert node.aspect == pytest.approx(4 / 3)


def test_a_lidar_has_axes_and_a_broken_picture_is_left_out(marks: ScannerMarks) -> None:
    marks.note_seen(seen(BOB, 1, pose(0), intrinsics=None, shape=None, picture=None, client="bob"))
    marks.note_seen(seen(ANNA, 1, pose(1), picture=b"\xff\xd8 no picture"))
    scene = drawn(marks)
    assert "image" not in scene.nodes[f"/scanners/{BOB.hex()}"].__dict__
    assert scene.nodes[f"/scanners/{ANNA.hex()}"].__dict__["image"] is None
    assert marks.name(BOB) == "bob"
    assert marks.name(ANNA) == ANNA.hex()[:8]


def test_axes_become_a_frustum_once_the_camera_is_known(marks: ScannerMarks) -> None:
    """A page that comes late is told the path before a keyframe."""
    marks.note_paths(PathsFound({ANNA: (np.array([1]), pose(0.1)[None])}))
    name = f"/scanners/{ANNA.hex()}"
    assert "image" not in drawn(marks).nodes[name].__dict__
    marks.note_seen(seen(ANNA, 2, pose(0.2)))
    node: Any = drawn(marks, 200.0).nodes[name]
    assert node.image.shape == (240, 320, 3)
    assert node.position.tolist() == [0.2, 0, 0]


def test_a_corrected_path_stands_beside_the_one_before(marks: ScannerMarks) -> None:
    for seq in range(1, 6):
        marks.note_seen(seen(ANNA, seq, pose(0.1 * seq)))
    scene = drawn(marks)
    path, first = f"/paths/{ANNA.hex()}", f"/first-paths/{ANNA.hex()}"
    assert np.asarray(scene.nodes[path].points).shape == (4, 2, 3)
    assert first not in scene.nodes
    moved = np.array([pose(0.1 * seq, 0.05 * seq) for seq in range(1, 5)])
    marks.note_paths(PathsFound({ANNA: (np.arange(1, 5), moved)}))
    scene = drawn(marks, 200.0)
    points = np.asarray(scene.nodes[path].points)
    assert np.allclose(points[:, 0], moved[:, :3, 3]), "the fifth keyframe is not fused yet, and stays"
    assert np.allclose(points[-1, 1], (0.5, 0, 0))
    before = np.asarray(scene.nodes[first].points)
    assert np.allclose(before[:, 0, 0], 0.1 * np.arange(1, 5))
    strong, faded = (scene.nodes[name].__dict__ for name in (path, first))
    assert strong["thickness"] > faded["thickness"]
    assert np.ptp(strong["colors"].astype(int)) > np.ptp(faded["colors"].astype(int))


def test_forgotten_keyframes_leave_the_path(marks: ScannerMarks) -> None:
    poses = np.array([pose(0.1 * seq) for seq in range(4)])
    marks.note_paths(PathsFound({ANNA: (np.arange(4), poses), BOB: (np.arange(4), poses + 1)}))
    marks.note_paths(PathsFound({ANNA: (np.array([0, 1, 3]), poses[[0, 1, 3]])}))
    assert len(xs(marks)) == 3
    assert np.allclose(marks.pose(ANNA), poses[3])  # type: ignore[arg-type]


def test_kinds_of_marks_are_hidden_and_shown(marks: ScannerMarks) -> None:
    marks.show("paths", False)
    for seq in range(3):
        marks.note_seen(seen(ANNA, seq, pose(0.1 * seq)))
    scene = drawn(marks)
    path: Any = scene.nodes[f"/paths/{ANNA.hex()}"]
    marks.show("scanners", False)
    assert not scene.nodes[f"/scanners/{ANNA.hex()}"].visible
    marks.show("paths", True)
    assert path.visible
    marks.clear()
    assert not scene.nodes


def test_a_long_path_is_thinned_and_a_jump_is_no_line(marks: ScannerMarks) -> None:
    poses = np.array([pose(0.01 * seq) for seq in range(10_000)])
    poses[5000:, 1, 3] += 50
    marks.note_paths(PathsFound({ANNA: (np.arange(10_000), poses)}))
    points = np.asarray(drawn(marks).nodes[f"/paths/{ANNA.hex()}"].points)
    assert 2000 < len(points) < 3100
    assert np.linalg.norm(points[:, 1] - points[:, 0], axis=1).max() < 1.3


def paths(*seqs: int) -> PathsFound:
    found = (np.array(seqs, np.int64), np.array([pose(seq) for seq in seqs]).reshape(-1, 4, 4))
    return PathsFound({ANNA: found} if seqs else {})


def xs(marks: ScannerMarks) -> list[float]:
    return sorted(place[0] for track in marks._scanners.values() for place in track.now.values())


def test_a_keyframe_that_came_after_the_paths_were_asked_for_stays(marks: ScannerMarks) -> None:
    for seq in (1, 2, 3):
        marks.note_seen(seen(ANNA, seq, pose(seq)))
    marks.note_paths(paths(1, 2))
    assert xs(marks) == [1, 2, 3]
    assert marks.pose(ANNA) is not None


def test_a_map_that_is_rewound_has_the_path_of_its_time(marks: ScannerMarks) -> None:
    marks.note_paths(paths(1, 2, 3, 4))
    marks.note_seen(seen(ANNA, 4, pose(4)))
    drawn(marks, 0.0)
    for seq in (3, 2):  # back in time
        marks.note_seen(seen(ANNA, seq, pose(seq)))
    marks.note_paths(paths(1, 2))
    marks.note_seen(seen(ANNA, 2, pose(2)))
    node: Any = drawn(marks, 10.0).nodes[f"/scanners/{ANNA.hex()}"]
    assert xs(marks) == [1, 2]
    assert node.position.tolist() == [2, 0, 0]
    marks.note_paths(paths())  # before the first keyframe
    assert f"/scanners/{ANNA.hex()}" not in drawn(marks, 20.0).nodes
    assert (xs(marks), marks.pose(ANNA)) == ([], None)
    marks.note_paths(paths(1, 2, 3, 4))
    marks.note_seen(seen(ANNA, 4, pose(4)))
    assert f"/scanners/{ANNA.hex()}" in drawn(marks, 30.0).nodes
    assert xs(marks) == [1, 2, 3, 4]
