# SPDX-License-Identifier: MIT
"""Keyframes: what one must be, and the message when it is not."""

import inspect
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from tsfusion import Intrinsics, Keyframe
from tsfusion.core.errors import InvalidKeyframe
from tsfusion.geometry.keyframe import check_pose, keyframe_of
from tsfusion.geometry.keyframe_rows import KeyframeRows

CAMERA = Intrinsics(500.0, 500.0, 320.0, 240.0)
DEPTH = np.ones((4, 5), np.uint16)
POINTS = np.zeros((3, 3), np.float32)


TINY = np.eye(4)  # numbers so small that NumPy divides by zero in its determinant
TINY[:3, :3] = [[1.0, 0.0, 0.5], [1e-310, 0.0, 1e-310], [1e-310, 1e-310, 1e-310]]


def turned(angle: float, scale: float = 1.0) -> np.ndarray:
    T = np.eye(4)
    T[:2, :2] = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    T[:3, :3] *= scale
    return T


def test_each_measurement_is_accepted_and_normalised() -> None:
    strided = np.ones((8, 10), np.uint16)[::2, ::2]
    keyframe = Keyframe(depth=strided, intrinsics=CAMERA, T_world_camera=np.eye(4).tolist())
    assert (keyframe.kind, keyframe.shape) == ("depth", (4, 5))
    assert keyframe.measurement.flags.c_contiguous
    assert keyframe.T_world_camera.dtype == np.float64
    narrow = Intrinsics(np.float32(500), 500, np.float32(320), 240)
    camera = Keyframe(depth=DEPTH, intrinsics=narrow, T_world_camera=np.eye(4)).intrinsics
    assert camera == CAMERA
    assert type(camera.fx) is float
    stereo = Keyframe(disparity=DEPTH, baseline_fx=380.0, intrinsics=CAMERA, T_world_camera=np.eye(4))
    assert stereo.kind == "disparity"
    cloud = Keyframe(points=POINTS, origins=np.zeros(3, np.float32), T_world_camera=np.eye(4))
    assert (cloud.kind, cloud.shape) == ("points", (3,))
    wide = Keyframe(points=POINTS.astype(np.float64), T_world_camera=np.eye(4))
    assert wide.measurement.dtype == np.float32
    assert np.isinf(Keyframe(points=np.full((1, 3), 1e300), T_world_camera=np.eye(4)).measurement).all()
    swapped = Keyframe(depth=DEPTH.astype(">u2"), intrinsics=CAMERA, T_world_camera=np.eye(4))
    assert swapped.measurement.max() == 1


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({}, "exactly one of depth, disparity and points must be given, got none"),
        ({"depth": DEPTH, "points": POINTS}, "got depth and points"),
        ({"depth": DEPTH.astype(np.float64)}, "depth must be uint16 or float32, got float64"),
        ({"depth": DEPTH[0]}, r"depth must have shape \(H, W\), got \(5,\)"),
        ({"depth": np.zeros((0, 5), np.uint16)}, "depth must not be empty"),
        ({"depth": np.zeros((1, 9000), np.uint16)}, "at most 8192"),
        ({"depth": DEPTH, "intrinsics": None}, "intrinsics must be given with depth"),
        ({"depth": DEPTH, "intrinsics": Intrinsics(-5.0, 5.0, 1.0, 1.0)}, "fx > 0"),
        ({"depth": DEPTH, "intrinsics": Intrinsics(5.0, 0.0, 1.0, 1.0)}, "fy != 0"),
        ({"depth": DEPTH, "intrinsics": Intrinsics(5.0, 5.0, np.nan, 1.0)}, "finite"),
        ({"depth": DEPTH, "intrinsics": Intrinsics("a", 5.0, 1.0, 1.0)}, "four numbers"),
        ({"depth": DEPTH, "depth_scale": 0.0}, "depth_scale must be finite and > 0, got 0.0"),
        ({"depth": DEPTH, "depth_scale": "x"}, "depth_scale must be a number"),
        ({"depth": DEPTH, "color": np.zeros((4, 5), np.uint8)}, r"color must have shape \(4, 5, 3\)"),
        ({"depth": DEPTH, "confidence": np.zeros((5, 4), np.uint8)}, "confidence must have shape"),
        ({"depth": DEPTH, "origins": np.zeros(3, np.float32)}, "origins go with points"),
        ({"depth": DEPTH, "timestamp_ns": -1}, "timestamp_ns must be an integer"),
        ({"depth": DEPTH, "captured_ns": 1.5}, "captured_ns must be an integer"),
        ({"disparity": DEPTH}, "baseline_fx must be given"),
        ({"disparity": DEPTH, "baseline_fx": np.inf}, "baseline_fx must be finite"),
        ({"points": POINTS.astype(np.int32)}, "points must be float32 or float64, got int32"),
        ({"points": [[1.0, 2.0, 3.0], [1.0]]}, "points must be an array, got list"),
        ({"points": POINTS, "intrinsics": CAMERA}, "intrinsics go with images"),
        ({"points": POINTS[:, :2]}, "points must have shape"),
        ({"points": POINTS, "origins": np.zeros((2, 3), np.float32)}, "origins must have shape"),
        ({"points": POINTS, "origins": np.full(3, np.nan, np.float32)}, "origins must be finite"),
        ({"points": np.zeros((2_000_001, 3), np.float32)}, "at most 2000000"),
        ({"depth": DEPTH, "T_world_camera": np.eye(3)}, r"shape \(4, 4\), got \(3, 3\)"),
        ({"depth": DEPTH, "T_world_camera": "pose"}, "matrix of numbers"),
        ({"depth": DEPTH, "T_world_camera": np.full((4, 4), np.nan)}, "must be finite"),
        ({"depth": DEPTH, "T_world_camera": turned(0.3, 1.01)}, "must hold a rotation"),
        ({"depth": DEPTH, "T_world_camera": np.diag([1.0, 1.0, -1.0, 1.0])}, "det > 0"),
        ({"depth": DEPTH, "T_world_camera": TINY}, "must hold a rotation"),
        ({"depth": DEPTH, "T_world_camera": np.eye(4) + np.diag([2e6] * 3, 1)}, "T_world_camera"),
        ({"depth": DEPTH, "T_world_camera": np.eye(4).T + np.eye(4)[::-1] * 0.5}, "T_world_camera"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named(fields: dict[str, Any], message: str) -> None:
    given = {"intrinsics": CAMERA, "T_world_camera": np.eye(4), **fields}
    if "points" in fields and "intrinsics" not in fields and "depth" not in fields:
        given.pop("intrinsics")
    with pytest.raises(InvalidKeyframe, match=message):
        Keyframe(**given)


def test_what_is_masked_is_no_return() -> None:
    hidden = np.eye(4, 5, dtype=bool)
    depth, metres = (
        Keyframe(depth=np.ma.masked_array(one, hidden), intrinsics=CAMERA, T_world_camera=np.eye(4)).depth
        for one in (np.full((4, 5), 7, np.uint16), np.full((4, 5), 0.5, np.float32))
    )
    assert depth is not None
    assert metres is not None
    np.testing.assert_array_equal(depth, np.where(hidden, 0, 7))
    np.testing.assert_array_equal(metres, np.where(hidden, np.nan, 0.5).astype(np.float32))
    cloud = Keyframe(points=np.ma.masked_equal(POINTS, POINTS[0, 0]), T_world_camera=np.eye(4)).points
    assert cloud is not None
    assert np.isnan(cloud[0, 0])


def test_a_far_translation_is_refused() -> None:
    T = np.eye(4)
    T[0, 3] = 2e6
    with pytest.raises(InvalidKeyframe, match="translate by at most"):
        check_pose(T)


def test_a_nearly_proper_rotation_is_made_exact_once_and_for_all() -> None:
    T = turned(0.7, 1.0 + 1e-4)
    fixed = check_pose(T)
    assert np.abs(fixed[:3, :3].T @ fixed[:3, :3] - np.eye(3)).max() < 1e-12
    assert (check_pose(fixed) == fixed).all()
    exact = turned(0.7)
    assert (check_pose(exact) == exact).all()


def test_scaled_intrinsics_project_to_scaled_pixels() -> None:
    half = CAMERA.scaled(0.5)
    u = 500.0 * 0.2 + 320.0
    assert half.fx * 0.2 + half.cx == pytest.approx((u + 0.5) * 0.5 - 0.5)
    assert CAMERA.matrix[0, 0] == 500.0


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        (
            {"T_camera_world": np.eye(4)},
            r"no T_camera_world: write .*np.linalg.inv\(T_camera_world\)",
        ),
        ({"extrinsic": np.eye(4)}, r"T_world_camera=np.linalg.inv\(extrinsic\)"),
        (
            {"pose": np.eye(4)},
            "no pose: write T_world_camera, which takes a point of the camera to",
        ),
        ({"K": CAMERA}, "no K: write intrinsics"),
        ({"rgb": DEPTH}, "BGR"),
        ({"deph": DEPTH}, "no deph: did you mean depth"),
        ({"flavour": 1}, "a keyframe has no flavour$"),
        ({"depth": DEPTH, "depth_scale": 1000}, "metres per unit .* at most 1, got 1000; .* write 1/1000"),
        ({"depth": DEPTH, "intrinsics": CAMERA.matrix.T}, r"as the matrix .* got array\(\[\[500"),
    ],
)
def test_names_of_other_libraries_are_answered(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidKeyframe, match=message) as raised:
        Keyframe(**{"T_world_camera": np.eye(4), "intrinsics": CAMERA, **fields})
    assert "\n" not in str(raised.value)


