# SPDX-License-Identifier: MIT
"""Figures of surface error, from errors that are known."""

import numpy as np
import pytest

from lab.evaluation import surface_error


def test_spread_of_known_errors() -> None:
    spread = surface_error.spread_mm(np.array([-0.003, 0.001, 0.001, 0.003]))
    assert (spread.mean, spread.rmse) == pytest.approx((2.0, 5**0.5))
    assert surface_error.spread_mm(np.linspace(0, 0.1, 101)).p95 == pytest.approx(95.0)
    assert np.isnan(surface_error.spread_mm(np.empty(0)).mean)


def test_shares_and_their_harmonic_mean() -> None:
    assert surface_error.percent_within(np.array([-0.02, 0.01, 0.03, 0.05]), 0.02) == 50.0
    assert surface_error.f_score(50.0, 100.0) == pytest.approx(200 / 3)
    assert surface_error.f_score(0.0, 0.0) == 0.0


def test_angles_between_directions_of_any_length() -> None:
    a = np.array([(1, 0, 0), (0, 2, 0), (1, 0, 0), (1, 0, 0), (0, 0, 0)], np.float64)
    b = np.array([(3, 0, 0), (1, 1, 0), (0, 0, 1), (-1, 0, 0), (1, 0, 0)], np.float64)
    assert surface_error.angles(a, b) == pytest.approx([0, 45, 90, 180, 90])
    tiny = np.array([(1, 1e-7, 0)])
    assert surface_error.angles(tiny, np.array([(1.0, 0, 0)])) == pytest.approx(np.degrees(1e-7))


def test_distance_from_segments_ends_included() -> None:
    segments = np.array([[(0, 0, 0), (1, 0, 0)], [(0, 5, 0), (0, 5, 0)]], np.float64)
    points = np.array([(0.5, 0.3, 0.4), (2, 0, 0), (-3, 4, 0), (0, 5, 1)], np.float64)
    assert surface_error.segment_distance(points, segments) == pytest.approx([0.5, 1, np.hypot(3, 1), 1])
    assert np.isinf(surface_error.segment_distance(points, segments[:0])).all()


def test_distance_from_segments_by_the_chunk(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(0)
    points, segments = rng.normal(size=(57, 3)), rng.normal(size=(9, 2, 3))
    whole = surface_error.segment_distance(points, segments)
    monkeypatch.setattr(surface_error, "_CHUNK", 40)
    assert (surface_error.segment_distance(points, segments) == whole).all()


def test_one_point_a_cell_whatever_the_sign() -> None:
    points = np.array([(0.01, 0, 0), (0.02, 0, 0), (-0.01, 0, 0), (0.01, 0, 0), (0.01, 0, -7.0)])
    assert (surface_error.one_per_cell(points, 0.1) == points[[0, 2, 4]]).all()
    assert (surface_error.one_per_cell(points, 0.1, at_least=2) == points[[0]]).all()
    assert surface_error.one_per_cell(points[:0], 0.1).shape == (0, 3)
