# SPDX-License-Identifier: MIT
"""A live page in a real browser: its pixels, through a correction and restarts of server and page."""

import re
import signal
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest
from headless_browser import Browser, browser
from keyframes_and_servers import DEADLINE, lasting_address, pose, serving, wall
from live_pages import address_of, ended, viewing

from tsfusion import Client

RED, GREEN, MAGENTA = (230, 20, 20), (20, 200, 20), (200, 20, 200)  # none is of the page itself
TOKEN = {"TSFUSION_TOKEN": "open-sesame"}
SIZE = {"width": 960, "height": 540}
# Of three.js inside viser; and a browser's own words about a server that is away.
_HARMLESS = re.compile(r"THREE\.Clock: This module has been|ERR_CONNECTION|WebSocket connection to")


def painted(x: float, color: tuple[int, int, int]) -> Any:
    """A wall of one colour, a good metre in front of a camera at x."""
    keyframe = wall(T_world_camera=pose(x))
    assert keyframe.color is not None
    keyframe.color[:] = color[::-1]
    return keyframe


class Seen:
    """The pixels of a page."""

    def __init__(self, page: Browser) -> None:
        self._page = page

    def where(self, color: tuple[int, int, int]) -> np.ndarray:
        """(n, 2) row and column of the pixels that have about this hue."""
        picture = cv2.imdecode(np.frombuffer(self._page.screenshot(), np.uint8), cv2.IMREAD_COLOR)
        hues, wanted = (cv2.cvtColor(one, cv2.COLOR_BGR2HSV) for one in (picture, np.uint8([[color[::-1]]])))
        distance = np.abs(hues[..., 0].astype(int) - int(wanted[0, 0, 0]))
        near = (np.minimum(distance, 180 - distance) < 12) & (hues[..., 1] > 120)
        return np.argwhere(near & (hues[..., 2] > 40))

    def until(self, reached: Callable[[], Any]) -> None:
        end = time.monotonic() + DEADLINE
        while not reached():
            assert time.monotonic() < end, (self._page.evaluate("document.body.innerText"), self._page.errors)
            time.sleep(0.2)

    def is_left(self, color: tuple[int, int, int], other: tuple[int, int, int]) -> bool | None:
        """Whether one colour is left of another; None = not both are shown."""
        a, b = self.where(color), self.where(other)
        return bool(a[:, 1].mean() < b[:, 1].mean()) if len(a) and len(b) else None

    def shows(self, color: tuple[int, int, int]) -> bool:
        return len(self.where(color)) > 4000  # the red axis of a scanner has up to 1700


@pytest.mark.nightly  # a browser that draws in software beside other tests may miss the deadline
def test_a_page_follows_its_map_whatever_happens(tmp_path: Path) -> None:
    address, state = lasting_address(), tmp_path / "state"
    with ExitStack() as stack, browser() as page:
        server = stack.enter_context(serving(state, listen=address))
        viewer = stack.enter_context(viewing(address, "--listen", "127.0.0.1:0", **TOKEN))
        url = address_of(viewer)
        place = urlsplit(url).netloc
        page.call("Emulation.setFocusEmulationEnabled", enabled=True)  # else it does not connect again
        page.open(url, **SIZE)
        seen = Seen(page)
        client = stack.enter_context(Client(address, spool=tmp_path / "spool"))

        red = client.send(painted(0.0, RED))
        assert red is not None
        seen.until(lambda: seen.shows(RED))
        assert not seen.shows(GREEN)
        client.send(painted(1.2, GREEN))
        seen.until(lambda: seen.shows(RED) and seen.shows(GREEN))
        before = seen.is_left(RED, GREEN)
        client.correct({red: pose(2.4)})
        seen.until(lambda: seen.is_left(RED, GREEN) is (not before))

        server.kill()
        stack.enter_context(serving(state, listen=address))
        client.send(painted(3.6, MAGENTA))
        seen.until(lambda: seen.shows(MAGENTA) and seen.shows(GREEN) and seen.shows(RED))

        assert ended(viewer, signal.SIGTERM)[0] == 0
        viewer = stack.enter_context(viewing(address, "--listen", place, **TOKEN))
        assert address_of(viewer) == url
        client.correct({}, removed=[red])
        seen.until(lambda: seen.shows(MAGENTA) and seen.shows(GREEN) and not seen.shows(RED))
        assert ended(viewer, signal.SIGINT)[::2] == (0, "")

        own = (f"http://{place}/", f"ws://{place}", f"blob:http://{place}/", "data:")
        assert not {one for one in page.requests if not one.startswith(own)}
        assert not [one for one in page.errors if not _HARMLESS.search(one)]
