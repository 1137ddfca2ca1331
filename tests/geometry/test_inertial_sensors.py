# SPDX-License-Identifier: MIT
"""Gyroscopes and accelerometers: a known turn comes back, and a wrong axis, sign or clock does not."""

from threading import Thread

import numpy as np
import pytest
from known_turns import END_S, R_SENSOR_IMU, STILL_S, angle, assert_known, attitude, samples
from numpy.typing import NDArray

from tsfusion.core.errors import InvalidKeyframe
from tsfusion.geometry import se3
from tsfusion.geometry.frame import Attitude, Frame
from tsfusion.geometry.inertial_sensors import Accelerometer, Gyroscope, inertial_fields

NS = 10**9
TIMES = np.arange(0.01, END_S - 0.02, 1 / 30).tolist()


def filled(R: NDArray[np.float64] = R_SENSOR_IMU, sign: float = 1.0, late_s: float = 0.0) -> Gyroscope:
    made = Gyroscope(R)
    for seconds, _, rate in samples():
        made.add(round((seconds + late_s) * NS), sign * rate)
    return made


def turns(gyroscope: Gyroscope) -> list[tuple[float, Attitude | None]]:
    return [(seconds, gyroscope.attitude(round(seconds * NS))) for seconds in TIMES]


def test_a_known_turn_comes_back_without_the_bias() -> None:
    assert_known(turns(filled()))


@pytest.mark.parametrize("wrong", [
    {"R": np.eye(3)}, {"R": R_SENSOR_IMU.T}, {"sign": -1.0}, {"late_s": 0.03},
    {"R": se3.exp(np.array([0, 0, 0, 0.02, 0, 0]))[:3, :3] @ R_SENSOR_IMU},
], ids=["no axes", "inverse axes", "sign", "clock", "axes by one degree"])  # fmt: skip
def test_wrong_axes_sign_or_clock_are_seen(wrong: dict[str, NDArray[np.float64]]) -> None:
    with pytest.raises(AssertionError):
        assert_known(turns(filled(**wrong)))


def test_a_live_gyroscope_says_the_same_as_a_recorded_one() -> None:
    live, recorded = Gyroscope(R_SENSOR_IMU, live=True), filled()
    frames = iter(TIMES)
    at = next(frames)
    for seconds, _, rate in samples():
        if seconds > at:
            found = inertial_fields(Accelerometer(), live, round(at * NS))["attitude"]
            rest = 0.5 if at > STILL_S else 1e-6  # the newest velocity is taken to hold
            assert angle(found.R.T @ recorded.attitude(round(at * NS)).R) < rest
            at = next(frames, np.inf)
        live.add(round(seconds * NS), rate)


@pytest.mark.parametrize("value", [1e308, 1e5, np.nan, np.inf])
def test_values_that_no_sensor_measures_are_left_out(value: float) -> None:
    gyroscope, accelerometer = filled(np.eye(3)), Accelerometer()
    before = gyroscope.attitude(round(END_S * NS))
    for count in range(3):
        for sensor in (gyroscope, accelerometer):
            sensor.add(round((END_S + count) * NS), (value, 0.0, -value))
    assert not len(accelerometer.table())
    np.testing.assert_array_equal(gyroscope.attitude(round(END_S * NS)).R, before.R)


def test_many_values_in_half_a_second_are_added_one_by_one() -> None:
    gyroscope = Gyroscope()
    gyroscope.add(1, (0.0, 0.0, 0.0))
    window = gyroscope._window
    gyroscope.add(2, (0.0, 0.0, 0.0))
    assert gyroscope._window is window  # a copy for each value takes minutes for a wrong clock


