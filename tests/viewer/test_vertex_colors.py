# SPDX-License-Identifier: MIT
"""Colours say what the legend says, whoever knows the numbers."""

import logging
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from test_map_tiles import grown

from tsfusion.viewer.map import vertex_colors
from tsfusion.viewer.map.map_tiles import MapTiles
from tsfusion.viewer.map.vertex_colors import (
    AGE,
    CLIENT,
    HEIGHT,
    NORMAL,
    PICTURE,
    WEIGHT,
    Scale,
    VertexColors,
    color_ramp,
    item_color,
)

ERROR = "Error [m]"
DEADLINE = 30.0


@pytest.fixture(scope="module")
def sphere() -> MapTiles:
    return grown()[0]


def colors_of(tiles: MapTiles, **measures: Any) -> VertexColors:
    return VertexColors(tiles, lambda points: 5 + 10 * points[:, 0], measures)


def until(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + DEADLINE
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.01)


def asked(colors: VertexColors, mode: str) -> set[Any]:
    """Choose what has to be asked for, and wait for all of it."""
    colors.choose(mode)
    colors.values.ask(colors._tiles.tiles)
    ready: set[Any] = set()
    until(lambda: ready.update(colors.values.take_ready()) or len(ready) == len(colors._tiles.tiles))
    colors.fit_scale()
    return ready


def test_pictures_are_shown_as_they_were_seen(sphere: MapTiles) -> None:
    colors = colors_of(sphere)
    assert colors.mode == PICTURE
    for key, tile in sphere.tiles.items():
        assert colors.colors(key, tile) is tile.mesh.colors
    assert not colors.legend()


def test_height_follows_up_and_its_legend_has_round_numbers(sphere: MapTiles) -> None:
    colors = colors_of(sphere)
    colors.up = np.array((1.0, 0, 0))
    colors.choose(HEIGHT)
    assert colors.fit_scale()
    assert not colors.fit_scale(), "the same ends: nothing is sent again"
    scale = colors.scale
    assert scale is not None
    assert -0.32 <= scale.low <= -0.25
    assert 0.15 <= scale.high <= 0.32
    for text in ("height", f"{scale.low:.4g}", f"{scale.high:.4g}&nbsp;m"):
        assert text in colors.legend()
    brightness = [
        (tile.mesh.vertices[:, 0], colors.colors(key, tile).astype(float).sum(axis=1))
        for key, tile in sphere.tiles.items()
    ]
    x, light = (np.concatenate(part) for part in zip(*brightness, strict=True))
    assert np.corrcoef(x, light)[0, 1] > 0.8


def test_values_come_from_another_thread_and_once(sphere: MapTiles) -> None:
    threads, counts = set(), []

    def error(points: NDArray[np.float32]) -> NDArray[np.floating]:
        threads.add(threading.get_ident())
        counts.append(len(points))
        found = np.abs(points[:, 0]) / 10
        found[0] = np.nan
        return found

    colors = colors_of(sphere, **{ERROR: error})
    assert asked(colors, ERROR) == set(sphere.tiles)
    colors.values.ask(sphere.tiles)
    assert threading.get_ident() not in threads
    assert sum(counts) == sum(len(tile.mesh.vertices) for tile in sphere.tiles.values())
    assert colors.scale == Scale(0.0, 0.03)
    assert "Error" in colors.legend()
    assert "0.03&nbsp;m" in colors.legend()
    key, tile = next(iter(sphere.tiles.items()))
    assert len(np.unique(colors.colors(key, tile)[0])) <= 2, "grey where there is no value"
    colors.values.close()


def test_weights_are_asked_of_the_feed_and_nobody_may_know(sphere: MapTiles) -> None:
    colors = VertexColors(sphere, lambda points: None, {})
    colors.choose(WEIGHT)
    colors.values.ask(sphere.tiles)
    until(lambda: colors.values.is_unknown)
    assert colors.legend() == "not known now"
    key, tile = next(iter(sphere.tiles.items()))
    shades = colors.colors(key, tile)
    assert (shades == shades[:, :1]).all(), "grey"
    colors.values.close()
    known = colors_of(sphere)
    asked(known, WEIGHT)
    assert "samples" in known.legend()
    known.values.close()


def test_a_measure_that_fails_is_a_line_in_the_log(
    sphere: MapTiles, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(points: NDArray[np.float32]) -> NDArray[np.floating]:
        raise ZeroDivisionError("no reference")

    colors = colors_of(sphere, Odd=broken)
    with caplog.at_level(logging.WARNING):
        colors.choose("Odd")
        colors.values.ask(sphere.tiles)
        until(lambda: colors.values.is_unknown)
    assert "no Odd: no reference" in caplog.text
    assert "Traceback" not in caplog.text
    colors.values.close()


def test_scanners_have_colours_and_names_that_are_no_html(sphere: MapTiles) -> None:
    colors = colors_of(sphere)
    colors.choose(CLIENT)
    colors.name_clients(lambda session: "<b>anna</b>")
    assert "&lt;b&gt;anna" in colors.legend()
    assert "<b>anna" not in colors.legend()
    key, tile = next(iter(sphere.tiles.items()))
    shades = colors.colors(key, tile)
    full = np.array(item_color(0))
    assert (shades <= full).all()
    assert shades.max() > 0.5 * full.max()


def test_normals_and_ages(sphere: MapTiles) -> None:
    colors = colors_of(sphere)
    colors.choose(NORMAL)
    key, tile = next(iter(sphere.tiles.items()))
    np.testing.assert_allclose(colors.colors(key, tile), 127.5 * (tile.mesh.normals + 1), atol=0.6)
    colors.choose(AGE)
    colors.fit_scale()
    assert "last change" in colors.legend()
    assert len(colors.colors(key, tile)) == len(tile.mesh.vertices)


def test_a_scale_colours_from_dark_to_bright() -> None:
    found = Scale(0, 10).colors(np.array([-5, 0, 10, 99, np.nan]))
    assert (found[[0, 1]] == color_ramp()[0]).all()
    assert (found[[2, 3]] == color_ramp()[255]).all()
    assert tuple(found[4]) == vertex_colors._UNKNOWN
