# SPDX-License-Identifier: MIT
"""Depth in a wrong unit, and keyframes without a usable sample: what is said of them."""

from typing import Any

import numpy as np
import pytest

from tsfusion import Intrinsics, Keyframe
from tsfusion.geometry.sample_ranges import sample_ranges, why_no_samples, wrong_unit

SHAPE = (6, 8)
CAMERA = Intrinsics(10.0, 10.0, 3.5, 2.5)


def keyframe(**fields: Any) -> Keyframe:
    camera = {} if "points" in fields else {"intrinsics": CAMERA}
    return Keyframe(**{"T_world_camera": np.eye(4), **camera, **fields})


def flat(metres: float, dtype: type = np.float32) -> np.ndarray:
    return np.full(SHAPE, metres, dtype)


@pytest.mark.parametrize(
    ("fields", "metres"),
    [
        ({"depth": flat(1.5)}, 1.5),
        ({"depth": flat(1500, np.uint16)}, 1.5),
        ({"disparity": flat(160, np.uint16), "baseline_fx": 15.0}, 1.5),
        ({"points": np.full((48, 3), 3**-0.5 * 1.5, np.float32)}, 1.5),
        ({"points": np.full((48, 3), 2.0, np.float32), "origins": np.array([2, 2, 0.5], np.float32)}, 1.5),
    ],
)
def test_ranges_are_metres_whatever_the_kind(fields: dict[str, Any], metres: float) -> None:
    found = sample_ranges(keyframe(**fields))
    assert len(found) == 48
    np.testing.assert_allclose(found, metres, rtol=1e-6)
    assert wrong_unit(keyframe(**fields)) == ""


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        (
            {"depth": flat(1500)},
            "1500 m looks like millimetres: give uint16 with depth_scale=0.001",
        ),
        ({"depth": flat(1500, np.uint16), "depth_scale": 1.0}, "1500 m looks like millimetres"),
        ({"depth": flat(0.0015)}, "0.0015 m: check depth_scale"),
        ({"disparity": flat(160, np.uint16), "baseline_fx": 1e5}, "check baseline_fx and disparity_scale"),
        ({"points": np.full((48, 3), 900.0, np.float32)}, "points must be in metres"),
        ({"depth": flat(np.nan)}, ""),
    ],
)
def test_a_wrong_unit_is_named_with_its_cure(fields: dict[str, Any], words: str) -> None:
    found = wrong_unit(keyframe(**fields))
    assert words in found
    assert bool(words) == bool(found)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        (
            {"depth": flat(1500)},
            "none is from 0.1 to 5 m away (median 1500 m); a median depth of",
        ),
        ({"depth": flat(7)}, "(median 7 m); use another --sensor or --max-range"),
        ({"depth": flat(0)}, "of 48 pixels none has a return; is the sensor covered, or is this no depth?"),
        ({"points": np.zeros((0, 3), np.float32)}, "of 0 points none has a return"),
        ({"depth": flat(1), "confidence": flat(0, np.uint8)}, "confidence 0; 255 is full confidence"),
        ({"depth": flat(1)}, "stand alone, as noise does"),
    ],
)
def test_why_a_keyframe_has_no_usable_sample(fields: dict[str, Any], words: str) -> None:
    assert words in why_no_samples(keyframe(**fields), 0.1, 5.0, 2e4)


def test_a_sensor_beyond_the_maps_reach_is_named() -> None:
    T = np.eye(4)
    T[1, 3] = -22_000.0
    found = why_no_samples(keyframe(depth=flat(1), T_world_camera=T), 0.1, 5.0, 21_000.0)
    assert "the sensor is 22 km from the map's origin" in found
    assert "reach 21 km; subtract an offset" in found
