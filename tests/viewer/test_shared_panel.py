# SPDX-License-Identifier: MIT
"""Choices of browsers reach the feed in the page's thread, once, and only what there is to choose."""

from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any

import pytest
from growing_maps import GrowingMap

from tsfusion import Volume
from tsfusion.viewer.map_feed import TimeLine
from tsfusion.viewer.page.page_server import PageServer
from tsfusion.viewer.panels.shared_panel import SharedPanel

pytest.importorskip("viser", reason="the page is viser's (pip install 'tsfusion[viewer]')")


class TwoMaps(GrowingMap):
    """A feed with two maps and a past."""

    time_line = TimeLine(40)

    def maps(self) -> list[str]:
        return ["attic", "cellar"]


@pytest.fixture(scope="module")
def panel() -> Iterator[SharedPanel]:
    served = PageServer()
    feed = TwoMaps(Volume(voxel_size=0.1, threads=1), [])
    found = SharedPanel(served.server.gui, feed, lambda what, wanted: None)
    tell(found, "attic")
    yield found
    served.close()


def tell(panel: SharedPanel, map_name: str) -> None:
    panel.tell(map_name=map_name, problem="", facts=[], health=None, sessions=[])


def event(control: Any, value: Any, client: object = "a browser") -> Any:
    return SimpleNamespace(target=SimpleNamespace(value=value, control=control), client=client)


def test_a_map_is_chosen_once_and_stays_chosen_until_it_comes(panel: SharedPanel) -> None:
    panel._map.value = "cellar"
    panel._note_map(event(panel._map, "cellar"))
    assert panel.take_orders(0.0, 0.25).map_name == "cellar"
    tell(panel, "attic")
    assert panel._map.value == "cellar", "what was chosen is under way"
    assert panel.take_orders(0.0, 0.25).map_name is None
    tell(panel, "cellar")
    tell(panel, "attic")
    assert panel._map.value == "attic", "the feed shows another one"
    panel._note_map(event(panel._map, "no such map"))
    panel._note_map(event(panel._map, "cellar", client=None))
    assert panel.take_orders(0.0, 0.25).map_name is None


def test_the_past_is_asked_for_once_the_slider_rests(panel: SharedPanel) -> None:
    assert panel._time.visible
    assert (panel._time.max, panel._time.value) == (40, 40)
    for place in (30, 20, 10):
        panel._note_place(event(panel._time, place))
    moved = panel._slid_at
    assert panel.take_orders(moved + 0.1, 0.25).place is None
    assert panel.take_orders(moved + 0.3, 0.25).place == 10
    assert panel.take_orders(moved + 0.6, 0.25).place is None
    panel._note_place(event(panel._time, 40, client=None))
    assert panel.take_orders(moved + 9, 0.25).place is None, "moved by the page itself"
