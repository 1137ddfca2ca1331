# SPDX-License-Identifier: MIT
"""The page in a real browser: what is fused is seen, in its colours, and follows what browsers ask for."""

import logging
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
import pytest
from growing_maps import GrowingMap, surface_update
from headless_browser import Browser, browser
from reading_browser import ReadingBrowser

from tsfusion import Intrinsics, Keyframe, Volume
from tsfusion.geometry.trajectory import quaternion
from tsfusion.viewer.page.page_server import PageServer
from tsfusion.wire.asking.followed_map import LinkSeen

pytest.importorskip("viser", reason="the page is viser's (pip install 'tsfusion[viewer]')")

from tsfusion.viewer.live_page import LivePage
from tsfusion.viewer.page.page_server import calm
from tsfusion.viewer.panels import browser_panel

DEADLINE = 60.0
CAMERA = Intrinsics(160.0, 160.0, 119.5, 89.5)
SHAPE = (180, 240)
PATCHES = np.array([  # RGB: wood, brick, leaf, sky, skin, shadow
    [(181, 140, 90), (150, 60, 45), (70, 120, 50)],
    [(120, 170, 220), (215, 175, 150), (45, 42, 48)],
])  # fmt: skip
VIEWS = (1.8, 0.9, 0.0)  # the last sees what the pictures show
OWN_WARNING = "THREE.Clock"  # of the viewer's own libraries
FORWARD = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # of a camera that looks along +x, up is +z