def test_fields_are_given_by_name() -> None:
    with pytest.raises(InvalidKeyframe, match="given by name: Keyframe"):
        Keyframe(DEPTH, CAMERA, np.eye(4))
    assert "T_world_camera" in inspect.signature(Keyframe).parameters


@pytest.mark.parametrize("given", [CAMERA.matrix, CAMERA.matrix.tolist(), (500, 500, 320, 240)], ids=str)
def test_a_camera_matrix_will_do(given: Any) -> None:
    assert Keyframe(depth=DEPTH, intrinsics=given, T_world_camera=np.eye(4)).intrinsics == CAMERA


def test_a_keyframe_of_a_mapping_or_an_object() -> None:
    fields = {"depth": DEPTH, "intrinsics": CAMERA, "T_world_camera": np.eye(4), "timestamp_ns": 7}
    kept = Keyframe(**fields)
    assert keyframe_of(kept) is kept
    for given in (fields, SimpleNamespace(**fields, weight=3)):
        made = keyframe_of(given)
        assert (made.timestamp_ns, made.intrinsics) == (7, CAMERA)
    with pytest.raises(InvalidKeyframe, match="got ndarray; by name: depth="):
        keyframe_of(DEPTH)


def rows_of(**numbers: list[int]) -> KeyframeRows:
    """Keyframes of sessions: the record of number n is at byte 10 n, its sensor at x = n; none at x = 0."""
    saved = {}
    for name, seqs in numbers.items():
        x = np.array(seqs, np.float64)
        poses = np.tile(np.eye(4)[:3].ravel(), (len(x), 1))
        poses[:, 3] = x
        places = {"segments": np.ones_like(x, np.int64), "offsets": 10 * np.array(seqs, np.int64)}
        poses[x == 0] = np.nan
        saved[name.encode()] = {"seqs": np.array(seqs, np.int64), **places, "fused": poses.ravel()}
    return KeyframeRows.of_saved(saved)


