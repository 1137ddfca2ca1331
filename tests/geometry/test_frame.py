# SPDX-License-Identifier: MIT
"""Frames of stereo pairs: matched once, for the keyframe and for tracking."""

import dataclasses
from typing import Any

import cv2
import numpy as np
import pytest

from tsfusion.core.errors import InvalidConfig, InvalidKeyframe
from tsfusion.geometry import frame as frame_module
from tsfusion.geometry import se3
from tsfusion.geometry.calibration import Camera, StereoRig
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.geometry.stereo_matching import exchanged

SHIFT = 8  # pixels of disparity


def pair() -> Frame:
    """A wall of noise, parallel to both cameras."""
    wall = np.random.default_rng(0).integers(0, 256, (64, 256 + SHIFT), dtype=np.uint8)
    return Frame(
        sensor="stereo", left=wall[:, :-SHIFT].copy(), right=wall[:, SHIFT:].copy(), baseline_fx=50.0,
        intrinsics=Intrinsics(200.0, 200.0, 128.0, 32.0),
    )  # fmt: skip


def test_a_keyframes_disparity_serves_tracking_too(monkeypatch: pytest.MonkeyPatch) -> None:
    frame = pair()

    def twice(*_: Any) -> None:
        raise AssertionError("the pair was matched already")

    keyframe = frame.keyframe(np.eye(4))
    monkeypatch.setattr(frame_module, "Matcher", twice)
    monkeypatch.setattr(frame_module, "quick_disparity", twice)
    disparity = frame.tracking_disparity
    assert disparity is not None
    assert disparity.dtype == np.float32
    np.testing.assert_array_equal(disparity * 16, keyframe.disparity)
    np.testing.assert_array_equal(frame.keyframe(np.eye(4)).disparity, keyframe.disparity)
    assert np.median(disparity[disparity > 0]) == SHIFT


def test_tracking_alone_matches_half_the_resolution() -> None:
    frame = pair()
    disparity = frame.tracking_disparity
    assert disparity is not None
    np.testing.assert_array_equal(disparity, frame_module.quick_disparity(frame.left, frame.right))
    assert frame.tracking_disparity is disparity
    frame.keyframe(np.eye(4))
    np.testing.assert_array_equal(frame.tracking_disparity, frame.matched / np.float32(16))
    assert frame.quick_disparity is disparity, "for loops, which have the same at whatever time they ask"


def test_other_frames_have_nothing_to_match() -> None:
    depth = np.full((4, 4), 1000, np.uint16)
    frame = Frame(sensor="kinect", depth=depth, intrinsics=Intrinsics(4.0, 4.0, 2.0, 2.0))
    np.testing.assert_array_equal(frame.keyframe(np.eye(4)).depth, depth)
    assert frame.tracking_disparity is None
    matched = dataclasses.replace(pair(), left=None, right=None, disparity=pair().matched)
    assert matched.tracking_disparity is None


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_distances_along_rays_become_depth(dtype: type) -> None:
    K, unit = Intrinsics(40.0, 50.0, 31.5, 20.0), 0.001 if dtype == np.uint16 else 1.0
    v, u = np.mgrid[:48, :64]
    length = np.linalg.norm(np.stack([(u - K.cx) / K.fx, (v - K.cy) / K.fy, np.ones(u.shape)]), axis=0)
    z = np.where(u > 5, 2.0 + 0.01 * v, 0.0)
    measured = (z * length / unit).round(0 if dtype == np.uint16 else 9).astype(dtype)
    frame = Frame(sensor="kinect", depth=measured, intrinsics=K, timestamp_ns=7).along_axis()
    assert (frame.depth.dtype, frame.timestamp_ns) == (dtype, 7)
    np.testing.assert_allclose(frame.depth_m, z, atol=0.0011 if dtype == np.uint16 else 1e-6)
    with pytest.raises(InvalidKeyframe, match="is for depth images, and this is one of points"):
        Frame(sensor="lidar", points=np.ones((3, 3))).along_axis()


def test_exchanged_images_of_a_pair_and_a_baseline_in_millimetres_are_noticed() -> None:
    right_way = pair()
    assert not exchanged(right_way.left, right_way.right)
    assert exchanged(right_way.right, right_way.left)
    assert not exchanged(*np.zeros((2, 64, 256), np.uint8))
    squares = np.kron(
        np.random.default_rng(0).integers(0, 256, (12, 24), np.uint8), np.ones((16, 16), np.uint8)
    )
    squares = cv2.GaussianBlur(squares, (3, 3), 0)
    for right_way in ((squares[:, :320], squares[:, shift : 320 + shift]) for shift in (9, 14)):
        assert not exchanged(*right_way)
        assert exchanged(*right_way[::-1])
    right_way = pair()
    with pytest.raises(InvalidKeyframe, match=r"120 m of baseline: are these millimetres\?"):
        dataclasses.replace(right_way, baseline_fx=120 * 200.0)
    camera = Camera(right_way.intrinsics, (64, 256))
    with pytest.raises(InvalidConfig, match="baseline in metres, got 120: are these millimetres"):
        StereoRig(camera, camera, se3.exp(np.array([-120.0, 0, 0, 0, 0, 0])))
