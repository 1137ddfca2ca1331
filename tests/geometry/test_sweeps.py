# SPDX-License-Identifier: MIT
"""Points of a moving sensor are put where they were at their times, by its poses then."""

import dataclasses

import moving_lidars as lidar
import numpy as np
import pytest
from numpy.typing import NDArray

from tsfusion import Intrinsics, Keyframe
from tsfusion.core.errors import InvalidKeyframe
from tsfusion.geometry import se3, sweeps
from tsfusion.geometry.keyframe import keyframe_of


def known_from(first_s: float, last_s: float, number: int = 3):
    """The true poses, known between two times after the beginning of a sweep."""
    begin = number * lidar.PERIOD_S

    def at(stamp_ns: int) -> NDArray[np.float64] | None:
        t = (stamp_ns - lidar.T0_NS) / 1e9
        return lidar.pose_at(t) if first_s - 1e-6 <= t - begin <= last_s + 1e-6 else None

    return at, lidar.T0_NS + round(begin * 1e9)


def keyframe(swept: lidar.Sweep, motion: object, **fields: object) -> Keyframe:
    given = {"points": swept.points, "point_times_s": swept.times_s, "motion": motion, **fields}
    return Keyframe(T_world_camera=lidar.pose_at(0.3), sensor="lidar", **given)  # type: ignore[arg-type]


@pytest.mark.parametrize("shift_s", [0.0, 0.05, 0.1, 0.25])  # stamps at begin, middle and end, and after it
def test_points_go_where_they_were_whatever_the_stamp(shift_s: float) -> None:
    swept, (at, begin_ns) = lidar.sweep(3), known_from(-1, 1)
    times = (swept.times_s - shift_s).astype(np.float32)
    motion = sweeps.motion_about(at, begin_ns + round(shift_s * 1e9), times)
    assert motion is not None
    T_stamp_begin = se3.inverse(lidar.pose_at(0.3 + shift_s)) @ lidar.pose_at(0.3)
    found = sweeps.at_stamp(swept.points, times, motion)
    np.testing.assert_allclose(found, se3.apply(T_stamp_begin, swept.put_right), atol=1e-3)
    assert lidar.off(swept.points, swept) > 0.5


def test_where_a_trajectory_ends_the_motion_goes_on() -> None:
    swept = lidar.sweep(3)
    times = swept.times_s.astype(np.float32)
    for ends, most in (((-1, 0.08), 0.02), ((-0.05, 0.06), 0.05), ((-1, 0), 0.12), ((0, 0.05), 0.05)):
        motion = sweeps.motion_about(*known_from(*ends), times)
        assert motion is not None
        assert lidar.off(sweeps.at_stamp(swept.points, times, motion), swept) < most, ends
    for ends in ((0, 0), (0.02, 1), (-1, -0.02), (-0.01, 0.03)):
        assert sweeps.motion_about(*known_from(*ends), times) is None


def test_a_keyframe_puts_its_points_right_and_forgets_how() -> None:
    swept = lidar.sweep(3)
    seconds = np.linspace(0, 0.1, 21)
    poses = se3.inverse(lidar.pose_at(0.3)) @ np.array([lidar.pose_at(0.3 + t) for t in seconds])
    made = keyframe(swept, (seconds, poses), origins=np.zeros((len(swept.points), 3)))
    assert lidar.off(made.points, swept) < 1e-3
    assert (made.point_times_s, made.motion) == (None, None)
    np.testing.assert_allclose(made.origins[-1], poses[-1][:3, 3], atol=1e-6)
    again = dataclasses.replace(made, captured_ns=5)
    np.testing.assert_array_equal(again.points, made.points)
    both = keyframe_of({"points": swept.points, "point_times_s": swept.times_s, "T_world_camera": np.eye(4),
                        "motion": sweeps.Motion(seconds, poses)})  # fmt: skip
    np.testing.assert_array_equal(both.points, made.points)
    kept = keyframe(swept, None)
    np.testing.assert_array_equal(kept.points, swept.points)
    np.testing.assert_array_equal(kept.point_times_s, swept.times_s.astype(np.float32))


def test_a_point_without_a_return_stays_one() -> None:
    points = np.array([[1, 2, 3], [np.nan] * 3, [np.inf, 0, 0]], np.float32)
    motion = sweeps.steady(np.array([1.0, 0, 0, 0, 0, 0]), np.array([0.0, 0.1]))
    found = sweeps.at_stamp(points, np.full(3, 0.1, np.float32), motion)
    np.testing.assert_allclose(found[0], [1.1, 2, 3], atol=1e-6)
    assert not np.isfinite(found[1:]).all(axis=1).any()


def test_nothing_measured_does_not_become_a_point() -> None:
    points = np.array([[0, 0, 0], [5, 0, 0]], np.float32)
    motion = sweeps.steady(np.array([20.0, 0, 0, 0, 0, 0]), np.array([0.0, 0.1]))
    made = Keyframe(points=points, T_world_camera=np.eye(4), point_times_s=np.full(2, 0.1), motion=motion)
    np.testing.assert_allclose(made.points, [[np.nan] * 3, [7, 0, 0]], atol=1e-5)
    np.testing.assert_array_equal(points[0], 0)


@pytest.mark.parametrize(
    ("motion", "reason"),
    [
        (([0.0, 0.05], [np.eye(4)] * 2), "motion must cover point_times_s, 0 to 0.1 s, got 0 to 0.05"),
        (([0.0, 0.0], [np.eye(4)] * 2), "rising"),
        (([0.0], [np.eye(4)]), "rising"),
        (([], np.zeros((0, 4, 4))), "rising"),
        (([0.0, np.inf], [np.eye(4)] * 2), "finite"),
        (([0.0, 0.1], [np.eye(4), np.full((4, 4), np.nan)]), "finite"),
        (0.1, r"motion must be \(times_s, poses\), got 0.1"),
        (([0.0, 0.1], [np.eye(3)] * 2), r"motion's poses must have shape \(2, 4, 4\)"),
        (([0.0, 0.1], [lidar.pose_at(0.3), lidar.pose_at(0.4)]), r"linalg\.inv\(T_world_camera\)"),
    ],
)
def test_a_motion_that_is_none_is_refused(motion: object, reason: str) -> None:
    with pytest.raises(InvalidKeyframe, match=reason):
        keyframe(lidar.sweep(3, columns=8), motion)


def test_times_of_points_are_finite() -> None:
    with pytest.raises(InvalidKeyframe, match="point_times_s must be finite"):
        Keyframe(points=np.ones((2, 3), np.float32), point_times_s=np.array([0, np.nan], np.float32),
                 T_world_camera=np.eye(4))  # fmt: skip


def test_times_are_of_points() -> None:
    with pytest.raises(InvalidKeyframe, match="go with points only"):
        Keyframe(depth=np.ones((4, 4), np.uint16), point_times_s=np.zeros(16),
                 intrinsics=Intrinsics(4, 4, 2, 2), T_world_camera=np.eye(4))  # fmt: skip
    with pytest.raises(InvalidKeyframe, match=r"point_times_s must have shape \(2\)"):
        Keyframe(points=np.ones((2, 3), np.float32), T_world_camera=np.eye(4), point_times_s=np.zeros(3))
