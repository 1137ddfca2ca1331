# SPDX-License-Identifier: MIT
"""A click meets the front of the surface that is shown."""

import numpy as np
import pytest
from test_map_tiles import RADIUS, grown

from tsfusion.viewer.map.clipping import Clipping
from tsfusion.viewer.map.map_tiles import MapTiles
from tsfusion.viewer.map.map_views import first_hit


@pytest.fixture(scope="module")
def sphere() -> MapTiles:
    return grown(count=26)[0]


def test_rays_meet_the_sphere_where_it_is(sphere: MapTiles) -> None:
    random = np.random.default_rng(0)
    for _ in range(40):
        eye, aim = random.normal(size=3), random.uniform(-0.1, 0.1, 3)
        eye /= np.linalg.norm(eye)
        point = first_hit(sphere, Clipping(), eye, 3 * (aim - eye))
        assert point is not None
        assert abs(np.linalg.norm(point) - RADIUS) < 0.006
        assert (point - eye) @ point < 0, "the side that faces the eye"


def test_nothing_is_met_beside_it_or_from_inside(sphere: MapTiles) -> None:
    assert first_hit(sphere, Clipping(), np.array((1.0, 0, 0.4)), np.array((-1.0, 0, 0))) is None
    assert first_hit(sphere, Clipping(), np.zeros(3), np.array((0.0, 0, 1))) is None
    assert first_hit(sphere, Clipping(), np.array((1.0, 0, 0)), np.array((1.0, 0, 0))) is None
    assert first_hit(MapTiles(), Clipping(), np.zeros(3), np.ones(3)) is None


def test_what_is_cut_away_is_not_met(sphere: MapTiles) -> None:
    eye, down = np.array((0.05, 0.02, 1.0)), np.array((0.0, 0, -1))
    above = first_hit(sphere, Clipping(), eye, down)
    assert above is not None
    assert above[2] > 0.25
    assert first_hit(sphere, Clipping(np.array((0.0, 0, 1)), 0.1), eye, down) is None
    aside = first_hit(
        sphere, Clipping(np.array((0.0, 0, 1)), 0.1), np.array((1.0, 0, 0.05)), np.array((-1.0, 0, 0))
    )
    assert aside is not None
