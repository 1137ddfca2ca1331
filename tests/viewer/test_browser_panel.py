# SPDX-License-Identifier: MIT
"""Owner of a browser's camera: the page, until somebody moves it, however slow the browser is."""

from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest
from numpy.typing import NDArray

from tsfusion.viewer.map.map_views import PageCamera
from tsfusion.viewer.panels import browser_panel
from tsfusion.viewer.panels.browser_panel import BY_HAND, WHOLE, BrowserPanel

UP = np.array((0.0, 0, 1))
FIRST, SECOND = np.array((5.0, 0, 0)), np.array((9.0, 0, 0))


class Browser:
    """A browser that tells where its camera is when it is asked to, and the panel of it."""

    def __init__(self) -> None:
        self.whole = PageCamera(FIRST, np.zeros(3), UP)
        self._camera = camera = SimpleNamespace(position=np.zeros(3), aspect=1.6)
        camera.on_update = lambda tell: setattr(self, "_tell", tell)
        client = MagicMock(camera=camera, gui=MagicMock(add_dropdown=self._dropdown))
        shown: Any = SimpleNamespace(scanners=list, whole_view=self._whole_view)
        self.panel = BrowserPanel(client, shown, nullcontext(), nullcontext(), ["Picture"])
        self.panel.update()

    def _whole_view(self, aspect: float, covered: float) -> PageCamera:
        self.covered = covered
        return self.whole

    def _dropdown(self, label: str, options: Any, initial_value: str, **_: object) -> Any:
        self.choice = SimpleNamespace(value=initial_value, options=options, on_update=lambda call: None)
        return self.choice

    def tells(self, place: NDArray[np.float64]) -> None:
        self._camera.position = place
        self._tell(None)

    def grows(self) -> None:
        self.whole = PageCamera(SECOND, np.zeros(3), UP)
        self.panel.update()


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    now = SimpleNamespace(s=100.0)
    monkeypatch.setattr(browser_panel.time, "monotonic", lambda: now.s)
    return now


def test_a_slow_browser_that_tells_an_older_place_keeps_its_camera(clock: SimpleNamespace) -> None:
    browser = Browser()
    browser.grows()
    clock.s += 5
    browser.tells(FIRST)  # where the page had it before
    assert browser.choice.value == WHOLE
    browser.tells(SECOND)
    assert browser.choice.value == WHOLE


def test_a_camera_that_is_turned_away_is_moved_there_again(clock: SimpleNamespace) -> None:
    """The up direction and the camera's place reach a browser in either order: the one turns the other."""
    browser = Browser()
    browser.tells(np.array((0.0, -5, 0)))
    clock.s += 0.3
    browser.panel.update()
    assert browser._camera.position is not FIRST, "it may be on its way"
    clock.s += 1
    browser.panel.update()
    assert browser._camera.position is FIRST
    browser.tells(FIRST)
    browser._camera.position = SECOND
    clock.s += 5
    browser.panel.update()
    assert browser._camera.position is SECOND, "it has been there"
    assert browser.choice.value == WHOLE


def test_a_camera_that_leaves_its_place_is_moved_by_hand(clock: SimpleNamespace) -> None:
    browser = Browser()
    browser.tells(FIRST + 0.01)
    clock.s += 0.1
    browser.tells(FIRST + 1)
    assert browser.choice.value == BY_HAND
    browser.grows()
    assert browser._camera.position is not SECOND


def test_a_camera_that_never_comes_to_its_place_is_moved_by_hand(clock: SimpleNamespace) -> None:
    browser = Browser()
    clock.s += 60
    browser.tells(SECOND)
    assert browser.choice.value == BY_HAND


@pytest.mark.parametrize(("width", "height", "covered"), [(390, 844, 0.5), (640, 540, 0.0), (844, 390, 0.0)])
def test_only_a_phone_s_panel_covers_the_map(width: int, height: int, covered: float) -> None:
    """However many pixels a browser draws: three for a point, or fewer where it is slow."""
    browser = Browser()
    browser._camera.aspect = width / height
    browser.panel.update()
    assert browser.covered == covered