def test_rows_of_keyframes_are_chosen_joined_and_put_in_order() -> None:
    rows = rows_of(a=[1, 0, 5], none=[], b=[2, 4])
    assert list(rows) == [(b"a", 1), (b"a", 0), (b"a", 5), (b"b", 2), (b"b", 4)]
    there = rows[rows.in_map]
    assert list(there.in_order()) == [(b"a", 1), (b"b", 2), (b"b", 4), (b"a", 5)]
    assert there.matrices[:, :3, 3].tolist() == [[1, 0, 0], [5, 0, 0], [2, 0, 0], [4, 0, 0]]
    joined = KeyframeRows.joined([there, rows_of(c=[3], a=[7])])
    assert (joined.sessions, len(joined)) == ((b"a", b"none", b"b", b"c"), 6)
    assert list(joined)[4:] == [(b"c", 3), (b"a", 7)]
    assert {name: each.seqs.tolist() for name, each in joined.by_session()} == {
        b"a": [1, 5, 7],
        b"b": [2, 4],
        b"c": [3],
    }


def test_a_table_without_keyframes_has_all_columns() -> None:
    joined = KeyframeRows.joined([rows_of(), rows_of(a=[])])
    for rows in (rows_of(), rows_of(a=[]), rows_of(a=[1])[:0], joined):
        assert (len(rows.in_order()), rows.matrices.shape, list(rows.by_session())) == (0, (0, 4, 4), [])
        assert rows.session.dtype == np.int32
