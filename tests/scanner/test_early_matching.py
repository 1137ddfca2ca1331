# SPDX-License-Identifier: MIT
"""Pairs matched beside the tracker: the same keyframes, matched once."""

import dataclasses
import threading

import numpy as np
import pytest

from tsfusion.geometry import se3
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.keyframe import Intrinsics
from tsfusion.scanner.early_matching import EarlyMatching, ExpectedPose

SHIFT = 8  # pixels of disparity


def pair(seed: int = 0) -> Frame:
    """A wall of noise, parallel to both cameras."""
    wall = np.random.default_rng(seed).integers(0, 256, (64, 256 + SHIFT), dtype=np.uint8)
    return Frame(
        sensor="stereo", left=wall[:, :-SHIFT].copy(), right=wall[:, SHIFT:].copy(), baseline_fx=50.0,
        intrinsics=Intrinsics(200.0, 200.0, 128.0, 32.0),
    )  # fmt: skip


@pytest.fixture
def matched_by(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the threads that matched a pair so far."""
    names: list[str] = []
    match = Frame.match

    def noted(frame: Frame) -> np.ndarray:
        names.append(threading.current_thread().name)
        return match(frame)

    monkeypatch.setattr(Frame, "match", noted)
    return names


def test_what_was_begun_is_not_matched_again(matched_by: list[str]) -> None:
    frame, early = pair(), EarlyMatching()
    early.begin(frame)
    found = early.keyframe(frame, np.eye(4))
    assert len(matched_by) == 1
    assert matched_by[0].startswith("matching")
    np.testing.assert_array_equal(found.disparity, frame.keyframe(np.eye(4)).disparity)
    assert np.median(found.disparity[found.disparity > 0]) == SHIFT * 16


def test_a_wrong_guess_changes_no_keyframe(matched_by: list[str]) -> None:
    guessed, frame, early = pair(1), pair(2), EarlyMatching()
    early.begin(guessed)
    found = early.keyframe(frame, np.eye(4))
    np.testing.assert_array_equal(found.disparity, frame.match())
    assert threading.current_thread().name in matched_by
    early.begin(guessed)
    early.begin(frame)
    np.testing.assert_array_equal(early.keyframe(frame, np.eye(4)).disparity, found.disparity)


def test_other_frames_have_nothing_to_match() -> None:
    depth = np.full((4, 4), 1000, np.uint16)
    frame = Frame(sensor="kinect", depth=depth, intrinsics=Intrinsics(4.0, 4.0, 2.0, 2.0))
    np.testing.assert_array_equal(EarlyMatching().keyframe(frame, np.eye(4)).depth, depth)


def test_an_error_of_the_thread_is_raised_where_it_is_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(_: Frame) -> np.ndarray:
        raise MemoryError("no room")

    monkeypatch.setattr(Frame, "match", fails)
    frame, early = pair(), EarlyMatching()
    early.begin(frame)
    with pytest.raises(MemoryError, match="no room"):
        early.keyframe(frame, np.eye(4))


def test_a_steady_motion_goes_on() -> None:
    twist = np.array([0.1, 0.0, 1.2, 0.0, 0.05, 0.0])
    expected = ExpectedPose()
    assert expected.at(0) is None
    expected.add(1_000, np.eye(4))
    np.testing.assert_array_equal(expected.at(2_000), np.eye(4))
    expected.add(2_000, se3.exp(twist))
    np.testing.assert_allclose(expected.at(3_000), se3.exp(2 * twist), atol=1e-12)
    np.testing.assert_allclose(expected.at(4_000), se3.exp(3 * twist), atol=1e-12)
    np.testing.assert_allclose(expected.at(99_000), se3.exp(4 * twist), atol=1e-12)  # a gap: not for ever
    expected.add(2_000, se3.exp(2 * twist))  # a clock that stands still
    np.testing.assert_allclose(expected.at(2_000), se3.exp(3 * twist), atol=1e-12)
    expected.reset()
    assert expected.at(5_000) is None


def test_a_pair_keeps_its_quick_disparity() -> None:
    frame = pair()
    assert frame.quick_disparity is frame.quick_disparity
    assert dataclasses.replace(frame, left=None, right=None, disparity=frame.match()).quick_disparity is None