def wall(y: float, *, red: bool = False) -> Keyframe:
    """A wall of patches two metres in front of a camera that is `y` metres to its left."""
    v, u = np.mgrid[: SHAPE[0], : SHAPE[1]]
    across = (u - CAMERA.cx) / CAMERA.fx * 2 - y  # metres to the right, on the wall
    column = np.clip(np.floor(across / 0.8 + 1.5), 0, 2).astype(int)
    color = PATCHES[(v >= SHAPE[0] // 2).astype(int), column].astype(np.uint8)
    if red:
        color[:] = (170, 40, 40)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = FORWARD, (0, y, 0)
    depth = np.full(SHAPE, 2000, np.uint16)
    return Keyframe(depth=depth, color=color[..., ::-1].copy(), intrinsics=CAMERA, T_world_camera=T)


@dataclass
class Shown:
    """A page, its feed, and the browser that has it open."""

    page: LivePage
    feed: GrowingMap
    browser: Browser
    url: str

    @property
    def client(self) -> Any:
        until(lambda: bool(self.page._server.get_clients()))
        return next(iter(self.page._server.get_clients().values()))

    def picture(self) -> np.ndarray:
        """(h, w, 4) RGBA of the wall, from where it was seen."""
        wxyz = np.roll(quaternion(FORWARD), 1)
        fov = 2 * np.arctan(SHAPE[0] / 2 / CAMERA.fy)
        found: np.ndarray = self.client.get_render(
            *SHAPE, wxyz=wxyz, position=(0.0, 0, 0), fov=fov, transport_format="png", timeout=DEADLINE
        )
        return found

    def pixels(self) -> int:
        """Number of pixels that show something."""
        return int((self.picture()[..., 3] > 0).sum())

    def press(self, x: float, y: float) -> None:
        for what in ("mousePressed", "mouseReleased"):
            self.browser.call(
                "Input.dispatchMouseEvent", type=what, x=x, y=y, button="left", clickCount=1, buttons=1
            )

    def click(self, label: str, kind: str) -> None:
        found = f"[...document.querySelectorAll('{kind}')].find(one => one.innerText.trim() == '{label}')"
        self.browser.wait(f"!!{found}")
        self.browser.evaluate(f"{found}.scrollIntoView()")
        box = f"(b => [b.x + b.width / 2, b.y + b.height / 2])({found}.getBoundingClientRect())"
        self.press(*self.browser.evaluate(box))

    def control(self, label: str) -> Any:
        """A control of the panel by its label."""
        panel = next(iter(self.page._browsers.values()))
        guis = (self.page._server.gui, panel._client.gui)
        found = [one for gui in guis for one in gui._gui_input_handle_from_uuid.values()]
        return next(one for one in found if getattr(one, "label", "") == label)


def until(condition: Callable[[], Any]) -> None:
    end = time.monotonic() + DEADLINE
    while not condition():
        assert time.monotonic() < end, "never so"
        time.sleep(0.05)


@pytest.fixture(scope="module")
def shown() -> Iterator[Shown]:
    volume = Volume(voxel_size=0.04, threads=2)
    with browser() as page_of_browser:
        served = PageServer()
        feed = GrowingMap(volume, map(wall, VIEWS), map_name="wall")
        page = LivePage(served.server, feed, measures={"Depth [m]": lambda points: points[:, 0]})
        stop = threading.Event()
        thread = threading.Thread(target=page.run, args=(stop,))
        thread.start()
        try:
            page_of_browser.open(served.url, width=640, height=400)
            yield Shown(page, feed, page_of_browser, served.url)
        finally:
            stop.set()
            thread.join(DEADLINE)
            served.close()
            assert not thread.is_alive()
            assert not served.refused, "a message of the real page"


@pytest.fixture
def whole(shown: Shown) -> Shown:
    """The page with all of the wall and nothing else, whichever of these tests a process runs first."""
    while not shown.feed.is_whole:
        shown.feed.grow()
    until(lambda: shown.page._browsers and shown.pixels() > 0.8 * SHAPE[0] * SHAPE[1])
    for what in ("Scanners", "Paths"):
        shown.control(what).value = False
    return shown


def test_the_mesh_appears_and_grows(shown: Shown) -> None:
    assert shown.pixels() == 0
    counts = [0]
    for _ in range(3):
        shown.feed.grow()
        until(lambda: shown.pixels() > counts[-1] + 100)
        counts.append(shown.pixels())


def test_it_has_the_colours_that_were_seen(whole: Shown) -> None:
    def errors() -> np.ndarray:
        picture = whole.picture()[..., :3].astype(int)
        places = [(row, column) for row in (45, 135) for column in (56, 120, 184)]
        means = [picture[r - 3 : r + 4, c - 3 : c + 4].mean(axis=(0, 1)) for r, c in places]
        return np.abs(np.reshape(means, PATCHES.shape) - PATCHES)

    until(lambda: errors().max() < 8)


def test_corrected_cells_take_the_place_of_others(whole: Shown) -> None:
    volume = whole.feed.volume
    for y in VIEWS:
        volume.retract(wall(y))
        volume.integrate(wall(y, red=True))
    cells = volume.cells_to_mesh(volume.take_dirty())
    whole.feed.tell(surface_update(volume, cells, None))
    until(lambda: abs(whole.picture()[90, 30:210, :3].astype(int) - (170, 40, 40)).max() < 8)


def test_a_plane_cuts_the_wall(whole: Shown) -> None:
    pixels = whole.pixels()
    plane, at = whole.control("Cut at"), whole.control("Metres")
    plane.value = "z"
    until(lambda: not at.disabled)
    at.value = 0.0
    until(lambda: 0.3 * pixels < whole.pixels() < 0.7 * pixels)
    assert not (whole.picture()[: SHAPE[0] // 2 - 8, :, 3] > 0).any()
    plane.value = "none"
    until(lambda: whole.pixels() == pixels)


def test_colours_by_numbers_have_a_legend(whole: Shown) -> None:
    before = whole.picture()
    whole.control("Colour").value = "Depth [m]"
    panel = next(iter(whole.page._browsers.values()))
    until(lambda: "Depth" in panel._legend.content)
    until(lambda: np.abs(whole.picture()[..., :3].astype(int) - before[..., :3]).max() > 50)
    whole.browser.wait("document.body.innerText.includes('Depth')")
    whole.control("Colour").value = "Picture"


def test_a_browser_cuts_and_colours_for_itself_alone(whole: Shown) -> None:
    pixels, before = whole.pixels(), whole.picture()
    other = ReadingBrowser(whole.url)
    try:
        until(lambda: len(whole.page._browsers) == 2)
        own, theirs = whole.page._browsers.values()
        until(lambda: theirs._clipping._low[2] < 0)  # fitted to the map
        theirs._clipping._plane.value = "z"
        theirs._clipping._at.value = 0.0
        theirs._mode.value = "Height"
        until(lambda: theirs.own is not None and theirs._legend.visible)
        until(lambda: theirs.own is not None and theirs.own._cover is not None)
        up = [np.array((0.0, 0, 0)), np.array((2.0, 0, 0.3))]
        assert whole.page.hit(own._look, *up) is not None
        assert whole.page.hit(theirs._look, *up) is None, "cut away"
        assert (whole.pixels(), own.own, own._legend.visible) == (pixels, None, False)
        np.testing.assert_array_equal(whole.picture(), before)
        assert len(whole.page.shown_mesh(theirs._look).faces) < len(whole.page.shown_mesh(own._look).faces)
        theirs._clipping._plane.value, theirs._mode.value = "none", "Picture"
        until(lambda: theirs.own is None)
    finally:
        assert other.close() > 0
    until(lambda: len(whole.page._browsers) == 1)


def test_two_clicks_measure_a_distance(whole: Shown) -> None:
    panel = next(iter(whole.page._browsers.values()))
    panel._toggle_measuring()
    middle = {"origin": np.array((0.0, 0, 0)), "direction": np.array((2.0, 0.5, 0))}
    for direction in ((2.0, 0.5, 0), (2.0, -0.25, 0)):
        panel._click(type("Click", (), {"ray_origin": middle["origin"], "ray_direction": direction}))
    whole.browser.wait("document.body.innerText.includes('75.0 cm')")
    panel._toggle_measuring()
    assert panel._answer.visible is False


def test_what_a_person_does_in_the_page_gets_through(whole: Shown) -> None:
    """Boxes, choices, buttons, sliders and clicks of the real page are messages that the page takes."""

    click, press = whole.click, whole.press
    click("Dark", "label")
    until(lambda: whole.control("Dark").value)
    panel = next(iter(whole.page._browsers.values()))
    click("Measure a distance", "button")
    until(lambda: panel._is_measuring)
    until(lambda: (press(160, 200), bool(panel._points))[1])
    click("End measuring", "button")
    until(lambda: not panel._is_measuring)


def test_pictures_and_models_are_saved(whole: Shown, monkeypatch: pytest.MonkeyPatch) -> None:
    panel, files = next(iter(whole.page._browsers.values())), {}

    def save(name: str, content: bytes, **_: Any) -> None:
        files[name.rsplit(".", maxsplit=1)[-1]] = content

    monkeypatch.setattr(panel._client, "send_file_download", save)
    monkeypatch.setattr(browser_panel, "_RENDER", 2 * DEADLINE)  # other processes may have the cores
    panel._save_picture()
    panel._save_model()
    picture = cv2.imdecode(np.frombuffer(files["png"], np.uint8), cv2.IMREAD_UNCHANGED)
    camera = panel._client.camera
    assert picture.shape == (camera.image_height, camera.image_width, 3)
    import trimesh

    model = trimesh.load(trimesh.util.wrap_as_stream(files["glb"]), file_type="glb", force="mesh")
    assert len(model.faces) == whole.page._tiles.triangles
    assert abs(model.bounds[1][1] - model.bounds[0][1] - 2.1) < 0.3, "y is up"


def test_problems_are_told_in_words(whole: Shown) -> None:
    whole.feed.tell(LinkSeen("the server does not answer <for> 3 s"))
    whole.browser.wait("document.body.innerText.includes('the server does not answer <for> 3 s')")
    whole.feed.tell(LinkSeen(""))
    whole.browser.wait("document.body.innerText.includes('connected')")


def test_the_page_has_the_map_s_name_and_every_control_one(whole: Shown) -> None:
    whole.browser.wait("document.title == 'wall'")
    controls = "[...document.querySelectorAll('button, input, [role=slider]')]"
    named = (
        "one.labels?.length || one.ariaLabel || one.innerText?.trim() || one.getAttribute('aria-labelledby')"
    )
    assert whole.browser.evaluate(f"{controls}.length") > 8
    assert whole.browser.evaluate(f"{controls}.filter(one => !({named})).map(one => one.outerHTML)") == []


def test_arrow_keys_in_a_slider_do_not_turn_the_camera(whole: Shown) -> None:
    slider = "[...document.querySelectorAll('[role=slider]')].find(one => one.ariaLabel == 'Metres')"
    whole.click("Cut", "[role=tab]")
    whole.browser.wait(f"!!{slider}")
    whole.control("Only inside a box").value = True
    thumb = "document.querySelector('.multi-slider-thumb')"
    whole.browser.wait(f"!!{thumb}")
    whole.browser.evaluate(
        "document.addEventListener('keydown', event => (window.heard ??= []).push(event.code))"
    )
    for place, key in ((slider, "ArrowUp"), (thumb, "ArrowLeft"), ("", "ArrowDown")):
        whole.browser.evaluate(f"{place}.focus()" if place == slider else "document.activeElement.blur()")
        if place == thumb:
            whole.press(
                *whole.browser.evaluate(f"(b => [b.x + 2, b.y + 2])({thumb}.getBoundingClientRect())")
            )
        for what in ("rawKeyDown", "keyUp"):
            whole.browser.call("Input.dispatchKeyEvent", type=what, key=key, code=key)
    whole.control("Only inside a box").value = False
    whole.click("View", "[role=tab]")
    assert whole.browser.evaluate("window.heard") == ["ArrowDown"], "viser's camera listens there"


def test_an_ended_run_is_said(whole: Shown) -> None:
    whole.page.tell_end("the run has ended; its map is seen again with: tsfusion view out/kitchen")
    whole.browser.wait("document.body.innerText.includes('tsfusion view out/kitchen')")
    whole.feed.tell(LinkSeen(""))


def test_a_browser_that_leaves_amid_a_picture_ends_nothing(
    whole: Shown, caplog: pytest.LogCaptureFixture
) -> None:
    panel = next(iter(whole.page._browsers.values()))
    save = calm(lambda event: [panel._save_picture() for _ in range(20)])
    with caplog.at_level(logging.WARNING):
        saving = threading.Thread(target=save, args=(None,))
        saving.start()
        whole.browser.call("Page.navigate", url="about:blank")
        saving.join(DEADLINE)
    assert not saving.is_alive()
    assert "a request of a browser failed" in caplog.text
    until(lambda: not whole.page._browsers)
    assert "Traceback" not in caplog.text
    whole.browser.open(whole.url, width=640, height=400)
    until(lambda: whole.page._browsers)
    until(lambda: whole.pixels() > 0.8 * SHAPE[0] * SHAPE[1])  # a late browser gets everything


def test_nothing_foreign_is_asked_for_and_no_error_is_shown(whole: Shown) -> None:
    own = (whole.url, "data:", f"blob:{whole.url}", "about:blank")
    assert not [one for one in whole.browser.requests if not one.startswith(own)]
    assert not [one for one in whole.browser.errors if OWN_WARNING not in one]
