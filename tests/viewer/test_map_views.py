# SPDX-License-Identifier: MIT
"""Views of the whole map: found once for each shape of a window, and not kept without end."""

from typing import Any

import numpy as np
import pytest

from tsfusion.viewer.map import map_views
from tsfusion.viewer.map.map_tiles import MapTiles


@pytest.fixture
def views(monkeypatch: pytest.MonkeyPatch) -> map_views.WholeViews:
    """Views of a map of some points."""
    points = np.random.default_rng(1).random((200, 3))
    monkeypatch.setattr(map_views, "sample", lambda tiles: map_views.ShownPoint(points, points - 0.5))
    return map_views.WholeViews(MapTiles())


def test_a_view_is_found_once_while_the_map_stays(views: map_views.WholeViews) -> None:
    first = views.of(1.5, 0.0)
    assert first is not None
    assert views.of(1.5, 0.0) is first
    views.forget()
    again: Any = views.of(1.5, 0.0)
    assert again is not first
    assert np.array_equal(again.position, first.position)


def test_windows_of_any_shape_fill_no_memory(views: map_views.WholeViews) -> None:
    for aspect in (*np.linspace(0.5, 2.0, 200).tolist(), *(float("nan") for _ in range(50))):
        views.of(aspect, 0.0)
    assert len(views._views) <= 16