def test_old_values_of_a_live_sensor_are_dropped() -> None:
    both = Gyroscope(live=True), Accelerometer(live=True)
    for stamp in range(0, 300 * NS, NS // 100):
        for sensor in both:
            sensor.add(stamp, (0.0, 0.0, 1.0))
    gyroscope, accelerometer = both
    assert 4000 < len(gyroscope.table()) == len(accelerometer.table()) < 8200
    assert accelerometer.around(299 * NS) == pytest.approx((0, 0, 1))
    assert angle(gyroscope.attitude(298 * NS).R.T @ gyroscope.attitude(299 * NS).R) == pytest.approx(57.2958)


def test_without_values_near_there_is_no_attitude_and_no_force() -> None:
    gyroscope, accelerometer = Gyroscope(), Accelerometer()
    assert gyroscope.attitude(0) is gyroscope.attitude(5) is accelerometer.around(0) is None
    for stamp in (NS, 2 * NS):
        gyroscope.add(stamp, (0.0, 0.0, 1.0))
        accelerometer.add(stamp, (0.0, 0.0, 9.81))
    for stamp, is_there in ((NS - 1, False), (NS, True), (NS + 60_000_000, False), (2 * NS, True)):
        assert (gyroscope.attitude(stamp) is not None) == is_there
    assert accelerometer.around(NS + 10_000_000) == pytest.approx((0, 0, 9.81))
    assert accelerometer.around(NS + 60_000_000) is None


def test_a_turn_in_a_gap_is_not_known() -> None:
    gyroscope = Gyroscope()
    for stamp in (*range(0, NS, NS // 100), *range(2 * NS, 3 * NS, NS // 100)):
        gyroscope.add(stamp, (0.0, 0.0, 1.0))
    before, end, begin, after = (
        Frame(sensor="lidar", points=np.ones((3, 3)), attitude=gyroscope.attitude(round(seconds * NS)))
        for seconds in (0.5, 0.99, 2, 2.5)
    )
    assert begin.turn_since(end.attitude) is after.turn_since(before.attitude) is None
    for turn in (end.turn_since(before.attitude), after.turn_since(begin.attitude)):
        assert angle(turn) == pytest.approx(np.degrees(0.5), abs=1)
    assert gyroscope.attitude(1_030_000_000).gaps == 0


def test_late_repeated_and_impossible_values_change_nothing() -> None:
    clean, other = filled(), Gyroscope(R_SENSOR_IMU)
    for seconds, _, rate in samples():
        other.add(round(seconds * NS), rate)
        for stamp in (round(seconds * NS), round(seconds * NS) - 1, -5, 2**63, 2**70):
            other.add(stamp, (9.0, 9.0, 9.0))
        other.add(round(seconds * NS) + 1, (np.nan, 0.0, 0.0))
        other.add(round(seconds * NS) + 1, (0.0, np.inf, -np.inf))
    np.testing.assert_array_equal(clean.table(), other.table())


@pytest.mark.parametrize("at", [0, 1, 150])
def test_one_value_of_a_time_to_come_does_not_cost_those_after_it(at: int) -> None:
    other = Gyroscope(R_SENSOR_IMU)
    for number, (seconds, _, rate) in enumerate(samples()):
        if number == at:
            other.add(2**62, (0.1, 0.1, 0.1))
        other.add(round(seconds * NS), rate)
    assert other.table()[:, :3].shape == filled().table()[:, :3].shape
    assert_known(turns(other))
    assert len(other._window) < 200  # values of a second


def test_a_fast_pan_is_no_bias() -> None:
    gyroscope = Gyroscope()
    for stamp in range(0, 3 * NS, NS // 100):
        gyroscope.add(stamp, (0.0, 0.2, 0.0))
    found = gyroscope.attitude(NS).R.T @ gyroscope.attitude(2 * NS).R
    assert angle(found) == pytest.approx(np.degrees(0.2))


def test_values_may_come_from_another_thread() -> None:
    gyroscope = Gyroscope(R_SENSOR_IMU)
    thread = Thread(target=lambda: [gyroscope.add(round(s * NS), rate) for s, _, rate in samples()])
    thread.start()
    while thread.is_alive():
        inertial_fields(Accelerometer(), gyroscope, round(END_S * NS))
    thread.join()
    assert_known(turns(gyroscope))


def test_an_accelerometer_points_away_from_the_ground() -> None:
    accelerometer = Accelerometer(R_SENSOR_IMU)
    for seconds, force, _ in samples(STILL_S):
        accelerometer.add(round(seconds * NS), force)
    found = accelerometer.around(round(0.4 * NS))
    assert attitude(0.4) @ found == pytest.approx((0, 0, 9.81))


def test_an_attitude_that_is_no_number_is_refused() -> None:
    with pytest.raises(InvalidKeyframe, match="attitude must be a 3×3 rotation"):
        Frame(sensor="lidar", points=np.ones((3, 3)), attitude=Attitude(np.full((3, 3), np.nan)))
